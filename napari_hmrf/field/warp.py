"""Warping of an image with its tissue.

A displacement is material: the tissue at X moves to X + d(X). The warped image I' therefore
satisfies I'(X + d(X)) = I(X), and is computed with the inverse of the motion. (Sampling the image
at X + d(X) would show the opposite motion.) Between the sites of a slice, the motion is linear on
triangles of three neighbouring sites. In a volume it is trilinear in cells of eight sites, and
linear on tetrahedra in cells with fewer sites. The inverse of this motion is exact, even for large
gradients.

Parts that slide along each other are drawn one by one, each up to its own border. The cells between
two parts are stretched by the slip; they are drawn only onto pixels that no part covers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import reals, shown
from napari_hmrf.compute.compile_cache import compiler, loader, loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ProblemError
from napari_hmrf.field import triangle_arrays
from napari_hmrf.field.parts import Sites, part_numbers
from napari_hmrf.field.resample import as_image, resample
from napari_hmrf.field.slabs import slabs
from napari_hmrf.real_arrays import as_mask, as_numbers

Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
#: Size of a pixel along each axis, or a single number for all axes.
Spacing = float | Sequence[float]


def warp(
    image: npt.ArrayLike,
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    order: int = 1,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
    fill: float = 0,
) -> npt.NDArray[Any]:
    """Warp an image or a volume with the tissue.

    Parameters
    ----------
    image : array_like, shape ([D,] H, W) or ([D,] H, W, channels)
        Grey, RGB or RGBA image, or labels (with ``order=0``). NaN and infinite pixels move like
        other pixels, but are ignored by the interpolation around them.
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement in the order of the axes, in the unit of `spacing`.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis; a scalar applies to all axes.
    order : int
        Order of the interpolating spline, from 0 to 5: 0 is nearest-neighbour interpolation, which
        labels require; 1 is linear.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the sites that move; by default all sites. Other pixels are background: they stay
        in place and are hidden by tissue that moves onto them.
    parts : array_like of int, shape ([D,] H, W), optional
        Label of the sliding part of each site, as `Solution.parts`. By default, all tissue is
        connected.
    fill : float
        Value of uncovered pixels, which tissue has left and no other tissue has reached.

    Returns
    -------
    ndarray
        Warped image, with the shape and dtype of `image`. Integers are rounded and clipped.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.

    See Also
    --------
    inverse_map, resample : The two steps of `warp`, to warp several images by one displacement.
    """
    picture = as_image(image, as_field(displacement).shape[:-1])
    coordinates, covered = inverse_map(displacement, spacing=spacing, tissue=tissue, parts=parts)
    return resample(picture, coordinates, covered, order=order, fill=fill)


def inverse_map(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> tuple[Float64Array, BoolArray]:
    """Compute the origin of each pixel: the position of its tissue before the motion.

    Where tissue has folded over itself, the non-inverted part is visible.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `warp`.

    Returns
    -------
    coordinates : ndarray, shape ([D,] H, W, n), float64
        Origin of each pixel, in pixels along the axes; 0 where `covered` is False.
    covered : ndarray, shape ([D,] H, W), bool
        False at pixels that tissue has left and no other tissue has reached.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    coordinates, covered, _ = inverse_map_and_overlaps(displacement, spacing, tissue, parts)
    return coordinates, covered


