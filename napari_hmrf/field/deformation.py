"""Local volume change, folds, grids and arrows of a displacement.

Segments and arrows are in pixels, with components in axis order, as for napari's Vectors layer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import is_whole, real, shown
from napari_hmrf.compute.compile_cache import loader, loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.followers import Followers, followers_of
from napari_hmrf.field.parts import Sites, in_one_part, same_part
from napari_hmrf.field.slabs import slabs, with_neighbours
from napari_hmrf.field.warp import (
    BoolArray,
    Float64Array,
    Spacing,
    as_field,
    checked_sizes,
    moved_sites,
    numbered_sites,
)
from napari_hmrf.real_arrays import as_mask, check_finite, grid_in_words

FloatArray = npt.NDArray[np.float32]

# Number of rows of an image, and of planes of a volume, that are processed together.
_STRIP, _SLAB = 64, 8
# Ways to reduce the determinants around a site; the loop for volumes receives the index.
_Kind = Literal["smallest", "mean", "mean or fold"]
_KINDS: tuple[_Kind, ...] = get_args(_Kind)
# Upper bound of the distance between grid lines, in pixels; it exceeds the size of any image.
_FAR = 2**31
# Arrows shorter than this fraction of the longest arrow are omitted, as they would look like dots.
_LEAST = 0.1
# Arrows shorter than this fraction of the smallest side of a pixel are omitted: the motion is not
# visible, and its direction may be an error of the solver, up to 0.01 pixels in the window.
_UNSEEN = 0.05


def magnitude(displacement: npt.ArrayLike) -> FloatArray:
    """Return the length of the displacement at each site.

    Parameters
    ----------
    displacement : array_like, shape ([D,] H, W, n)
        In the unit of `spacing`.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        Lengths in the same unit.

    Raises
    ------
    ProblemError
        If the displacement has an invalid shape or is not numeric.
    """
    length: FloatArray = np.linalg.norm(as_field(displacement), axis=-1).astype(np.float32)
    return length


def rmsd(
    displacement: npt.ArrayLike, reference: npt.ArrayLike, tissue: npt.ArrayLike | None = None
) -> float:
    """Return the root mean square deviation of two displacements (eq. 20 of the paper).

    Parameters
    ----------
    displacement, reference : array_like, shape ([D,] H, W, n)
        Displacements of the same sites, in the same unit.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the sites that are compared; by default all sites.

    Returns
    -------
    float
        Root of the mean, over the sites, of the squared length of the difference.

    Raises
    ------
    ProblemError
        If an input has an invalid shape, is not numeric or not finite, or if there are no sites to
        compare.
    """
    found, known = as_field(displacement), as_field(reference)
    mask = np.ones(found.shape[:-1], bool)
    if tissue is not None:
        mask = as_mask("tissue", tissue)
    for field, shape in (("reference", known.shape[:-1]), ("tissue", mask.shape)):
        if shape != found.shape[:-1]:
            raise ProblemError(
                field,
                f"has {grid_in_words(shape)} sites, but the displacement has "
                f"{grid_in_words(found.shape[:-1])}. Use the same pixel grid for both.",
            )
    if not mask.any():
        raise ProblemError("tissue", "has no sites to compare. Include at least one site.")
    difference = found[mask].astype(np.float64) - known[mask]
    check_finite("displacement", difference)
    return float(np.sqrt((difference**2).sum(axis=-1).mean()))


def jacobian_determinant(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the Jacobian determinant det(I + dd/dX), the ratio of areas or volumes, at each site.

    A value of 1 means unchanged size, below 1 shrinkage, above 1 growth, and 0 or below a fold.
    Differences are central, or one-sided if a neighbour is missing. A site in no element, such as
    the tip of a disc, has the determinant of the affine motion that it follows; see
    `napari_hmrf.field.followers`. If it follows no other tissue and both neighbours along an axis
    are missing, it is assumed to be unstrained along that axis.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement in the order of the axes, in the unit of `spacing`.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis; a scalar applies to all axes.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the tissue; by default all sites. Differences do not cross the border of the tissue.
    parts : array_like of int, shape ([D,] H, W), optional
        Label of the sliding part of each site, as `Solution.parts`. Differences do not cross from
        one part to another, because the slip between them is no strain. By default, all tissue is
        connected.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        Determinants; NaN outside tissue.

    Raises
    ------
    ProblemError
        If an input has an invalid shape or value; the error names the input.
    """
    moved, sites = numbered_sites(displacement, spacing, tissue, parts)
    # The mean over the quadrants around a site equals the determinant of its central differences.
    return _over_quadrants("mean", moved, sites)


