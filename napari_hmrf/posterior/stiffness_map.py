"""Stiffness of each site from the measured motion of tissue: elastography.

The map of u = log m, the logarithm of the stiffness, minimizes

    1/2 sum of |d(u) - y|^2 / s^2  +  a sum of |grad u|

where d is the displacement of the tissue, y the measured one and s its standard deviation. The
second term, the total variation of u, keeps the map constant within a tissue and allows jumps
between tissues. Its weight a is reduced until the differences from the measured motion are as large
as their errors (the discrepancy principle). The total variation lowers the contrast of a jump; the
last steps therefore weigh large gradients less.

Each Gauss-Newton step solves a linear system by conjugate gradients. A product with its matrix
takes two solves: the response to forces, and that to the differences (the adjoint).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.field_data import FieldData
from napari_hmrf.posterior.response import Response
from napari_hmrf.posterior.sampling import checked_prior
from napari_hmrf.solver.neighbours import around_sites, corner_slices, pairs
from napari_hmrf.solver.optimizers import Monitor, Multigrid
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.priors.elements import Lame, element_stiffness, of_elements
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments, solve

Float64Array = npt.NDArray[np.float64]

#: Number of weights of the total variation, and ratio of a weight to the one before.
_WEIGHTS, _RATIO = 14, 0.5
#: Gauss-Newton steps for each weight, and products of each step.
_STEPS, _PRODUCTS = 2, 12
#: Misfit at which the weight is small enough.
_MISFIT = 1.02
#: Gradient of u, per site, below which the total variation is quadratic.
_SMOOTH = 0.02
#: Largest change of u in a step, and largest |u|.
_LARGEST_STEP, _LARGEST = 1.0, 5.0
#: Steps that do not punish large jumps, their factor on the weight, and what a large jump is.
_JUMP_STEPS, _JUMP_WEIGHT, _JUMP = 5, 2.0, 0.1
#: Part of the weight that keeps u at 0 where the motion does not determine it.
_RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class StiffnessMap:
    """Stiffness of each site that explains a measured motion.

    Attributes
    ----------
    stiffness : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness in the unit of the initial guess, up to a common factor; 0 in void.
    misfit : float
        Mean squared difference from the measured motion, in units of its variance.
    weight : float
        Weight of the total variation.
    solution : Solution
        Solution with this stiffness.
    """

    stiffness: npt.NDArray[np.float32]
    misfit: float
    weight: float
    solution: Solution

    def __repr__(self) -> str:
        tissue = self.stiffness[self.stiffness > 0]
        return f"StiffnessMap({tissue.min():.3g} to {tissue.max():.3g}, misfit {self.misfit:.3g})"


def stiffness_map(
    problem: Problem,
    measured: npt.ArrayLike,
    *,
    sd: npt.ArrayLike,
    prior: Prior | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> StiffnessMap:
    """Compute a map of the stiffness from the measured motion of tissue.

    Use `fit` instead if the labels of the tissue are known: it is more accurate, and states
    intervals.

    Parameters
    ----------
    problem : Problem
        Tissue with an initial guess of the stiffness, usually uniform, and its boundary conditions:
        sites whose motion is known, and forces. Only ratios of stiffness affect the motion unless
        there are forces.
    measured : array_like, shape (H, W, 2) or (D, H, W, 3)
        Measured displacement in the unit of `spacing`; NaN where it is unknown. See `fit`.
    sd : float or array_like, shape (H, W) or (D, H, W)
        Standard deviation of each component of the measured displacement.
    prior, backend, progress, cancel
        As for `fit`.

    Returns
    -------
    StiffnessMap

    Raises
    ------
    ProblemError
        If the input is invalid, or tissue grows or is rigid.
    Cancelled
        If `cancel` was set.

    References
    ----------
    A. Oberai, N. Gokhale, G. Feijoo: Solution of inverse problems in elasticity imaging using the
    adjoint method. Inverse Problems 19, 2003.
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    bare = variant_of(problem, precision=None, landmarks=None)
    elastic = checked_prior(bare, prior)
    if problem.loads is not None and problem.loads.growth is not None:
        raise ProblemError("loads", "contain growth. Use fit() for tissue that grows.")
    if problem.rigid.any():
        raise ProblemError(
            "stiffness", "is infinite (rigid) somewhere. Use fit(), or a finite stiffness."
        )
    data = FieldData.of(problem, measured, sd, None)
    return _Mapper(bare, elastic, data, backend, cancel).run(progress)


