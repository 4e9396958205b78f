"""Moving an image with its tissue.

A displacement says where tissue goes: what is at X moves to X + d(X). The moved image I' therefore
has I'(X + d(X)) = I(X), and drawing it takes the inverse of the motion. (Sampling the image at
X + d(X) would show the opposite motion.) Between the sites the motion is taken to be linear on
triangles of three neighbouring sites, of a volume on tetrahedra of four; its inverse is then exact,
however large the gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import reals, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.field import triangle_arrays
from napari_hmrf.field.resample import as_image, resample
from napari_hmrf.field.slabs import slabs
from napari_hmrf.solver.backends import compiler, loader, loops
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.problem import as_numbers

Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
#: Size of a pixel along each axis, or one number for all axes.
Spacing = float | Sequence[float]


def warp(
    image: npt.ArrayLike,
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    order: int = 1,
    tissue: npt.ArrayLike | None = None,
    fill: float = 0,
) -> npt.NDArray[Any]:
    """Move an image, or a volume, with the tissue.

    Parameters
    ----------
    image : array_like, shape ([D,] H, W) or ([D,] H, W, channels)
        Grey, RGB or RGBA image, or labels (with ``order=0``). A pixel that is NaN or infinite
        stays so where it moves, and is left out of the interpolation around it.
    displacement : array_like, shape (H, W, 2), or (D, H, W, 3) of a volume
        Material displacement in the order of the axes, in the unit of `spacing`.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis, or along all of them.
    order : int
        Of the interpolating spline, 0 to 5: 0 takes the nearest pixel, as labels need; 1 is linear.
    tissue : array_like of bool, shape ([D,] H, W), optional
        What moves; by default everything. The rest stays in place as background, and tissue that
        moves onto it covers it.
    fill : float
        What is seen where tissue has left and nothing came.

    Returns
    -------
    ndarray
        Of the shape and dtype of `image`; integers are rounded and clipped to their range.

    Raises
    ------
    ProblemError
        Naming the input at fault.

    See Also
    --------
    inverse_map, resample : the two halves of this, to move several images by one displacement.
    """
    picture = as_image(image, as_field(displacement).shape[:-1])
    coordinates, covered = inverse_map(displacement, spacing=spacing, tissue=tissue)
    return resample(picture, coordinates, covered, order=order, fill=fill)


def inverse_map(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> tuple[Float64Array, BoolArray]:
    """Find where that which is seen at each pixel after the motion came from.

    Where the tissue has folded over itself, the part that is not turned over is seen.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `warp`.

    Returns
    -------
    coordinates : ndarray, shape ([D,] H, W, n), float64
        The source of each pixel, in pixels along the axes; 0 where not `covered`.
    covered : ndarray, shape ([D,] H, W), bool
        False where tissue has left and nothing came.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    coordinates, covered, _ = inverse_map_and_overlaps(displacement, spacing, tissue)
    return coordinates, covered


