"""Cauchy stress of elastic tissue: force per area of the deformed tissue.

An element is a block of 2 x 2 (2 x 2 x 2) sites; its stress is that of its centre, where the strain
of a bilinear element is most accurate. The stress of a site is the mean of the elements around it.
With the elastic strain e and the elastic gradient F = I + H of `elastic_strain`, which exclude
growth, and J = det F,

    linear elasticity   s = lambda tr(e) I + 2 mu e
    large motion        s = (mu (F F^T - I) + lambda / 2 (J^2 - 1) I) / J

Both include the direction perpendicular to an image: s_z is 0 in plane stress. For an image, the
first axis of a tensor is perpendicular to the image. Shear stresses perpendicular to the image are
0. The barrier with which large motion prevents folds is not part of the stress.

Stress has the unit of the stiffness. It is NaN outside tissue, in rigid tissue, whose stress the
motion does not determine, and at sites without an element. At a free surface that is not parallel
to the grid, the pixels form a staircase; docs/concepts/stress.md shows what their stress means.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import add
from typing import Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import is_one_of, refuse_unless
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.deformation import FloatArray
from napari_hmrf.field.neighbours import around_sites, of_corners, pairs
from napari_hmrf.field.parts import in_one_part, part_numbers
from napari_hmrf.field.warp import BoolArray, Float64Array
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.solver.elastic_strain import growth_at, strain_of_gradient
from napari_hmrf.solver.elasticity import Elasticity, MovedTissue

Place = Literal["sites", "elements"]
#: Number of planes of a volume that are processed together, to limit memory.
_SLAB = 8


def von_mises_stress(stress: npt.ArrayLike) -> FloatArray:
    """Return the von Mises stress, sqrt(3/2 s':s'), of the deviatoric stress s'.

    Parameters
    ----------
    stress : array_like, shape (..., 3, 3)
        Stress tensors, as from `Solution.stress`.

    Returns
    -------
    ndarray, shape (...), float32
        0 for a hydrostatic stress, and the tension of a bar that is pulled along its axis.

    Raises
    ------
    ProblemError
        If the stress has an invalid shape.
    """
    tensor = _as_stress(stress)
    deviatoric = tensor + pressure_of(tensor)[..., None, None] * np.eye(3)
    square = 1.5 * np.einsum("...ij,...ij", deviatoric, deviatoric)
    return np.asarray(np.sqrt(square), np.float32)


def hydrostatic_pressure(stress: npt.ArrayLike) -> FloatArray:
    """Return the pressure, minus a third of the trace of the stress; positive if compressed.

    Parameters
    ----------
    stress : array_like, shape (..., 3, 3)
        Stress tensors, as from `Solution.stress`.

    Returns
    -------
    ndarray, shape (...), float32

    Raises
    ------
    ProblemError
        If the stress has an invalid shape.
    """
    return pressure_of(_as_stress(stress)).astype(np.float32)


def pressure_of(stress: Float64Array) -> Float64Array:
    """Return the pressure of stress tensors, shape (..., 3, 3), in their own precision."""
    return np.asarray(-np.einsum("...ii", stress) / 3)


def stress_values(
    solution: MovedTissue,
    value: Callable[[Float64Array], npt.NDArray[np.floating]] = np.asarray,
    *,
    at: Place = "sites",
    fraction: float = 1.0,
) -> FloatArray:
    """Compute the stress of a solution, or a value of it, at each site or element.

    Parameters
    ----------
    solution : Solution
        Solution of a model of elastic tissue.
    value : callable
        Function that maps tensors, (N, 3, 3), to values, (N, ...); by default the tensors.
    at : {"sites", "elements"}
    fraction : float
        Fraction of the deformation and of the growth, from 0 to 1.

    Returns
    -------
    ndarray, shape ([D,] H, W, ...) or, for elements, ([D - 1,] H - 1, W - 1, ...), float32
        NaN where there is no stress.

    Raises
    ------
    ArgumentError
        If `at` is not one of these values.
    ProblemError
        If the model has no stress, such as the paper's model.
    """
    known = is_one_of(at, ("sites", "elements"))
    refuse_unless(known, "at", at, '"sites" or "elements"')
    elasticity = solution.elasticity
    if elasticity is None:
        raise ProblemError(
            "solution",
            "has no stress, because its model has no elastic tissue. Solve with ElasticPrior() or "
            "NeoHookeanPrior().",
        )
    of_sites = at == "sites"
    shape = tuple(size if of_sites else size - 1 for size in solution.tissue.shape)
    values = np.full((*shape, *value(np.zeros((0, 3, 3))).shape[1:]), np.nan, np.float32)
    slab = len(solution.tissue) if len(shape) == 2 else _SLAB
    for begin in range(0, shape[0], slab):
        compute_thread.check_cancelled()
        first = max(begin - 1, 0) if of_sites else begin
        planes = slice(first, begin + slab + 1)
        tensors, known_at = _of_elements(solution, elasticity, planes, fraction)
        if of_sites:
            tensors, known_at = _around(tensors, known_at, solution.tissue[planes])
        inner = slice(begin - first, begin - first + slab)
        tensors, known_at = tensors[inner], known_at[inner]
        values[begin : begin + slab][known_at] = value(tensors[known_at])
    return values


def _of_elements(
    solution: MovedTissue, elasticity: Elasticity, planes: slice, fraction: float
) -> tuple[Float64Array, BoolArray]:
    """Return the stress of each element in a range of the first axis, and the deformable elements.

    The stress has shape ([D,] H, W, 3, 3) and is 0 in other elements.
    """
    tissue = solution.tissue[planes]
    sites = part_numbers(tissue, None if solution.parts is None else solution.parts[planes])
    stiffness, nu = elasticity.stiffness[planes], elasticity.poisson
    known = in_one_part(sites) & of_corners(np.isfinite(stiffness), np.logical_and)
    mean = partial(_element_means, known=known)
    d = np.where(tissue[..., None], solution.displacement[planes], 0) * np.float64(fraction)
    gradient = _gradients(d, solution.spacing)[known]
    growth, growth_across = growth_at(elasticity, planes, sites, mean, fraction)
    ratio = nu if isinstance(nu, float) else mean(nu[planes])
    own, strain, across = strain_of_gradient(elasticity, gradient, growth, growth_across, ratio)
    if elasticity.finite:
        of_tissue = _neo_hookean_stress(
            _lifted(own, np.sqrt(1 + 2 * np.asarray(across)) - 1), mean(stiffness), ratio
        )
    else:
        of_tissue = _linear_stress(_lifted(strain, across), mean(stiffness), ratio)
    tensors = np.zeros((*known.shape, 3, 3))
    tensors[known] = of_tissue
    return tensors, known


def _linear_stress(strain: Float64Array, young: Float64Array, nu: npt.ArrayLike) -> Float64Array:
    """Return s = lambda tr(e) I + 2 mu e for strains, (N, 3, 3)."""
    first, shear = _lame(young, nu)
    trace = np.einsum("...ii", strain)
    return np.asarray(
        np.einsum("...,ij->...ij", first * trace, np.eye(3))
        + np.einsum("...,...ij->...ij", 2 * shear, strain)
    )


def _neo_hookean_stress(
    gradient: Float64Array, young: Float64Array, nu: npt.ArrayLike
) -> Float64Array:
    """Return s = (mu (F F^T - I) + lambda / 2 (J^2 - 1) I) / J for F = I + H, (N, 3, 3)."""
    first, shear = _lame(young, nu)
    f = np.eye(3) + gradient
    volume = np.linalg.det(f)
    left = np.einsum("...ik,...jk->...ij", f, f) - np.eye(3)
    with np.errstate(all="ignore"):  # a part of a large rotation may flatten tissue
        return np.asarray(
            np.einsum("...,...ij->...ij", shear / volume, left)
            + np.einsum("...,ij->...ij", first / 2 * (volume - 1 / volume), np.eye(3))
        )


def _lame(young: Float64Array, nu: npt.ArrayLike) -> tuple[Float64Array, Float64Array]:
    """Return lambda and mu in three dimensions."""
    ratio = np.asarray(nu)
    shear = young / (2 * (1 + ratio))
    return 2 * shear * ratio / (1 - 2 * ratio), shear


def _lifted(tensors: Float64Array, across: npt.ArrayLike) -> Float64Array:
    """Return tensors of an image, (N, 2, 2), with the component across it, as (N, 3, 3)."""
    if tensors.shape[-1] == 3:
        return tensors
    whole = np.zeros((len(tensors), 3, 3))
    whole[:, 1:, 1:], whole[:, 0, 0] = tensors, across
    return whole


def _gradients(d: Float64Array, spacing: tuple[float, ...]) -> Float64Array:
    """Return the displacement gradient at the centre of each element, ([D,] H, W, n, n)."""
    columns = []
    for along, size in enumerate(spacing):
        column = d
        for axis, (before, after) in enumerate(pairs(len(spacing))):
            one, other = column[before], column[after]
            column = (other - one) / size if axis == along else (one + other) / 2
        columns.append(column)
    return np.stack(columns, axis=-1)


def _element_means(values: npt.NDArray[np.floating], *, known: BoolArray) -> Float64Array:
    """Return the mean over the corners of each element of a mask, (N,)."""
    finite = np.where(np.isfinite(values), values, 0).astype(np.float64)
    return np.asarray((of_corners(finite, add) / 2**known.ndim)[known])


def _around(
    tensors: Float64Array, known: BoolArray, tissue: BoolArray
) -> tuple[Float64Array, BoolArray]:
    """Return the mean stress of the elements around each site, and the sites that have one."""
    count = around_sites(known.astype(int), add)
    mean = np.zeros((*count.shape, 3, 3))
    for i, j in np.ndindex(3, 3):
        mean[..., i, j] = around_sites(tensors[..., i, j], add) / np.maximum(count, 1)
    return mean, (count > 0) & tissue


def _as_stress(stress: npt.ArrayLike) -> Float64Array:
    """Check that stresses are (3, 3) tensors, and convert them to float64."""
    tensor = as_numbers("stress", stress).astype(np.float64, copy=False)
    if tensor.shape[-2:] != (3, 3):
        raise ProblemError("stress", f"has shape {tensor.shape}. Pass (..., 3, 3) tensors.")
    return tensor
