"""Affine drift: a uniform strain of all tissue that is estimated together with landmarks.

A drift is a growth tensor A = sum of a_k e_k, equal in all tissue that is not rigid, where e_k are
the symmetric unit strains. Tissue that strains by A stores no energy. Rotations and translations of
free tissue cost no energy anyway, so the drift adds the other affine motions.

The field is linear in A. With t the solution without drift and s_k the response to the growth e_k
with all observations and loads set to 0, the field is t + sum of a_k s_k, and its energy is

    E(a) = E(0) + a . p + 1/2 a . M a,     p_k = (t, s_k),     M_kl = (s_k, s_l)

where ( , ) is the bilinear form of the energy. The least energy is at a = - M^-1 p. Both t and s_k
are stationary points of their energies, so errors of the fields have only a second-order effect on
p and M, and a is accurate for landmarks of any precision.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Monitor, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.priors.growth import slabs
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solution import Provenance, Solution
from napari_hmrf.solver.uncertain_landmarks import interpolated
from napari_hmrf.solver.volume_memory import check_memory
from napari_hmrf.solver.warm_start import Initial

Float64Array = npt.NDArray[np.float64]
Progress = Callable[[Monitor], None]
#: Function that solves a problem without drift with a prior, from a warm start, and reports its
#: progress.
Solve = Callable[[Problem, ElasticPrior, Optimizer, Initial | None, Progress | None], Solution]

# Share of the tolerance for the field without drift. The rest is for the responses.
_SHARE = 0.75
# Share of the tolerance for a response, whose error is multiplied by the strain of the drift.
_SHARE_OF_RESPONSE = 0.25
# Largest tolerance of a response, in pixels, so that previews and live solutions share responses.
_LARGEST_TOLERANCE = 0.01
# Standard deviation of an estimated strain above which the drift counts as unknown.
_LARGEST_SD = 1.0
# Smallest ratio of the eigenvalues of M at which M is regular despite rounding.
_REGULAR = 1e-9


def has_drift(problem: Problem, prior: Prior | None) -> bool:
    """Return whether a drift of elastic tissue is estimated; other priors refuse landmarks."""
    marks = problem.landmarks
    return marks is not None and marks.drift and isinstance(prior, ElasticPrior | None)


def without_drift(problem: Problem) -> Problem:
    """Return the same problem without a drift."""
    assert problem.landmarks is not None
    return variant_of(problem, landmarks=problem.landmarks.without_drift)


def with_drift_of(problem: Problem, solution: Solution) -> Problem:
    """Return the problem without drift that has the growth of a solution, drift included.

    The solution is also a solution of this problem.

    Parameters
    ----------
    problem : Problem
        Problem with a drift.
    solution : Solution
        Solution of this problem.
    """
    growth = None if solution.elasticity is None else solution.elasticity.growth
    force = None if problem.loads is None else problem.loads.force
    return variant_of(without_drift(problem), loads=Loads(growth=growth, force=force))


def drift_clauses(solution: Solution) -> tuple[str, ...]:
    """Return a clause with the principal strains of a solution's drift, or () without a drift."""
    drift = solution.provenance.parameters.get("drift")
    return () if drift is None else (_in_words(np.array(drift)),)


def solve_with_drift(
    problem: Problem,
    prior: ElasticPrior,
    optimizer: Optimizer,
    progress: Progress | None,
    initial: Initial | None,
    solve: Solve,
) -> Solution:
    """Solve a problem whose observations do not slip together with its drift.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
    optimizer : Optimizer
    progress : callable or None
    initial : Solution, sequence of Solution, or None
        Warm start. If there is one, the latest field without drift replaces it where possible.
    solve : callable
        Function that solves a problem without drift.

    Raises
    ------
    ProblemError
        If the landmarks do not determine a drift, or the drift would compress tissue to nothing.
    """
    check_memory(problem)
    begun = time.perf_counter()
    joined = connected(problem, prior)
    plain = without_drift(joined.without_orphans)
    found = _responses.valid(lambda last: last.covers(problem, prior, optimizer))
    solves = 1 if found is not None else 1 + len(_unit_strains(len(problem.shape)))
    # The responses come first, so that the field without drift does not depend on whether they
    # are cached: solves of the same tissue share what they find about their convergence.
    cached = found or _Responses.of(plain, prior, optimizer, progress, solves, solve)
    _responses.value = cached
    if initial is not None:
        initial = cached.latest or initial
    report = _part(progress, solves - 1, solves)
    base = solve(plain, prior, _tighter(optimizer, _SHARE), initial, report)
    cached.latest = base
    pull = cached.pull(plain, prior, base.displacement)
    amounts = _amounts(cached.matrix, pull, cached.unit_of_energy)
    drift = np.einsum("k,kij->ij", amounts, np.array(_unit_strains(len(problem.shape))))
    _check_size(drift)
    energy = base.energy.copy()
    # The iterations find the energy without drift; the last value is the energy of the result.
    energy[-1] += float(pull @ amounts) / 2 / np.count_nonzero(problem.tissue)
    loads = Loads(growth=growth_of(problem, drift), spacing=problem.spacing)
    loads = loads if problem.loads is None else problem.loads + loads
    assert base.elasticity is not None
    convergence = base.convergence
    if convergence is not None:
        far = sum(abs(amount) * error for amount, error in zip(amounts, cached.errors, strict=True))
        convergence = replace(convergence, error=convergence.error + float(far))
    return replace(
        base,
        displacement=cached.moved(base.displacement, amounts),
        energy=energy,
        convergence=convergence,
        provenance=provenance_of(base, problem, optimizer, drift.tolist(), begun),
        loads=loads,
        elasticity=replace(base.elasticity, growth=loads.growth),
        notes=(*dict.fromkeys((*joined.notes, *base.notes)), _in_words(drift)),
    )


