"""Deformation gradient, area change and strain of a displacement at each site.

All quantities are *material*: a value at the site X belongs to the tissue with position X before
the motion, on the pixel grid of the displacement. With the displacement d(X), its gradient
H = dd/dX and the deformation gradient F = I + H,

    area ratio            J = det F                        1: unchanged, 0 or below: folded
    small strain          e = (H + H^T) / 2                valid for small motions without rotation
    Green-Lagrange strain E = (F^T F - I) / 2              valid for any motion; 0 for a rotation

Differences are central, or one-sided if a neighbour is missing, and do not cross the border of the
tissue or of a part that slides. A site in no element, a block of two sites along each axis, has the
gradient of the affine motion that it follows (`napari_hmrf.field.followers`); if it follows no
other tissue and both neighbours along an axis are missing, it is assumed to be unstrained along
that axis. `jacobian_determinant` uses the same differences and equals det F.
Tensors are in (row, col) order: H[..., 0, 1] is the derivative of the row component with respect to
the column. In a volume the order is (depth, row, col). Strains have no unit (0.01 is one per cent).
The displacement and `spacing` must have the same unit. All values are NaN outside tissue.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loader, loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.deformation import (
    FloatArray,
    count_folds,
    differences_along_axes,
    followers_at,
    jacobian_determinant,
    magnitude,
    smallest_determinant,
)
from napari_hmrf.field.parts import Sites
from napari_hmrf.field.warp import (
    BoolArray,
    Float64Array,
    Spacing,
    as_field,
    checked_sizes,
    numbered_sites,
)
from napari_hmrf.real_arrays import as_numbers

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

#: Number of planes of a volume that are processed together, to limit memory.
_SLAB = 8
# Number of sites that are processed between two checks for cancellation.
_AT_ONCE = 2**17


def deformation_gradient(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the deformation gradient F = I + dd/dX, the local stretch and rotation of tissue.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement in the order of the axes, in the unit of `spacing`.
    spacing : float or sequence of float, shape (n,)
        Size of a pixel along each axis; a scalar applies to all axes.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the tissue; by default all sites.
    parts : array_like of int, shape ([D,] H, W), optional
        Label of the sliding part of each site, as in `jacobian_determinant`.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n), float32
        F[..., i, j] is component i of the deformed unit step along axis j. NaN outside tissue.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    gradient, sites = displacement_gradient(displacement, spacing, tissue, parts)
    return on_sites(gradient + np.eye(sites.ndim), sites)


def fold_mask(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> BoolArray:
    """Return a mask of the sites at which tissue folds or collapses; see `count_folds`.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `deformation_gradient`.

    Returns
    -------
    ndarray, shape ([D,] H, W), bool
        True if the determinant is 0 or below in at least one element around the site. This mask
        includes folds at which J > 0, such as a single site that has moved past its neighbour.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    folded: BoolArray = smallest_determinant(displacement, spacing, tissue, parts) <= 0
    return folded


def small_strain(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the strain of linear elasticity, e = (H + H^T) / 2, as in `ElasticPrior`.

    In this measure, tissue that rotates by an angle a appears to shrink by 1 - cos(a). The
    `green_lagrange_strain` does not have this error.

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `deformation_gradient`.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n), float32
        Symmetric tensors: [..., i, i] is the strain along axis i, and [..., i, j] half the change
        of the angle between axes i and j. NaN outside tissue.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    gradient, sites = displacement_gradient(displacement, spacing, tissue, parts)
    return on_sites(symmetric(gradient), sites)


