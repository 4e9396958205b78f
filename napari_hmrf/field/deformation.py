"""Local volume change, folds, grids and arrows of a displacement.

Segments and arrows are in pixels, in the order of the axes, as napari's Vectors layer takes them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import is_whole, real, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.slabs import slabs, with_neighbours
from napari_hmrf.field.warp import (
    BoolArray,
    Float64Array,
    Spacing,
    as_field,
    checked_sizes,
    moved_sites,
)
from napari_hmrf.solver.backends.compile_cache import loader, loops
from napari_hmrf.solver.backends.thread import compute_thread

FloatArray = npt.NDArray[np.float32]

# Number of rows of an image processed together, and of planes of a volume.
_STRIP, _SLAB = 64, 8
# Reductions of the determinants around a site; the loop for volumes takes their index.
_Kind = Literal["smallest", "mean", "mean or fold"]
_KINDS: tuple[_Kind, ...] = get_args(_Kind)
# Upper bound of the distance between lines, in pixels: larger than any image.
_FAR = 2**31
# Arrows shorter than this fraction of the longest are left out: they would look like dots.
_LEAST = 0.1


def magnitude(displacement: npt.ArrayLike) -> FloatArray:
    """Return the length of the displacement of each site.

    Parameters
    ----------
    displacement : array_like, shape ([D,] H, W, n)
        In the unit of `spacing`.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        In the same unit.

    Raises
    ------
    ProblemError
        If the displacement has another shape, or is not numeric.
    """
    length: FloatArray = np.linalg.norm(as_field(displacement), axis=-1).astype(np.float32)
    return length


def jacobian_determinant(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the factor of area, or volume, change around each site: det d(X + d(X)) / dX.

    1 is no change, below 1 shrinks, above 1 grows, 0 or below is folded. Differences are central,
    and one-sided where a neighbour is missing; along an axis on which a site has no neighbour it
    counts as unstrained.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2), or (D, H, W, 3) of a volume
        Material displacement in the order of the axes, in the unit of `spacing`.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis, or along all of them.
    tissue : array_like of bool, shape ([D,] H, W), optional
        By default everything. Differences are never taken across its border.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        NaN where there is no tissue.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    moved, mask = moved_sites(displacement, spacing, tissue)
    # The mean over the quadrants around a site equals the determinant of its central differences.
    return _over_quadrants("mean", moved, mask)


def count_folds(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> int:
    """Count the sites at which tissue folds over itself or collapses.

    A site counts if its determinant is 0 or below in any element that has it as a corner: in any
    block of 2 x 2 pixels, or of 2 x 2 x 2 voxels, that is entirely tissue. Central differences
    alone would miss a site that jumps over its neighbour and back.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `jacobian_determinant`.

    Returns
    -------
    int

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    moved, mask = moved_sites(displacement, spacing, tissue)
    if mask.ndim == 2 and _is_little_strained(moved):
        return 0
    return int((_over_quadrants("smallest", moved, mask) <= 0).sum())


