"""Deformation gradient, area change and strain of a displacement at each site.

All quantities are *material*: a value at the site X belongs to the tissue that lay at X before the
motion, on the pixel grid of the displacement, wherever that tissue is now. With the displacement
d(X), its gradient H = dd/dX and the deformation gradient F = I + H they are

    area ratio            J = det F                        1: unchanged, 0 or below: folded
    small strain          e = (H + H^T) / 2                valid for small motions without rotation
    Green-Lagrange strain E = (F^T F - I) / 2              valid for any motion; 0 for a rotation

Differences are central, one-sided where a neighbour is missing, and never taken across the border
of the tissue; along an axis on which a site has no neighbour it counts as unstrained. They are
those of `jacobian_determinant`, which is det F. Tensors are in (row, col) order: [..., 0, 1] is the
change of the row component along a column step; in a volume the order is (depth, row, col). Strains
have no unit (0.01 is one per cent); the displacement and `spacing` must share theirs. All values
are NaN where there is no tissue.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.deformation import (
    FloatArray,
    count_folds,
    differences_along_axes,
    jacobian_determinant,
    magnitude,
    smallest_determinant,
)
from napari_hmrf.field.warp import (
    BoolArray,
    Float64Array,
    Spacing,
    checked_sizes,
    moved_sites,
)
from napari_hmrf.solver.backends.compile_cache import loader, loops
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.problem import as_numbers

__all__ = [
    "count_folds",
    "deformation_gradient",
    "equivalent_strain",
    "fold_mask",
    "green_lagrange_strain",
    "jacobian_determinant",
    "magnitude",
    "principal_strains",
    "small_strain",
    "strain_through_slice",
]

#: Number of planes of a volume whose strains are in memory at a time.
_SLAB = 8
# Number of sites computed between two checks for cancellation.
_AT_ONCE = 2**17


def deformation_gradient(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the local stretch and rotation of tissue: F = d(X + d(X)) / dX.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2), or (D, H, W, 3) of a volume
        Material displacement in the order of the axes, in the unit of `spacing`.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis, or along all of them.
    tissue : array_like of bool, shape ([D,] H, W), optional
        By default everything.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n), float32
        F[..., i, j] is the component along axis i of an original unit step along axis j; NaN where
        there is no tissue.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    gradient, mask = displacement_gradient(displacement, spacing, tissue)
    return on_sites(gradient + np.eye(mask.ndim), mask)


def fold_mask(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> BoolArray:
    """Return a mask of the sites where tissue folds or collapses, which `count_folds` counts.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `deformation_gradient`.

    Returns
    -------
    ndarray, shape ([D,] H, W), bool
        True if the determinant at the site is 0 or below in any element that has it as a corner.
        This is stricter than J <= 0, which misses a site that jumps over its neighbour and back.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    folded: BoolArray = smallest_determinant(displacement, spacing, tissue) <= 0
    return folded


def small_strain(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the strain of linear elasticity, e = (H + H^T) / 2, as used by `ElasticPrior`.

    Tissue that rotates by an angle a seems to shrink by 1 - cos(a) in this strain, but not in
    `green_lagrange_strain`.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `deformation_gradient`.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n), float32
        Symmetric; [..., i, i] is the strain along an axis, [..., i, j] half the change of the angle
        between two axes. NaN where there is no tissue.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    gradient, mask = displacement_gradient(displacement, spacing, tissue)
    return on_sites(symmetric(gradient), mask)


def green_lagrange_strain(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the Green-Lagrange strain, E = (F^T F - I) / 2, in which rotations do not count.

    The motion makes a fibre along the unit vector a sqrt(1 + 2 a.E a) times as long.

    Parameters
    ----------
    displacement, spacing, tissue
        As in `deformation_gradient`.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n), float32
        Symmetric, in the axes before the motion; NaN where there is no tissue.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    gradient, mask = displacement_gradient(displacement, spacing, tissue)
    return on_sites(green_lagrange(gradient), mask)