def provenance_of(
    base: Solution, problem: Problem, optimizer: Optimizer, drift: Any, begun: float
) -> Provenance:
    """Return the provenance of a solution with a drift from that of its last field.

    Parameters
    ----------
    base : Solution
        Field without drift, or with a known one.
    problem : Problem
    optimizer : Optimizer
    drift : list of list of float
    begun : float
        Start of the work on the clock `time.perf_counter`.
    """
    run = base.provenance
    parameters = {**run.parameters, "optimizer": optimizer.parameters, "drift": drift}
    return replace(
        run,
        seconds=time.perf_counter() - begun - run.preparation_seconds,
        parameters=parameters,
        inputs=problem.digests,
    )


@dataclass(eq=False)
class _Responses:
    """Responses to the unit strains, for any targets, observed displacements and loads.

    Attributes
    ----------
    problem : Problem
        Problem without drift.
    prior : ElasticPrior
    settings : dict
        Parameters of the optimizer of the responses.
    fields : list of ndarray
        Displacement of each response, in the unit of the problem.
    forces : list of ndarray, float32
        Elastic forces of each response, relative to its growth, in the units of the model.
    at_points : list of ndarray, shape (n, axes)
        Displacement of the landmarks in each response, in pixels.
    matrix : ndarray
        M in the equations, in the units of the model.
    errors : list of float
        Estimated error of each response, in pixels.
    latest : Solution or None
        Latest solution without drift.
    """

    problem: Problem
    prior: ElasticPrior
    settings: dict[str, Any]
    fields: list[npt.NDArray[np.floating]]
    forces: list[npt.NDArray[np.float32]]
    at_points: list[Float64Array]
    matrix: Float64Array
    errors: list[float]
    latest: Solution | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        prior: ElasticPrior,
        optimizer: Optimizer,
        progress: Progress | None,
        solves: int,
        solve: Solve,
    ) -> _Responses:
        """Compute the responses, and the forces and the matrix that follow from them."""
        schedule, units = _response_optimizer(optimizer), _unit_strains(len(problem.shape))
        solved = [
            solve(
                _response_problem(problem, unit),
                prior,
                schedule,
                None,
                _part(progress, number, solves),
            )
            for number, unit in enumerate(units)
        ]
        bare = variant_of(problem, loads=None)
        fields = [each.displacement for each in solved]
        at_points = [_at_points(problem, field) for field in fields]
        forces, matrix = [], np.empty((len(units),) * 2)
        for k, unit in enumerate(units):
            exact = prior.forces(bare, _less_affine(fields[k], unit, problem))
            moment = _moment(exact, problem)
            for j, other in enumerate(units):
                matrix[j, k] = _dot(fields[j], exact) / problem.unit - float((other * moment).sum())
                matrix[j, k] += _product_of_data(problem, prior, fields[j], fields[k])
                matrix[j, k] += _product_of_points(problem, prior, at_points[j], at_points[k])
                matrix[j, k] += _product_of_parts(problem, prior, fields[j], fields[k])
            forces.append(exact.astype(np.float32))
        errors = [0.0 if each.convergence is None else each.convergence.error for each in solved]
        matrix = (matrix + matrix.T) / 2
        return cls(problem, prior, schedule.parameters, fields, forces, at_points, matrix, errors)

    def covers(self, problem: Problem, prior: ElasticPrior, optimizer: Optimizer) -> bool:
        """Return whether the responses of a problem are the same."""
        own, marks, others = self.problem, self.problem.landmarks, problem.landmarks
        assert marks is not None
        assert others is not None
        return (
            own.spacing == problem.spacing
            and self.prior == prior
            and self.settings == _response_optimizer(optimizer).parameters
            and marks.scale == others.scale
            and np.array_equal(marks.points, others.points)
            and np.array_equal(marks.sd, others.sd)
            and are_equal(own.stiffness, problem.stiffness)
            and are_equal(own.known, problem.known)
            and are_equal(own.precision, problem.precision)
            and own.coupling == problem.coupling
        )

    @property
    def unit_of_energy(self) -> float:
        """Unit of energy of the landmarks, in the units of the model."""
        marks, own = self.problem.landmarks, self.problem
        assert marks is not None
        unit = self.prior.force_unit(own) * own.unit
        return marks.scale.energy(own.stiffness, own.spacing) / unit

    def pull(
        self, problem: Problem, prior: ElasticPrior, field: npt.NDArray[np.floating]
    ) -> Float64Array:
        """Return p in the equations for a solution without drift, in the units of the model."""
        assert problem.landmarks is not None
        moved = problem.landmarks.displacement(problem.spacing) / problem.unit
        missing = _at_points(problem, field) - moved
        load, moment = prior.load(problem), np.zeros((field.shape[-1],) * 2)
        if load is not None:
            of_growth = load.forces
            if problem.loads is not None and problem.loads.force is not None:
                of_growth = of_growth - problem.loads.force / prior.force_unit(problem)
            moment = _moment(of_growth, problem)
        units = _unit_strains(len(problem.shape))
        pulls = np.empty(len(units))
        for k, (own, forces, unit) in enumerate(zip(self.fields, self.forces, units, strict=True)):
            pulls[k] = _dot(field, forces) / problem.unit
            pulls[k] += _product_of_data(problem, prior, field, own, problem.observed)
            pulls[k] += _product_of_points(problem, prior, missing, self.at_points[k])
            pulls[k] += _product_of_parts(problem, prior, field, own)
            if load is not None:
                pulls[k] += float((unit * moment).sum()) - _dot(own, load.forces) / problem.unit
        return pulls

    def moved(
        self, field: npt.NDArray[np.floating], amounts: Float64Array
    ) -> npt.NDArray[np.floating]:
        """Return the field with the given strains of the drift added."""
        total = field.copy()
        for sites in slabs(field.shape[:-1]):
            part = field[sites].astype(np.float64)
            for amount, own in zip(amounts, self.fields, strict=True):
                part += amount * own[sites]
            total[sites] = part
        return total


