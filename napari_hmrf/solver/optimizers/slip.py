"""Linear models with observations that may slip: a rounded kink, then exchanges of states.

The force of an observation is at most ``p = K c``. If a smaller force is enough to keep a component
at its observed position, the component is *held*. Otherwise it *slips*: it is away from this
position and is pulled towards it with the force p. The energy of an observation, ``p |y - d|``, has
a kink at the observed position. The kink is rounded, and the width of the rounding is reduced in
steps. Each step of Newton's method is a linear problem with a data term. The result shows which
components slip. The problem with these states is then solved without rounding, and the states that
contradict the result are exchanged. If no consistent states are found, the result for the narrowest
kink is the solution, and its change since the previous width is the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ConvergenceError, ProblemError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.data_term import DataTerm, packed_axes
from napari_hmrf.solver.optimizers import least_motion
from napari_hmrf.solver.optimizers.base import Report
from napari_hmrf.solver.optimizers.external_forces import SoftObservations
from napari_hmrf.solver.optimizers.refinement import Refinement, add
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import free_motions

Float64Array = npt.NDArray[np.float64]

# Initial width of the kink, as a fraction of the largest distance from an observed position.
_FIRST_WIDTH = 0.2
# Ratio of each width of the kink to the previous one.
_WIDTH_FACTOR = 0.1
# Width of the kink from which its result may be accepted, and smallest width, as fractions of the
# tolerance.
_NARROW, _LEAST_WIDTH = 1e-3, 1e-7
# Largest change of the field since the previous width that ends the search, in tolerances.
_SMALL_CHANGE = 0.1
# Width of the kink, as a fraction of the largest displacement, from which states are tried.
_SHARP = 0.02
# Largest number of Newton steps for a width, and step that ends them, in widths.
_MOST_STEPS, _LAST_STEP = 30, 0.3
# Tolerance of a Newton step, in widths.
_STEP_TOLERANCE = 0.1
# Reduction of the slope of the energy at which a whole Newton step is taken.
_SLOPE = 0.3
# Factor on the tolerance for the first exchanges, which are followed by exchanges at the tolerance.
_ROUGH = 10.0
# Largest number of exchanges, and number of exchanges without fewer contradictions that ends them.
_EXCHANGES, _PATIENCE = 12, 3
# Largest expected motion in further exchanges, relative to the motion in the last exchange.
_FURTHER = 2.0
# Largest accepted excess of the force of a held component, as a fraction of its limit.
_EXCESS = 1e-6
# Accepted motion of a slipping component beyond its observed position, as a fraction of the
# tolerance.
_PASSED = 1e-3
# Fraction of the limit by which a force must be below it to prove that a component is held.
_NEAR_LIMIT = 1e-4
# Work over a free motion that is rounding error, as a fraction of the sum of absolute values.
_BALANCED = 1e-9
# Distance of held observations of a rigid body from one of its motions that is rounding error,
# relative to the largest observed displacement, and factor on it in the estimated error, because
# tissue around a turning body moves farther than the body.
_ROUNDED, _LEVER = 3e-7, 30.0


class Slip:
    """Minimum of the energy of a linear model with observations that may slip.

    Parameters
    ----------
    problem : Problem
    backend : Backend
    model : LinearModel
        Model without observations.
    observed : ndarray of bool, planes
        Observed components that have an equation.
    y, limit : ndarray, planes
        Observed displacement, in pixels, and largest force of each observation, which is infinite
        for a component that never slips.
    load : ndarray, planes, or None
        Force on each component.
    stored : float
        Energy at zero displacement.
    new_refinement : callable
        Function that returns a `Refinement` of a model.
    report : callable
    """

    def __init__(
        self,
        problem: Problem,
        backend: Backend[Any],
        model: LinearModel,
        observed: HeldPlanes,
        y: Planes,
        limit: Planes,
        load: Planes | None,
        stored: float,
        new_refinement: Callable[[LinearModel], Refinement],
        report: Report,
    ) -> None:
        self._problem, self._backend, self._latest = problem, backend, model
        self._material = model.material
        self._y, self._load, self._stored = y, load, stored
        self._new_refinement, self._report = new_refinement, report
        self._fixed: HeldPlanes = observed & np.isinf(limit)
        self._at = np.flatnonzero(observed & ~self._fixed)
        self._aims, self._limit = y.ravel()[self._at], limit.ravel()[self._at]
        self._yielding = self._planes(self._limit)
        self._sides: Float64Array = np.zeros(len(self._at))
        model.hold(self._fixed)
        bodies = np.zeros_like(observed)
        if model.bodies is not None:
            bodies = model.bodies.hold(bodies)
        self._bodies: HeldPlanes = bodies
        self._on_body = bodies.ravel()[self._at]
        self._scale = float(np.abs(self._aims).max(initial=0.0))
        self._largest = float(np.abs(y).max(initial=0.0))
        #: Refinement of the last solve, with its estimated error.
        self.refinement = new_refinement(model)
        self._soft: tuple[LinearModel, Refinement] | None = None
        #: Required force of each observation in the last field.
        self._needed: Float64Array = np.zeros(len(self._at))
        #: Rounding error of the field while the kink is rounded, or None if it is negligible.
        self._low: Planes | None = None

    def run(self, d: Planes, tolerance: float) -> None:
        """Minimize the energy over `d`, in place."""
        self._hold(self._model, self._fixed, d)
        off = self._off(d)
        self._sides = np.where(np.abs(off) > tolerance, np.sign(off), 0.0)
        begun = d.copy()
        if not self._exchange(d, tolerance):
            np.copyto(d, begun)
            self._soften(d, tolerance)
        self._settle(d)

    def energy(self, d: Planes) -> float:
        """Return the total energy of a displacement."""
        of_observations = float((self._limit * np.abs(self._off(d))).sum())
        of_tissue, _ = self._model.work(d)
        return of_tissue + of_observations + self._stored - host.work_of(self._load, d)

    def _planes(self, values: Float64Array) -> Planes:
        planes: Planes = np.zeros(self._y.shape)
        planes.ravel()[self._at] = values
        return planes

    def _off(self, d: Planes) -> Float64Array:
        return np.asarray(self._aims - d.ravel()[self._at])

    def _held(self, components: npt.NDArray[np.bool_]) -> HeldPlanes:
        held: HeldPlanes = self._fixed.copy()
        held.ravel()[self._at] = components
        return held

    def _with_load(self, forces: Planes) -> Planes:
        return forces if self._load is None else forces + self._load

    @property
    def _model(self) -> LinearModel:
        """Model without springs. If it has a data term, springs have used its memory."""
        if self._latest.material is not self._material:
            self._latest = self._backend.elastic_model(self._material)
        return self._latest

    def _with_springs(self, springs: Planes) -> tuple[LinearModel, Refinement]:
        """Return the model with additional springs on observed components."""
        material, axes = self._material, len(self._y)
        weights = np.zeros((len(packed_axes(axes)), *self._y.shape[1:]))
        weights[:axes] = springs
        points = None
        if material.data is not None:
            weights += material.data.weights
            points = material.data.points
        model = self._backend.elastic_model(replace(material, data=DataTerm(weights, points)))
        if self._soft is None or self._soft[0] is not model:
            self._soft = model, self._new_refinement(model)
        return self._soft

    # Exchanges of states

    def _exchange(self, d: Planes, tolerance: float) -> bool:
        """Exchange states that contradict the field until it stays; return whether it does."""
        fewest, patience, near = len(self._at) + 1, _PATIENCE, _ROUGH * tolerance
        for number in range(_EXCHANGES):
            held = self._held(self._sides == 0)
            before = d.copy()
            try:
                ways = self._free(held)
                if not self._is_balanced(ways):
                    return False
                self.refinement.is_rough = near > tolerance
                needed = self._solve(d, near, self._pins(ways))
            except (ConvergenceError, ProblemError):
                # The tolerance is out of reach, or a body cannot have all observed positions.
                return False
            if ways:
                self._least(d, needed, ways)
            holds = self._sides == 0
            over = np.abs(needed) > (1 + _EXCESS) * self._limit
            passed = -self._sides * self._off(d) > _PASSED * tolerance
            wrong = np.where(holds, over, passed)
            moved = float(np.abs(d - before).max())
            count = int(np.count_nonzero(wrong))
            # A body stays until the last of its redundant observations slips.
            may_move = bool((wrong & self._on_body).any())
            further = _FURTHER * moved if count else 0.0
            is_still = not count or (number > 0 and further <= near and not may_move)
            is_accurate = self.refinement.worst + further <= tolerance
            # An estimate far below what was asked is less reliable beside rigid bodies.
            is_final = near == tolerance or (not count and self._model.bodies is None)
            if is_still and is_accurate and is_final:
                self._needed = needed
                self.refinement.estimate += further
                return True
            self._sides = np.where(wrong, np.where(holds, np.sign(needed), 0.0), self._sides)
            if is_still:
                near = tolerance
                continue
            patience = _PATIENCE if count < fewest else patience - 1
            fewest = min(count, fewest)
            if not patience:
                return False
        return False

    def _solve(self, d: Planes, tolerance: float, pins: HeldPlanes) -> Float64Array:
        """Solve for the current states, in place; return the required force of each observation.

        Raises
        ------
        ConvergenceError, ProblemError
            If the tolerance cannot be reached, or no motion of a rigid body has all its observed
            positions.
        """
        holds, model = self._sides == 0, self._model
        held = self._held(holds)
        np.copyto(d, self._y, where=held)
        self._hold(model, held | pins, d)
        far = float(np.abs(self._off(d)[holds]).max(initial=0.0))
        if far > _ROUNDED * self._largest + _PASSED * tolerance:
            raise ConvergenceError("a rigid body cannot have all observed positions")
        pulls = self._planes(self._sides * self._limit)
        self.refinement.run(d, self._with_load(pulls), tolerance)
        self.refinement.estimate += _LEVER * far
        self.refinement.set_energy(self.energy(d))
        forces = self._with_load(self.refinement.pull(d)).copy()
        if model.bodies is not None:
            forces += np.where(self._bodies, pulls, 0.0)
            model.bodies.carry(forces, self._yielding)
        return -forces.ravel()[self._at]

    def _hold(self, model: LinearModel, held: HeldPlanes, d: Planes) -> None:
        """Set the constrained components, and make the displacement of bodies rigid, in place."""
        model.hold(held)
        if model.bodies is not None:
            model.bodies.make_rigid(d)

    # Free motions

    def _free(self, held: HeldPlanes) -> list[Float64Array]:
        """Return all free motions of tissue with the constrained components `held`."""
        return list(free_motions(self._problem, host.field(held)))

    def _free_in_result(self, holds: npt.NDArray[np.bool_]) -> list[Float64Array]:
        """Return all free motions of the result if only the observations `holds` hold it."""
        return self._free(self._held(holds))

    def _is_balanced(self, motions: list[Float64Array]) -> bool:
        """Return whether the forces for the current states do no work over free motions."""
        load = self._with_load(self._planes(self._sides * self._limit))
        return all(_works_nothing(load, way) for ways in motions for way in ways)

    def _pins(self, motions: list[Float64Array]) -> HeldPlanes:
        """Return components that prevent all free motions if they are constrained."""
        pins: HeldPlanes = np.zeros(self._y.shape, np.bool_)
        at = np.flatnonzero(self._model.steepness.ravel() > 0) if motions else np.zeros(0, int)
        for ways in motions:
            moves = np.stack([host.planes(way).ravel() for way in ways])
            *_, order = scipy.linalg.qr(moves[:, at], mode="economic", pivoting=True)
            pins.ravel()[at[order[: len(ways)]]] = True
        return pins

    def _least(self, d: Planes, needed: Float64Array, motions: list[Float64Array]) -> None:
        """Choose the least motion among the fields that differ by `motions`, in place."""
        holds = self._sides == 0
        off = self._planes(np.where(holds, 0.0, self._off(d)))
        side = self._planes(np.where(holds, np.sign(needed), self._sides))
        field, off, side = map(host.field, (d, off, side))
        least_motion.choose_least_motion(field, off, side, motions, self._problem.tissue)

    def _settle(self, d: Planes) -> None:
        """Choose the least motion if held observations at their limit leave tissue free."""
        needed, holds = self._needed, self._sides == 0
        below = np.abs(needed) < (1 - _NEAR_LIMIT) * self._limit
        sides = np.where(holds & ~below, np.sign(needed), self._sides)
        load = self._with_load(self._planes(sides * self._limit))
        motions = []
        for ways in self._free_in_result(holds & below):
            work = np.array([host.work_of(load, host.planes(way)) for way in ways])
            if all(_works_nothing(load, way) for way in ways):
                motions.append(ways)
            elif len(ways) > 1:  # combinations over which the forces do no work
                others = scipy.linalg.null_space(work[None] / np.abs(work).max())
                motions.append(np.tensordot(others.T, ways, 1))
        if motions:
            self._least(d, needed, motions)

    # Rounded kink

    def _soften(self, d: Planes, tolerance: float) -> None:
        """Minimize the energy over `d`, in place, with successively narrower kinks."""
        scale = max(self._scale, float(np.abs(self._off(d)).max(initial=0.0)), tolerance)
        np.copyto(d, self._y, where=self._fixed)
        self._hold(self._model, self._fixed, d)
        soft = SoftObservations(self._y, self._yielding, self._load)
        first, last = _FIRST_WIDTH * scale, _LEAST_WIDTH * tolerance
        count = 1 + math.ceil(math.log(last / first, _WIDTH_FACTOR))
        error, before = math.inf, first
        for width in np.geomspace(first, last, count):
            wider, low = d.copy(), None if self._low is None else self._low.copy()
            soft.sharpen(d, width)
            try:
                is_minimal = self._minimize(d, soft, width)
            except ConvergenceError:
                if error > tolerance:
                    raise
                np.copyto(d, wider)
                self._low = low
                soft.sharpen(d, before)
                break
            error = float(np.abs(d - wider).max()) if is_minimal else math.inf
            before = width
            if width <= _SHARP * scale:
                off = self._off(d)
                length = np.hypot(off, width)
                slack = width**2 / (length * (length + np.abs(off)))
                slips = np.abs(off) / scale > slack
                self._sides = np.where(slips, np.sign(off), 0.0)
                rounded = d.copy()
                if self._exchange(d, tolerance):
                    return
                np.copyto(d, rounded)
            if width <= _NARROW * tolerance and error <= _SMALL_CHANGE * tolerance:
                break
        self._accept(d, soft, error, tolerance)

    def _accept(self, d: Planes, soft: SoftObservations, error: float, tolerance: float) -> None:
        """Accept the result for the narrowest kink if its error is within the tolerance."""
        if error > tolerance:
            raise ConvergenceError(
                "no consistent slipping observations were found. Raise the penalty, or hold more "
                "of the tissue"
            )
        self._needed = -soft.forces(d).ravel()[self._at]
        if self._load is not None:
            self._needed -= self._load.ravel()[self._at]
        is_at_limit = np.abs(self._needed) >= (1 - _NEAR_LIMIT) * self._limit
        self._sides = np.where(is_at_limit, np.sign(self._needed), 0.0)
        self.refinement.error = self.refinement.estimate = error
        self._hold(self._model, self._fixed, d)
        rest = self._model.pull(d, self._low) - soft.forces(d)
        rest[~self._model.moves] = 0
        if self._model.bodies is not None:
            self._model.bodies.project(rest)
        self.refinement.residual = float(np.linalg.norm(rest))
        self.refinement.set_energy(self.energy(d))

    def _minimize(self, d: Planes, soft: SoftObservations, width: float) -> bool:
        """Minimize the energy with a rounded kink over `d`, in place, by Newton's method.

        Return whether the steps have become small.
        """
        for _ in range(_MOST_STEPS):
            step = self._newton_step(d, soft, width)
            length = float(np.abs(step).max())
            step *= self._part(d, step, soft)
            before = d.copy()
            if self._low is None:
                d += step
            else:
                add(d, self._low, step)
            soft.follow(before, d)
            if not step.any() or np.abs(d - before).max() <= _LAST_STEP * width:
                return length <= _LAST_STEP * width
        return False

    def _newton_step(self, d: Planes, soft: SoftObservations, width: float) -> Planes:
        """Return the Newton step from `d` for a rounded kink."""
        rest = self._model.pull(d) - soft.forces(d)
        model, refinement = self._with_springs(soft.springs(d))
        model.hold(self._fixed)
        rest[~model.moves] = 0
        step: Planes = np.zeros_like(d)
        refinement.run(step, rest, _STEP_TOLERANCE * width)
        return step

    def _part(self, d: Planes, step: Planes, soft: SoftObservations) -> float:
        """Return the part of a step at which the energy is lowest, from 0 to 1."""
        pull, change = self._model.pull(d, self._low).copy(), self._model.pull(step)

        def slope(part: float) -> float:
            forces = soft.forces(d + part * step) - pull - part * change
            return float((forces * step).sum())

        first, last = slope(0.0), slope(1.0)
        if last <= _SLOPE * abs(first):
            return 1.0
        return 0.0 if first >= 0 else float(scipy.optimize.brentq(slope, 0.0, 1.0, rtol=1e-2))


def _works_nothing(load: Planes, way: Float64Array) -> bool:
    """Return whether the work of a load over a motion is a rounding error."""
    work = load * host.planes(way)
    return bool(abs(work.sum()) <= _BALANCED * np.abs(work).sum())
