"""Blanket reading with observations that may slip: a search for consistent states."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.bending_modes import free_bend
from napari_hmrf.solver.optimizers import interior, least_motion
from napari_hmrf.solver.optimizers.base import Report
from napari_hmrf.solver.optimizers.null_space import (
    SoftMotions,
    explain_singular,
    find_soft_motions,
    refuse_free,
    resolves,
)
from napari_hmrf.solver.optimizers.refinement import (
    BARELY_HELD,
    Refinement,
    add,
    factorise,
    factors_fit,
)
from napari_hmrf.solver.optimizers.slip_states import ActiveSet
from napari_hmrf.solver.problem import Problem

Float64Array = npt.NDArray[np.float64]

# Factor on the tolerance for the first exchanges, which are followed by exchanges at the tolerance.
_ROUGH_FACTOR = 10.0
# Accuracy of the final exchange, relative to the largest displacement, or to 1 pixel if larger.
_EXACT = 1e-11
# Largest accepted violation of the slip conditions after the final exchange, as a multiple of the
# accuracy.
_CONTRADICTION = 10.0
# Largest accepted violation of the slip conditions when a result is confirmed, as a multiple of the
# accuracy.
_CONFIRMATION = 10.0
# Fraction of the limit by which a force must be below the limit to prove that a component is held.
_AT_LIMIT = 1e-9
# Fraction of the limit by which a force must be below the limit to need no closer inspection.
_NEAR_LIMIT = 1e-4
# Largest accepted excess of the force of a held component, as a fraction of its limit.
_EXCESS = 1e-9
# Number of refinement solves that compute the start of the interior-point method.
_REFINEMENTS = 4
# Number of exchanges after which another method is used.
_MOST_EXCHANGES = 100
# Number of exchanges after which only one component is exchanged at a time.
_BLOCK_EXCHANGES = 30


class BendingSlip:
    """Search for the states of observations (held or slipping) and for the resulting field.

    With many slipping observations or a small penalty, a single wrong state can change the field
    considerably, even if its contradiction is small. At the end, all states must therefore be right
    to within rounding errors.

    Parameters
    ----------
    problem : Problem
    model : LinearModel
    states : ActiveSet
    refinement : Refinement
    report : callable
    """

    def __init__(
        self,
        problem: Problem,
        model: LinearModel,
        states: ActiveSet,
        refinement: Refinement,
        report: Report,
    ) -> None:
        self._problem, self._model, self._report = problem, model, report
        self._states, self._refinement = states, refinement
        self._steepness = model.steepness

    def run(self, d: Planes, tolerance: float) -> None:
        """Minimize the energy over `d`, in place."""
        exact = _EXACT * max(1.0, float(np.abs(d).max()))
        try:
            if self._free(self._states.held) is not None:
                self._states.hold_all()
            for rough in (_ROUGH_FACTOR * tolerance, tolerance):
                self._exchange(d, rough, rough / 2)
            self._refinement.require_rehearsal()
            self._exchange(d, exact, _CONTRADICTION * exact)
            clear = np.array_equal(self._clear(d), self._states.held)
            if not clear and factors_fit(self._model):
                factorise(self._model, self._report)
                self._refinement.run(d, self._states.load, exact)
            pull = self._pull(d)
            if self._states.contradicted(d, pull, self._steepness, _CONTRADICTION * exact, _EXCESS):
                raise ConvergenceError("the released observations would leave tissue free")
            if not self._resolved:
                self._model.hold(self._states.every)
                self._check_held()
                self._confirm(d, exact)
        except ConvergenceError:
            # The exchanges did not end, or their states leave tissue free. First check that the
            # tissue has no free motion if all observations are held.
            self._model.hold(self._states.every)
            if self._model.moves.any():
                self._check_held()
            self._close_gap(d)
            self._confirm(d, exact)
        self._settle(d)

    def _close_gap(self, d: Planes) -> None:
        """Find the states by the interior-point method, in place."""
        # The rounding errors of the method depend on its start. If the method fails from the result
        # of the exchanges, it starts again with all observations held.
        try:
            interior.solve(self._model, self._states, d, self._report)
        except ConvergenceError:
            self._model.hold(self._states.every)
            d[:] = self._with_all_held(d)
            interior.solve(self._model, self._states, d, self._report)

    def _with_all_held(self, d: Planes) -> Planes:
        """Return the field with all observations held; the model must have these constraints."""
        model, states = self._model, self._states
        held = np.where(self._steepness > 0, 0.0, d)
        states.place_fixed(held)
        held.ravel()[states.at] = states.y
        if model.moves.any():
            factors, low = factorise(model, self._report), np.zeros_like(d)
            for _ in range(_REFINEMENTS):
                rest = model.pull(held, low).copy()
                rest[~model.moves] = 0
                add(held, low, factors.solve(rest))
        return held

    def _check_held(self) -> None:
        """Raise an error with the reason if the observations do not constrain the tissue."""
        model, every = self._model, self._states.every
        try:
            factorise(model, self._report)
        except ConvergenceError as error:
            if str(error) != BARELY_HELD:
                raise
            raise explain_singular(model, every, self._refinement, self._report) from None
        if not self._resolved:
            refuse_free(model, every, self._refinement, self._report)

    @property
    def _resolved(self) -> bool:
        """True if the last solution is unique."""
        return resolves(self._model)

    def _pull(self, d: Planes) -> Planes:
        """Return the forces after the last run, without the forces of observations."""
        return self._refinement.pull(d)

    def _free(self, held: HeldPlanes) -> Planes | None:
        """Return a free motion of tissue with the constrained components `held`, or None."""
        motion = free_bend(self._problem, host.field(held))
        return None if motion is None else host.planes(motion.motion)

    def _exchange(self, d: Planes, tolerance: float, near: float) -> None:
        """Exchange states and solve, in place, until no contradiction exceeds `near` pixels."""
        model, states, bound = self._model, self._states, self._model.bounds[1]

        def pull(at: Planes) -> Planes:
            return model.pull(at)

        before = None
        for _ in range(_MOST_EXCHANGES):
            states.place(d)
            model.hold(states.held)
            self._refinement.run(d, states.load, tolerance)
            arrived = True
            if before is not None:
                way = d - before
                far, pulls = float(np.abs(way).max()), pull(before).copy()
                # Within the tolerance, the direction of the step is random.
                arrived = states.step(d, before, way, pulls, model.pull(way)) or far <= near
            elif states.lost:
                states.follow(d)
                if self._free(states.held) is not None:
                    states.hold_all()
                    states.place(d)
                arrived = False
            if states.lost:
                before = d.copy()
            energy, _ = model.work(d)
            self._refinement.set_energy(energy + states.cost(d))
            if states.lost:
                if arrived and not states.contradicted(d, pull(d), self._steepness, near):
                    return
                if states.relax(d, pull, bound * self._steepness, self._free):
                    before = d.copy()
                    continue
            if not states.exchange(d, pull(d), self._steepness, near, self._free) and arrived:
                return
        raise ConvergenceError(
            f"no consistent slipping observations were found in {_MOST_EXCHANGES} exchanges"
        )

    def _confirm(self, d: Planes, exact: float) -> None:
        """Solve for the current states and exchange components that contradict their state."""
        states, model, refinement = self._states, self._model, self._refinement
        for number in range(_MOST_EXCHANGES):
            play = self._soft_motions(states.held)
            states.place(d)
            adrift = play.unbalanced_motion(states.load)
            if adrift is not None and states.slide(d, adrift):
                continue
            model.hold(states.held | play.pins)
            play.balance(model, refinement, d, states.load, exact)
            pull = refinement.pull(d)
            self._least(d, pull, play.free)
            sure = _CONFIRMATION * max(exact, refinement.estimate)
            if not states.correct(d, pull, sure, _EXCESS, number >= _BLOCK_EXCHANGES):
                break
        else:
            raise ConvergenceError(
                "no consistent slipping observations were found in double precision. Raise the "
                "penalty, or hold more of the tissue"
            )
        energy, _ = model.work(d)
        refinement.set_energy(energy + states.cost(d))

    def _settle(self, d: Planes) -> None:
        """Choose the least motion among fields of lowest energy, in place."""
        states, pull = self._states, self._pull(d)
        if not np.array_equal(states.certain(pull, _AT_LIMIT), states.held):
            quality = self._refinement.estimate, self._refinement.residual
            self._least(d, pull, self._motions(states.certain(pull, _AT_LIMIT)))
            self._refinement.estimate, self._refinement.residual = quality

    def _clear(self, d: Planes) -> HeldPlanes:
        """Return a mask of the held components with a force clearly below the limit."""
        noise = _EXACT * max(1.0, float(np.abs(d).max())) * self._steepness
        return self._states.certain(self._pull(d), _NEAR_LIMIT, noise)

    def _motions(self, held: HeldPlanes) -> list[Float64Array]:
        """Return all free motions of tissue with the constrained components `held`."""
        return self._soft_motions(held).free

    def _soft_motions(self, held: HeldPlanes) -> SoftMotions:
        """Return all soft motions of tissue with the constrained components `held`."""
        return find_soft_motions(self._model, held, self._refinement, self._report)

    def _least(self, d: Planes, pull: Planes, motions: list[Float64Array]) -> None:
        """Choose the least motion among the fields that differ by `motions`, in place."""
        if motions:
            moved, off, side = map(host.field, (d, *self._states.sides(d, pull)))
            least_motion.choose_least_motion(moved, off, side, motions, self._problem.tissue)