_responses: Kept[_Responses] = Kept(is_large=True)


def _unit_strains(axes: int) -> list[Float64Array]:
    units = []
    for i in range(axes):
        for j in range(i, axes):
            unit = np.zeros((axes, axes))
            unit[i, j] = unit[j, i] = 1.0
            units.append(unit)
    return units


def growth_of(problem: Problem, strain: Float64Array) -> npt.NDArray[np.float32]:
    """Return a drift as a uniform growth of all tissue that is not rigid."""
    soft = problem.tissue & ~problem.rigid
    return np.asarray(soft[..., None, None] * strain.astype(np.float32), np.float32)


def _response_problem(plain: Problem, unit: Float64Array) -> Problem:
    marks = plain.landmarks
    assert marks is not None
    rest, loads = np.zeros_like(plain.observed), Loads(growth=growth_of(plain, unit))
    return variant_of(plain, observed=rest, loads=loads, landmarks=marks.at_rest)


def _tighter(optimizer: Optimizer, share: float, largest: float = np.inf) -> Optimizer:
    if not isinstance(optimizer, Multigrid):
        return optimizer
    return replace(optimizer, tolerance=share * min(optimizer.tolerance, largest))


_response_optimizer = partial(_tighter, share=_SHARE_OF_RESPONSE, largest=_LARGEST_TOLERANCE)


