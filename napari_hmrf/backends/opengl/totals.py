"""Energies of many sweeps, kept on the device until the last of them.

Reading after every sweep would make the host and the device wait for each other 700 times.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from napari_hmrf.backends.base import EnergyArray
from napari_hmrf.backends.opengl.programs import Program

#: Rows and columns of sites whose energies one invocation of the sum adds up.
BLOCK = 8

#: Up to this many sites a software renderer keeps the shares of every sweep, as they are: to it a
#: pass costs at least 30 microseconds and reading a small image one.
KEPT_SITES = 2**17

# How many sweeps are kept before they are read.
_KEPT_SWEEPS = 16

#: Runs a program: inputs, outputs, grid, first row.
Run = Callable[[Program, list[Any], list[Any], tuple[int, ...], int], None]


class Textures(Protocol):
    """Where textures come from and go back to; (H, W) and components."""

    def take(self, shape: tuple[int, ...], components: int, use: str = "sites") -> Any:
        """Return a texture; of ``sites`` it holds 0 where the level has no tissue."""
        ...

    def give(
        self, shape: tuple[int, ...], components: int, texture: Any, use: str = "sites"
    ) -> None:
        """Take a texture back for others of the same use."""
        ...


class Totals(Protocol):
    """U_total of one sweep after the other."""

    def share(self) -> Any:
        """The texture that the next sweep writes the sites' shares to."""
        ...

    def add(self) -> None:
        """Count what has been written."""
        ...

    def read(self) -> EnergyArray:
        """Wait for the sums, in the order they were added, and give the textures back."""
        ...


class BlockTotals:
    """The device adds up blocks of sites; the blocks of a sweep fill one strip of an atlas.

    Parameters
    ----------
    program : Program
        The kernel ``sum`` for blocks of `BLOCK`.
    run : callable
        Runs it.
    textures : Textures
    wait : callable
        Waits for the device.
    shape : (int, int)
        The level's grid.
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
        shape: tuple[int, ...],
        sweeps: int,
        largest: int,
    ) -> None:
        self._program, self._run, self._textures, self._wait = program, run, textures, wait
        self._shape = shape
        self._blocks = tuple(-(-size // BLOCK) for size in shape)
        rows, cols = self._blocks
        self._strips = max(1, min(sweeps, largest // rows))
        self._atlas_shape = (rows * self._strips, cols)
        self._atlas = textures.take(self._atlas_shape, 1, use="atlas")
        self._share = textures.take(shape, 1)
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
        self._textures.give(self._shape, 1, self._share)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._wait()
        blocks = np.frombuffer(self._atlas.read(), np.float32).reshape(self._strips, -1)
        self._energies += list(blocks[: self._used].sum(axis=1, dtype=np.float64))
        self._used = 0


class SiteTotals:
    """Every sweep has a texture of its own; the host adds the sites up.

    Parameters
    ----------
    textures : Textures
    wait : callable
        Waits for the device.
    shape : (int, int)
        The level's grid.
    sweeps : int
        How many there will be.
    """

    def __init__(
        self, textures: Textures, wait: Callable[[], None], shape: tuple[int, ...], sweeps: int
    ) -> None:
        self._textures, self._wait, self._shape = textures, wait, shape
        self._shares = [textures.take(shape, 1) for _ in range(max(1, min(sweeps, _KEPT_SWEEPS)))]
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
        """Add the sites of a row up, and the rows in double precision."""
        self._flush()
        for share in reversed(self._shares):
            self._textures.give(self._shape, 1, share)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._wait()
        for share in self._shares[: self._used]:
            rows = np.frombuffer(share.read(), np.float32).reshape(self._shape).sum(axis=1)
            self._energies.append(float(rows.sum(dtype=np.float64)))
        self._used = 0