def green_lagrange(gradient: Float64Array) -> Float64Array:
    """Return the Green-Lagrange strain of displacement gradients H, shape (N, n, n)."""
    # (F^T F - I) / 2 is computed from H, so that small strains are not lost beside the ones of I.
    product = np.einsum("...ki,...kj->...ij", gradient, gradient)
    return np.asarray(symmetric(gradient) + product / 2)


def values_by_parts(
    strains: Callable[[slice], tuple[Float64Array, npt.ArrayLike, BoolArray]],
    value: Callable[[Float64Array, npt.ArrayLike], npt.NDArray[np.floating]],
    tissue: BoolArray,
) -> FloatArray:
    """Compute a scalar from the strain of each site.

    A volume is processed a few planes at a time: all its strains take nine times the memory.

    Parameters
    ----------
    strains : callable
        Returns the strains of the tissue in a range of the first axis, (N, n, n); for an image
        the strains across its plane, (N,) or 0; and the mask of the sites.
    value : callable
        Computes scalars, shape (N,), from the first two.
    tissue : ndarray of bool, shape ([D,] H, W)

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        NaN where there is no tissue.
    """
    slab = len(tissue) if tissue.ndim == 2 else _SLAB
    values = np.full(tissue.shape, np.nan, np.float32)
    for begin in range(0, len(tissue), slab):
        first, end = max(begin - 1, 0), begin + slab
        strain, across, wide = strains(slice(first, end + 1))
        inner = np.zeros_like(wide)
        inner[begin - first :][:slab] = True
        inside = inner[wide]
        strain = strain[inside]
        through = np.asarray(across)[inside] if np.ndim(across) else across
        parts = [np.zeros(0, np.float32)]
        for at in range(0, len(strain), _AT_ONCE):
            compute_thread.look()
            span = slice(at, at + _AT_ONCE)
            beyond = np.asarray(through)[span] if np.ndim(through) else through
            parts.append(np.asarray(value(strain[span], beyond), np.float32))
        values[begin:end][tissue[begin:end]] = np.concatenate(parts)
    return values


def principal_strains(strain: npt.ArrayLike) -> FloatArray:
    """Return the principal strains, the eigenvalues of the strain tensor.

    Parameters
    ----------
    strain : array_like, shape (..., n, n)
        Symmetric strain of a slice or volume, from `small_strain` or `green_lagrange_strain`.

    Returns
    -------
    ndarray, shape (..., n), float32
        The largest (stretch) first; NaN where the strain is NaN.

    Raises
    ------
    ProblemError
        If the strain has another shape.
    """
    tensor = _as_strain(strain, 2, 3)
    if tensor.shape[-1] == 3:
        known = np.asarray(np.isfinite(tensor).all(axis=(-1, -2), keepdims=True))
        values = np.linalg.eigvalsh(np.where(known, tensor, 0))[..., ::-1]
        return np.asarray(np.where(known[..., 0], values, np.nan), dtype=np.float32)
    mean = (tensor[..., 0, 0] + tensor[..., 1, 1]) / 2
    radius = np.hypot((tensor[..., 0, 0] - tensor[..., 1, 1]) / 2, tensor[..., 0, 1])
    return np.stack([mean + radius, mean - radius], axis=-1).astype(np.float32)