def _part(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Return a function that reports the progress of one of several solves."""
    if progress is None:
        return None

    def report(monitor: Monitor) -> None:
        progress(replace(monitor, fraction=(number + monitor.fraction) / count))

    return report


def _positions(problem: Problem, sites: slice = slice(None)) -> Float64Array:
    """Return the positions of sites relative to the centre of the grid, in pixels."""
    first = np.arange(problem.shape[0])[sites]
    others = [np.arange(size) for size in problem.shape[1:]]
    index = np.stack(np.meshgrid(first, *others, indexing="ij"), axis=-1)
    centre = (np.array(problem.shape) - 1) / 2
    return np.asarray((index - centre) * (np.array(problem.spacing) / problem.unit))


def _less_affine(
    field: npt.NDArray[np.floating], unit: Float64Array, problem: Problem
) -> Float64Array:
    """Return a response without the motion of free growth, in the unit of the problem."""
    rest = field.astype(np.float64)
    for sites in slabs(problem.shape):
        rest[sites] -= problem.unit * (_positions(problem, sites) @ unit)
    return rest


def _moment(forces: Float64Array, problem: Problem) -> Float64Array:
    """Return the sum of the products of force and position, in the units of the model."""
    axes = forces.shape[-1]
    moment = np.zeros((axes, axes))
    for sites in slabs(problem.shape):
        arms = _positions(problem, sites).reshape(-1, axes)
        moment += np.einsum("ni,nj->ij", forces[sites].reshape(-1, axes), arms)
    return moment


def _dot(one: npt.NDArray[np.floating], other: npt.NDArray[np.floating]) -> float:
    return float(np.einsum("i,i->", one.ravel(), other.ravel(), dtype=np.float64))


def _at_points(problem: Problem, field: npt.NDArray[np.floating]) -> Float64Array:
    """Return the displacement at the landmarks, in pixels."""
    assert problem.landmarks is not None
    return interpolated(field, problem.landmarks.points) / problem.unit


def _product_of_points(
    problem: Problem, prior: ElasticPrior, one: Float64Array, other: Float64Array
) -> float:
    """Return the bilinear form of the landmarks, in the units of the model."""
    assert problem.landmarks is not None
    weights = problem.landmarks.precision(problem.stiffness, problem.spacing)
    return float((weights * one * other).sum()) * problem.unit / prior.force_unit(problem)


def _product_of_data(
    problem: Problem,
    prior: ElasticPrior,
    one: npt.NDArray[np.floating],
    other: npt.NDArray[np.floating],
    observed: npt.NDArray[np.floating] | None = None,
) -> float:
    """Return the bilinear form of the precision, in the units of the model."""
    if problem.precision is None:
        return 0.0
    total = 0.0
    for sites in slabs(problem.shape):
        far = one[sites] if observed is None else one[sites] - observed[sites].astype(np.float64)
        pull = np.einsum("...ij,...j->...i", problem.precision[sites], other[sites])
        total += float((far * pull).sum())
    return total / (prior.force_unit(problem) * problem.unit)


def _product_of_parts(
    problem: Problem,
    prior: ElasticPrior,
    one: npt.NDArray[np.floating],
    other: npt.NDArray[np.floating],
) -> float:
    """Return the bilinear form of the coupling of sliding parts, in the units of the model."""
    if problem.coupling is None:
        return 0.0
    return problem.coupling.product(one, other) / (prior.force_unit(problem) * problem.unit)


def _amounts(matrix: Float64Array, pull: Float64Array, unit_of_energy: float) -> Float64Array:
    """Return the strains of least energy.

    Raises
    ------
    ProblemError
        If the landmarks hardly determine some strain.
    """
    values, vectors = np.linalg.eigh(matrix)
    # The inverse of the matrix, times the unit of energy, is the covariance of the strains.
    least = max(unit_of_energy / _LARGEST_SD**2, _REGULAR * float(values[-1]))
    if values[0] < least:
        raise ProblemError(
            "landmarks",
            "cannot determine a drift: there are too few, they are nearly on one line or plane, or "
            "they are too uncertain. Add landmarks elsewhere, or estimate no drift "
            "(`drift=False`).",
        )
    return np.asarray(-(vectors / values) @ (vectors.T @ pull))


def _check_size(drift: Float64Array) -> None:
    least = float(np.linalg.eigvalsh(drift)[0])
    if least <= -1:
        raise ProblemError(
            "landmarks",
            f"cannot be met: their targets need a drift of {100 * least:.3g} %, which would "
            "compress tissue to nothing. Correct the targets, or estimate no drift "
            "(`drift=False`).",
        )


def _in_words(drift: Float64Array) -> str:
    strains = [f"{100 * each:.2g} %" for each in np.linalg.eigvalsh(drift)[::-1]]
    listed = ", ".join(strains[:-1]) + f" and {strains[-1]}"
    return f"a drift was estimated with the landmarks: strains of {listed}"
