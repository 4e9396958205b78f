"""Large motion: initial field, growth in steps, and report of unsatisfied observations."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.optimizers.base import (
    Convergence,
    LevelRun,
    Monitor,
    Outcome,
    Reach,
    Report,
)
from napari_hmrf.solver.optimizers.coarse_start import coarse_problem, prolonged, takes_coarse_start
from napari_hmrf.solver.optimizers.cycle import smoothing_of
from napari_hmrf.solver.optimizers.external_forces import ExternalForces, Measurements
from napari_hmrf.solver.optimizers.large_slip import LargeSlip
from napari_hmrf.solver.optimizers.loading import check_balanced, check_reach, load_forces
from napari_hmrf.solver.optimizers.newton import LEAST_JACOBIAN, Newton, Obstructed, Strategy, norm
from napari_hmrf.solver.optimizers.work import Work
from napari_hmrf.solver.priors import NeoHookeanPrior
from napari_hmrf.solver.priors.elements import contrast
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import holding_strength

_TINY = 1e-300
# Fraction of the work for the solution on coarser grids.
_COARSE_WORK = 0.5
# Completed fraction of a solve when the solution on coarser grids is found.
_COARSE_PROGRESS = 0.5
# Tolerance on coarser grids, in pixels.
_COARSE_TOLERANCE = 0.05
# Largest norm of the distances of a warm start from the observations, relative to the norm for a
# field of zeros.
_USEFUL_GAP = 0.95
# Smallest allowed ratio between a corner's Jacobian after and before an extrapolation.
_EXTRAPOLATION_PART = 0.25
# Smallest Jacobian of a returned field, after its conversion to the unit of the spacing, relative
# to `LEAST_JACOBIAN`.
_RETURNED_PART = 0.5
# Distance up to which an observation counts as satisfied, as a fraction of the tolerance.
_MET = 1.0
# Value of `holding_strength` below which cycles reduce rotations slowly.
_WEAK_GRIP = 5e-3
# Value of `holding_strength` below which the system is factorized at once.
_LOOSE_GRIP = 1e-4
# Stiffness contrast above which cycles reduce rotations of stiff parts slowly.
_HIGH_CONTRAST = 50.0
# Stiffness contrast above which the system is factorized at once.
_EXTREME_CONTRAST = 1.2e3
# Logarithm of the growth of area in one growth step.
_GROWTH_STEP = math.log(4.0)
# Accepted distance from equilibrium after each growth step except the last, in pixels.
_GROWTH_DISTANCE = 0.1
# Number of Newton steps after which a growth step is halved.
_NEWTON_STEPS = 80
# Smallest growth step that may be halved, as a fraction of the total growth.
_LEAST_GROWTH_STEP = 0.05


def converge(
    tolerance: float,
    problem: Problem,
    prior: NeoHookeanPrior,
    backend: Backend[Any],
    report: Report,
    start: WarmStart | None,
    work: Work,
    is_coarse: bool = False,
) -> Outcome:
    """Solve a large-motion problem; from here on, lengths are in pixels.

    A motion that takes many steps is started again from the solution on coarser grids.

    Parameters
    ----------
    tolerance : float
        Largest accepted error, in pixels.
    problem : Problem
    prior : NeoHookeanPrior
    backend : Backend
    report : Report
    start : WarmStart or None
    work : Work
        Work of the solve, and its limit.
    is_coarse : bool
        True if the result is only the initial field on a finer grid. The solve then starts from
        coarser grids at once.

    Raises
    ------
    ConvergenceError
        If Newton's method does not reach equilibrium, or if tissue is crushed to zero size.
    """
    material = prior.material(problem)
    model = backend.finite_model(material)
    observed, held = host.prescribed(problem)
    load, limit = load_forces(problem, prior).pulls, prior.limit(problem)
    # Observations that may slip do not constrain the rigid bodies.
    stops = held if limit is None else held & np.isinf(host.planes(limit))
    # Unobserved sites of a constrained rigid body have no target displacement.
    poses, has_target = model.poses(stops), held.copy()
    poses.hold(observed, held)
    data = _measurements(problem, material)
    outside, strategy = ExternalForces.of(load, data), _strategy(problem, material)
    strategy = strategy._replace(approximate=is_coarse)
    progress = _Progress(report)
    make_newton = partial(
        Newton, model, smoothing_of(material), progress, strategy, poses, outside, work
    )
    newton = make_newton()
    d = _start_field(problem, model, poses, start, observed, held)
    if problem.loads is None and data is None and limit is None:
        gaps = [norm(np.where(held, observed - field, 0.0)) for field in (d, 0.0)]
        if gaps[0] >= _USEFUL_GAP * gaps[1]:
            d, start = np.zeros_like(d), None  # the warm start belongs to another motion

    def state(d: Planes, grown: float) -> tuple[npt.NDArray[np.floating], float, Reach]:
        """Return the displacement, its rounding error, and how far it satisfies observations."""
        displacement, rounding, least = _returned(model, problem, d, tolerance)
        missing = host.field(np.where(has_target, observed - d, 0.0))
        # A site in no element has no motion yet: it follows the tissue near it.
        missing[~sites_of_elements(problem.tissue)] = 0
        parts = missing, host.field(observed), problem, tolerance, least, grown
        return displacement, rounding, _reach(*parts)

    def picture(d: Planes) -> Outcome | None:
        """Return a field on the way to the solution; None if one of its elements is folded."""
        if not model.energy(d)[1] >= LEAST_JACOBIAN:
            return None
        displacement, _, reach = state(d, progress.span[1])
        energies = newton.energies or [model.energy(d)[0]]
        energy = _per_site(energies, problem)
        return Outcome(displacement, energy, (level(),), reach=replace(reach, stopped=True))

    def level() -> LevelRun:
        return LevelRun(0, problem.shape, len(newton.energies))

    restart = None
    if limit is None and takes_coarse_start(problem):
        refine = partial(_on_finer_grid, problem)
        report_coarse = partial(progress.report_coarse, lambda found: picture(refine(found)))
        restart = partial(_coarse_start, problem, prior, backend, report_coarse, work, model)
    if restart is not None and not is_coarse:
        newton.restart = restart
    elif start is None and restart is not None:
        coarse = restart()
        if coarse is not None:
            d, newton.is_refined = coarse, True
    if limit is None:
        # A solve that ran out of work is continued, even if it is obstructed.
        newton.is_warm = start is not None and not start.is_unfinished
        settle = partial(newton.run, d, observed, held)
    else:
        most = np.where(held, host.planes(limit), 0.0)
        check_balanced(problem, most > 0, most, load)
        settle = partial(
            LargeSlip(newton, observed, most, load, data).run, d, warm=start is not None
        )

    newton.so_far = partial(picture, d)
    try:
        try:
            grown = _grow(settle, model, material, d, tolerance, progress)
        except Obstructed:
            # The motion up to an obstruction depends on the start, so begin again from rest.
            d[:] = 0
            work.begin_again()
            newton = make_newton()
            newton.restart, newton.so_far = restart, partial(picture, d)
            settle = partial(newton.run, d, observed, held)
            grown = _grow(settle, model, material, d, tolerance, progress)
    except ConvergenceError:
        if outside is not None:
            check_reach(d, problem)
        raise
    if outside is not None:
        check_reach(d, problem)
    displacement, rounding, reach = state(d, grown)
    distance = newton.distance
    # Tissue that did not settle may have an estimate above any motion of the tissue.
    largest = max(float(np.abs(field).max()) for field in (d, observed))
    estimate = min(distance.estimate, max(largest, tolerance))
    if estimate > tolerance:
        reach = replace(reach, unbalanced=estimate * problem.unit, unbalanced_at=newton.worst(d))
    if newton.ran_out and (reach.where is not None or reach.unbalanced_at is not None):
        reach = replace(reach, stopped=True)
    forces = norm(model.forces(d))
    host.reuse(observed, held)
    return Outcome(
        displacement=displacement,
        energy=_per_site(newton.energies, problem),
        levels=(level(),),
        convergence=Convergence(
            max(estimate, rounding),
            distance.residual / max(forces, _TINY),
            "factors" if newton.by_factors else "cycles",
        ),
        reach=reach,
    )


def _per_site(energies: list[float], problem: Problem) -> npt.NDArray[np.float64]:
    sites = max(1, int(np.count_nonzero(problem.tissue)))
    return np.array(energies, dtype=np.float64) / sites


def _measurements(problem: Problem, material: FiniteMaterial) -> Measurements | None:
    """Return the data term and its observations, or None if there is no data term."""
    if material.data is None:
        return None
    return Measurements(material.data, host.planes(problem.observed / np.float64(problem.unit)))


class _Progress:
    """Report whose completed fraction never decreases.

    Parameters
    ----------
    report : Report
    """

    def __init__(self, report: Report) -> None:
        self._report, self._fraction = report, 0.0
        #: Completed fraction at the begin and at the end of the current run.
        self.span = 0.0, 1.0

    def __call__(self, monitor: Monitor) -> None:
        first, last = self.span
        self._fraction = max(self._fraction, first + monitor.fraction * (last - first))
        self._report(replace(monitor, fraction=self._fraction))

    def report_coarse(self, picture: Callable[[Outcome], Outcome | None], monitor: Monitor) -> None:
        """Report the progress of a solve on a coarser grid, and a `picture` of its field."""
        fraction = _COARSE_PROGRESS * monitor.fraction
        self(replace(monitor.with_field(picture), fraction=fraction))


def _coarse_start(
    problem: Problem,
    prior: NeoHookeanPrior,
    backend: Backend[Any],
    report: Report,
    work: Work,
    model: FiniteModel,
) -> Planes | None:
    """Return an initial field from coarser grids; None if its elements are folded or it fails."""
    coarse, coarse_prior = coarse_problem(problem, prior)
    part = work.part(_COARSE_WORK, coarse.shape)
    try:
        found = converge(_COARSE_TOLERANCE, coarse, coarse_prior, backend, report, None, part, True)
    except ConvergenceError:
        return None
    d = _on_finer_grid(problem, found)
    return d if model.energy(d)[1] >= LEAST_JACOBIAN else None


def _on_finer_grid(problem: Problem, coarse: Outcome) -> Planes:
    """Return the field of a coarser grid on the grid of a problem."""
    d = host.planes(prolonged(coarse.displacement, problem.shape))
    _reset_idle(problem, d)
    return d


def _reset_idle(problem: Problem, d: Planes) -> None:
    """Set the displacement of sites that Newton steps do not move to zero, in place."""
    idle = ~sites_of_elements(problem.stiffness)
    host.inside(d)[:, idle] = 0


def _returned(
    model: FiniteModel, problem: Problem, d: Planes, tolerance: float
) -> tuple[npt.NDArray[np.floating], float, float]:
    """Return a displacement in pixels, its rounding error, and the smallest Jacobian of any corner.

    The result is in single precision only if its rounding error is within the tolerance, and no
    element is folded after the conversion to the unit of the spacing.

    Raises
    ------
    ConvergenceError
        If an element is folded even in double precision.
    """
    for largest_rounding in (tolerance, 0.0):
        displacement, rounding = host.gathered(d, largest_rounding)
        unit = displacement.dtype.type(problem.unit)
        converted = (displacement * unit).astype(np.float64) / problem.unit
        returned = host.planes(converted)
        energy, least = model.energy(returned)
        if math.isfinite(energy) and least >= _RETURNED_PART * LEAST_JACOBIAN:
            return displacement, rounding, model.least_jacobian(returned)
    raise ConvergenceError(
        "a pixel of the tissue is crushed to nothing. Move, press or grow it less, or reduce the "
        "ratio of the stiffest to the softest tissue"
    )


def _strategy(problem: Problem, material: FiniteMaterial) -> Strategy:
    coupling = problem.coupling
    firmness, m = holding_strength(problem), material.m
    if coupling is not None:
        m = coupling.stiffness  # copies are soft, but have no tissue of their own
        firmness = 0.0 if coupling.nearly_free else firmness
    ratio = contrast(m)
    strategy = Strategy(
        doubtful=not material.mild or material.rigid or firmness < _WEAK_GRIP,
        stiff=ratio > _HIGH_CONTRAST or firmness < _WEAK_GRIP,
        by_factors=(firmness < _LOOSE_GRIP or ratio > _EXTREME_CONTRAST)
        and Factors.fit(problem.shape, coupled=coupling is not None),
        projects=problem.is_volume or coupling is not None,
    )
    return strategy if material.growth is None else strategy._replace(steps=_NEWTON_STEPS)


def _grow(
    converge_to: Callable[[float], None],
    model: FiniteModel,
    material: FiniteMaterial,
    d: Planes,
    tolerance: float,
    progress: _Progress,
) -> float:
    """Solve for equilibrium in growth steps, in place; return the completed fraction of growth."""
    if material.growth is None:
        converge_to(tolerance)
        return 1.0
    done, step = 0.0, min(1.0, _GROWTH_STEP / max(math.log(material.most_growth), _GROWTH_STEP))
    while done < 1:
        # A field of zeros is not copied, to save the memory.
        before, aim = d.copy() if d.any() else np.zeros(1), min(1.0, done + step)
        model.assemble(material.grown(aim))
        progress.span = done, aim
        try:
            converge_to(tolerance if aim == 1 else max(tolerance, _GROWTH_DISTANCE))
        except ConvergenceError:
            np.copyto(d, before)
            if step >= _LEAST_GROWTH_STEP:
                step /= 2
                continue
            if done == 0:
                raise
            # Return to the last completed growth step, where the field was close to equilibrium.
            model.assemble(material.grown(done))
            with suppress(ConvergenceError):
                converge_to(tolerance)
            break
        else:
            done = aim
    return done


def _start_field(
    problem: Problem,
    model: FiniteModel,
    poses: Poses,
    start: WarmStart | None,
    observed: Planes,
    held: HeldPlanes,
) -> Planes:
    """Return an initial field without folded elements: near the warm start if possible, or 0."""
    zero: Planes = np.zeros(observed.shape)
    if start is None:
        return zero
    last, combined = host.planes(start.displacements[0] / start.unit), host.combined(start)
    for field in last, combined:
        _reset_idle(problem, field)
    poses.make_rigid(last)
    if not model.energy(last)[1] >= LEAST_JACOBIAN:
        last = zero
    # Extrapolate a drag linearly, unless that would fold an element.
    step = combined - last
    alone = len(start.displacements) == 1
    if alone:
        # Tissue was at rest before this solution, so scale the solution to the observations.
        at_held = last[held]
        square = float((at_held**2).sum())
        scale = float((at_held * observed[held]).sum()) / square if square > 0 else 1.0
        step = (scale - 1) * last
    length, _ = model.length(last, step, _EXTRAPOLATION_PART, LEAST_JACOBIAN)
    if alone and length < 1:  # the start is an incomplete solution
        return last
    extrapolated = last + min(1.0, length) * step
    poses.make_rigid(extrapolated)
    return extrapolated if model.energy(extrapolated)[1] >= LEAST_JACOBIAN else last


def _reach(
    missing: npt.NDArray[np.float64],
    observed: npt.NDArray[np.float64],
    problem: Problem,
    tolerance: float,
    least: float,
    grown: float,
) -> Reach:
    """Return the extent to which observations were satisfied, and the worst site."""
    far = np.linalg.norm(missing, axis=-1)
    sites = far > _MET * tolerance
    if not sites.any():
        return Reach(least, grown=grown)
    labels, count = scipy.ndimage.label(sites, structure=np.ones((3,) * sites.ndim))
    where = tuple(int(index) for index in np.unravel_index(int(np.argmax(far)), far.shape))
    most = float(far[where])
    others = [number for number in range(1, count + 1) if number != labels[where]]
    farthest = scipy.ndimage.maximum_position(far, labels, others) if others else []
    farthest = sorted(farthest, key=lambda at: -far[at])
    regions = (where, *(tuple(int(index) for index in at) for at in farthest))
    whole = max(float(np.linalg.norm(observed[where])), most)
    return Reach(
        least,
        1.0 - most / whole,
        most * problem.unit,
        where,
        int(sites.sum()),
        grown,
        regions=regions,
    )
