"""Regions of texels for passes: rectangles, or work groups that contain tissue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.opengl.programs.source import GROUP

# Largest number of work groups in one row of a list.
_ACROSS = 256


class Window(NamedTuple):
    """Rectangle of texels: rows ``top`` to ``bottom``, and columns ``left`` to ``right``.

    Both ``bottom`` and ``right`` are exclusive.
    """

    top: int
    left: int
    bottom: int
    right: int

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.bottom - self.top, self.right - self.left

    def strip(self, begin: int, end: int) -> Window:
        """Return the part of the window in rows `begin` to `end` (exclusive), relative to `top`."""
        return self._replace(top=self.top + begin, bottom=self.top + end)


class Groups(NamedTuple):
    """Listed work groups of a compute shader.

    Attributes
    ----------
    places : moderngl.Texture
        Two-dimensional list of groups: the (col, row) of each group, in units of groups.
    grid : (int, int)
        Grid of texels of the level, (rows, cols).
    top, bottom : int
        Range of list rows to run; `bottom` is exclusive.
    """

    places: Any
    grid: tuple[int, int]
    top: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Number of list rows, and number of texels in the groups of each row."""
        return self.bottom - self.top, self.places.width * GROUP[0] * GROUP[1]

    def strip(self, begin: int, end: int) -> Groups:
        """Return rows `begin` to `end` (exclusive) of the list, relative to `top`."""
        return self._replace(top=self.top + begin, bottom=self.top + end)


@dataclass(frozen=True, eq=False)
class Tissue:
    """Region of a level that contains tissue, to which passes can be limited.

    Attributes
    ----------
    region : Window or Groups
        Rectangle around all tissue (fragment stage), or work groups that contain tissue.
    mask : moderngl.Texture or None
        Depth texture for the fragment stage: 1 where a pair has tissue, otherwise 0; see
        ``triangle.glsl``.
    """

    region: Window | Groups
    mask: Any = None


def window_around(shown: npt.NDArray[np.bool_]) -> Window:
    """Return the smallest window that contains all True texels of a mask."""
    rows, cols = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return Window(0, 0, 1, 1)
    return Window(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1)


def groups_with(shown: npt.NDArray[np.bool_]) -> FloatArray:
    """List the work groups that contain True texels of a mask.

    The list has shape (rows, cols, 2) and contains the (col, row) of each group.
    """
    (rows, cols), (height, width) = shown.shape, GROUP
    filled = np.pad(shown, ((0, -rows % height), (0, -cols % width)))
    used = filled.reshape(filled.shape[0] // height, height, -1, width).any(axis=(1, 3))
    places = np.argwhere(used)[:, ::-1].astype(np.float32)
    lines = max(1, -(-len(places) // _ACROSS))
    across = max(1, -(-len(places) // lines))
    # Fill the last row with repeated groups: computing a group twice has no effect.
    return np.resize(places, (lines, across, 2))