def green_lagrange_strain(
    displacement: npt.ArrayLike,
    *,
    spacing: Spacing,
    tissue: npt.ArrayLike | None = None,
    parts: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return the Green-Lagrange strain, E = (F^T F - I) / 2, which is 0 for a rotation.

    The motion changes the length of a fibre in the direction of the unit vector a by the factor
    sqrt(1 + 2 a.E a).

    Parameters
    ----------
    displacement, spacing, tissue, parts
        As in `deformation_gradient`.

    Returns
    -------
    ndarray, shape ([D,] H, W, n, n), float32
        Symmetric tensors at the undeformed sites, in axis order. NaN outside tissue.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    gradient, sites = displacement_gradient(displacement, spacing, tissue, parts)
    return on_sites(green_lagrange(gradient), sites)


def green_lagrange(gradient: Float64Array) -> Float64Array:
    """Return the Green-Lagrange strain of displacement gradients H, shape (N, n, n)."""
    # Compute (F^T F - I) / 2 from H, because F would lose small strains to rounding next to 1.
    product = np.einsum("...ki,...kj->...ij", gradient, gradient)
    return np.asarray(symmetric(gradient) + product / 2)


def values_by_parts(
    strains: Callable[[slice], tuple[Float64Array, npt.ArrayLike, BoolArray]],
    value: Callable[[Float64Array, npt.ArrayLike], npt.NDArray[np.floating]],
    tissue: BoolArray,
) -> FloatArray:
    """Compute a scalar from the strain at each site.

    A volume is processed a few planes at a time, because the strains of all sites would require
    nine times the memory of the result.

    Parameters
    ----------
    strains : callable
        Function of a range of the first axis. It returns the strains of the tissue, (N, n, n); the
        strains perpendicular to an image, (N,) or 0; and the mask of the N sites.
    value : callable
        Function that computes scalars, (N,), from the two kinds of strain.
    tissue : ndarray of bool, shape ([D,] H, W)

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        Scalars; NaN outside tissue.
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
            compute_thread.check_cancelled()
            span = slice(at, at + _AT_ONCE)
            beyond = np.asarray(through)[span] if np.ndim(through) else through
            parts.append(np.asarray(value(strain[span], beyond), np.float32))
        values[begin:end][tissue[begin:end]] = np.concatenate(parts)
    return values


def principal_strains(strain: npt.ArrayLike) -> FloatArray:
    """Return the principal strains, which are the eigenvalues of the strain tensor.

    Parameters
    ----------
    strain : array_like, shape (..., n, n)
        Symmetric strain of a slice or volume, from `small_strain` or `green_lagrange_strain`.

    Returns
    -------
    ndarray, shape (..., n), float32
        Principal strains in descending order; NaN where the strain is NaN.

    Raises
    ------
    ProblemError
        If the strain has an invalid shape.
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
    """Return the von Mises equivalent strain, a scalar measure of distortion.

    The equivalent strain is sqrt(2/3 e':e'), where e' = e - tr(e)/3 I is the deviatoric part of the
    strain, which changes the shape but not the volume. The equivalent strain equals e for a bar of
    incompressible tissue that is stretched by e along its axis, and g / sqrt(3) for a simple shear
    by g.

    Parameters
    ----------
    strain : array_like, shape (..., 2, 2) or (..., 3, 3)
        Symmetric strain tensors; for an image, the strain in its plane.
    through : array_like, shape (...)
        Strain perpendicular to an image, which the image does not determine. It is 0 for a slice
        between fixed neighbours, and `strain_through_slice` for a slice that is free to bulge.
        Shears perpendicular to the image are assumed to be 0. Ignored for a volume.

    Returns
    -------
    ndarray, shape (...), float32
        Non-negative values; NaN where the strain is NaN.

    Raises
    ------
    ProblemError
        If the strain has an invalid shape.
    """
    tensor = _as_strain(strain, 2, 3)
    across = as_numbers("through", through).astype(np.float64)
    # Subtracting infinite strains is invalid, and squaring very large strains overflows.
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
    """Return the strain perpendicular to a slice in plane stress: -nu / (1 - nu) (e_rr + e_cc).

    Parameters
    ----------
    strain : array_like, shape (..., 2, 2)
        Small strain in the plane of the slice.
    poisson : array_like, shape (...)
        Poisson's ratio nu, below 0.5.

    Returns
    -------
    ndarray, shape (...), float32
        Strain; negative where the slice becomes thinner.

    Raises
    ------
    ProblemError
        If the strain has an invalid shape, or Poisson's ratio is out of range.
    """
    tensor = _as_strain(strain, 2)
    ratio = as_numbers("poisson", poisson).astype(np.float64)
    if not ((ratio > -1) & (ratio < 0.5)).all():
        raise ProblemError("poisson", "must be above -1 and below 0.5 everywhere.")
    trace = tensor[..., 0, 0] + tensor[..., 1, 1]
    return np.asarray(-ratio / (1 - ratio) * trace, dtype=np.float32)


def displacement_gradient(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None,
    parts: npt.ArrayLike | None,
) -> tuple[Float64Array, Sites]:
    """Return the gradient H = dd/dX, (N, n, n), at the N tissue sites, and the `numbered_sites`."""
    gradient, sites = gradient_of_differences(displacement, spacing, tissue, parts)
    followers = followers_at(sites)
    if followers is not None:
        own = followers.gradient(as_field(displacement)) / checked_sizes(spacing, sites.ndim)
        gradient[np.searchsorted(np.flatnonzero(sites), followers.sites)] = own
    return gradient, sites


def gradient_of_differences(
    displacement: npt.ArrayLike,
    spacing: Spacing,
    tissue: npt.ArrayLike | None,
    parts: npt.ArrayLike | None,
) -> tuple[Float64Array, Sites]:
    """Return the `displacement_gradient` from differences alone, also at sites in no element."""
    moved, sites = numbered_sites(displacement, spacing, tissue, parts)
    n, mask = sites.ndim, sites.astype(bool)
    sizes = checked_sizes(spacing, n)
    if n == 3 and parts is None and loops.ready_for_volumes():
        loader.before_numba()
        from napari_hmrf.field.volume_loops import gradients  # heavy: numba

        return gradients(moved, loops.only_read(mask), sizes), sites
    gradient = np.empty((*moved.shape, n))
    for axis, (following, previous) in enumerate(differences_along_axes(moved, sites)):
        gradient[..., axis] = (following + previous) / 2 - np.eye(n)[axis]
    # Convert steps in pixels to lengths, because pixel sizes may differ between axes.
    return gradient[mask] * (sizes[:, None] / sizes), sites


def on_sites(values: Float64Array, sites: Sites) -> FloatArray:
    """Scatter values at the tissue sites to all pixels; NaN outside tissue."""
    image = np.full((*sites.shape, *values.shape[1:]), np.nan, np.float32)
    image[sites.astype(bool)] = values
    return image


def symmetric(tensor: Float64Array) -> Float64Array:
    """Return the symmetric part of tensors, shape (..., n, n)."""
    part: Float64Array = (tensor + tensor.swapaxes(-1, -2)) / 2
    return part


def _as_strain(strain: npt.ArrayLike, *axes: int) -> Float64Array:
    """Check that strains are (n, n) tensors with n in `axes`, and convert them to float64."""
    tensor = as_numbers("strain", strain).astype(np.float64, copy=False)
    if tensor.shape[-2:] not in [(n, n) for n in axes]:
        needed = " or ".join(f"(..., {n}, {n})" for n in axes)
        raise ProblemError(
            "strain", f"has shape {tensor.shape}. Pass {needed}, in the order of the axes."
        )
    return tensor
