"""Surfaces along which tissue slides: normals of painted surfaces, and their precision tensors.

A site on a sliding surface has the precision ``k n n^T``: its displacement along the normal n is
observed, and its displacement along the surface is free. A wrong normal locks the tissue, because a
slip of 10 pixels along a normal that is wrong by 5 degrees is an error of 0.9 pixels. On a pixel
grid, an oblique surface is a staircase, so the normals come from a fit to many sites.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import real, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.notes import Note
from napari_hmrf.real_arrays import as_float32, as_int32, checked_spacing
from napari_hmrf.solver.precision import MAX_PRECISION
from napari_hmrf.solver.problem import as_stiffness
from napari_hmrf.tissue.normals import outer_rim, parts_of

Float64Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.int32]

#: Precision along the normal, relative to the stiffness of the tissue at the site.
STRENGTH = 1e3
#: Standard deviation of the Gaussian blur of the first estimate of the normals, in pixels.
_BLUR = 1.5
#: Standard deviation of the Gaussian weights of a fit in an image and in a volume, in pixels. A
#: line has fewer sites than a surface, so its fit is wider.
_WIDTH = {2: 6.0, 3: 4.0}
#: Radius of a fit, in standard deviations.
_REACH = 2.5
#: Largest number of sites in a fit, in an image and in a volume.
_NEIGHBOURS = {2: 36, 3: 180}
#: Distance from the fitted surface beyond which a site has little weight, in pixels.
_OUTLIER = 1.0
#: Typical curvature of a line and a surface, in 1 / pixels; a fit prefers smaller curvatures.
_CURVATURE = {2: 0.03, 3: 0.06}
#: Weight of an unpainted site of the surface in a fit; a painted site has weight 1. It continues
#: the surface beyond the end of the paint, but hardly counts beyond a corner.
_UNPAINTED = 0.1
#: Smallest share of the outline of some paint that is on the surface of the tissue; with a smaller
#: share, the paint is a line or a sheet inside tissue, which only ends at the surface.
_SHARE = 0.15
# Number of frames of a fit, and number of weightings in each frame.
_FRAMES, _WEIGHTINGS = 3, 3
# Number of sites that are fitted together, to limit the memory.
_TOGETHER = 2048
_INSIDE = Note(
    "there is tissue on both sides of a sliding surface: the surface keeps its place, and the two "
    "sides do not slip past each other. To let tissue slide along the surface, give the other side "
    "the stiffness 0",
    short="a sliding surface in tissue keeps its place",
)


class SlidingSurface(NamedTuple):
    """Sites along which tissue slides, with their normals.

    Attributes
    ----------
    sites : ndarray of bool, shape ([D,] H, W)
        Mask of the sites.
    normals : ndarray, shape (N, n)
        Unit normal of each site in the order of ``np.nonzero(sites)``, towards the outside of the
        tissue. Inside tissue, the sign is arbitrary.
    is_outer : ndarray of bool, shape (N,)
        True for sites on the surface of the tissue, False for sites inside tissue.
    """

    sites: Mask
    normals: Float64Array
    is_outer: Mask


def sliding_surface(
    stiffness: npt.ArrayLike, painted: npt.ArrayLike, *, spacing: float | Sequence[float]
) -> SlidingSurface:
    """Return the sites and the normals of a painted surface.

    For each connected part of a label, these are its sites on the surface of the tissue, next to
    void or at the edge of the image, and the normals of this surface. A part inside tissue has the
    normals of its own outline, even if an end of it reaches the surface.

    The normal of a site is the normal of a quadratic surface that is fitted to the sites around it.
    Sites far from the fitted surface, such as those on the other side of a corner, hardly count.

    Parameters
    ----------
    stiffness : array_like, shape ([D,] H, W)
        Stiffness of the problem; above 0 in tissue.
    painted : array_like of bool or int, shape ([D,] H, W)
        Mask or labels of the painted sites; 0 is unpainted, and paint outside tissue has no effect.
        Each label has normals of its own, so that two labels may meet at a corner.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis; a single number applies to all axes.

    Returns
    -------
    SlidingSurface

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """
    tissue = as_stiffness(stiffness) > 0
    paint = as_int32("painted", painted)
    if paint.shape != tissue.shape:
        raise ProblemError(
            "painted",
            f"has shape {paint.shape}, but stiffness has shape {tissue.shape}. Use the same image "
            "or volume for both.",
        )
    # Sites without an element, such as a spur one pixel wide, follow others and need no normal.
    tissue = sites_of_elements(tissue)
    size = np.array(checked_spacing(spacing, tissue.ndim))
    size /= size.max()
    sites = np.zeros(tissue.shape, np.bool_)
    normals = np.zeros((*tissue.shape, tissue.ndim), np.float32)
    outer = np.zeros(tissue.shape, np.bool_)
    paint = np.where(tissue, paint, 0)
    for label, box, part in _parts_of_labels(paint):
        margin = [int(np.ceil(_REACH * _WIDTH[tissue.ndim] / along)) + 1 for along in size]
        wide = tuple(
            slice(max(side.start - more, 0), side.stop + more)
            for side, more in zip(box, margin, strict=True)
        )
        inside = tuple(
            slice(side.start - of.start, side.stop - of.start)
            for side, of in zip(box, wide, strict=True)
        )
        near, mine = paint[wide], np.zeros_like(tissue[wide])
        mine[inside] = part
        whole = [
            (of.start == 0, of.stop >= length)
            for of, length in zip(wide, tissue.shape, strict=True)
        ]
        own, points, shape, mode = _surface_of(mine, tissue[wide], whole)
        at = np.argwhere(own)
        away = _first_normals(shape, own, size, mode)
        other = np.argwhere(points & ~own & ((near == 0) | (near == label)))
        weights = np.where(np.arange(len(at) + len(other)) < len(at), 1.0, _UNPAINTED)
        fitted = _fitted(at * size, np.concatenate([at, other]) * size, weights, away)
        fitted *= np.where((fitted * away).sum(axis=1) < 0, -1, 1)[:, None]
        normals[wide][own] = fitted
        sites[wide] |= own
        outer[wide] |= own & (shape is not mine)
    unit = normals[sites].astype(np.float64)
    return SlidingSurface(sites, unit / np.linalg.norm(unit, axis=1, keepdims=True), outer[sites])


def sliding_precision(
    stiffness: npt.ArrayLike,
    painted: npt.ArrayLike,
    *,
    spacing: float | Sequence[float],
    strength: float = STRENGTH,
) -> Float64Array:
    """Return the precision tensors of a painted surface along which tissue slides.

    Parameters
    ----------
    stiffness : array_like, shape ([D,] H, W)
        Stiffness of the problem; above 0 in tissue, infinite in rigid tissue.
    painted : array_like of bool or int, shape ([D,] H, W)
        Mask or labels of the painted sites. Tissue slides where the paint covers its surface, next
        to void or at the edge of the image; paint inside tissue slides along its own outline. At a
        sharp corner, give each side a label of its own.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis; a single number applies to all axes.
    strength : float
        Precision along the normal, relative to the largest stiffness next to the site. The unit of
        stiffness therefore has no effect on the displacement.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n)
        Argument `precision` of a `Problem`; 0 at sites that do not slide.

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """
    if not 0 < real(strength) <= MAX_PRECISION:
        raise ProblemError(
            "strength",
            f"is {shown(strength)}. Pass a number above 0, up to {MAX_PRECISION:g}.",
        )
    surface = sliding_surface(stiffness, painted, spacing=spacing)
    return _tensors(stiffness, surface, spacing, strength)


def _tensors(
    stiffness: npt.ArrayLike,
    surface: SlidingSurface,
    spacing: float | Sequence[float],
    strength: float = STRENGTH,
) -> Float64Array:
    """Return the precision tensors of a sliding surface."""
    m = as_float32("stiffness", stiffness).astype(np.float64)
    size = checked_spacing(spacing, m.ndim)
    soft = np.where(np.isfinite(m), m, 0.0)
    near = scipy.ndimage.maximum_filter(soft, 3, mode="nearest")[surface.sites]
    near[near == 0] = soft.max() or 1.0  # inside a rigid body
    k = strength * near * np.prod(size) ** ((m.ndim - 2) / m.ndim)
    tensors = np.zeros((*m.shape, m.ndim, m.ndim))
    n = surface.normals
    tensors[surface.sites] = k[:, None, None] * n[:, :, None] * n[:, None, :]
    return tensors


class _Data(NamedTuple):
    """Sliding surfaces of some paint and their tensors."""

    slides: Labels
    stiffness: npt.NDArray[np.float32]
    spacing: tuple[float, ...]
    surface: SlidingSurface
    tensors: Float64Array

    def is_valid_for(
        self, slides: Labels, stiffness: npt.NDArray[np.float32], spacing: tuple[float, ...]
    ) -> bool:
        """Return whether the surface belongs to the given paint and stiffness."""
        same = self.spacing == spacing and np.array_equal(self.slides, slides)
        return same and np.array_equal(self.stiffness, stiffness)


#: Last data of a sliding surface, cached because each frame of a drag needs them.
_last_data: list[_Data] = []


def sliding_data(
    observed: npt.NDArray[np.float32],
    slides: Labels,
    stiffness: npt.NDArray[np.float32],
    spacing: tuple[float, ...],
) -> tuple[npt.NDArray[np.float32], Float64Array | None]:
    """Return the observed displacement and the precision of a problem with sliding paint.

    Parameters
    ----------
    observed : ndarray, shape ([D,] H, W, n)
        Observed displacement; where tissue slides, its first component is the displacement along
        the outward normal.
    slides : ndarray of int, shape ([D,] H, W)
        Labels of the surfaces along which tissue slides; 0 elsewhere.
    stiffness : ndarray, shape ([D,] H, W)
    spacing : tuple of float

    Returns
    -------
    observed : ndarray, shape ([D,] H, W, n)
    precision : ndarray, shape ([D,] H, W, n, n), or None if no tissue slides

    Raises
    ------
    ProblemError
        If paint inside tissue has a displacement along its normal, which has no outside there.
    """
    if not slides.any():
        return observed, None
    data = _data_of(slides, stiffness, spacing)
    surface, tensors = data.surface, data.tensors
    amounts = observed[surface.sites][:, 0]
    if (amounts[~surface.is_outer] != 0).any():
        raise ProblemError(
            "observed",
            "shifts a surface that slides inside tissue along its normal, but such a surface has "
            "no outside. Use a distance of 0 there, or paint the surface of the tissue.",
        )
    y = np.where((slides != 0)[..., None], np.float32(0), observed)
    y[surface.sites] = amounts[:, None] * surface.normals
    return y, tensors if tensors.any() else None


def inner_surface(
    slides: Labels, stiffness: npt.NDArray[np.float32], spacing: tuple[float, ...]
) -> str:
    """Return a clause if some sliding surface is inside tissue, or "".

    Tissue on both sides of such a surface shares its pixels, so that the sides cannot slip past
    each other.

    Parameters
    ----------
    slides, stiffness, spacing
        As for `sliding_data`.
    """
    if not slides.any() or _data_of(slides, stiffness, spacing).surface.is_outer.all():
        return ""
    return _INSIDE


def is_inner(paint: Mask, tissue: Mask, whole: list[tuple[bool, bool]]) -> bool:
    """Return whether some paint is a surface inside tissue.

    Parameters
    ----------
    paint, tissue : ndarray of bool
        Paint, and tissue, in a box of the image that is wider than the paint.
    whole : list of (bool, bool)
        For each axis, whether the box begins and ends at the edge of the image.
    """
    part = paint & tissue
    return bool(part.any()) and _surface_of(part, tissue, whole)[2] is part


def _data_of(
    slides: Labels, stiffness: npt.NDArray[np.float32], spacing: tuple[float, ...]
) -> _Data:
    """Return the surfaces of some paint and its tensors, from the cache if possible."""
    last = next(
        (each for each in _last_data if each.is_valid_for(slides, stiffness, spacing)), None
    )
    if last is None:
        surface = sliding_surface(stiffness, slides, spacing=spacing)
        tensors = _tensors(stiffness, surface, spacing)
        last = _Data(slides.copy(), stiffness.copy(), spacing, surface, tensors)
        _last_data[:] = [last]
    return last


def _parts_of_labels(labels: Labels) -> Iterator[tuple[np.int32, tuple[slice, ...], Mask]]:
    """Yield the label and the bounding box of each connected part, and the part within the box."""
    for label in np.unique(labels[labels != 0]):
        for box, part in parts_of(labels == label):
            yield label, box, part


def _surface_of(
    part: Mask, tissue: Mask, whole: list[tuple[bool, bool]]
) -> tuple[Mask, Mask, Mask, str]:
    """Return the sliding sites of a part of the paint, and the surface that has their normals.

    Parameters
    ----------
    part, tissue : ndarray of bool
        Part of the paint, and tissue, in a box of the image.
    whole : list of (bool, bool)
        For each axis, whether the box begins and ends at the edge of the image.

    Returns
    -------
    own : ndarray of bool
        Sliding sites.
    points : ndarray of bool
        All sites of the surface.
    shape : ndarray of bool
        Mask whose outline is the surface.
    mode : {"nearest", "constant"}
        Extension of the mask beyond the edge of the image.
    """
    next_to_void = tissue & ~scipy.ndimage.binary_erosion(tissue, border_value=1)
    at_edge = np.zeros_like(tissue)
    for axis, ends in enumerate(whole):
        for end, is_edge in zip((0, -1), ends, strict=True):
            at_edge.swapaxes(0, axis)[end] |= is_edge
    at_edge &= tissue
    by_void, only_edge = part & next_to_void, part & at_edge & ~next_to_void
    rim = outer_rim(part)
    if np.count_nonzero(by_void | only_edge) < _SHARE * np.count_nonzero(rim):
        return rim, rim, part, "nearest"
    if np.count_nonzero(only_edge) > np.count_nonzero(by_void):
        own = part & (next_to_void | at_edge)
        return own, own, tissue, "constant"
    # Tissue continues beyond the edge of the image, so that the surface has no corner there.
    return by_void, next_to_void, tissue, "nearest"


def _first_normals(shape: Mask, sites: Mask, size: Float64Array, mode: str) -> Float64Array:
    """Return the normals of the blurred outline of a mask at sites."""
    sigma = tuple(_BLUR / size)
    padded = np.pad(shape, 8, mode="edge" if mode == "nearest" else "constant")
    inside = (slice(8, -8),) * shape.ndim
    blurred = scipy.ndimage.gaussian_filter(padded.astype(np.float64), sigma, mode="nearest")
    slope = np.stack(np.gradient(blurred, *size), axis=-1)
    tensor = slope[..., :, None] * slope[..., None, :]
    # Only the sites need an eigenvector, and a line has one although its slope vanishes.
    tensor = scipy.ndimage.gaussian_filter(tensor, (*sigma, 0, 0), mode="nearest")
    normals = np.linalg.eigh(tensor[inside][sites])[1][..., -1]
    out = -(slope[inside][sites] * normals).sum(axis=1)
    return np.asarray(normals * np.where(out < 0, -1, 1)[:, None])


def _fitted(
    at: Float64Array, points: Float64Array, weights: Float64Array, normals: Float64Array
) -> Float64Array:
    """Return the normals at sites of quadratic surfaces that are fitted to points."""
    axes = at.shape[1]
    tree = scipy.spatial.cKDTree(points)
    width = _WIDTH[axes]
    most = min(len(points), _NEIGHBOURS[axes])
    fitted = np.empty_like(normals)
    for start in range(0, len(at), _TOGETHER):
        some = slice(start, start + _TOGETHER)
        far, of = tree.query(at[some], k=np.arange(1, most + 1))
        near = far <= _REACH * width
        weight = np.where(near, np.exp(-0.5 * (far / width) ** 2) * weights[of], 0.0)
        fitted[some] = _fit(points[of] - at[some, None], weight, normals[some])
    return fitted


def _fit(relative: Float64Array, weight: Float64Array, normals: Float64Array) -> Float64Array:
    """Return the normals of quadratic surfaces fitted to points around sites.

    Parameters
    ----------
    relative : ndarray, shape (N, K, n)
        Positions of the K points around each site, relative to the site.
    weight : ndarray, shape (N, K)
        Weights of the points.
    normals : ndarray, shape (N, n)
        First estimate of the normals.
    """
    axes = relative.shape[2]
    pairs = list(itertools.combinations_with_replacement(range(axes - 1), 2))
    penalty = np.diag([1e-9] * axes + [_CURVATURE[axes] ** -2] * len(pairs))
    for _ in range(_FRAMES):
        eye = np.broadcast_to(np.eye(axes), (len(normals), axes, axes))
        along = np.linalg.qr(np.concatenate([normals[:, :, None], eye], axis=2))[0][:, :, 1:axes]
        height = (relative * normals[:, None]).sum(axis=-1)
        u = relative @ along
        columns = [np.ones_like(height), *np.moveaxis(u, -1, 0)]
        columns += [u[..., a] * u[..., b] for a, b in pairs]
        terms = np.stack(columns, axis=-1)
        w = weight
        for _ in range(_WEIGHTINGS):
            weighted = (w[..., None] * terms).swapaxes(1, 2)
            parts = np.linalg.solve(weighted @ terms + penalty, weighted @ height[..., None])
            far = height - (terms @ parts)[..., 0]
            w = weight / (1 + (far / _OUTLIER) ** 2) ** 2
        tilted = normals - (along @ parts[:, 1:axes])[..., 0]
        normals = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    return normals