def inverse_map_and_overlaps(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> tuple[Float64Array, BoolArray, BoolArray]:
    """Return the `inverse_map` and a mask of the pixels at which two parts of the tissue overlap.

    Two parts can overlap without a fold if a gap between them closes.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `warp`.

    Returns
    -------
    coordinates, covered
        As in `inverse_map`.
    overlaps : ndarray, shape ([D,] H, W), bool
        Mask of the pixels onto which non-inverted tissue has moved from two positions more than a
        pixel apart. Either part may be visible. Tissue that is only one pixel thin is ignored, as
        is an overlap of sliding parts by less than two pixels.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    moving, sites = numbered_sites(displacement, spacing, tissue, parts)
    mask = sites.astype(bool)
    coordinates, state = inverse_raster_of_parts(moving, sites)
    if mask.ndim == 2:
        still = ~mask & (state == 0)
        coordinates[still] = np.argwhere(still)
    return coordinates, (state > 0) | ~mask, state == triangle_arrays.TWICE


def inverse_raster(
    moved: Float64Array, tissue: BoolArray, shape: tuple[int, ...] | None = None, planes: int = 0
) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Invert the motion of sites, with compiled loops or, until these are ready, with NumPy.

    Parameters
    ----------
    moved, tissue
        Output of `moved_sites`.
    shape : tuple of int, optional
        Shape of the whole volume, if the sites are only some of its planes.
    planes : int
        Number of planes of the result for a volume; 0 for all planes.

    Returns
    -------
    source : ndarray, shape ([D,] H, W, n), float64
        Origin of the tissue at each pixel. In a whole volume, the origin of an empty pixel outside
        tissue is the pixel itself.
    state : ndarray, shape ([D,] H, W), uint8
        0 at pixels onto which no tissue has moved; `TWICE` where two parts of the tissue overlap.
    """
    if tissue.ndim == 3:
        # The loops for volumes use numba's threads, which must be used from a single thread only.
        drawn = partial(_volume_raster, moved, tissue, shape or tissue.shape, planes or len(tissue))
        return compute_thread.result_of(drawn, "warping a volume")
    if not loops.ready_for_pictures():
        compiler.compile_meanwhile()
        return triangle_arrays.rasterise(moved, tissue)
    loader.before_numba()
    # Import numba on first use, because this import takes half a second.
    from napari_hmrf.field.triangle_raster import rasterise  # heavy: numba

    coordinates, state = rasterise(moved, loops.only_read(tissue))
    return coordinates, state


def inverse_raster_of_parts(
    moved: Float64Array, sites: Sites
) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Invert the motion of each part, and draw the cells between parts onto uncovered pixels only.

    Parameters
    ----------
    moved, sites
        Output of `numbered_sites`.

    Returns
    -------
    source, state
        As from `inverse_raster`. Pixels onto which two parts have moved by more than a pixel are
        marked with `TWICE`.
    """
    source, state = inverse_raster(moved, sites.astype(bool))
    if sites.dtype == np.bool_:
        return source, state
    state[state == triangle_arrays.TWICE] = triangle_arrays.KEPT
    around = np.ones((3,) * sites.ndim)
    covered, deep, twice = np.zeros((3, *sites.shape), bool)
    for number in np.unique(sites[sites > 0]):
        compute_thread.check_cancelled()
        own, of_part = inverse_raster(moved, sites == number)
        drawn = of_part >= triangle_arrays.KEPT
        # A part covers half a pixel beyond its outermost sites, so that neighbours overlap there.
        inside = scipy.ndimage.binary_erosion(drawn, around, border_value=1)
        twice |= (of_part == triangle_arrays.TWICE) | (inside & deep)
        drawn &= ~covered | (inside & ~deep)
        source[drawn], state[drawn] = own[drawn], triangle_arrays.KEPT
        covered |= drawn
        deep |= inside
    state[twice] = triangle_arrays.TWICE
    return source, state


def has_volume_loops() -> bool:
    """Return whether the loops that warp volumes are compiled and cached."""
    loader.before_numba()
    from napari_hmrf.field import tetrahedron_raster  # heavy: numba

    return loader.is_cached(tetrahedron_raster.outline)


def _volume_raster(
    moved: Float64Array, tissue: BoolArray, shape: tuple[int, ...], planes: int
) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Invert the motion of the sites of a volume; call on the compute thread only."""
    loader.before_numba()
    from numba import get_num_threads  # heavy: numba

    from napari_hmrf.field import tetrahedron_raster  # heavy: numba

    cores, mask = get_num_threads(), loops.only_read(tissue)
    source = np.zeros((planes, *moved.shape[1:]))
    state = np.zeros(source.shape[:-1], np.uint8)
    compute_thread.check_cancelled()
    outer, reach = tetrahedron_raster.surface(moved, mask)
    longest = float(sum(shape))
    for slab in slabs(state.shape, cores):
        begin, end = slab.start, slab.stop
        out = begin, end, min(cores, end - begin), source, state
        tetrahedron_raster.rasterise(moved, mask, reach, *out)
        tetrahedron_raster.refine(moved, mask, *out)
        tetrahedron_raster.outline(moved, mask, outer, reach, longest, *out)
    return source, state


def numbered_sites(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None,
    parts: npt.ArrayLike | None,
) -> tuple[Float64Array, Sites]:
    """Check a displacement, and return the moved position and the part of each site.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `warp`.

    Returns
    -------
    moved : ndarray, shape ([D,] H, W, n), float64
        As from `moved_sites`.
    sites : ndarray of int or bool, shape ([D,] H, W)
        As from `part_numbers`.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    moved, mask = moved_sites(displacement, spacing, tissue)
    return moved, part_numbers(mask, parts)


def moved_sites(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None,
    fraction: float = 1.0,
) -> tuple[Float64Array, BoolArray]:
    """Check a displacement and a tissue mask, and return the moved position of each site.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `warp`.
    fraction : float
        Fraction of the displacement, from 0 to 1.

    Returns
    -------
    moved : ndarray, shape ([D,] H, W, n), float64
        X + d(X) in pixels; X outside tissue.
    tissue : ndarray, shape ([D,] H, W), bool
        Mask of the tissue; True everywhere if `tissue` is None.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    d = as_field(displacement)
    sizes = checked_sizes(spacing, d.shape[-1])
    mask = np.ones(d.shape[:-1], dtype=bool)
    if tissue is not None:
        mask = as_mask("tissue", tissue)
        if mask.shape != d.shape[:-1]:
            raise ProblemError(
                "tissue",
                f"has shape {mask.shape}, but the displacement has shape {d.shape}, so "
                f"{d.shape[:-1]} is needed. Use the same pixel grid for both.",
            )
    moved = _added(d, sizes, mask, fraction)
    if not all(map(_is_finite, moved)):
        bad = ~np.isfinite(moved).all(axis=-1)
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ProblemError(
            "displacement",
            f"is NaN or infinite at {int(bad.sum())} pixels, the first at {at}. Replace these "
            "vectors, or exclude the pixels from `tissue`.",
        )
    return moved, mask


def _is_finite(plane: Float64Array) -> bool:
    compute_thread.check_cancelled()
    return bool(np.isfinite(plane).all())


def _added(
    d: npt.NDArray[Any], sizes: Float64Array, mask: BoolArray, fraction: float
) -> Float64Array:
    """Return the position of each site, in pixels, at a fraction of the displacement."""
    # Planes are processed one by one, because a plane fits into the CPU cache. The components of a
    # row form one line, because a NumPy loop over 3 numbers is as slow as a loop over a hundred.
    (height, width), n = mask.shape[-2:], mask.ndim
    moved, size = np.empty(d.shape), np.tile(sizes, width)
    scaled = bool((sizes != 1).any())
    own = np.zeros((height, width, n))
    own[..., n - 2], own[..., n - 1] = np.ogrid[:height, :width]
    for plane in np.ndindex(mask.shape[:-2]):
        compute_thread.check_cancelled()
        own[..., : n - 2] = plane
        inside = np.repeat(mask[plane], n, axis=-1)
        line = moved[plane].reshape(inside.shape)
        line[...] = np.where(inside, d[plane].reshape(inside.shape), 0)
        if fraction != 1:
            line *= fraction
        if scaled:
            line /= size
        line += own.reshape(inside.shape)
    return moved


def checked_sizes(spacing: Spacing, axes: int = 2) -> Float64Array:
    """Check a pixel spacing and return it, shape (axes,); a single number applies to all axes."""
    one = isinstance(spacing, Real)
    sizes = np.array(reals((spacing,) * axes if one else spacing, axes))
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise ProblemError(
            "spacing", f"is {shown(spacing)}. Pass {axes} positive, finite pixel sizes."
        )
    return sizes


def as_field(displacement: npt.ArrayLike) -> npt.NDArray[Any]:
    """Check the shape of a displacement of a slice or a volume, and return it as an array."""
    d = as_numbers("displacement", displacement)
    if d.ndim not in (3, 4) or d.shape[-1] != d.ndim - 1:
        raise ProblemError(
            "displacement",
            f"has shape {d.shape}. Pass (H, W, 2), or (D, H, W, 3) for a volume: one vector per "
            "pixel, in the order of the axes.",
        )
    return d