def inverse_map_and_overlaps(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> tuple[Float64Array, BoolArray, BoolArray]:
    """`inverse_map`, and where one part of the tissue lies on another.

    Two parts that move onto each other across a gap fold nowhere, and yet one hides the other.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `warp`.

    Returns
    -------
    coordinates, covered
        As of `inverse_map`.
    overlaps : ndarray, shape ([D,] H, W), bool
        Pixels onto which tissue, not turned over, has moved from two places more than a pixel
        apart; which of the two is seen is chance. Tissue one pixel thin is not looked at.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    moving, mask = moved_sites(displacement, spacing, tissue)
    coordinates, state = inverse_raster(moving, mask)
    if mask.ndim == 2:
        still = ~mask & (state == 0)
        coordinates[still] = np.argwhere(still)
    return coordinates, (state > 0) | ~mask, state == triangle_arrays.TWICE


def inverse_raster(
    moved: Float64Array, tissue: BoolArray, shape: tuple[int, ...] | None = None, planes: int = 0
) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Invert the motion of sites by the loops, or by NumPy before these are compiled.

    Parameters
    ----------
    moved, tissue
        Of `moved_sites`.
    shape : tuple of int, optional
        Of the volume of which these are some planes.
    planes : int
        Only so many planes of a volume are drawn on; by default all.

    Returns
    -------
    source : ndarray, shape ([D,] H, W, n), float64
        Where the tissue that is seen at each pixel came from; of a whole volume also its own place
        where there is none.
    state : ndarray, shape ([D,] H, W), uint8
        0 where nothing came; `TWICE` where two parts of the tissue did.
    """
    if tissue.ndim == 3:
        # Its loops use numba's own threads, which must not be entered from two threads.
        drawn = partial(_volume_raster, moved, tissue, shape or tissue.shape, planes or len(tissue))
        return compute_thread.result_of(drawn, "a volume to be warped")
    if not loops.ready_for_pictures():
        compiler.compile_meanwhile()
        return triangle_arrays.rasterise(moved, tissue)
    loader.before_numba()
    # Numba takes half a second to import: only those who warp wait for it.
    from napari_hmrf.field.triangle_raster import rasterise

    coordinates, state = rasterise(moved, loops.only_read(tissue))
    return coordinates, state


def _volume_raster(
    moved: Float64Array, tissue: BoolArray, shape: tuple[int, ...], planes: int
) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Invert the motion of a volume's sites onto so many planes; on the compute thread only."""
    loader.before_numba()
    from numba import get_num_threads

    from napari_hmrf.field import tetrahedron_raster

    cores, mask = get_num_threads(), loops.only_read(tissue)
    source = np.zeros((planes, *moved.shape[1:]))
    state = np.zeros(source.shape[:-1], np.uint8)
    compute_thread.look()
    about = tetrahedron_raster.surface(moved, mask)
    longest = float(sum(shape))
    for slab in slabs(state.shape, cores):
        begin, end = slab.start, slab.stop
        parts = min(cores, end - begin)
        tetrahedron_raster.rasterise(moved, mask, *about, longest, begin, end, parts, source, state)
    return source, state


def moved_sites(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None,
    fraction: float = 1.0,
) -> tuple[Float64Array, BoolArray]:
    """Check a displacement and its tissue; where every site has moved, in pixels.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `warp`.
    fraction : float
        How much of the displacement.

    Returns
    -------
    moved : ndarray, shape ([D,] H, W, n), float64
        X + d(X) in pixels; X where there is no tissue.
    tissue : ndarray, shape ([D,] H, W), bool
        Everywhere, if it was not given.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    d = as_field(displacement)
    sizes = checked_sizes(spacing, d.shape[-1])
    mask = np.ones(d.shape[:-1], dtype=bool)
    if tissue is not None:
        mask = as_numbers("tissue", tissue).astype(bool)
        if mask.shape != d.shape[:-1]:
            raise ProblemError(
                "tissue",
                f"has shape {mask.shape}, but the displacement has shape {d.shape}, so "
                f"{d.shape[:-1]} is needed. Give both on the same pixel grid.",
            )
    moved = _added(d, sizes, mask, fraction)
    if not all(map(_is_finite, moved)):
        bad = ~np.isfinite(moved).all(axis=-1)
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ProblemError(
            "displacement",
            f"is NaN or infinite at {int(bad.sum())} pixels, the first at {at}. Replace those "
            "vectors, or leave the pixels out of `tissue`.",
        )
    return moved, mask


def _is_finite(plane: Float64Array) -> bool:
    compute_thread.look()
    return bool(np.isfinite(plane).all())


def _added(
    d: npt.NDArray[Any], sizes: Float64Array, mask: BoolArray, fraction: float
) -> Float64Array:
    """Where every site has moved, in pixels, by so much of a displacement."""
    # A plane after the other, which stays in the cache, and all components of a row as one line:
    # a loop over three components takes as long as one over a hundred.
    (height, width), n = mask.shape[-2:], mask.ndim
    moved, size = np.empty(d.shape), np.tile(sizes, width)
    scaled = bool((sizes != 1).any())
    own = np.zeros((height, width, n))
    own[..., n - 2], own[..., n - 1] = np.ogrid[:height, :width]
    for plane in np.ndindex(mask.shape[:-2]):
        compute_thread.look()
        own[..., : n - 2] = plane
        there = np.repeat(mask[plane], n, axis=-1)
        line = moved[plane].reshape(there.shape)
        line[...] = np.where(there, d[plane].reshape(there.shape), 0)
        if fraction != 1:
            line *= fraction
        if scaled:
            line /= size
        line += own.reshape(there.shape)
    return moved


def checked_sizes(spacing: Spacing, axes: int = 2) -> Float64Array:
    """Return a checked pixel spacing, shape (axes,); one number counts along all axes."""
    one = isinstance(spacing, Real)
    sizes = np.array(reals((spacing,) * axes if one else spacing, axes))
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise ProblemError(
            "spacing", f"is {shown(spacing)}. Give {axes} positive, finite pixel sizes."
        )
    return sizes


def as_field(displacement: npt.ArrayLike) -> npt.NDArray[Any]:
    """Take a displacement of a slice or of a volume as it is, or raise a `ProblemError`."""
    d = as_numbers("displacement", displacement)
    if d.ndim not in (3, 4) or d.shape[-1] != d.ndim - 1:
        raise ProblemError(
            "displacement",
            f"has shape {d.shape}, but (H, W, 2), or (D, H, W, 3) of a volume, is needed: one "
            "vector per pixel, in the order of the axes.",
        )
    return d
