"""Texels of a grid that a pass runs on: a rectangle, or the work groups that hold tissue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.opengl.programs.source import GROUP

# Most work groups in a row of their list.
_ACROSS = 256


class Window(NamedTuple):
    """A rectangle of a grid's texels: rows ``top`` to ``bottom``, columns ``left`` to ``right``."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.bottom - self.top, self.right - self.left

    def strip(self, begin: int, end: int) -> Window:
        """Return some of its rows, counted from its top."""
        return self._replace(top=self.top + begin, bottom=self.top + end)


class Groups(NamedTuple):
    """Work groups of a compute shader, by their places in a list.

    Attributes
    ----------
    places : moderngl.Texture
        (col, row) of each group, counted in groups; no texel is without one.
    grid : (int, int)
        How many (rows, cols) of texels there are to be run.
    top, bottom : int
        The rows of the list to run.
    """

    places: Any
    grid: tuple[int, int]
    top: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows, and of texels in each."""
        return self.bottom - self.top, self.places.width * GROUP[0] * GROUP[1]

    def strip(self, begin: int, end: int) -> Groups:
        """Return some of its rows, counted from its top."""
        return self._replace(top=self.top + begin, bottom=self.top + end)


@dataclass(frozen=True, eq=False)
class Tissue:
    """Region of a level with tissue, for passes that need not run anywhere else.

    Attributes
    ----------
    region : Window or Groups
        The rectangle around all of it (fragment stage), or the work groups that have some.
    mask : moderngl.Texture or None
        For the fragment stage: a depth image, 1 where a pair has tissue and 0 elsewhere
        (``triangle.glsl``).
    """

    region: Window | Groups
    mask: Any = None


def window_around(shown: npt.NDArray[np.bool_]) -> Window:
    """Return the smallest window that holds all that is shown."""
    rows, cols = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return Window(0, 0, 1, 1)
    return Window(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1)


def groups_with(shown: npt.NDArray[np.bool_]) -> FloatArray:
    """List the work groups that hold something shown: (col, row), shape (rows, cols, 2)."""
    (rows, cols), (height, width) = shown.shape, GROUP
    filled = np.pad(shown, ((0, -rows % height), (0, -cols % width)))
    used = filled.reshape(filled.shape[0] // height, height, -1, width).any(axis=(1, 3))
    places = np.argwhere(used)[:, ::-1].astype(np.float32)
    lines = max(1, -(-len(places) // _ACROSS))
    across = max(1, -(-len(places) // lines))
    # The last line is filled up with groups that are there already, which does no harm.
    return np.resize(places, (lines, across, 2))
