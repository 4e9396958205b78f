"""Layouts of a level's vectors in memory: whole planes, or only the rows of tissue.

A processor reads memory ahead of the loops. If a row of tissue is followed by void, it reads the
void as well: in rows of 130 to 200 sites, copying the middle half of each row takes as long as
copying whole rows. Large levels with much void therefore store only the tissue of each padded row,
with a border of one site, one row after another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import vectors
from napari_hmrf.solver.backends.cpu.transfer import PAD

Table = npt.NDArray[np.int64]
Values = npt.NDArray[Any]

# Number of values per line of a vector, for loops that visit all values in any order.
_LINE = 512
# Smallest number of stored sites, by number of axes, for which void is left out. The sites of a
# smaller level remain in a fast cache.
_FEW = {2: 16384, 3: 4096}
# Largest number of stored sites, as a fraction of the grid with a border of one site, for which
# void is left out.
_FULL = 0.85


@dataclass(frozen=True, eq=False)
class Layout:
    """Places of the sites of one level in its vectors.

    Attributes
    ----------
    planes : tuple of int
        Shape of the padded grid, (H + 4, W + 4) or (D + 4, H + 4, W + 4).
    starts : ndarray, shape (H + 4,) or (D + 4, H + 4)
        Index of column 0 of each padded row in a vector. It may be negative if that column is not
        stored.
    stored : ndarray, shape (H + 4, 2) or (D + 4, H + 4, 2)
        Start and stop column of the stored sites of each padded row.
    tissue : ndarray, shape (H + 4, 2) or (D + 4, H + 4, 2)
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
        *lines, width = planes
        starts = width * np.arange(math.prod(lines), dtype=np.int64).reshape(lines)
        stored, tissue = np.zeros((2, *lines, 2), dtype=np.int64)
        stored[..., 1] = width
        inside = (slice(PAD, -PAD),) * len(lines)
        tissue[(*inside, 1)] = width - 2 * PAD
        return cls(planes, starts, stored, tissue, planes)

    @classmethod
    def of_tissue(cls, shear: Values, whole: bool) -> Self:
        """Return the layout of a level with the given elements.

        Parameters
        ----------
        shear : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
            Shear modulus of the elements; 0 in void.
        whole : bool
            True to store all sites.
        """
        planes = shear.shape
        if whole:
            return cls.whole(planes)
        _load_loops()
        tissue = tissue_spans(shear)
        begin, past = (each + PAD for each in np.moveaxis(tissue, -1, 0))
        begin, past = _joined(begin - 1, past + 1, tissue[..., 1] > tissue[..., 0], (-1, 0, 1))
        stored = np.stack((begin, past), axis=-1)
        lengths = past - begin
        total = int(lengths.sum())
        most = _FULL * math.prod(size - PAD for size in planes)
        if not _FEW[len(planes)] <= total <= most:
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

    @cached_property
    def rows(self) -> tuple[Table, Table, Table]:
        """Tables `starts`, `stored` and `tissue` with a single axis for all padded rows."""
        return self.starts.ravel(), self.stored.reshape(-1, 2), self.tissue.reshape(-1, 2)

    def vector(self, components: int | None = None, dtype: Any = np.float32) -> Values:
        """Return a vector of zeros; by default, with a component for each axis."""
        count = len(self.planes) if components is None else components
        return np.zeros((count, *self.shape), dtype=dtype)

    def packed(self, values: Values) -> Values:
        """Return planes in this layout; the planes themselves if all sites are stored."""
        if self.is_whole:
            return values
        out = self.vector(len(values), values.dtype)
        starts, stored, _ = self.rows
        vectors.copy_rows(flat(values), whole_rows(self.planes)[0], flat(out), starts, stored)
        return out

    def unpacked(self, vector: Values) -> Values:
        """Return a vector as planes; the vector itself if all sites are stored."""
        if self.is_whole:
            return vector
        out = np.zeros((len(vector), *self.planes), dtype=vector.dtype)
        starts, stored, _ = self.rows
        vectors.copy_rows(flat(vector), starts, flat(out), whole_rows(self.planes)[0], stored)
        return out


@cache
def _load_loops() -> None:
    """Compile or load the loop of packing, so that trial problems prepare it, too."""
    line = np.zeros((1, 1), dtype=np.float32)
    table = np.zeros(1, dtype=np.int64)
    vectors.copy_rows(line, table, line.copy(), table, np.zeros((1, 2), dtype=np.int64))


def flat(vector: Values) -> Values:
    """Return a view of a vector with shape (C, N)."""
    return vector.reshape(len(vector), -1)


def rows(planes: Values) -> Values:
    """Return a view of planes with shape (C, R, W + 4); R counts the padded rows of all slices."""
    return planes.reshape(len(planes), -1, planes.shape[-1])


def whole_starts(planes: tuple[int, ...]) -> Table:
    """Return the table of rows of planes with the given shape."""
    return Layout.whole(planes).starts


def whole_rows(planes: tuple[int, ...]) -> tuple[Table, Table, Table]:
    """Return the tables of planes with the given shape; see `Layout.rows`."""
    return Layout.whole(planes).rows


def tissue_spans(shear: Values) -> Table:
    """Return the start and stop column of the sites of each row that belong to an element.

    Parameters
    ----------
    shear : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
        Shear modulus of the elements; 0 in void.

    Returns
    -------
    ndarray of int, shape (H + 4, 2) or (D + 4, H + 4, 2)
        Columns, counted without the border.
    """
    spans = np.zeros((*shear.shape[:-1], 2), dtype=np.int64)
    vectors.element_spans(shear.reshape(-1, shear.shape[-1]), spans.reshape(-1, 2))
    begin, past = np.moveaxis(spans, -1, 0)
    begin, past = _joined(begin, past + 1, past > begin, (0, 1))
    return np.where((past > begin)[..., None], np.stack((begin, past), axis=-1) - PAD, 0)


def _joined(begin: Table, past: Table, full: Any, shifts: tuple[int, ...]) -> tuple[Table, Table]:
    """Return the smallest spans that contain those of neighbouring rows, given by their shifts."""
    first, last = np.where(full, begin, np.iinfo(np.int64).max), np.where(full, past, 0)
    for axis in range(begin.ndim):
        first = np.min([np.roll(first, shift, axis) for shift in shifts], axis=0)
        last = np.max([np.roll(last, shift, axis) for shift in shifts], axis=0)
    return np.where(last > 0, first, 0), last
