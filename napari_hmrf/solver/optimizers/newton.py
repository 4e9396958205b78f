"""Newton's method for large motion, without folded elements at any accepted step.

Each step solves the tangent system at the current displacement by conjugate gradients,
preconditioned with a V-cycle. The same step also moves the prescribed components towards their
prescribed values. The step length is limited at the element corners: along a step, the Jacobian of
a corner is a quadratic polynomial, and no Jacobian may lose more than three quarters of its value.
If this limit shortens a pull, the tissue is relaxed before the next pull. Regions that cannot be
pulled any further stay where they are: those whose motion folds the elements that limit the pull.
All other regions are pulled further.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.field.neighbours import around_sites
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.optimizers.base import (
    Monitor,
    Outcome,
    Report,
    factorizing,
    words_of_cycle,
)
from napari_hmrf.solver.optimizers.cycle import Cycle, Smoothing
from napari_hmrf.solver.optimizers.external_forces import ExternalForces
from napari_hmrf.solver.optimizers.krylov import (
    RELIABLE_STEPS,
    USUAL_LEAST,
    ConjugateGradients,
    Step,
)
from napari_hmrf.solver.optimizers.obstruction import folding
from napari_hmrf.solver.optimizers.self_check import BELIEVABLE, Rehearsal
from napari_hmrf.solver.optimizers.work import Work

# A step of the field

#: Share of a pull in the progress of a run; the rest is for the way to equilibrium.
_PULL_SHARE = 0.9
#: Smallest allowed ratio between a corner's Jacobian after and before a step.
_JACOBIAN_PART = 0.25
#: Safety factor on the largest possible length of a pull, if a corner limits the length.
_PULL_PART = 0.85
#: Jacobian below which a pull may not compress a corner any further.
_PULL_FLOOR = 1e-5
#: The same on coarser grids, which must not crush tissue that the finest grid could still pull.
_COARSE_PULL_FLOOR = 0.05
#: Fraction of the least Jacobian that must remain after a pull that rotates rigid bodies, because
#: `_JACOBIAN_PART` applies to straight steps only.
_RIGID_PART = 0.1
#: Fraction of a descent step below which a step without buckling terms is tried.
_LEAST_STEP = 0.1
#: Smallest decrease in energy, relative to the decrease predicted by the slope (Armijo rule).
_ARMIJO = 1e-4
#: Relative rounding error of the energy; an increase in energy up to this is accepted.
_ENERGY_ROUNDING = 1e-12
#: Energy per component, in pixels squared, added to the energy to estimate its rounding error.
_COMPONENT_ROUNDING = 1e-3
#: Largest number of halvings of a step before the step is rejected.
_HALVING_LIMIT = 12
#: Number of Newton steps after which tissue is not pulled any further.
_PULL_LIMIT = 150
#: Largest number of Newton steps before a run fails.
_STEP_LIMIT = 400
#: Work, as a part of `Work.measure`, after which a pull ends if it has not reduced the distance
#: left to `_STALLED_PART`.
_STALLED_WORK = 1.0
_STALLED_PART = 0.75
#: Work, as a part of `Work.measure`, after which tissue that is not pulled any further stays as it
#: is, if its targets are out of reach.
_SETTLING_WORK = 0.75
#: Fraction of the work after which tissue is not pulled any further.
_PULL_WORK = 0.8
#: Work, as a part of `Work.measure`, after which tissue is not pulled any further if the work is
#: not limited.
_LONGEST_PULL = 2.5
#: Fraction of `Work.measure` after which a new initial field is tried if the tissue is still
#: pulled.
_RESTART_WORK = 0.4
#: Fraction of a pull that may be left after a step; if more is left, a new initial field is tried
#: at once.
_SLOW_PULL = 0.5
# The linear system of a step

#: Error at which a linear solve ends, relative to the initial error.
_INNER_REDUCTION = 0.03
#: Error at which a linear solve ends, relative to the tolerance; the larger error applies.
_INNER_TOLERANCE = 0.4
#: Residual, relative to the load, that cannot be reduced in single precision.
_SINGLE_RESIDUAL = 2e-5
#: Number of cycles after which a small system is factorized.
_CYCLE_LIMIT = 40
#: Largest number of sites of a small system, for which a factorization is faster than many cycles.
_SMALL_GRID = 20_000
#: Number of cycles after which a larger system is factorized.
_LARGE_CYCLE_LIMIT = 200
#: Growth of the assumed smallest eigenvalue after a run that is not reliable.
_FORGOTTEN = 2.0
#: Rough error, relative to the tolerance, at which it is worth a cycle to measure the error.
_ROUGHLY = 2.0
#: Smallest nonzero fraction of the buckling terms that is left out.
_FIRST_SHARE = 0.05
#: Number of steps without the buckling terms after a step in which they made the model indefinite.
_PROJECTED_STEPS = 4
#: Ratio of each fraction to the previous one, until the tangent matrix is positive definite.
_SHARE_GROWTH = 2.0

# Tissue between two pulls

#: Distance from equilibrium, in pixels, at which tissue is relaxed enough for the next pull.
_RELAXED_DISTANCE = 0.3
#: Largest number of steps to reduce the distance to `_RELAXED_DISTANCE`.
_RELAXATION_LIMIT = 2
#: Distance from equilibrium, in pixels, that tissue must reach before a pull counts as stuck.
_BALANCED_DISTANCE = 0.02
#: Largest number of steps to reduce the distance to `_BALANCED_DISTANCE`.
_BALANCE_LIMIT = 25
#: Fraction of a step. A pull below this fraction and below `_STUCK_DISTANCE` is stuck.
_STUCK_PART = 0.05
#: Length of a pull, in pixels. A pull below this length and below `_STUCK_PART` is stuck.
_STUCK_DISTANCE = 0.1
#: Number of consecutive stuck pulls after which components that obstruct the pull are released.
_STUCK_LIMIT = 2
#: An element obstructs a pull if the element limits the pull to less than this fraction.
_OBSTRUCTION = 0.3
#: The elements that limit a pull most make the pull stuck, or their limit is at most this multiple
#: of the smallest limit.
_CLOSEST = 2.0
#: A region obstructs a pull if its motion folds these elements by at least this part of the motion
#: of the region that folds them most.
_CAUSE = 0.1
#: Largest number of regions whose effect on these elements is computed; the nearest are chosen.
_MOST_PIECES = 20
#: Largest component of the load that finds these regions; large, so that cycles end at a relative
#: error.
_ADJOINT_LOAD = 1e3
#: Fraction of the work up to which a warm start is given up if it obstructs a pull.
_START_WORK = 0.5
#: Sites are pulled as one piece if their relative deviation from the mean motion is at most this.
_PIECE_SPREAD = 0.2

# The end of a run

#: Number of most recent steps that are tested for creep, the slow motion of crushed tissue.
_CREEP_STEPS = 30
#: Largest relative decrease in energy over these steps that counts as creep.
_CREEP_ENERGY = 1e-7
#: Distance from equilibrium, in pixels, that is accepted for creeping tissue.
_CREEP_DISTANCE = 0.1
#: Largest final step, relative to the tolerance, for tissue in which cycles may miss motions.
_FINAL_STEP = 10.0
#: Smallest Jacobian at any corner of an accepted field, far above rounding in double precision.
LEAST_JACOBIAN = 1e-9


class Strategy(NamedTuple):
    """Settings of the Newton iteration for a given tissue.

    Attributes
    ----------
    doubtful : bool
        True if cycles may miss motions. The final step must then be short, and cycles are tested
        in a rehearsal.
    stiff : bool
        True if some tissue is very stiff or barely constrained. Such tissue must be free to rotate,
        and its rounding errors resemble buckling.
    by_factors : bool
        True to solve by factorization without trying cycles.
    steps : int
        Number of steps after which a run fails.
    projects : bool
        True to leave out all buckling terms while tissue is pulled, as in volumes, where cycles
        converge slowly if only a part of these terms is left out.
    approximate : bool
        True if the result may be far from equilibrium, as an initial field may be.
    """

    doubtful: bool
    stiff: bool
    by_factors: bool
    steps: int = _STEP_LIMIT
    projects: bool = False
    approximate: bool = False


class Distance(NamedTuple):
    """Distance of a field from equilibrium.

    Attributes
    ----------
    estimate : float
        Estimated largest distance of any site, in pixels; infinite if unknown.
    residual : float
        Norm of the residual forces.
    """

    estimate: float = math.inf
    residual: float = math.inf


class Obstructed(Exception):
    """Signal that prescribed positions are out of reach from a warm start."""


class _Linear(NamedTuple):
    """Solution of a tangent system."""

    #: Displacement, rough error per residual, and largest component of the displacement.
    way: Planes
    reach: float
    far: float
    #: Cycle that preconditions the system, and the smallest eigenvalue of the product of both.
    cycle: Cycle | None = None
    least: float = 1.0
    #: Fraction of the buckling terms that was left out.
    positive: float = 0.0
    #: Factorization that was used, or None if the system was solved by cycles.
    factors: Factors | None = None


class _After(Enum):
    """What follows a Newton step."""

    MOVED = auto()
    ARRIVED = auto()
    ENDED = auto()


class _Pace:
    """Steps that relax tissue between two pulls, and what obstructs the pulls.

    Attributes
    ----------
    relaxations : int
        Largest number of steps that relax the tissue before the next pull.
    near : float
        Distance from equilibrium, in pixels, at which tissue is relaxed enough.
    """

    def __init__(self) -> None:
        self.relaxations, self.near = 0, _RELAXED_DISTANCE
        self._stuck, self._patience = 0, _STUCK_LIMIT

    def restart(self) -> None:
        """Relax a new initial field before the first pull."""
        self.relaxations, self._stuck, self._patience = _RELAXATION_LIMIT, 0, _STUCK_LIMIT

    def is_stuck_after(self, taken: float, left: float) -> bool:
        """Note a pull; return whether components that obstruct the pulls must be released.

        Parameters
        ----------
        taken : float
            Fraction of the pull that was possible.
        left : float
            Largest distance of a component from its prescribed position, in pixels.
        """
        if taken == 1.0:
            return False
        stays = taken < _STUCK_PART and taken * left < _STUCK_DISTANCE
        self._stuck = self._stuck + 1 if stays and self.near == _BALANCED_DISTANCE else 0
        self.near = _BALANCED_DISTANCE if stays else _RELAXED_DISTANCE
        self.relaxations = _BALANCE_LIMIT if stays else _RELAXATION_LIMIT
        if self._stuck < self._patience:
            return False
        self._stuck, self._patience = 0, 1
        return True


class Newton:
    """Newton iteration for equilibrium in large motion.

    Parameters
    ----------
    model : FiniteModel
    smoothing : Smoothing
    report : Report
    strategy : Strategy
    poses : Poses
        Poses of the rigid bodies, and their constrained components.
    external_forces : ExternalForces or None
        Loads on the tissue and forces of its data, or None if there are none.
    """

    def __init__(
        self,
        model: FiniteModel,
        smoothing: Smoothing,
        report: Report,
        strategy: Strategy,
        poses: Poses,
        external_forces: ExternalForces | None,
        work: Work,
    ) -> None:
        self._model, self._smoothing, self._report = model, smoothing, report
        self._work = work
        #: Function that returns another initial field for a run that takes long, or None. It is
        #: used once; the run continues with the field that is closer to the observations.
        self.restart: Callable[[], Planes | None] | None = None
        self._strategy, self._poses = strategy, poses
        #: Function that returns the present field as an `Outcome`, for reports; or None.
        self.so_far: Callable[[], Outcome | None] | None = None
        #: True if the run begins with a warm start, which is given up if it obstructs a pull.
        self.is_warm = False
        #: True if the run begins with the solution on a coarser grid.
        self.is_refined = False
        #: Loads on the tissue and forces of its data, or None.
        self.external_forces = external_forces
        self._tolerance = math.inf
        #: Distance of the field from equilibrium.
        self.distance = Distance()
        #: Energy after each step.
        self.energies: list[float] = []
        self.cycles = 0
        #: True if the limit of the work ended a pull or the run.
        self.ran_out = False
        self.by_factors = strategy.by_factors
        self._first = 0.0
        # Distance from the targets, in pixels, and work when it was last reduced by a part.
        self._pace_of_pull = math.inf, 0.0
        # Number of steps up to the last pull, and the work up to it.
        self._pulled, self._pulled_work = 0, 0.0
        # False once a prescribed position is known to be out of reach.
        self._is_converged = True
        # Smallest eigenvalue of the preconditioned tangent matrix that the next run should expect.
        self._least = USUAL_LEAST
        # First fraction of the buckling terms to leave out in the next step, and whether cycles
        # found a direction in which the tissue buckles.
        self._positive = 0.0
        self._buckles = False
        # Number of steps before the buckling terms are included again.
        self._projected = 0

    def run(self, d: Planes, y: Planes, held: HeldPlanes, tolerance: float) -> None:
        """Solve for equilibrium and move constrained components as close to `y` as possible.

        Parameters
        ----------
        d : ndarray, planes
            Displacement without folded elements, in pixels; changed in place.
        y : ndarray, planes
            Prescribed displacement, in pixels.
        held : ndarray of bool, planes
            Components with a prescribed displacement.
        tolerance : float
            Largest accepted distance from equilibrium, in pixels.

        Raises
        ------
        ConvergenceError
            If the field is far from equilibrium although no tissue is crushed, or if its distance
            from equilibrium is unknown.
        """
        self._tolerance, self._is_converged = tolerance, True
        y, pace = np.where(held, y, d), _Pace()
        self._first, self._pulled = float(np.abs(y - d).max()), len(self.energies)
        self._pace_of_pull = math.inf, self._work.spent
        if self.is_refined:
            self._begin_refined(pace)
        for number in range(self._strategy.steps):
            if self._is_slow(number, d, y, held) and self._restarts(d, y, held):
                self._begin_refined(pace)
            late = self._is_late(_PULL_WORK)
            is_long = math.isinf(self._work.limit) and self._takes_long(_LONGEST_PULL)
            if late or is_long or number == _PULL_LIMIT or self._is_stalled(_largest(y - d, held)):
                self._stop_pulling(d, y, held, ran_out=late)
            after = self._advance(number, d, y, held, pace)
            if after is _After.ARRIVED:
                return
            if after is _After.ENDED:
                break
        # Only crushed tissue that creeps may be this far from equilibrium.
        estimate = self.distance.estimate
        must_settle = self._is_converged and not self._strategy.approximate
        if not math.isfinite(estimate) or (must_settle and estimate > _CREEP_DISTANCE):
            self._fail()

    def _begin_refined(self, pace: _Pace) -> None:
        """Relax the solution on a coarser grid first, without buckling terms.

        Linear interpolation leaves kinks, at which tissue would buckle.
        """
        pace.restart()
        self._positive = 1.0

    def _is_stalled(self, left: float) -> bool:
        """Return whether tissue hardly moves towards its target any more, for much work.

        Tissue can be crushed further almost without end, which moves its target only a little.
        """
        before, spent = self._pace_of_pull
        if left <= _STALLED_PART * before:
            self._pace_of_pull = left, self._work.spent
            return False
        return left > 0 and self._work.spent - spent > _STALLED_WORK * self._work.measure

    def _stop_pulling(self, d: Planes, y: Planes, held: HeldPlanes, *, ran_out: bool) -> None:
        """Leave the constrained components where they are: `y` becomes `d`, in place."""
        if (held & (y != d)).any():
            np.copyto(y, d)
            self._is_converged = False
            self.ran_out = self.ran_out or ran_out

    def _advance(self, number: int, d: Planes, y: Planes, held: HeldPlanes, pace: _Pace) -> _After:
        """Make a Newton step, in place: pull the tissue towards `y`, or relax it."""
        left = _largest(y - d, held)
        pulls = left > 0 and pace.relaxations == 0
        aim = self._poses.aim(d, y)
        gap = np.where(held, aim - d, 0.0) if pulls else None
        self._report_step(number, left)
        self._work.add_step()
        before, distance_before = d.copy(), self.distance
        step = self._step(d, gap, held)
        del gap
        if step is None:
            self._end_without_step(left)
            return _After.ENDED
        if pulls:
            taken = self._pull(d, before, step.way, aim, held)
            self._pulled = len(self.energies) + 1
            if pace.is_stuck_after(taken, left):
                self._release(d, y, held, step)
        else:
            step, taken = self._relax(d, before, held, step)
            pace.relaxations = max(pace.relaxations - 1, 0)
        if not self._judge(d, step):
            if left > 0:
                self._give_up_start()
            # Return to the last valid field and end the run.
            np.copyto(d, before)
            self.distance = distance_before
            self._is_converged = self._is_converged and left == 0
            return _After.ENDED
        if taken == 1.0 and min(self.distance.estimate, step.far) <= pace.near and not pulls:
            pace.relaxations = 0
        arrived = taken == 1.0 and ((pulls and aim is y) or left == 0)
        if arrived and self._is_balanced(d, held, step):
            return _After.ARRIVED
        if left > 0:
            self._pulled_work = self._work.spent
        if left == 0 and (taken == 0.0 or self._creeps(step.far) or self._takes_long_to_settle):
            far = max(self.distance.estimate, step.far)
            self.distance = self.distance._replace(estimate=far)
            return _After.ENDED
        if self._work.is_done:
            self._is_converged = False
            self.ran_out = True
            return _After.ENDED
        return _After.MOVED

    def _end_without_step(self, left: float) -> None:
        """Note why a run ends: crushed tissue whose tangent system has no solution, or no work."""
        # Without work, it is unknown whether the system has a solution.
        lacks_work = not self._work.allows_factorization
        self.ran_out = self.ran_out or lacks_work
        if left > 0:
            self._give_up_start()
        settled = left == 0 and not lacks_work
        self._is_converged = self._is_converged and (settled or math.isinf(self.distance.estimate))

    def _is_late(self, fraction: float) -> bool:
        return self._work.spent >= fraction * self._work.limit

    def _takes_long(self, fraction: float) -> bool:
        return self._work.spent >= fraction * self._work.measure

    def _is_slow(self, number: int, d: Planes, y: Planes, held: HeldPlanes) -> bool:
        """Return whether another initial field is worth trying."""
        if self.restart is None or number == 0:
            return False
        part = _largest(y - d, held) / self._first if self._first > 0 else 0.0
        return part > (0.0 if self._takes_long(_RESTART_WORK) else _SLOW_PULL)

    def _restarts(self, d: Planes, y: Planes, held: HeldPlanes) -> bool:
        """Replace `d` by a field that is closer to `y`; return False if there is none."""
        assert self.restart is not None
        restart, self.restart = self.restart, None
        field = restart()
        if field is None or _largest(y - field, held) >= _largest(y - d, held):
            return False
        np.copyto(d, field)
        self.distance = Distance()
        return True

    def _fail(self) -> None:
        if not math.isfinite(self.distance.estimate):
            raise ConvergenceError(
                "cycles may miss motions of this tissue. Crop the image, or reduce the ratio of "
                "the stiffest to the softest tissue"
            )
        raise ConvergenceError(
            f"the tissue is still {self.distance.estimate:.2g} px from equilibrium after "
            f"{len(self.energies)} steps of large motion. Move, press or grow it less, or reduce "
            "the ratio of the stiffest to the softest tissue"
        )

    def _judge(self, d: Planes, step: _Linear) -> bool:
        """Measure the distance from equilibrium after a step; return whether the field is valid.

        A field is invalid if an element is folded, or if its energy or distance is not finite.
        """
        energy, least = self._energy(d)
        if not (math.isfinite(energy) and least >= LEAST_JACOBIAN):
            return False
        rest = self._rest(d)
        residual = norm(rest)
        estimate = step.reach * residual
        if step.factors is not None:
            # With a factorization, one more solve is cheap.
            left = step.factors.solve(rest)
            self._model.project(left)
            far = float(np.abs(left).max())
            if math.isfinite(far):
                estimate = far
        elif step.cycle is not None and estimate <= _ROUGHLY * self._tolerance:
            # The residual of a long step is smoother than that of the linear solve, and then means
            # a larger distance. A cycle corrects the slowest motion by its eigenvalue.
            self._count_cycle()
            estimate = step.cycle.largest_correction(self._model.balance(rest)) / step.least
        if not math.isfinite(estimate):
            return False
        self.distance = Distance(estimate, residual)
        self.energies.append(energy)
        return True

    def _rest(self, d: Planes) -> Planes:
        """Return the residual forces on the free components."""
        rest: Planes = np.where(self._model.moves, self.forces(d), 0.0)
        self._model.project(rest)
        return rest

    def worst(self, d: Planes) -> tuple[int, ...]:
        """Return the index of the site that is probably farthest from equilibrium."""
        correction = self._rest(d) * self._model.levels[0].inverse
        far = np.linalg.norm(host.field(correction), axis=-1)
        return tuple(int(index) for index in np.unravel_index(int(np.argmax(far)), far.shape))

    def _is_balanced(self, d: Planes, held: HeldPlanes, step: _Linear) -> bool:
        """Return whether tissue is reliably within the tolerance of equilibrium."""
        if self.distance.estimate > self._tolerance:
            return False
        if not self._strategy.doubtful:
            return True
        # Leaving out the buckling terms also prevents stiff parts from rotating.
        if self._strategy.stiff and step.positive > 0:
            return False
        if step.factors is not None:
            return True
        if step.far > _FINAL_STEP * self._tolerance:
            return False
        # Cycles are rehearsed here unless they were rehearsed with the same constraints before.
        model, rehearsal = self._model, self._model.rehearsed
        if rehearsal is None or not np.array_equal(rehearsal[0], held):
            model.linearise(d, held, self.forces(d), 1.0, model.springs)
            error = np.where(model.moves, host.noise(d.shape), 0.0)
            model.project(error)
            iteration = ConjugateGradients(Cycle(model, self._smoothing))
            doubt = Rehearsal().run(
                iteration, error, lambda d: model.balance(-model.image(d)), self._report
            )
            rehearsal = model.rehearsed = held.copy(), doubt
        if rehearsal[1] <= BELIEVABLE:
            return True
        self.by_factors = self._can_factorize
        return not self.by_factors

    def _step(
        self, d: Planes, gap: Planes | None, held: HeldPlanes, positive: float = 0.0
    ) -> _Linear | None:
        """Return the Newton step, which closes the `gap`; None if the system has no solution."""
        forces = self.forces(d)
        springs = None if self.external_forces is None else self.external_forces.springs(d)
        if gap is not None:
            gap = self._poses.extend(gap)
        for stiff in self._shares_to_try(gap is not None, positive):
            self._model.linearise(d, held, forces, stiff, springs)
            linear = None if self.by_factors else self._iterate(self._load(forces, gap))
            # At a large stiffness contrast, apparent buckling may be a rounding error.
            sure = stiff == 1 or self._strategy.stiff
            sure = sure or not (self._buckles or self._strategy.projects)
            # Terms of the contact are indefinite in most steps, but matter for the last ones.
            sure = sure or (self.by_factors and self._model.coupled)
            affordable = self._work.allows_factorization or math.isinf(self.distance.estimate)
            if linear is None and sure and affordable and self._can_factorize:
                linear = self._solve(self._load(forces, gap))
            if linear is not None:
                self._positive = stiff / _SHARE_GROWTH if stiff > _FIRST_SHARE else 0.0
                if gap is not None:
                    np.add(linear.way, gap, out=linear.way)
                return linear._replace(positive=stiff)
        return None

    @property
    def _can_factorize(self) -> bool:
        return Factors.fit(self._model.shape, coupled=self._model.coupled)

    def _load(self, forces: Planes, gap: Planes | None) -> Planes:
        """Return the load of a Newton step that closes `gap`."""
        load: Planes = -forces
        if gap is not None:
            load -= self._model.image(gap)
        return load

    def _shares_to_try(self, pulls: bool, positive: float) -> Iterator[float]:
        """Yield fractions of the buckling terms to leave out, until the linear model is positive.

        Parameters
        ----------
        pulls : bool
            True if the step closes the gap of constrained components.
        positive : float
            First fraction; 0 to use the fraction of earlier steps.
        """
        if not self._strategy.projects:
            yield from _shares(positive or self._positive)
            return
        if not pulls and positive == 0 and self._projected == 0:
            yield 0.0
            self._projected = _PROJECTED_STEPS
        self._projected = max(self._projected - 1, 0)
        yield 1.0

    def _iterate(self, load: Planes) -> _Linear | None:
        """Solve the tangent system by cycles; return None if the cycles did not converge."""
        self._buckles = False
        balance, way = self._model.balance(load), np.zeros_like(load)
        del load
        if balance.most == 0:
            return _Linear(way, 0.0, 0.0)
        latest: Step | None = None
        first, count, done = 0.0, 0, False
        is_small = math.prod(self._model.shape) <= _SMALL_GRID and not self._strategy.projects
        patience = _CYCLE_LIMIT if is_small else _LARGE_CYCLE_LIMIT

        def enough(step: Step) -> bool:
            nonlocal latest, first, count, done
            latest, count = step, count + 1
            error = step.error * balance.unit
            first = first or error
            self._count_cycle()
            self._report(Monitor(words_of_cycle(self.cycles, error), 0.0))
            done = error <= max(_INNER_REDUCTION * first, _INNER_TOLERANCE * self._tolerance)
            return done or count >= patience or self._work.is_done

        cycle = Cycle(self._model, self._smoothing)
        iteration = ConjugateGradients(cycle)
        iteration.expect(self._least)
        try:
            iteration.run(balance, way, enough)
        except FloatingPointError:
            self._model.clear()
            return None
        # At the limit of single precision, cycles have converged. Otherwise they stalled, or found
        # a direction in which the tissue buckles.
        if latest is not None and latest.rest * balance.unit <= _SINGLE_RESIDUAL * balance.norm:
            done = True
        # The direction of a run that ended early still decreases the energy.
        done = done or (latest is not None and self._work.is_done)
        self._buckles = not done and count < patience
        if latest is None or not done:
            return None
        least = kept = iteration.run_least
        if count < RELIABLE_STEPS:
            # A slow motion that a short run does not find again may have ended.
            least, kept = min(least, self._least), min(kept, _FORGOTTEN * self._least)
        self._least = kept
        return _Linear(way, latest.reach, float(np.abs(way).max()), cycle, least)

    def _count_cycle(self) -> None:
        self.cycles += 1
        self._work.add_cycle()

    def _solve(self, load: Planes) -> _Linear | None:
        """Solve by factorization; return None if the tangent matrix is not positive definite."""
        moves = self._model.moves
        load = np.where(moves, load, 0.0)
        self._model.project(load)
        self._work.add_factorization()
        try:
            model = self._model
            factors = Factors(
                model.tangents, moves, factorizing(self._report), model.springs, model.links
            )
            way = factors.solve(load)
        except Singular:
            return None
        self._model.project(way)
        if not np.isfinite(way).all() or float((way * load).sum()) < 0:
            return None
        self.by_factors = True
        far, most = float(np.abs(way).max()), norm(load)
        return _Linear(way, far / most if most > 0 else 0.0, far, factors=factors)

    @property
    def _takes_long_to_settle(self) -> bool:
        """True if tissue that stays short of its target hardly settles: it is crushed."""
        spent = self._work.spent - self._pulled_work
        return not self._is_converged and spent > _SETTLING_WORK * self._work.measure

    def _creeps(self, far: float) -> bool:
        """Return whether the latest steps were short and hardly decreased the energy."""
        late = self.energies[self._pulled :][-_CREEP_STEPS:]
        short = len(late) == _CREEP_STEPS and far <= _CREEP_DISTANCE
        return short and late[0] - late[-1] <= _CREEP_ENERGY * abs(late[-1])

    def _energy(self, d: Planes) -> tuple[float, float]:
        """Return the total energy, and the smallest Jacobian of all element corners."""
        energy, least = self._model.energy(d)
        return energy if self.external_forces is None else energy + self.external_forces.energy(
            d
        ), least

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the total energy; valid until the next call."""
        forces = self._model.forces(d)
        return forces if self.external_forces is None else forces + self.external_forces.forces(d)

    @property
    def _pull_floor(self) -> float:
        return _COARSE_PULL_FLOOR if self._strategy.approximate else _PULL_FLOOR

    def _pull(self, d: Planes, start: Planes, way: Planes, y: Planes, held: HeldPlanes) -> float:
        """Move `d` from `start` until a corner is nearly folded; return the fraction taken."""
        length, _ = self._model.length(d, way, _JACOBIAN_PART, self._pull_floor)
        taken = 1.0 if length >= 1 else _PULL_PART * length
        floor = LEAST_JACOBIAN
        if self._model.bodies:
            floor = max(floor, _RIGID_PART * self._model.energy(d)[1])
        for _ in range(_HALVING_LIMIT):
            np.multiply(way, taken, out=d)
            d += start
            if taken == 1.0:
                np.copyto(d, y, where=held)
            # A straight step deforms a rotating rigid body.
            self._poses.make_rigid(d)
            energy, least = self._model.energy(d)
            if math.isfinite(energy) and least >= floor:
                return taken
            taken /= 2
        np.copyto(d, start)
        return 0.0

    def _relax(
        self, d: Planes, before: Planes, held: HeldPlanes, step: _Linear
    ) -> tuple[_Linear, float]:
        """Take a descent step in place from `before`; return the step and the fraction taken.

        If only a small fraction is possible, a step without the buckling terms is tried.
        """
        taken = self._descend(d, before, step.way)
        if taken < _LEAST_STEP and step.positive < 1:
            again = self._step(d, None, held, positive=1.0)
            if again is not None:
                return again, max(taken, self._descend(d, d.copy(), again.way))
        return step, taken

    def _descend(self, d: Planes, before: Planes, way: Planes) -> float:
        """Take a descent step in place and update the loads; return the fraction taken."""
        taken = self._fall(d, before, way)
        if self.external_forces is not None and taken > 0:
            self.external_forces.follow(before, d)
        return taken

    def _fall(self, d: Planes, start: Planes, way: Planes) -> float:
        """Move `d` from `start` until the energy decreases enough; return the fraction taken."""
        before, _ = self._energy(d)
        slope = float(np.einsum("i,i->", self.forces(d).ravel(), way.ravel()))
        length, _ = self._model.length(d, way, _JACOBIAN_PART, LEAST_JACOBIAN)
        taken = min(1.0, length)
        for _ in range(_HALVING_LIMIT):
            np.multiply(way, taken, out=d)
            d += start
            self._poses.make_rigid(d)
            energy, least = self._energy(d)
            rounding = _ENERGY_ROUNDING * (abs(before) + _COMPONENT_ROUNDING * d.size)
            promise = _ARMIJO * taken * slope + rounding
            if least >= LEAST_JACOBIAN and energy <= before + promise:
                return taken
            np.copyto(d, start)
            taken /= 2
        return 0.0

    def _release(self, d: Planes, y: Planes, held: HeldPlanes, step: _Linear) -> None:
        """Stop pulling the prescribed components that obstruct the pull of others."""
        self._give_up_start()
        self._is_converged, self.restart = False, None
        _, lengths = self._model.length(d, step.way, _JACOBIAN_PART, self._pull_floor, each=True)
        elements = lengths < _OBSTRUCTION
        pulled = host.inside(held & (y != d)).any(axis=0)
        pieces, count = scipy.ndimage.label(pulled, structure=np.ones((3,) * pulled.ndim))
        touching = around_sites(elements, np.logical_or) & pulled
        causes = list(range(1, count + 1))
        if count > 1 and elements.any():
            stuck = min(_STUCK_PART, _STUCK_DISTANCE / _largest(y - d, held)) / _PULL_PART
            closest = lengths <= max(_CLOSEST * float(lengths.min()), stuck)
            causes = self._causes(d, y, held, step, pieces, elements & closest)
        stops = np.zeros_like(pulled)
        gap = host.inside(y - d)
        for number in causes:
            piece = pieces == number
            ways = gap[:, piece]
            mean = ways.mean(axis=1, keepdims=True)
            # Components that move as one piece must stop together; otherwise the piece is crushed.
            together = norm(ways - mean) <= _PIECE_SPREAD * norm(ways)
            touches = piece & touching
            stops |= touches if touches.any() and not together else piece
        for body in self._model.bodies:
            stops[body] |= stops[body].any()
        stay = np.zeros_like(held)
        host.inside(stay)[...] = stops
        np.copyto(y, d, where=stay)

    def _causes(
        self,
        d: Planes,
        y: Planes,
        held: HeldPlanes,
        step: _Linear,
        pieces: npt.NDArray[np.int32],
        elements: npt.NDArray[np.bool_],
    ) -> list[int]:
        """Return the numbers of the pieces whose motion folds the elements that limit a pull."""
        weights = folding(d, step.way, self._poses.sides, elements)
        load = np.where(self._model.moves, weights, 0.0)
        self._model.project(load)
        # An element also folds if a piece moves the free tissue around it: one solve with the
        # weights as the load yields the effect of every piece.
        if step.factors is not None:
            effect: Planes | None = step.factors.solve(load)
        else:
            size = float(np.abs(load).max())
            scale = _ADJOINT_LOAD / size if size > 0 else 1.0
            linear = self._iterate(scale * load)
            effect = None if linear is None else linear.way / scale
        if effect is None:
            effect = np.zeros_like(d)
        self._model.project(effect)
        self._work.add_step()
        count = int(pieces.max())
        numbers = np.arange(1, count + 1)
        if count > _MOST_PIECES:
            far = scipy.ndimage.distance_transform_edt(~around_sites(elements, np.logical_or))
            nearest = np.argsort(scipy.ndimage.minimum(far, pieces, numbers), kind="stable")
            numbers = np.sort(numbers[nearest[:_MOST_PIECES]])
        shares = []
        for number in numbers:
            gap = np.zeros_like(d)
            host.inside(gap)[...] = np.where(pieces == number, host.inside(y - d), 0.0)
            gap = self._poses.extend(np.where(held, gap, 0.0))
            shares.append(float((weights * gap - effect * self._model.image(gap)).sum()))
        limit = _CAUSE * max(shares)
        if not limit > 0:
            return list(range(1, count + 1))
        return [int(at) for at, share in zip(numbers, shares, strict=True) if share >= limit]

    def _give_up_start(self) -> None:
        """Raise `Obstructed` if the run began with a warm start and enough work is left."""
        if self.is_warm and not self._is_late(_START_WORK):
            raise Obstructed

    def _report_step(self, number: int, left: float) -> None:
        done = _PULL_SHARE * (1 - left / self._first if self._first > 0 else 1.0)
        action = f"{left:.2g} px left to pull" if left else "relaxing"
        self._report(Monitor(f"step {number + 1}, {action}", done, self.so_far))


def _shares(first: float) -> Iterator[float]:
    """Yield increasing fractions of the buckling terms to leave out, up to 1."""
    share = first
    while share < 1:
        yield share
        share = max(_SHARE_GROWTH * share, _FIRST_SHARE)
    yield 1.0


def _largest(values: Planes, held: HeldPlanes) -> float:
    """Return the largest absolute value of the constrained components."""
    most, least = (function(where=held, initial=0.0) for function in (values.max, values.min))
    return float(max(most, -least))


def norm(values: Planes) -> float:
    """Return the Euclidean norm, without BLAS, because its idle threads would slow the solve."""
    flat = values.ravel()
    return math.sqrt(float(np.einsum("i,i->", flat, flat)))
