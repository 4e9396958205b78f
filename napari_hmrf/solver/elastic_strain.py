"""Elastic strain of a solution: the part of the strain that stores elastic energy.

Elastic strain excludes growth and includes the strain perpendicular to an image. With H = dd/dX,
the growth strain g and its component g_z perpendicular to an image,

    linear elasticity   e = (H + H^T) / 2 - g
    large motion        e = (Fe^T Fe - I) / 2,   Fe = (I + H) (I + g)^-1,   J = det Fe

and, perpendicular to an image,

                        plane stress                                     plane strain
    linear elasticity   e_z = -nu / (1 - nu) (e_rr + e_cc)               e_z = -g_z
    large motion        e_z = nu (1 - J^2) / (2 (1 - 2 nu + nu J^2))   e_z = ((1 + g_z)^-2 - 1) / 2

In plane stress, the stress perpendicular to the slice is zero, which determines e_z. Shear strains
perpendicular to the image are assumed to be 0. Derivatives are computed as in
`green_lagrange_strain`. Growth and Poisson's ratio at a site are means over the elements around the
site, as in the model.

The paper's model has neither a Poisson's ratio nor a third direction, and growth is unknown for a
displacement without a model. In these two cases the total Green-Lagrange strain is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from operator import add
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.followers import followers_of
from napari_hmrf.field.neighbours import around_sites, of_corners
from napari_hmrf.field.parts import Sites, in_one_part
from napari_hmrf.field.strain import (
    gradient_of_differences,
    green_lagrange,
    on_sites,
    symmetric,
    values_by_parts,
)
from napari_hmrf.field.warp import BoolArray, Float64Array
from napari_hmrf.real_arrays import FloatArray
from napari_hmrf.solver.elasticity import Elasticity, MovedTissue

#: Kinds of strain: elastic strain; total strain within an image; total strain of a volume.
StrainKind = Literal["elastic", "in-plane", "total"]
#: Function that maps strains, (N, n, n), and strains perpendicular to an image, (N,) or 0, to
#: values, (N,).
StrainValue = Callable[[Float64Array, npt.ArrayLike], npt.NDArray[np.floating]]


def strain_kind(solution: MovedTissue) -> StrainKind:
    """Return the kind of strain that `measure` and the colour overlays use for a solution."""
    if solution.elasticity is not None:
        return "elastic"
    return "in-plane" if solution.tissue.ndim == 2 else "total"


def strain_note(solution: MovedTissue) -> str:
    """Explain in a clause why the elastic strain of a solution is unknown; "" if it is known."""
    if solution.elasticity is not None:
        return ""
    total = "its strain is the total strain"
    total += ", within the image" if solution.tissue.ndim == 2 else ""
    prior = solution.provenance.parameters.get("prior")
    name = prior.get("name") if isinstance(prior, dict) else None
    if name == "SeilerPrior":
        return f"the paper's model has no Poisson's ratio and no third direction: {total}"
    return f"no model of the tissue is known: {total}"


def elastic_strain(solution: MovedTissue) -> FloatArray:
    """Return the elastic strain tensor of a solution in all three dimensions.

    Parameters
    ----------
    solution : Solution
        Solution of a model of elastic tissue.

    Returns
    -------
    ndarray, shape ([D,] H, W, 3, 3), float32
        Symmetric tensors at the undeformed sites, in axis order. For an image, the first
        component is perpendicular to the image. Small strain for `ElasticPrior`, Green-Lagrange
        strain for `NeoHookeanPrior`. NaN outside tissue.

    Raises
    ------
    ProblemError
        If the model has no elastic strain, or the solution was read from a file without growth and
        Poisson's ratios.
    """
    if solution.elasticity is None:
        raise ProblemError(
            "solution",
            f"has no elastic strain: {strain_note(solution)}. Use another kind of strain.",
        )
    strain, across, mask = _elastic(solution, slice(None), 1.0)
    if mask.ndim == 2:
        whole = np.zeros((len(strain), 3, 3))
        whole[:, 1:, 1:], whole[:, 0, 0] = strain, across
        strain = whole
    return on_sites(strain, mask)


def values_of_strain(
    solution: MovedTissue, value: StrainValue, fraction: float = 1.0
) -> FloatArray:
    """Compute a scalar from the strain at each site; `strain_kind` gives the kind of strain.

    Parameters
    ----------
    solution : Solution
    value : callable
        Function that maps strains to scalars, such as `equivalent_strain`.
    fraction : float
        Fraction of the deformation and of the growth, from 0 to 1.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        NaN outside tissue.
    """
    known = solution.elasticity is not None

    def strains(sites: slice) -> tuple[Float64Array, npt.ArrayLike, BoolArray]:
        return (_elastic if known else _total)(solution, sites, fraction)

    return values_by_parts(strains, value, solution.tissue)


def _total(
    solution: MovedTissue, sites: slice, fraction: float
) -> tuple[Float64Array, npt.ArrayLike, BoolArray]:
    """Compute the total Green-Lagrange strain in a range of the first axis.

    Return the strain, (N, n, n), the strain perpendicular to the image, which is 0, and the mask of
    the N sites.
    """
    gradient, numbers = _gradient(solution, sites, fraction)
    return green_lagrange(gradient), 0.0, numbers.astype(bool)


def _gradient(solution: MovedTissue, sites: slice, fraction: float) -> tuple[Float64Array, Sites]:
    """Return the `displacement_gradient` in a range of the first axis."""
    d = solution.displacement[sites] * np.float32(fraction)
    parts = None if solution.parts is None else solution.parts[sites]
    gradient, numbers = gradient_of_differences(d, solution.spacing, solution.tissue[sites], parts)
    # An orphan near the end of the range follows tissue beyond it.
    found = followers_of(solution.tissue, solution.parts)
    if found is not None:
        own = fraction * found.gradient(solution.displacement) / np.array(solution.spacing)
        inside, at = _within(found.sites, sites, solution.tissue.shape)
        gradient[np.searchsorted(np.flatnonzero(numbers), at)] = own[inside]
    return gradient, numbers


def _within(
    found: npt.NDArray[np.intp], sites: slice, shape: tuple[int, ...]
) -> tuple[BoolArray, npt.NDArray[np.intp]]:
    """Return which flat indices are in a range of the first axis, and their indices there."""
    first, end, _ = sites.indices(shape[0])
    plane = math.prod(shape[1:])
    inside = (found >= first * plane) & (found < end * plane)
    return inside, found[inside] - first * plane


def _elastic(
    solution: MovedTissue, sites: slice, fraction: float
) -> tuple[Float64Array, npt.ArrayLike, BoolArray]:
    """Compute the elastic strain in a range of the first axis; 0 in rigid tissue.

    Return the strain, (N, n, n), the strain perpendicular to the image, and the mask of the N
    sites.
    """
    elasticity = solution.elasticity
    assert elasticity is not None
    strain, across, mask = _of_model(solution, elasticity, sites, fraction)
    if elasticity.rigid is not None:
        # Differences at the border involve soft neighbours, but rigid tissue has no strain.
        rigid = elasticity.rigid[sites][mask]
        strain[rigid], across = 0, np.where(rigid, 0.0, across)
    return strain, across, mask


def _of_model(
    solution: MovedTissue, elasticity: Elasticity, sites: slice, fraction: float
) -> tuple[Float64Array, npt.ArrayLike, BoolArray]:
    """Compute the strain as in `_elastic`, without setting it to 0 in rigid tissue."""
    gradient, numbers = _gradient(solution, sites, fraction)
    mean, nu = partial(_of_elements, numbers=numbers), elasticity.poisson
    growth, growth_across = growth_at(elasticity, sites, numbers, mean, fraction)
    # Only plane stress depends on Poisson's ratio.
    in_slice = numbers.ndim == 2 and elasticity.plane == "stress"
    ratio = mean(nu[sites]) if in_slice and not isinstance(nu, float) else nu
    _, strain, across = strain_of_gradient(elasticity, gradient, growth, growth_across, ratio)
    return strain, across, numbers.astype(bool)


def strain_of_gradient(
    elasticity: Elasticity,
    gradient: Float64Array,
    growth: Float64Array | None,
    growth_across: npt.ArrayLike,
    ratio: npt.ArrayLike,
) -> tuple[Float64Array, Float64Array, npt.ArrayLike]:
    """Return the elastic part of displacement gradients at N places.

    Parameters
    ----------
    elasticity : Elasticity
    gradient : ndarray, shape (N, n, n)
        Displacement gradients H.
    growth, growth_across
        As from `growth_at`.
    ratio : float or ndarray, shape (N,)
        Poisson's ratio.

    Returns
    -------
    own : ndarray, shape (N, n, n)
        Elastic gradients: Fe - I for large motion, H - g for linear elasticity.
    strain : ndarray, shape (N, n, n)
        Elastic strains.
    across : float or ndarray, shape (N,)
        Elastic strain perpendicular to an image; 0 in a volume.
    """
    n = gradient.shape[-1]
    if elasticity.finite:
        if growth is not None:
            step = np.eye(n)
            gradient = (step + gradient) @ np.linalg.inv(step + growth) - step
        strain = green_lagrange(gradient)
    else:
        gradient = gradient if growth is None else gradient - growth
        strain = symmetric(gradient)
    if n == 3:
        return gradient, strain, 0.0
    if elasticity.plane == "strain":
        stretch = 1 / (1 + np.asarray(growth_across))
        across = (stretch**2 - 1) / 2 if elasticity.finite else -np.asarray(growth_across)
        return gradient, strain, np.broadcast_to(across, strain.shape[:1])
    nu = np.asarray(ratio)
    if elasticity.finite:
        squared = np.linalg.det(np.eye(2) + gradient) ** 2
        across = nu * (1 - squared) / (2 * (1 - 2 * nu + nu * squared))
    else:
        across = -nu / (1 - nu) * np.trace(strain, axis1=-2, axis2=-1)
    return gradient, strain, across


def growth_at(
    elasticity: Elasticity,
    sites: slice,
    numbers: Sites,
    mean: Callable[[npt.NDArray[Any]], Float64Array],
    fraction: float,
) -> tuple[Float64Array | None, npt.ArrayLike]:
    """Return the growth strain at N places, (N, n, n) or None, and its normal component.

    Parameters
    ----------
    elasticity : Elasticity
    sites : slice
        Range of the first axis.
    numbers : ndarray of bool or int, shape ([D,] H, W)
        Part of each site in this range.
    mean : callable
        Function that maps values of the sites, ([D,] H, W), to their means at the places, (N,).
    fraction : float
        Fraction of the growth, from 0 to 1.
    """
    mask, n = numbers.astype(bool), numbers.ndim
    if elasticity.growth is None or not (grown := elasticity.growth[sites])[mask].any():
        return None, 0.0
    if grown.ndim == n:
        amount = fraction * mean(grown)
        return amount[:, None, None] * np.eye(n), amount
    parts = [[mean(grown[..., i, j]) for j in _axes(grown)] for i in _axes(grown)]
    tensor = fraction * np.moveaxis(np.array(parts), -1, 0)
    beyond = tensor.shape[-1] - n
    return tensor[:, beyond:, beyond:], tensor[:, 0, 0] if beyond else 0.0


def _axes(tensors: npt.NDArray[Any]) -> range:
    return range(tensors.shape[-1])


def _of_elements(values: npt.NDArray[Any], numbers: Sites) -> Float64Array:
    """Return, for each tissue site, the mean over the elements around it.

    The value of an element is the mean of its corners. A site without elements retains its value.
    """
    mask, elements = numbers.astype(bool), in_one_part(numbers)
    own = np.where(mask, values, 0).astype(np.float64)
    means = np.where(elements, of_corners(own, add) / 2**mask.ndim, 0.0)
    total, count = around_sites(means, add)[mask], around_sites(elements.astype(int), add)[mask]
    found: Float64Array = np.divide(total, count, out=own[mask], where=count > 0)
    return found