def count_folds(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> int:
    """Count the sites at which tissue folds over itself or collapses.

    A site is counted if the determinant is 0 or below in at least one element around it. Elements
    are blocks of 2 x 2 pixels, or 2 x 2 x 2 voxels, that contain only tissue of one part. Central
    differences alone would miss a single site that has moved past its neighbour.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `jacobian_determinant`.

    Returns
    -------
    int

    Raises
    ------
    ProblemError
        As for `jacobian_determinant`.
    """
    moved, sites = numbered_sites(displacement, spacing, tissue, parts)
    if sites.ndim == 2 and _is_little_strained(moved):
        return 0
    return int((_over_quadrants("smallest", moved, sites) <= 0).sum())


def smallest_determinant(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the smallest determinant among the elements around each site, a measure of folding.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `jacobian_determinant`.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        0 or below where tissue folds; 1 at tissue sites without an element (see `count_folds`);
        NaN outside tissue.

    Raises
    ------
    ProblemError
        As for `jacobian_determinant`.
    """
    moved, sites = numbered_sites(displacement, spacing, tissue, parts)
    return _over_quadrants("smallest", moved, sites)


def determinant_or_fold(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the `smallest_determinant` at folds, and the `jacobian_determinant` elsewhere."""
    moved, sites = numbered_sites(displacement, spacing, tissue, parts)
    return _over_quadrants("mean or fold", moved, sites)


def deformation_grid(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    every: int = 10,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
    pieces: int = 5,
) -> FloatArray:
    """Return the lines of a square grid that moves with the tissue, as in figure 4 of the paper.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `jacobian_determinant`, for a slice. Lines are drawn in tissue only, and end where two
        parts slide along each other.
    every : int
        Distance between neighbouring lines, in pixels. If pixels are not square, this is the
        distance along the axis with the smaller pixel size, and the other distance is chosen to
        make the cells nearly square.
    pieces : int
        Largest number of straight segments of a line between two crossings. Fewer segments are
        drawn faster.

    Returns
    -------
    ndarray, shape (N, 2, 2), float32
        Segments as (start, direction), each (row, col) in pixels.

    Raises
    ------
    ProblemError
        As for `jacobian_determinant`, or if the displacement belongs to a volume.
    """
    every = _checked_count("every", every, "pixels")
    pieces = _checked_count("pieces", pieces, "pieces")
    moved, numbers = numbered_sites(displacement, spacing, tissue, parts)
    if numbers.ndim != 2:
        raise ProblemError(
            "displacement", "belongs to a volume. Draw the grid of one of its slices."
        )
    sizes = checked_sizes(spacing)
    rows, cols = (min(max(1, round(every * min(sizes) / size)), _FAR) for size in sizes)
    along_cols = _lines(moved, numbers, rows, max(1, cols // pieces))
    along_rows = _lines(moved.swapaxes(0, 1), numbers.T, cols, max(1, rows // pieces))
    return np.concatenate([along_cols, along_rows]).astype(np.float32)


def _checked_count(name: str, count: int, of: str) -> int:
    if not (is_whole(count) and count >= 1):
        raise ProblemError(name, f"is {shown(count)}. Pass a whole number of {of}, at least 1.")
    return int(count)


def pixels_between(lines: int, shape: Sequence[int], spacing: Sequence[float]) -> int:
    """Return the distance, in pixels, between `lines` grid lines along the longer side."""
    longer = max(count * size for count, size in zip(shape, spacing, strict=True))
    return max(1, round(longer / min(spacing) / lines))


def arrows(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    about: int = 1000,
) -> FloatArray:
    """Return arrows that show the displacement without hiding the image.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `jacobian_determinant`. Arrows start in tissue only.
    about : int
        Approximate number of arrows.

    Returns
    -------
    ndarray, shape (N, 2, n), float32
        Arrows as (start, step), in pixels, not scaled.

    Raises
    ------
    ProblemError
        As for `jacobian_determinant`, or if `about` is less than 1.
    """
    if not real(about) >= 1:
        raise ProblemError("about", f"is {shown(about)}. Pass a number of at least 1.")
    moved, mask = moved_sites(displacement, spacing, tissue)
    steps = _lattice(mask.sum() / about, checked_sizes(spacing, mask.ndim))
    chosen = np.zeros_like(mask)
    lines = tuple(
        slice(min(step, size) // 2, None, step)
        for step, size in zip(steps, mask.shape, strict=True)
    )
    chosen[lines] = mask[lines]
    starts = np.argwhere(chosen)
    if not len(starts):  # no lattice point is in tissue
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
    """Return `arrows` that do not overlap, without very short arrows; none if nothing moves.

    The parameters, return value and errors are those of `arrows`.
    """
    found = arrows(displacement, spacing=spacing, tissue=tissue, about=about)
    axes = found.shape[-1]
    sizes = checked_sizes(spacing, axes)
    found = found[_are_visible(found[:, 1], sizes)]
    sites = np.size(displacement) / axes if tissue is None else np.sum(tissue)
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
    """Return arrows of a volume for display in slices.

    The slice with the most tissue has approximately `about` arrows. Arrows start at voxels with
    x + s y + s^2 z = 0 modulo m, where m is the number of voxels per arrow in that slice and s is
    close to the golden section of m. Slices along any axis therefore show no visible rows of
    arrows. Very short arrows are omitted; if nothing moves, there are none. The parameters, return
    value and errors are those of `arrows`.
    """
    moved, mask = moved_sites(displacement, spacing, tissue)
    sites = max(1, round(int(mask.sum(axis=(1, 2)).max()) / about))
    shift = round(sites * 0.618)
    shift = next((s for s in range(shift, 2 * sites) if math.gcd(s, sites) == 1), 1)
    row, col = np.ogrid[tuple(map(slice, mask.shape[1:]))]
    chosen = np.empty_like(mask)
    for plane in range(len(mask)):
        compute_thread.check_cancelled()
        chosen[plane] = mask[plane] & ((col + shift * row + shift**2 * plane) % sites == 0)
    starts = np.argwhere(chosen)
    steps = moved[tuple(starts.T)] - starts
    visible = _are_visible(steps, checked_sizes(spacing, 3))
    found: FloatArray = np.stack([starts, steps], axis=1)[visible].astype(np.float32)
    return found


def _are_visible(steps: npt.NDArray[Any], sizes: Float64Array) -> BoolArray:
    """Return a mask of the steps, (N, n) in pixels, that are long enough for an arrow."""
    lengths = np.linalg.norm(steps * sizes, axis=1)
    least = max(_LEAST * lengths.max(initial=0.0), _UNSEEN * float(sizes.min()))
    visible: BoolArray = lengths >= least
    return visible


def spread(where: BoolArray, apart: npt.ArrayLike) -> npt.NDArray[np.intp]:
    """Return evenly distributed pixels of a region: the pixel nearest to the centre of each cell.

    Parameters
    ----------
    where : ndarray of bool, shape ([D,] H, W)
        Mask of the region.
    apart : float or array_like, shape (n,)
        Length of a cell along each axis, in pixels.

    Returns
    -------
    ndarray of int, shape (N, n)
        Indices of the chosen pixels.
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
    """Return the indices of arrows that are at least `gap` apart; longer arrows have priority.

    `gap` is in the unit of `spacing`.
    """
    if not len(arrows):
        return np.zeros(0, dtype=np.intp)
    # Cells are as long as the gap, so a chosen arrow blocks its own cells and their neighbours.
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
    """Return whether the strain is small enough everywhere to exclude folds."""
    # If each component of each step between neighbours differs by less than half a pixel from the
    # step at rest, the matrix of steps is diagonally dominant and its determinant is positive.
    return all(
        bool(np.abs(np.diff(moved, axis=axis) - step).max(initial=0) < 0.5)
        for axis, step in enumerate(np.eye(2))
    )


def _over_quadrants(kind: _Kind, moved: Float64Array, sites: Sites) -> FloatArray:
    """Reduce the determinants of the quadrants around each site; NaN outside tissue."""
    values = _over_existing_quadrants(kind, moved, sites)
    followers = None if kind == "smallest" else followers_at(sites)
    if followers is not None:
        values.reshape(-1)[followers.sites] = np.linalg.det(followers.gradient(moved))
    return values


def followers_at(sites: Sites) -> Followers | None:
    """Return the followers of tissue, or None if each site is in an element or follows no other."""
    connected = sites.dtype == np.bool_
    return followers_of(sites.astype(np.bool_, copy=False), None if connected else sites)


def _over_existing_quadrants(kind: _Kind, moved: Float64Array, sites: Sites) -> FloatArray:
    if sites.ndim == 3 and sites.dtype == np.bool_ and loops.ready_for_volumes():
        loader.before_numba()
        from napari_hmrf.field.volume_loops import determinants  # heavy: numba

        values, number = np.empty(sites.shape, dtype=np.float32), _KINDS.index(kind)
        for slab in slabs(sites.shape):
            wide, inner = with_neighbours(slab, len(sites))
            part = loops.only_read(sites[wide])
            values[slab] = determinants(moved[wide], part, elements(sites[wide]), number)[inner]
        return values
    # A strip has one extra row on each side; strips are small enough for the CPU cache.
    result = np.full(sites.shape, np.nan, dtype=np.float32)
    strip = _STRIP if sites.ndim == 2 else _SLAB
    for begin in range(0, len(sites), strip):
        first, last = max(begin - 1, 0), begin + strip + 1
        part = sites[first:last]
        reduced = _reduced(kind, _quadrants(moved[first:last], part), part)
        rows = slice(begin, begin + strip)
        np.copyto(result[rows], reduced[begin - first :][:strip], where=sites[rows].astype(bool))
    return result


def _reduced(kind: _Kind, each: list[Float64Array], sites: Sites) -> Float64Array:
    """Reduce the determinants of the quadrants around each site to one value."""
    mean = np.add.reduce(each) / len(each)
    if kind == "mean":
        return np.asarray(mean)
    exist = elements(sites)
    smallest = np.full(sites.shape, np.inf)
    ways = product((slice(1, None), slice(-1)), repeat=sites.ndim)
    for determinants, way in zip(each, ways, strict=True):
        np.minimum(smallest, determinants, out=smallest, where=exist[way])
    smallest[np.isinf(smallest)] = 1.0
    return smallest if kind == "smallest" else np.where(smallest <= 0, smallest, mean)


def elements(sites: Sites) -> BoolArray:
    """Return a mask of the elements with tissue of one part at all corners.

    The element that precedes a site along all axes has the index of that site. The mask therefore
    has one more entry along each axis than the array of the sites.
    """
    return np.pad(in_one_part(sites), 1)


def _quadrants(moved: Float64Array, sites: Sites) -> list[Float64Array]:
    """Return, for each quadrant around a site, the determinant of its one-sided differences."""
    # The determinant does not depend on the pixel sizes, so the steps are in pixels.
    return [determinant(steps) for steps in product(*differences_along_axes(moved, sites))]


def determinant(steps: Sequence[Float64Array]) -> Float64Array:
    """Compute the determinants of matrices, given as n columns of shape (..., n)."""
    if len(steps) == 2:
        down, along = steps
        return down[..., 0] * along[..., 1] - down[..., 1] * along[..., 0]
    a, b, c = (np.moveaxis(step, -1, 0) for step in steps)
    volume: Float64Array = a[0] * (b[1] * c[2] - b[2] * c[1])
    volume += a[1] * (b[2] * c[0] - b[0] * c[2])
    volume += a[2] * (b[0] * c[1] - b[1] * c[0])
    return volume


def differences_along_axes(moved: Float64Array, sites: Sites) -> list[list[Float64Array]]:
    """Return the `one_sided_differences` of all sites along each axis, in axis order."""
    differences = []
    for axis, step in enumerate(np.eye(sites.ndim)):
        both = one_sided_differences(moved.swapaxes(0, axis), sites.swapaxes(0, axis), step)
        differences.append([each.swapaxes(0, axis) for each in both])
    return differences


def one_sided_differences(
    moved: Float64Array, sites: Sites, unstrained: Float64Array
) -> list[Float64Array]:
    """Return the differences with the next and the previous site along the first axis.

    If one neighbour is missing, both differences are computed from the existing neighbour. If both
    neighbours are missing, both differences are `unstrained`.

    Parameters
    ----------
    moved : ndarray, shape ([D,] H, W, n)
        Moved positions of all sites, from `moved_sites`.
    sites : ndarray of bool or int, shape ([D,] H, W)
        Mask of the tissue, or numbers of its parts; differences do not cross their borders.
    unstrained : ndarray, shape (n,)
        Step to the next site in unstrained tissue.

    Returns
    -------
    list of two ndarrays, shape ([D,] H, W, n)
        Steps to the next site and from the previous site.
    """
    height = len(sites)
    # Entry i + 1 is True if site i has a next site; entry i is True if it has a previous site.
    exists = np.zeros((height + 1, *sites.shape[1:], 1), dtype=bool)
    exists[1:-1, ..., 0] = same_part(sites[1:], sites[:-1])
    steps = np.empty((height + 1, *moved.shape[1:]))
    np.subtract(moved[1:], moved[:-1], out=steps[1:-1])
    steps[[0, -1]] = unstrained
    np.copyto(steps, unstrained, where=~exists)
    following = np.where(exists[1:], steps[1:], steps[:-1])
    previous = np.where(exists[:-1], steps[:-1], steps[1:])
    return [following, previous]


def _lines(moved: Float64Array, sites: Sites, every: int, step: int) -> Float64Array:
    """Return the segments of lines along the second axis, `every` rows apart.

    Each segment is in tissue of one part.
    """
    lines = slice((len(moved) - 1) % every // 2, None, every)
    # Segments span several sites, because fewer segments are drawn faster.
    place, numbers = moved[lines], sites[lines]
    size = place.shape[1]
    stops = np.unique(np.append(np.arange(0, size, step), size - 1))
    starts, ends = stops[:-1], stops[1:]
    # Count the steps between neighbours that leave a part.
    leaves = ~same_part(numbers[:, 1:], numbers[:, :-1]).astype(bool)
    crossed = np.concatenate([np.zeros((len(numbers), 1), int), np.cumsum(leaves, axis=1)], axis=1)
    drawn = crossed[:, ends] == crossed[:, starts]
    start, end = place[:, starts][drawn], place[:, ends][drawn]
    return np.stack([start, end - start], axis=1)
