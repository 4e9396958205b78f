"""Energies of many sweeps, accumulated on the device and read in groups.

If the host read the energy after each sweep, the host and the device would wait for each other up
to 700 times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from napari_hmrf.solver.backends.base import EnergyArray
from napari_hmrf.solver.backends.opengl.programs.programs import Program

#: Side of the square block of texels that one invocation of the kernel ``sum`` adds.
BLOCK = 8

#: Largest number of shares per sweep that the host adds in place of a software renderer. A software
#: renderer takes at least 30 microseconds for a pass, but reads a small image in one microsecond.
KEPT_SHARES = 2**16

# Number of sweeps between two reads by the host.
_KEPT_SWEEPS = 16

#: Function that runs a program, given its inputs, outputs, grid and first row.
Run = Callable[[Program, list[Any], list[Any], tuple[int, ...], int], None]


class Textures(Protocol):
    """Pool of textures; see `fields.Pool`."""

    def acquire(self, grid: tuple[int, ...], components: int, use: str = "pairs") -> Any:
        """Return a texture from the pool; textures for the use ``pairs`` are 0 outside tissue."""
        ...

    def recycle(
        self, grid: tuple[int, ...], components: int, texture: Any, use: str = "pairs"
    ) -> None:
        """Return a texture to the pool for later requests with the same size and use."""
        ...


class Totals(Protocol):
    """Accumulator of the energy U_total of successive sweeps."""

    def share(self) -> Any:
        """Return the texture for the energy shares of all pairs in the next sweep."""
        ...

    def add(self) -> None:
        """Add the contributions of the latest sweep to the totals."""
        ...

    def read(self) -> EnergyArray:
        """Wait for the device, return the energy of each sweep, and release the textures."""
        ...


class BlockTotals:
    """Accumulator that sums blocks of per-site contributions on the device.

    The sums of each sweep fill one strip of an atlas texture.

    Parameters
    ----------
    program : Program
        Kernel ``sum`` for blocks of `BLOCK` x `BLOCK` texels.
    run : callable
        Function that runs the program.
    textures : Textures
    wait : callable
        Function that waits for the device.
    grid : (int, int)
        Grid of shares, (rows, cols).
    sweeps : int
        Expected number of sweeps.
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
        """Return the texture for the per-site contributions of the next sweep."""
        return self._share

    def add(self) -> None:
        """Add the shares of each block, and write the sums to the next strip."""
        if self._used == self._strips:
            self._flush()
        row = self._used * self._blocks[0]
        self._run(self._program, [self._share], [self._atlas], self._blocks, row)
        self._used += 1

    def read(self) -> EnergyArray:
        """Add the block sums in double precision, and return the total of each sweep."""
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
    """Accumulator that adds shares on the host, with a separate texture for each sweep.

    Parameters
    ----------
    textures : Textures
    wait : callable
        Function that waits for the device.
    grid : (int, int)
        Grid of shares, (rows, cols).
    sweeps : int
        Expected number of sweeps.
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
        """Return the texture for the per-site contributions of the next sweep."""
        if self._used == len(self._shares):
            self._flush()
        return self._shares[self._used]

    def add(self) -> None:
        """Mark the texture of the latest sweep as used."""
        self._used += 1

    def read(self) -> EnergyArray:
        """Add the shares of each sweep, and return the totals.

        The shares of a row are added in single precision, and the rows in double precision.
        """
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
