"""Layouts of a volume's vectors in memory: whole planes, or only the rows of tissue.

A processor reads memory ahead of the loops. If a row of tissue is followed by void, it reads the
void as well: in rows of 130 to 200 sites, copying the middle half of each row takes as long as
copying whole rows. Levels with much void therefore store only the tissue of each padded row, with a
border of one site, one row after another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import volume
from napari_hmrf.solver.backends.cpu.transfer import PAD

Table = npt.NDArray[np.int64]
Values = npt.NDArray[Any]

# Number of values per line of a vector, for loops that visit all values in any order.
_LINE = 512
# Smallest number of sites, and largest fraction of the grid with its border of one site, that are
# stored without void.
_FEW, _FULL = 4096, 0.85


@dataclass(frozen=True, eq=False)
class Layout:
    """Places of the sites of one level in its vectors.

    Attributes
    ----------
    planes : tuple of int
        Shape of the padded grid, (D + 4, H + 4, W + 4).
    starts : ndarray, shape (D + 4, H + 4)
        Index of column 0 of each padded row in a vector.
    stored : ndarray, shape (D + 4, H + 4, 2)
        Start and stop column of the stored sites of each padded row.
    tissue : ndarray, shape (D + 4, H + 4, 2)
        Start and stop column of the tissue in each row; columns are counted without the border.
    shape : tuple of int
        Shape of each component of a vector. Its first two and last two lines are never used.
    """

    planes: tuple[int, ...]
    starts: Table
    stored: Table
    tissue: Table
    shape: tuple[int, ...]

    @classmethod
    @lru_cache(maxsize=32)
    def whole(cls, planes: tuple[int, ...]) -> Self:
        """Return the layout of planes with the given shape; all columns count as tissue."""
        depth, height, width = planes
        starts = width * np.arange(depth * height, dtype=np.int64).reshape(depth, height)
        stored, tissue = np.zeros((2, depth, height, 2), dtype=np.int64)
        stored[..., 1] = width
        tissue[PAD:-PAD, PAD:-PAD, 1] = width - 2 * PAD
        return cls(planes, starts, stored, tissue, planes)

    @classmethod
    def of_tissue(cls, lame: Values, whole: bool) -> Self:
        """Return the layout of a level with the given elements.

        Parameters
        ----------
        lame : ndarray, shape (1 or 2, D + 4, H + 4, W + 4)
            Parameters of the elements; 0 in void.
        whole : bool
            True to store all sites.
        """
        planes = lame.shape[1:]
        if whole:
            return cls.whole(planes)
        tissue = _tissue_spans(lame)
        begin, past = (each + PAD for each in np.moveaxis(tissue, -1, 0))
        begin, past = _joined(begin - 1, past + 1, tissue[..., 1] > tissue[..., 0], (-1, 0, 1))
        stored = np.stack((begin, past), axis=-1)
        lengths = past - begin
        total = int(lengths.sum())
        most = _FULL * math.prod(size - PAD for size in planes)
        if not _FEW <= total <= most:
            return cls.whole(planes)
        starts = (np.cumsum(lengths) - lengths.ravel()).reshape(lengths.shape) - begin
        lines = max(1, -(-total // _LINE)) + 2 * PAD
        return cls(planes, starts + PAD * _LINE, stored, tissue, (lines, _LINE))

    @property
    def is_whole(self) -> bool:
        """True if vectors are planes."""
        return self.shape == self.planes

    def matches(self, other: Layout) -> bool:
        """Return whether another layout has the same places and the same spans of tissue."""
        return (
            self.shape == other.shape
            and np.array_equal(self.starts, other.starts)
            and np.array_equal(self.tissue, other.tissue)
        )

    def vector(self, components: int = 3, dtype: Any = np.float32) -> Values:
        """Return a vector of zeros."""
        return np.zeros((components, *self.shape), dtype=dtype)

    def packed(self, values: Values) -> Values:
        """Return planes in this layout; the planes themselves if all sites are stored."""
        if self.is_whole:
            return values
        out, starts = self.vector(len(values), values.dtype), Layout.whole(self.planes).starts
        volume.copy_rows(flat(values), starts, flat(out), self.starts, self.stored)
        return out

    def unpacked(self, vector: Values) -> Values:
        """Return a vector as planes; the vector itself if all sites are stored."""
        if self.is_whole:
            return vector
        out = np.zeros((len(vector), *self.planes), dtype=vector.dtype)
        starts = Layout.whole(self.planes).starts
        volume.copy_rows(flat(vector), self.starts, flat(out), starts, self.stored)
        return out


def flat(vector: Values) -> Values:
    """Return a view of a vector with shape (C, N)."""
    return vector.reshape(len(vector), -1)


def whole_starts(planes: tuple[int, ...]) -> Table:
    """Return the table of rows of planes with the given shape."""
    return Layout.whole(planes).starts


def restrict(fine: Values, of_fine: Layout, coarse: Values, of_coarse: Layout) -> None:
    """Apply the transpose of `volume.interpolate`."""
    places = of_coarse.starts, of_coarse.tissue
    volume.restrict(flat(fine), of_fine.starts, of_fine.stored, flat(coarse), *places)


def restrict_planes(fine: Values, coarse: Values) -> None:
    """Apply `restrict` to planes."""
    restrict(fine, Layout.whole(fine.shape[1:]), coarse, Layout.whole(coarse.shape[1:]))


def interpolate_planes(coarse: Values, fine: Values, inverse: Values) -> None:
    """Add the interpolated coarse correction to the components that move; all arrays are planes."""
    layout, starts = Layout.whole(fine.shape[1:]), whole_starts(coarse.shape[1:])
    arrays = flat(coarse), starts, flat(fine), layout.starts, flat(inverse)
    volume.interpolate(*arrays, layout.tissue)


def _tissue_spans(lame: Values) -> Table:
    """Return the start and stop column of the sites of each row that belong to an element."""
    spans = np.zeros((*lame.shape[1:3], 2), dtype=np.int64)
    volume.element_spans(lame, spans)
    begin, past = np.moveaxis(spans, -1, 0)
    begin, past = _joined(begin, past + 1, past > begin, (0, 1))
    return np.where((past > begin)[..., None], np.stack((begin, past), axis=-1) - PAD, 0)


def _joined(begin: Table, past: Table, full: Any, shifts: tuple[int, ...]) -> tuple[Table, Table]:
    """Return the smallest spans that contain those of neighbouring rows, given by their shifts."""
    first, last = np.where(full, begin, np.iinfo(np.int64).max), np.where(full, past, 0)
    for axis in (0, 1):
        first = np.min([np.roll(first, shift, axis) for shift in shifts], axis=0)
        last = np.max([np.roll(last, shift, axis) for shift in shifts], axis=0)
    return np.where(last > 0, first, 0), last