class _Mapper:
    """Gauss-Newton iteration for the logarithm of the stiffness."""

    def __init__(
        self,
        problem: Problem,
        prior: ElasticPrior,
        data: FieldData,
        backend: str,
        cancel: CancelFlag | None,
    ) -> None:
        self._initial, self._prior, self._data = problem, prior, data
        self._backend, self._cancel = backend, cancel
        self._optimizer = Multigrid(tolerance=data.tolerance(problem))
        self._tissue = problem.tissue
        self._shape = prior.shape(problem.spacing)
        self._matrices = element_stiffness(self._shape)
        # Lame parameters of elements of stiffness 1; 0 in void.
        uniform = self._tissue.astype(np.float32)
        self._lame = prior.lame(variant_of(problem, stiffness=uniform))
        self._unit = problem.unit ** (self._tissue.ndim - 2)

    def run(self, progress: Progress | None) -> StiffnessMap:
        """Return the map."""
        u = np.zeros(self._initial.shape)
        problem, solution = self._at(u)
        misfit = self._misfit(solution)
        weight = self._first_weight(problem, solution) / _RATIO
        for number in range(_WEIGHTS):
            if progress is not None:
                progress(Monitor(f"map {number + 1} of at most {_WEIGHTS}", number / _WEIGHTS))
            if misfit <= _MISFIT:
                break
            weight *= _RATIO
            for _ in range(_STEPS):
                u, problem, solution = self._moved(u, problem, solution, weight, jumps=False)
            misfit = self._misfit(solution)
        for _ in range(_JUMP_STEPS):
            u, problem, solution = self._moved(
                u, problem, solution, _JUMP_WEIGHT * weight, jumps=True
            )
        return StiffnessMap(problem.stiffness, self._misfit(solution), weight, solution)

    def _moved(
        self, u: Float64Array, problem: Problem, solution: Solution, weight: float, jumps: bool
    ) -> tuple[Float64Array, Problem, Solution]:
        """Return u after a Gauss-Newton step, and the tissue with this stiffness."""
        step = self._step(u, problem, solution, weight, jumps)
        step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-30))
        u = np.clip(u + step, -_LARGEST, _LARGEST)
        return u, *self._at(u)

    def _at(self, u: Float64Array) -> tuple[Problem, Solution]:
        m = (self._initial.stiffness * np.exp(u)).astype(np.float32)
        problem = variant_of(self._initial, stiffness=m)
        solution = solve(
            problem,
            self._prior,
            optimizer=self._optimizer,
            backend=self._backend,
            cancel=self._cancel,
        )
        return problem, solution

    def _misfit(self, solution: Solution) -> float:
        differences = self._data.misfit(solution.displacement)
        return float(differences @ differences) / differences.size

    def _first_weight(self, problem: Problem, solution: Solution) -> float:
        """Return a weight for which the map is nearly uniform."""
        response = Response(problem, self._prior, self._backend, self._cancel)
        gradient = self._gradient(problem, solution, response)
        return float(np.abs(gradient[self._tissue]).max()) * max(self._initial.shape) / 8

    def _gradient(self, problem: Problem, solution: Solution, response: Response) -> Float64Array:
        """Return the gradient of the misfit with respect to u."""
        pull = self._data.pull(self._data.misfit(solution.displacement), solution.displacement)
        moved = response.to(pull).astype(np.float64)
        return -self._products(problem, moved, solution.displacement)

    def _step(
        self, u: Float64Array, problem: Problem, solution: Solution, weight: float, jumps: bool
    ) -> Float64Array:
        """Return a Gauss-Newton step of u."""
        response = Response(problem, self._prior, self._backend, self._cancel)
        d = solution.displacement
        shares = _variation_shares(u, self._tissue, jumps)
        right = -self._gradient(problem, solution, response)
        right -= weight * (_variation(u, shares) + _RIDGE * u)
        tolerances: dict[str, float] = {}

        def solved(kind: str, force: Float64Array) -> Float64Array:
            # Forces of later products have about the size of the first.
            size = float(np.sqrt((force**2).mean()))
            if size == 0:
                return np.zeros_like(force)
            scaled = force / size
            if kind not in tolerances:
                tolerances[kind] = response.tolerance_for(scaled)
            return size * response.to(scaled, tolerances[kind]).astype(np.float64)

        def product(flat: npt.NDArray[Any]) -> Float64Array:
            v = np.zeros(u.shape)
            v[self._tissue] = flat
            moved = solved("forward", -self._forces(problem, v, d))
            back = solved("adjoint", self._data.pull(self._data.derivative(d, moved), d))
            found = -self._products(problem, back, d)
            found += weight * (_variation(v, shares) + _RIDGE * v)
            return np.asarray(found[self._tissue])

        size = int(self._tissue.sum())
        operator = scipy.sparse.linalg.LinearOperator(
            (size, size), matvec=product, dtype=np.float64
        )
        inside, _ = scipy.sparse.linalg.cg(
            operator, right[self._tissue], rtol=0.05, maxiter=_PRODUCTS
        )
        step = np.zeros(u.shape)
        step[self._tissue] = inside
        return step

    def _products(self, problem: Problem, back: Float64Array, d: npt.NDArray[Any]) -> Float64Array:
        """Return the derivatives of ``back . K d`` with respect to u, in the unit of `Loads`."""
        one, other = _at_corners(back), _at_corners(d)
        energies = sum(
            lame * np.einsum("...i,ij,...j->...", one, matrix, other)
            for matrix, lame in zip(self._matrices, self._lame, strict=True)
        )
        share = self._unit * problem.stiffness / 2**problem.stiffness.ndim
        return np.asarray(share * around_sites(np.asarray(energies), np.add))

    def _forces(self, problem: Problem, v: Float64Array, d: npt.NDArray[Any]) -> Float64Array:
        """Return the change of the forces K d for a change v of u."""
        change = of_elements(problem.stiffness * v)
        lame = Lame(*(each * change for each in self._lame))
        return np.asarray(self._unit * self._shape.forces(lame, d.astype(np.float64)))


