"""Energies of many sweeps, kept on the device until the last of them.

Reading after every sweep would make the host and the device wait for each other 700 times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from napari_hmrf.solver.backends.base import EnergyArray
from napari_hmrf.solver.backends.opengl.programs.programs import Program

#: Rows and columns of shares that one invocation of the sum adds up.
BLOCK = 8

#: Up to this many shares a software renderer keeps those of every sweep, as they are: to it a pass
#: costs at least 30 microseconds and reading a small image one.
KEPT_SHARES = 2**16

# Number of sweeps that are kept before they are read.
_KEPT_SWEEPS = 16

#: Runs a program: inputs, outputs, grid, first row.
Run = Callable[[Program, list[Any], list[Any], tuple[int, ...], int], None]


class Textures(Protocol):
    """Pool of textures, by (rows, cols) of texels and components."""

    def take(self, grid: tuple[int, ...], components: int, use: str = "pairs") -> Any:
        """Return a texture; of ``pairs`` it holds 0 where the level has no tissue."""
        ...

    def give(
        self, grid: tuple[int, ...], components: int, texture: Any, use: str = "pairs"
    ) -> None:
        """Take a texture back for others of the same use."""
        ...


class Totals(Protocol):
    """U_total of one sweep after the other."""

    def share(self) -> Any:
        """Return the texture that the next sweep writes the shares of its pairs of sites to."""
        ...

    def add(self) -> None:
        """Count what has been written."""
        ...

    def read(self) -> EnergyArray:
        """Wait for the sums, in the order they were added, and give the textures back."""
        ...


class BlockTotals:
    """The device adds up blocks of shares; the blocks of a sweep fill one strip of an atlas.

    Parameters
    ----------
    program : Program
        The kernel ``sum`` for blocks of `BLOCK`.
    run : callable
        Runs it.
    textures : Textures
    wait : callable
        Waits for the device.
    grid : (int, int)
        How many (rows, cols) of shares there are.
    sweeps : int
        How many there will be.
    largest : int
        The most rows a texture can have.
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
        self._atlas = textures.take(self._atlas_shape, 1, use="atlas")
        self._share = textures.take(grid, 1)
        self._used = 0
        self._energies: list[float] = []

    def share(self) -> Any:
        """Return the one texture there is."""
        return self._share

    def add(self) -> None:
        """Sum the blocks into the next strip."""
        if self._used == self._strips:
            self._flush()
        row = self._used * self._blocks[0]
        self._run(self._program, [self._share], [self._atlas], self._blocks, row)
        self._used += 1

    def read(self) -> EnergyArray:
        """Add the blocks up in double precision."""
        self._flush()
        self._textures.give(self._atlas_shape, 1, self._atlas, use="atlas")
        self._textures.give(self._grid, 1, self._share)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._wait()
        blocks = np.frombuffer(self._atlas.read(), np.float32).reshape(self._strips, -1)
        self._energies += list(blocks[: self._used].sum(axis=1, dtype=np.float64))
        self._used = 0


class PairTotals:
    """Every sweep has a texture of its own; the host adds the shares up.

    Parameters
    ----------
    textures : Textures
    wait : callable
        Waits for the device.
    grid : (int, int)
        How many (rows, cols) of shares there are.
    sweeps : int
        How many there will be.
    """

    def __init__(
        self, textures: Textures, wait: Callable[[], None], grid: tuple[int, ...], sweeps: int
    ) -> None:
        self._textures, self._wait, self._grid = textures, wait, grid
        kept = max(1, min(sweeps, _KEPT_SWEEPS))
        self._shares = [textures.take(grid, 1) for _ in range(kept)]
        self._read = np.empty((kept, *grid), np.float32)
        self._used = 0
        self._energies: list[float] = []

    def share(self) -> Any:
        """Return the next texture."""
        if self._used == len(self._shares):
            self._flush()
        return self._shares[self._used]

    def add(self) -> None:
        """Keep the texture as it is."""
        self._used += 1

    def read(self) -> EnergyArray:
        """Add the shares of a row up, and the rows in double precision."""
        self._flush()
        for share in reversed(self._shares):
            self._textures.give(self._grid, 1, share)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._wait()
        for sweep in range(self._used):
            self._shares[sweep].read_into(self._read, write_offset=sweep * self._read[0].nbytes)
        rows = self._read[: self._used].sum(axis=2)
        self._energies += rows.sum(axis=1, dtype=np.float64).tolist()
        self._used = 0
