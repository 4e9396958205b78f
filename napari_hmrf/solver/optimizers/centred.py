"""Converged field of the paper's centred update, with a bound on its error.

Let q be the weighted mean of the neighbours of a site, y its observed value, A the curvature of its
local energy, and p = K c. In the converged field, each component satisfies

    d = max(q - l, min(y, q + l))   with   l = p / 2 A.

This field does not minimize an energy, and the equations are not symmetric. However, the weights
are positive and add up to one, so a maximum principle holds: if a field w >= 0 satisfies
w - q(w) >= 1, then

    |d - exact| <= max w * max |d - q(d)|

at every site. Such a *barrier* w is computed by the same iteration, to a coarse tolerance. The
barrier proves the bound.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.optimizers.base import (
    Convergence,
    LevelRun,
    Monitor,
    Outcome,
    Report,
    part_done,
)
from napari_hmrf.solver.optimizers.cycle import AVERAGING, Cycle
from napari_hmrf.solver.optimizers.krylov import StabilisedGradients, Step
from napari_hmrf.solver.optimizers.refinement import factorise
from napari_hmrf.solver.priors import SeilerPrior
from napari_hmrf.solver.problem import Problem

# Largest accepted deviation of w - q(w) from 1 for a barrier w.
_BARRIER = 0.5
# Deviation of w - q(w) from 1 at which the iteration for a barrier ends.
_BARRIER_AIM = 0.4
# Largest contradiction of a state that is ignored, as a fraction of the tolerance.
_CONTRADICTION = 0.1
# Number of cycles after which a factorization is faster.
_CYCLES = 60
# Number of exchanges without a decrease in the smallest number of contradictions, after which
# systems are solved exactly.
_PATIENCE = 6
# Number of exchanges of states after which the solve fails.
_MOST_EXCHANGES = 2000
_TINY = 1e-300
# Largest residual of an exact solution.
_EXACT = 1e-12
# Relative difference above which one value exceeds another by more than rounding errors.
_SURE = 1e-11
# Largest residual of a solution by factorization, relative to the largest displacement.
_ROUNDING = 1e-14
# Force of a held observation, as a fraction of its limit, below which its state is not in doubt.
_FIRM = 0.5


def converge(
    tolerance: float,
    max_iterations: int,
    problem: Problem,
    prior: SeilerPrior,
    backend: Backend[Any],
    report: Report,
    start: WarmStart | None,
) -> Outcome:
    """Solve the centred reading of the paper's prior; from here on, lengths are in pixels.

    Parameters
    ----------
    tolerance : float
        Largest error of the field.
    max_iterations : int
        Largest number of cycles for each set of states.
    problem : Problem
    prior : SeilerPrior
    backend : Backend
    report : callable
    start : WarmStart or None

    Raises
    ------
    ConvergenceError
        If the error bound exceeds the tolerance or no consistent states are found.
    """
    model = backend.seiler_model(prior.material(problem))
    refinement = _Refinement(tolerance, max_iterations, model, report)
    try:
        d, states = _start_field(problem, prior, model, start)
        for _ in range(_MOST_EXCHANGES):
            states.place(d)
            model.hold(states.held)
            reach = refinement.run(d, states.load if states.any_slip else None, states.exact)
            pull = model.pull(d)
            if not states.exchange(d, pull, _CONTRADICTION * refinement.within / max(reach, 1.0)):
                if states.exact or model.mild or states.is_firm(d, pull):
                    break
                states.be_exact()
        else:
            raise ConvergenceError(
                f"no consistent slipping observations were found in {_MOST_EXCHANGES} exchanges. "
                "Raise the penalty, or hold more of the tissue"
            )
        off = max(reach * refinement.most, max(reach, 1.0) * states.off(d, pull))
        refinement.estimate = tolerance / refinement.within * off
        if reach * refinement.most > refinement.within:
            refinement.fail()
        energy, forces = model.work(d)
        way = "cycles" if model.earlier.factors is None else "factors"
    except ConvergenceError:
        model.clear_cache()
        raise
    finally:
        model.close()
    energy += states.cost(d)
    cycles = max(1, refinement.cycles)
    displacement, rounding = host.gathered(d, tolerance)
    return Outcome(
        displacement=displacement,
        energy=np.full(cycles, energy / max(1, int(problem.tissue.sum()))),
        levels=(LevelRun(0, problem.shape, cycles),),
        convergence=Convergence(
            max(refinement.estimate, rounding), refinement.residual / max(forces, _TINY), way
        ),
    )


def _start_field(
    problem: Problem, prior: SeilerPrior, model: LinearModel, start: WarmStart | None
) -> tuple[Planes, _States]:
    """Return the initial displacement and the states of the observations."""
    d, observed = host.prescribed(problem)
    steep = model.steepness
    # No force acts on a site that is not the middle of any clique, so the site does not move.
    states = _States(observed & (steep > 0), d, host.planes(prior.limit(problem)), steep)
    if start is not None:
        np.copyto(d, host.combined(start), where=~observed & (steep > 0))
    return d, states


class _States:
    """States of the observed components, held or slipping, for the centred update (eq. 19)."""

    # A component is held if q is within l = p / 2 A of its observed value y, that is, everywhere
    #
    #     d = max(q - l, min(y, q + l)).
    #
    # The held components are found by exchanging all components that contradict their state. If
    # this makes no progress, two selections are improved alternately (policy iteration): the set
    # of components at which the maximum is q - l and, for each such set, the set of other
    # components at which the minimum is q + l. The weights of the system are positive and add up to
    # one, so both improvements are monotone, and the iteration ends (Hoffman and Karp, Management
    # Science 12, 1966).

    def __init__(self, candidates: HeldPlanes, y: Planes, force: Planes, steep: Planes) -> None:
        limit = np.divide(force, steep, out=np.zeros_like(force), where=candidates)
        self._grid = candidates.shape
        #: Observed components that never slip.
        self._fixed: HeldPlanes = candidates & np.isinf(limit)
        self._fixed_at = np.flatnonzero(self._fixed)
        self._fixed_y = y.ravel()[self._fixed_at]
        #: Indices of the components that may slip, in the flattened planes.
        self.at = np.flatnonzero(candidates & ~self._fixed)
        self.y, self.limit = y.ravel()[self.at], limit.ravel()[self.at]
        self._force = force.ravel()[self.at]
        #: Sign of the force on each slipping component; 0 for held components.
        self._slips: npt.NDArray[Any] = np.zeros_like(self.y)
        self._fewest, self._patience = len(self.at) + 1, _PATIENCE

    @property
    def held(self) -> HeldPlanes:
        """Mask of the held components."""
        held: HeldPlanes = self._fixed.copy()
        held.ravel()[self.at[self._slips == 0]] = True
        return held

    @property
    def any_slip(self) -> bool:
        """True if any component slips."""
        return bool(self._slips.any())

    @property
    def load(self) -> Planes:
        """Forces of the observations on the slipping components, in units of the residual."""
        load = np.zeros(self._grid)
        load.ravel()[self.at] = self._slips * self.limit
        return load

    def place(self, d: Planes) -> None:
        """Move the held components to their observed position, in place."""
        held = self._slips == 0
        d.ravel()[self.at[held]] = self.y[held]
        d.ravel()[self._fixed_at] = self._fixed_y

    def cost(self, d: Planes) -> float:
        """Return the energy of the observations, ``sum(p |y - d|)``."""
        return float((self._force * np.abs(d.ravel()[self.at] - self.y)).sum())

    def off(self, d: Planes, pull: Planes) -> float:
        """Return the largest change in an observed component in one more update."""
        # The update is y + soft(q - y, p / 2 A), and `pull` is q - d.
        if not len(self.at):
            return 0.0
        away = d.ravel()[self.at] - self.y
        towards = away + pull.ravel()[self.at]
        target = np.sign(towards) * np.maximum(np.abs(towards) - self.limit, 0.0)
        return float(np.abs(away - target).max())

    def exchange(self, d: Planes, pull: Planes, tolerance: float) -> bool:
        """Exchange components that contradict their state; return whether any state has changed."""
        # `pull` is q - d.
        off = d.ravel()[self.at] - self.y
        q = off + pull.ravel()[self.at]
        if self.exact:
            return self._improve(q)
        held = self._slips == 0
        excess, passed = np.abs(q) - self.limit, self._slips * off
        wrong = np.where(held, excess, passed) > tolerance
        count = int(wrong.sum())
        if count < self._fewest:
            self._fewest, self._patience = count, _PATIENCE
        else:
            self._patience -= 1
        if count and self._patience == 0:
            self._slips = np.zeros_like(self._slips)
            return True
        self._slips = np.where(wrong, np.where(held, -np.sign(q), 0.0), self._slips)
        return count > 0

    @property
    def exact(self) -> bool:
        """True if systems must be solved exactly, because exchanges alone are not reliable."""
        return self._patience == 0

    def be_exact(self) -> None:
        """Require exact solutions from now on."""
        self._patience = 0

    def is_firm(self, d: Planes, pull: Planes) -> bool:
        """Return whether all components are held by forces far below their limits."""
        # If slipping stiff tissue could also be held, a small residual does not prove that the
        # states are right: other states may have a very different field.
        q = d.ravel()[self.at] - self.y + pull.ravel()[self.at]
        return not self.any_slip and bool((np.abs(q) < _FIRM * self.limit).all())

    def _improve(self, q: npt.NDArray[Any]) -> bool:
        """Improve the selection of the minimum or, if that is optimal, of the maximum."""
        high = self._slips < 0
        least = _SURE * (1 + np.abs(q))
        low = ~high & np.where(self._slips > 0, q + self.limit < 0, q + self.limit < -least)
        if not np.array_equal(low, self._slips > 0):
            self._slips = np.where(high, -1.0, np.where(low, 1.0, 0.0))
            return True
        better = np.where(high, q - self.limit > 0, q - self.limit > least)
        if np.array_equal(better, high):
            return False
        self._slips = np.where(better, -1.0, np.where(low & ~better, 1.0, 0.0))
        return True


class _Refinement:
    """Iterative refinement by cycles, with an error bound from a maximum principle."""

    def __init__(
        self, tolerance: float, max_iterations: int, model: LinearModel, report: Report
    ) -> None:
        self._tolerance, self._max_iterations, self._report = tolerance, max_iterations, report
        self._model = model
        #: Tolerance for a single component, because the bounds are for components, not for sites.
        self.within = tolerance / math.sqrt(len(model.shape))
        self._iteration = StabilisedGradients(Cycle(model, AVERAGING))
        self._barrier: Planes | None = None
        self.cycles = 0
        self.estimate, self.most, self.residual = math.inf, 0.0, 0.0
        self._begun = 0
        self._first: float | None = None

    def run(self, d: Planes, load: Planes | None, in_double: bool) -> float:
        """Solve d = q(d) + load in place, to the tolerance or, if `in_double`, exactly."""
        # Returns a bound on the error of any site, per unit of the largest residual.
        self._begun = self.cycles
        reach = self._reach(d.shape)

        def enough(step: Step, scale: float) -> bool:
            self._report_cycle(
                f"error {scale * reach * step.rest:.2g} px", scale * reach * step.rest
            )
            return scale * step.rest <= target

        most = target = self.within / reach if reach > 0 else math.inf
        if in_double:
            target = min(most, _EXACT)
        self.most, self.residual = self._solve(d, load, most, enough, target)
        return reach

    def _reach(self, shape: tuple[int, ...]) -> float:
        """Return a bound on the error of any site, per unit of the largest residual."""
        if self._barrier is None:
            self._barrier = np.zeros(shape)

        def enough(step: Step, scale: float) -> bool:
            self._report_cycle("computing the error bound", math.inf)
            return scale * step.rest <= _BARRIER_AIM

        barrier, ones = self._barrier, np.ones(shape)
        barrier[~self._model.moves] = 0
        off, _ = self._solve(barrier, ones, _BARRIER, enough, _BARRIER)
        return float(barrier.max()) / (1 - off)

    def _solve(
        self, d: Planes, load: Planes | None, most: float, enough: Any, target: float
    ) -> tuple[float, float]:
        """Reduce all residuals to `most`, in place, or to `target` if rounding errors allow it."""
        # Returns the largest absolute value and the norm of the residual.
        balance = self._model.balance(d, load)
        least, last = math.inf, self.cycles + _CYCLES
        while balance.most > target:
            unit, cycles = balance.unit, self._model.earlier.factors is None
            if cycles and balance.most < 0.9 * least and self.cycles < last:
                least = balance.most

                def ends(step: Step, unit: float = unit) -> bool:
                    return enough(step, unit) or self.cycles >= last

                try:
                    host.add(d, self._iteration.run(balance.rest, ends), unit)
                except FloatingPointError:
                    least = 0.0
                    continue
            else:
                if not cycles and not balance.most < 0.9 * least:
                    # If too many components slip, tissue moves far, and rounding errors limit the
                    # residual. More components are held in the next states.
                    if balance.most <= max(most, _ROUNDING * float(np.abs(d).max())):
                        break
                    self.fail()
                least = math.inf if cycles else balance.most
                d += unit * factorise(self._model, self._report).solve(balance.rest)
            balance = self._model.balance(d, load, balance.most)
        return balance.most, balance.norm

    def _report_cycle(self, message: str, estimate: float) -> None:
        """Count and report a cycle; raise an error if there were too many."""
        self.cycles += 1
        done = 0.0
        if math.isfinite(estimate):
            self._first = self._first or estimate
            done = part_done(self._first, estimate, self.within)
        self._report(Monitor(f"cycle {self.cycles}, {message}", done))
        if self.cycles - self._begun > self._max_iterations:
            self.fail("Raise max_iterations, or reduce")

    def fail(self, remedy: str = "Reduce") -> None:
        """Raise an error, because the error bound of the field exceeds the tolerance."""
        raise ConvergenceError(
            f"the error bound of the field is still above {self._tolerance:g} px after "
            f"{self.cycles} cycles. {remedy} the ratio of the stiffest to the softest tissue"
        )