def _at_corners(field: npt.NDArray[Any]) -> Float64Array:
    """Return the components at the corners of each element, shape (h, w, 8) or (d, h, w, 24)."""
    elements = tuple(size - 1 for size in field.shape[:-1])
    parts = [field[sites] for sites in corner_slices(elements)]
    return np.concatenate(parts, axis=-1).astype(np.float64)


def _variation_shares(
    u: Float64Array, tissue: npt.NDArray[np.bool_], jumps: bool
) -> list[Float64Array]:
    """Return the weight of each difference of neighbours in the total variation of u.

    The variation is ``sum of sqrt(|grad u|^2 + e^2)``; its gradient divides each difference by the
    root (lagged diffusivity). With `jumps`, large gradients count less.
    """
    squares = np.zeros(u.shape)
    for first, last in pairs(u.ndim):
        squares[first] += (tissue[first] & tissue[last]) * (u[last] - u[first]) ** 2
    roots = np.sqrt(squares + _SMOOTH**2)
    if jumps:
        roots *= 1 + squares / _JUMP**2
    return [(tissue[first] & tissue[last]) / roots[first] for first, last in pairs(u.ndim)]


def _variation(v: Float64Array, shares: list[Float64Array]) -> Float64Array:
    """Return the product of the matrix of the total variation with v."""
    found = np.zeros(v.shape)
    for (first, last), share in zip(pairs(v.ndim), shares, strict=True):
        flow = share * (v[last] - v[first])
        found[first] -= flow
        found[last] += flow
    return found
