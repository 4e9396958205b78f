"""Energies of many sweeps, which stay on the device until the last sweep.

A read after each sweep would make the host and the device wait for each other up to 700 times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from napari_hmrf.solver.backends.base import EnergyArray
from napari_hmrf.solver.backends.opengl.programs.programs import Program

#: Rows and columns of shares that one invocation of the sum adds.
BLOCK = 8

#: Largest number of shares that a software renderer stores for each sweep without adding them: a
#: pass takes at least 30 microseconds there, but reading a small image takes one microsecond.
KEPT_SHARES = 2**16

# Number of sweeps that are stored before they are read.
_KEPT_SWEEPS = 16

#: Function that runs a program, given inputs, outputs, grid and first row.
Run = Callable[[Program, list[Any], list[Any], tuple[int, ...], int], None]


class Textures(Protocol):
    """Pool of textures; see `fields.Pool`."""

    def acquire(self, grid: tuple[int, ...], components: int, use: str = "pairs") -> Any:
        """Return a texture; for the use ``pairs`` it is 0 outside tissue."""
        ...

    def recycle(
        self, grid: tuple[int, ...], components: int, texture: Any, use: str = "pairs"
    ) -> None:
        """Return a texture to the pool, for later requests with the same size and use."""
        ...


class Totals(Protocol):
    """Collector of U_total over successive sweeps."""

    def share(self) -> Any:
        """Return the texture for the next sweep's energy of each pair of sites."""
        ...

    def add(self) -> None:
        """Add the shares of the sweep that has been run."""
        ...

    def read(self) -> EnergyArray:
        """Wait for the sums and return them in the order of sweeps; release the textures."""
        ...


class BlockTotals:
    """Totals of blocks, which the device adds; each sweep fills one strip of an atlas texture.

    Parameters
    ----------
    program : Program
        Kernel ``sum`` for blocks of `BLOCK`.
    run : callable
        Runs the program.
    textures : Textures
    wait : callable
        Waits for the device.
    grid : (int, int)
        Number of (rows, cols) of shares.
    sweeps : int
        Number of sweeps that will follow.
    largest : int
        Largest number of rows of a texture.
    """

    def __init__(
        self,
        program: Program,
        run: Run,
        textures: Textures,
        wait: Callable[[], None],
        grid: tuple[int, ...],
        sweeps: int,
        largest: int,
    ) -> None:
        self._program, self._run, self._textures, self._wait = program, run, textures, wait
        self._grid = grid
        self._blocks = tuple(-(-size // BLOCK) for size in grid)
        rows, cols = self._blocks
        self._strips = max(1, min(sweeps, largest // rows))
        self._atlas_shape = (rows * self._strips, cols)
        self._atlas = textures.acquire(self._atlas_shape, 1, use="atlas")
        self._share = textures.acquire(grid, 1)
        self._used = 0
        self._energies: list[float] = []

    def share(self) -> Any:
        """Return the texture for the shares of the next sweep."""
        return self._share

    def add(self) -> None:
        """Add the shares of each block, and write the sums to the next strip."""
        if self._used == self._strips:
            self._flush()
        row = self._used * self._blocks[0]
        self._run(self._program, [self._share], [self._atlas], self._blocks, row)
        self._used += 1

    def read(self) -> EnergyArray:
        """Add the sums of blocks in double precision; return the total of each sweep."""
        self._flush()
        self._textures.recycle(self._atlas_shape, 1, self._atlas, use="atlas")
        self._textures.recycle(self._grid, 1, self._share)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._wait()
        blocks = np.frombuffer(self._atlas.read(), np.float32).reshape(self._strips, -1)
        self._energies += list(blocks[: self._used].sum(axis=1, dtype=np.float64))
        self._used = 0


class PairTotals:
    """Totals of shares, which the host adds; each sweep has a texture of its own.

    Parameters
    ----------
    textures : Textures
    wait : callable
        Waits for the device.
    grid : (int, int)
        Number of (rows, cols) of shares.
    sweeps : int
        Number of sweeps that will follow.
    """

    def __init__(
        self, textures: Textures, wait: Callable[[], None], grid: tuple[int, ...], sweeps: int
    ) -> None:
        self._textures, self._wait, self._grid = textures, wait, grid
        kept = max(1, min(sweeps, _KEPT_SWEEPS))
        self._shares = [textures.acquire(grid, 1) for _ in range(kept)]
        self._read = np.empty((kept, *grid), np.float32)
        self._used = 0
        self._energies: list[float] = []

    def share(self) -> Any:
        """Return the texture for the shares of the next sweep."""
        if self._used == len(self._shares):
            self._flush()
        return self._shares[self._used]

    def add(self) -> None:
        """Mark the present texture as used."""
        self._used += 1

    def read(self) -> EnergyArray:
        """Add the shares of each row, and the rows in double precision; return the totals."""
        self._flush()
        for share in reversed(self._shares):
            self._textures.recycle(self._grid, 1, share)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._wait()
        for sweep in range(self._used):
            self._shares[sweep].read_into(self._read, write_offset=sweep * self._read[0].nbytes)
        rows = self._read[: self._used].sum(axis=2)
        self._energies += rows.sum(axis=1, dtype=np.float64).tolist()
        self._used = 0