def equivalent_strain(strain: npt.ArrayLike, through: npt.ArrayLike = 0.0) -> FloatArray:
    """Return the equivalent strain of von Mises, a scalar measure of distortion.

    sqrt(2/3 e':e'), where e' = e - tr(e)/3 I is the part of the strain in space that changes shape
    and not volume. A bar of incompressible tissue stretched by e along its axis has the value e;
    a simple shear by g has g / sqrt(3).

    Parameters
    ----------
    strain : array_like, shape (..., 2, 2), or (..., 3, 3) of a volume
        Symmetric; for an image, the strain in its plane.
    through : array_like, shape (...)
        The strain across the plane of an image, which the image does not determine: 0 for a slice
        held between its neighbours, `strain_through_slice` for one free to bulge. Shears across
        the plane are taken as 0. Ignored for a volume.

    Returns
    -------
    ndarray, shape (...), float32
        Never negative; NaN where the strain is NaN.

    Raises
    ------
    ProblemError
        If the strain has another shape.
    """
    tensor = _as_strain(strain, 2, 3)
    across = as_numbers("through", through).astype(np.float64)
    # Differences of infinite strains are invalid, and squares of very large strains overflow.
    with np.errstate(invalid="ignore", over="ignore"):
        if tensor.shape[-1] == 3:
            mean = np.trace(tensor, axis1=-1, axis2=-2)[..., None, None] / 3
            squares = ((tensor - mean * np.eye(3)) ** 2).sum(axis=(-1, -2))
            return np.asarray(np.sqrt(2 / 3 * squares), dtype=np.float32)
        third = (tensor[..., 0, 0] + tensor[..., 1, 1] + across) / 3
        squares = (
            (tensor[..., 0, 0] - third) ** 2
            + (tensor[..., 1, 1] - third) ** 2
            + (across - third) ** 2
            + 2 * tensor[..., 0, 1] ** 2
        )
        equivalent: FloatArray = np.sqrt(2 / 3 * squares).astype(np.float32)
    return equivalent


def strain_through_slice(strain: npt.ArrayLike, poisson: npt.ArrayLike) -> FloatArray:
    """Return the strain across a thin, free slice (plane stress): -nu/(1 - nu) (e_rr + e_cc).

    Parameters
    ----------
    strain : array_like, shape (..., 2, 2)
        Small strain in the plane.
    poisson : array_like, shape (...)
        Poisson's ratio nu, below 0.5.

    Returns
    -------
    ndarray, shape (...), float32
        Negative where the slice becomes thinner.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    tensor = _as_strain(strain, 2)
    ratio = as_numbers("poisson", poisson).astype(np.float64)
    if not ((ratio > -1) & (ratio < 0.5)).all():
        raise ProblemError("poisson", "must be above -1 and below 0.5 everywhere.")
    trace = tensor[..., 0, 0] + tensor[..., 1, 1]
    return np.asarray(-ratio / (1 - ratio) * trace, dtype=np.float32)


def displacement_gradient(
    displacement: npt.ArrayLike, spacing: Spacing, tissue: npt.ArrayLike | None
) -> tuple[Float64Array, BoolArray]:
    """Return H = dd/dX, shape (N, n, n) without a unit, for the N sites of tissue; and a mask."""
    moved, mask = moved_sites(displacement, spacing, tissue)
    sizes = checked_sizes(spacing, mask.ndim)
    if mask.ndim == 3 and loops.ready_for_volumes():
        loader.before_numba()
        from napari_hmrf.field.volume_loops import gradients  # heavy: numba

        return gradients(moved, loops.only_read(mask), sizes), mask
    gradient = np.empty((*moved.shape, mask.ndim))
    for axis, (following, previous) in enumerate(differences_along_axes(moved, mask)):
        gradient[..., axis] = (following + previous) / 2 - np.eye(mask.ndim)[axis]
    # Convert from pixels to lengths: pixel sizes may differ between axes.
    return gradient[mask] * (sizes[:, None] / sizes), mask


def on_sites(values: Float64Array, mask: BoolArray) -> FloatArray:
    """Scatter values at the sites of tissue to all pixels; NaN where there is no tissue."""
    made = np.full((*mask.shape, *values.shape[1:]), np.nan, np.float32)
    made[mask] = values
    return made


def symmetric(tensor: Float64Array) -> Float64Array:
    """Return the symmetric part of tensors, shape (..., n, n)."""
    part: Float64Array = (tensor + tensor.swapaxes(-1, -2)) / 2
    return part


def _as_strain(strain: npt.ArrayLike, *axes: int) -> Float64Array:
    """Check that strains are (n, n) tensors with n in `axes`."""
    tensor = as_numbers("strain", strain).astype(np.float64, copy=False)
    if tensor.shape[-2:] not in [(n, n) for n in axes]:
        needed = " or ".join(f"(..., {n}, {n})" for n in axes)
        raise ProblemError(
            "strain", f"has shape {tensor.shape}. Give {needed}, in the order of the axes."
        )
    return tensor