def smallest_determinant(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the smallest determinant of each site over its elements, a measure of folding.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `jacobian_determinant`.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        0 or below where the tissue folds; 1 at tissue that belongs to no element (see
        `count_folds`); NaN where there is no tissue.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    moved, mask = moved_sites(displacement, spacing, tissue)
    return _over_quadrants("smallest", moved, mask)


def determinant_or_fold(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the `jacobian_determinant`, or at folds the `smallest_determinant`, at most 0."""
    return _over_quadrants("mean or fold", *moved_sites(displacement, spacing, tissue))


def deformation_grid(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    every: int = 10,
    tissue: npt.ArrayLike | None = None,
    pieces: int = 5,
) -> FloatArray:
    """Draw a square grid that has moved with the tissue (figure 4).

    Parameters
    ----------
    displacement, spacing, tissue
        As in `jacobian_determinant`, for a slice; lines are drawn in tissue only.
    every : int
        Pixels between two lines. If pixels are not square, this counts along the axis with the
        smaller pixel size, and the other distance is rounded to make the cells square.
    pieces : int
        Largest number of straight pieces of a line between two crossings: fewer are faster to
        draw.

    Returns
    -------
    ndarray, shape (N, 2, 2), float32
        Segments as (start, direction), each (row, col) in pixels.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    every = _checked_count("every", every, "pixels")
    pieces = _checked_count("pieces", pieces, "pieces")
    moved, mask = moved_sites(displacement, spacing, tissue)
    if mask.ndim != 2:
        raise ProblemError("displacement", "is of a volume. Draw the grid of one of its slices.")
    sizes = checked_sizes(spacing)
    rows, cols = (min(max(1, round(every * min(sizes) / size)), _FAR) for size in sizes)
    along_cols = _lines(moved, mask, rows, max(1, cols // pieces))
    along_rows = _lines(moved.swapaxes(0, 1), mask.T, cols, max(1, rows // pieces))
    return np.concatenate([along_cols, along_rows]).astype(np.float32)


def _checked_count(name: str, count: int, of: str) -> int:
    if not (is_whole(count) and count >= 1):
        raise ProblemError(name, f"is {shown(count)}. Give a whole number of {of}, at least 1.")
    return int(count)


def pixels_between(lines: int, shape: Sequence[int], spacing: Sequence[float]) -> int:
    """Return the spacing, in pixels, of `lines` grid lines across the longer side of an image."""
    longer = max(count * size for count, size in zip(shape, spacing, strict=True))
    return max(1, round(longer / min(spacing) / lines))


def arrows(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    about: int = 1000,
) -> FloatArray:
    """Pick arrows that show the displacement without hiding the image.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `jacobian_determinant`; arrows are in tissue only.
    about : int
        Approximate number of arrows.

    Returns
    -------
    ndarray, shape (N, 2, n), float32
        Arrows as (start, direction), each in pixels along the axes, at their true length. Always a
        list, never a dense grid of arrows.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    if not real(about) >= 1:
        raise ProblemError("about", f"is {shown(about)}. Ask for at least one arrow.")
    moved, mask = moved_sites(displacement, spacing, tissue)
    steps = _lattice(mask.sum() / about, checked_sizes(spacing, mask.ndim))
    chosen = np.zeros_like(mask)
    lines = tuple(
        slice(min(step, size) // 2, None, step)
        for step, size in zip(steps, mask.shape, strict=True)
    )
    chosen[lines] = mask[lines]
    starts = np.argwhere(chosen)
    if not len(starts):  # all tissue is thinner than a step
        sites = np.argwhere(mask)
        starts = sites[:: max(1, round(len(sites) / about))]
    ends = moved[tuple(starts.T)]
    return np.stack([starts, ends - starts], axis=1).astype(np.float32)


def arrows_apart(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    about: int = 1000,
) -> FloatArray:
    """Pick `arrows` that do not overlap, leaving out very short ones.

    Parameters, return value and errors are those of `arrows`.
    """
    found = arrows(displacement, spacing=spacing, tissue=tissue, about=about)
    lengths = np.linalg.norm(found[:, 1], axis=1)
    found = found[lengths >= max(_LEAST * lengths.max(initial=0.0), 1e-6)]
    axes = found.shape[-1]
    sites = np.size(displacement) / axes if tissue is None else np.sum(tissue)
    sizes = checked_sizes(spacing, axes)
    gap = max(1.0, (sites / about) ** (1 / axes)) * math.prod(sizes) ** (1 / axes) / 4
    chosen: FloatArray = found[_apart(found, gap, sizes)]
    return chosen


def arrows_in_slices(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    about: int = 1000,
) -> FloatArray:
    """Pick arrows of a volume, about `about` of them in the fullest slice across any axis.

    The arrows lie on a lattice without rows along any slice: x + s y + s^2 z = 0 modulo the number
    of voxels per arrow, with s near the golden section of that number. Very short arrows are left
    out. Parameters, return value and errors are those of `arrows`.
    """
    moved, mask = moved_sites(displacement, spacing, tissue)
    sites = max(1, round(int(mask.sum(axis=(1, 2)).max()) / about))
    share = round(sites * 0.618)
    share = next((s for s in range(share, 2 * sites) if math.gcd(s, sites) == 1), 1)
    row, col = np.ogrid[tuple(map(slice, mask.shape[1:]))]
    chosen = np.empty_like(mask)
    for deep in range(len(mask)):
        compute_thread.look()
        chosen[deep] = mask[deep] & ((col + share * row + share**2 * deep) % sites == 0)
    starts = np.argwhere(chosen)
    steps = moved[tuple(starts.T)] - starts
    lengths = np.linalg.norm(steps * checked_sizes(spacing, 3), axis=1)
    far = lengths >= max(_LEAST * lengths.max(initial=0.0), 1e-6)
    found: FloatArray = np.stack([starts, steps], axis=1)[far].astype(np.float32)
    return found


def spread(where: BoolArray, apart: npt.ArrayLike) -> npt.NDArray[np.intp]:
    """Pick evenly spread pixels of a region: in each cell the pixel nearest to its centre.

    Parameters
    ----------
    where : ndarray of bool, shape ([D,] H, W)
    apart : float or array_like, shape (n,)
        The sides of a cell, in pixels.

    Returns
    -------
    ndarray of int, shape (N, n)
    """
    pixels = np.argwhere(where)
    if not len(pixels):
        return pixels
    cells = (pixels / np.asarray(apart)).astype(np.int64)
    off = np.abs(pixels / np.asarray(apart) - cells - 0.5).max(axis=1)
    order = np.argsort(off, kind="stable")
    key = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, first = np.unique(key[order], return_index=True)
    return pixels[order[first]]


def _apart(arrows: FloatArray, gap: float, spacing: Float64Array) -> npt.NDArray[np.intp]:
    """Choose arrows with at least a gap, in the unit of `spacing`, between them, longest first."""
    if not len(arrows):
        return np.zeros(0, dtype=np.intp)
    # The cells are as wide as the gap: a chosen arrow claims its cells and their neighbours.
    starts, steps = arrows[:, 0] * spacing / gap, arrows[:, 1] * spacing / gap
    lowest = np.minimum(starts, starts + steps).min(axis=0) - 1
    starts = starts - lowest
    size = np.maximum(starts, starts + steps).max(axis=0).astype(int) + 3
    claimed = np.zeros(size, dtype=bool)
    lengths = np.linalg.norm(steps, axis=1)
    kept = []
    for number in np.argsort(-lengths, kind="stable"):
        along = np.linspace(0, 1, int(2 * lengths[number]) + 2)[:, None]
        cells = (starts[number] + along * steps[number]).astype(int)
        if claimed[tuple(cells.T)].any():
            continue
        kept.append(number)
        for around in product((-1, 0, 1), repeat=cells.shape[1]):
            claimed[tuple((cells + around).T)] = True
    return np.sort(np.array(kept, dtype=np.intp))


def _lattice(sites: float, spacing: Float64Array) -> tuple[int, ...]:
    """Return the steps of a lattice that is cubic in world units, with `sites` sites per point."""
    if len(spacing) == 3:
        side = (max(1.0, sites) * math.prod(spacing)) ** (1 / 3)
        return tuple(max(1, round(side / size)) for size in spacing)
    aspect = math.sqrt(spacing[1] / spacing[0])
    row = max(1, round(math.sqrt(max(1.0, sites)) * aspect))
    col = max(1, round(sites / row))
    if col == 1:
        row = max(1, round(sites))
    return row, col


def _is_little_strained(moved: Float64Array) -> bool:
    """Return whether all neighbours stay so near to one pixel apart that no tissue can fold."""
    # If each step is off by less than half a pixel along both axes, the matrix of steps is
    # diagonally dominant, and its determinant is positive.
    return all(
        bool(np.abs(np.diff(moved, axis=axis) - step).max(initial=0) < 0.5)
        for axis, step in enumerate(np.eye(2))
    )


def _over_quadrants(kind: _Kind, moved: Float64Array, mask: BoolArray) -> FloatArray:
    """Reduce the determinants of the quadrants around each site to one value; NaN in void."""
    if mask.ndim == 3 and loops.ready_for_volumes():
        loader.before_numba()
        from napari_hmrf.field.volume_loops import determinants  # heavy: numba

        found, which = np.empty(mask.shape, dtype=np.float32), _KINDS.index(kind)
        for slab in slabs(mask.shape):
            wide, inner = with_neighbours(slab, len(mask))
            there = loops.only_read(mask[wide])
            found[slab] = determinants(moved[wide], there, elements(mask[wide]), which)[inner]
        return found
    # Work strip by strip, with a row of each neighbour, so that temporary arrays stay in the cache.
    made = np.full(mask.shape, np.nan, dtype=np.float32)
    strip = _STRIP if mask.ndim == 2 else _SLAB
    for begin in range(0, len(mask), strip):
        first, last = max(begin - 1, 0), begin + strip + 1
        there = mask[first:last]
        values = _reduced(kind, _quadrants(moved[first:last], there), there)
        inner = slice(begin, begin + strip)
        np.copyto(made[inner], values[begin - first :][:strip], where=mask[inner])
    return made


def _reduced(kind: _Kind, each: list[Float64Array], mask: BoolArray) -> Float64Array:
    """Reduce the determinants of the quadrants around each site to one value."""
    mean = np.add.reduce(each) / len(each)
    if kind == "mean":
        return np.asarray(mean)
    exist = elements(mask)
    smallest = np.full(mask.shape, np.inf)
    ways = product((slice(1, None), slice(-1)), repeat=mask.ndim)
    for determinants, way in zip(each, ways, strict=True):
        np.minimum(smallest, determinants, out=smallest, where=exist[way])
    smallest[np.isinf(smallest)] = 1.0
    return smallest if kind == "smallest" else np.where(smallest <= 0, smallest, mean)


def elements(mask: BoolArray) -> BoolArray:
    """Return a mask of the existing elements, with one more entry per axis than there are sites.

    The element before a site along all axes has the index of the site; it exists if all its
    corners are tissue.
    """
    exist = mask
    for axis in range(mask.ndim):
        along = exist.swapaxes(0, axis)
        exist = (along[1:] & along[:-1]).swapaxes(0, axis)
    return np.pad(exist, 1)


def _quadrants(moved: Float64Array, mask: BoolArray) -> list[Float64Array]:
    """Return the determinant from one-sided differences in each quadrant around a site."""
    # Pixel units do not change the determinant: the pixel sizes cancel.
    return [determinant(steps) for steps in product(*differences_along_axes(moved, mask))]


def determinant(steps: Sequence[Float64Array]) -> Float64Array:
    """Compute determinants of matrices from their n columns, each of shape (..., n)."""
    if len(steps) == 2:
        down, along = steps
        return down[..., 0] * along[..., 1] - down[..., 1] * along[..., 0]
    a, b, c = (np.moveaxis(step, -1, 0) for step in steps)
    volume: Float64Array = a[0] * (b[1] * c[2] - b[2] * c[1])
    volume += a[1] * (b[2] * c[0] - b[0] * c[2])
    volume += a[2] * (b[0] * c[1] - b[1] * c[0])
    return volume


def differences_along_axes(moved: Float64Array, mask: BoolArray) -> list[list[Float64Array]]:
    """Return the `one_sided_differences` of all sites along each axis, in the order of the axes."""
    found = []
    for axis, step in enumerate(np.eye(mask.ndim)):
        both = one_sided_differences(moved.swapaxes(0, axis), mask.swapaxes(0, axis), step)
        found.append([each.swapaxes(0, axis) for each in both])
    return found


def one_sided_differences(
    moved: Float64Array, mask: BoolArray, unstrained: Float64Array
) -> list[Float64Array]:
    """Return the differences to the next and to the previous site along the first axis.

    Each replaces the other where that is missing; `unstrained` replaces both where both are
    missing.

    Parameters
    ----------
    moved : ndarray, shape ([D,] H, W, n)
        Moved positions of all sites, from `moved_sites`.
    mask : ndarray of bool, shape ([D,] H, W)
        The tissue; differences are never taken across its border.
    unstrained : ndarray, shape (n,)
        The step along the axis without any motion.

    Returns
    -------
    list of two ndarrays, shape ([D,] H, W, n)
        To the next site, and from the previous one.
    """
    height = len(mask)
    # For site i: entry i + 1 is True if there is a next site, entry i if there is a previous one.
    exists = np.zeros((height + 1, *mask.shape[1:], 1), dtype=bool)
    exists[1:-1, ..., 0] = mask[1:] & mask[:-1]
    steps = np.empty((height + 1, *moved.shape[1:]))
    np.subtract(moved[1:], moved[:-1], out=steps[1:-1])
    steps[[0, -1]] = unstrained
    np.copyto(steps, unstrained, where=~exists)
    following = np.where(exists[1:], steps[1:], steps[:-1])
    previous = np.where(exists[:-1], steps[:-1], steps[1:])
    return [following, previous]


def _lines(moved: Float64Array, mask: BoolArray, every: int, step: int) -> Float64Array:
    """Return the segments, within tissue, of every `every`-th line along the second axis."""
    lines = slice((len(moved) - 1) % every // 2, None, every)
    # Segments span a few sites, still far less than a mesh width: fewer are faster to draw.
    place, there = moved[lines], mask[lines]
    size = place.shape[1]
    stops = np.unique(np.append(np.arange(0, size, step), size - 1))
    starts, ends = stops[:-1], stops[1:]
    missing = np.concatenate([np.zeros((len(there), 1), int), np.cumsum(~there, axis=1)], axis=1)
    drawn = missing[:, ends + 1] == missing[:, starts]
    start, end = place[:, starts][drawn], place[:, ends][drawn]
    return np.stack([start, end - start], axis=1)
