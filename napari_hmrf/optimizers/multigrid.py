"""The converged field: a Krylov iteration, preconditioned by a V-cycle over the hierarchy.

Work per pixel does not depend on the size of the image: each level removes the error that its own
pixels can see.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from napari_hmrf.backends import host
from napari_hmrf.backends.base import Backend
from napari_hmrf.backends.found import Beginning, Quality
from napari_hmrf.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.bending import check_bent, free_bend
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.held import FreeMotion, free_motion
from napari_hmrf.optimizers import centred
from napari_hmrf.optimizers.active import ActiveSet
from napari_hmrf.optimizers.base import Convergence, LevelRun, Monitor, Outcome, Report, part_done
from napari_hmrf.optimizers.cycle import BENDING, STRETCHING, Cycle, Smoothing
from napari_hmrf.optimizers.krylov import ConjugateGradients, Step
from napari_hmrf.priors import ElasticPrior, Prior, SeilerPrior
from napari_hmrf.problem import Problem

# The states of what is observed are found at so many times the tolerance, and then confirmed.
_ROUGHLY = 10.0
_MOST_EXCHANGES = 500
_TINY = 1e-300
# What is this part of the tolerance, or less, is as good as nothing.
_NOTHING = 0.01


@dataclass(frozen=True)
class Multigrid:
    """A Krylov iteration with a V-cycle, Chebyshev-Jacobi smoothing, and refinement.

    The iteration runs in single precision; the residual that decides is computed in double. It is
    that of conjugate gradients for a prior with an energy to be least: `ElasticPrior`, and
    `SeilerPrior` in its blanket reading. For its centred reading, which is not symmetric, it is
    that of stabilised biconjugate gradients (`napari_hmrf.optimizers.centred`).

    Parameters
    ----------
    tolerance : float
        Stop when no site is estimated to be further than this from the converged field, in
        pixels. The estimate is what the last cycle corrected, times the residual it left, over
        the least eigenvalue of the preconditioned system as the iteration has come to know it.
        In the centred reading it is a bound, by a maximum principle.
    max_iterations : int
        Give up after so many cycles, with an error. Where observations may slip, that many for
        each set of those that do.
    """

    tolerance: float = 1e-3
    max_iterations: int = 300

    def __post_init__(self) -> None:
        if not (math.isfinite(self.tolerance) and self.tolerance > 0):
            raise ValueError(f"tolerance must be a positive number, not {self.tolerance!r}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be at least 1, not {self.max_iterations!r}")

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters, by name."""
        return {"name": "Multigrid", **asdict(self)}

    def rehearsal(self) -> Multigrid:
        """Return an iteration that is sure to end, with the same kernels."""
        return Multigrid()

    def run(
        self,
        problem: Problem,
        prior: Prior,
        backend: Backend[Any],
        report: Report,
        start: Beginning | None = None,
    ) -> Outcome:
        """Solve; lengths are in pixels from here on."""
        if isinstance(prior, SeilerPrior) and prior.conditional == "centred":
            return centred.converge(
                self.tolerance, self.max_iterations, problem, prior, backend, report, start
            )
        limit = prior.limit(problem)
        d, observed = host.prescribed(problem, start if limit is None else None)
        if isinstance(prior, ElasticPrior):
            model, smoothing = backend.elastic_model(prior.material(problem)), STRETCHING
        else:
            check_bent(problem)
            model, smoothing = backend.seiler_model(prior.material(problem)), BENDING
        refinement = _Refinement(self, model, smoothing, report)
        try:
            if limit is None:
                model.hold(observed)
                refinement.run(d, None, self.tolerance, self._known(start, model))
                energy, forces = model.work(d)
                refinement.settle(energy)
            else:
                y, d = d, d.copy()
                moves = model.steepness > 0
                if start is not None:
                    np.copyto(d, host.combined(start), where=moves)
                states = ActiveSet(observed & moves, y, host.planes(limit), d)
                find = free_motion if isinstance(prior, ElasticPrior) else free_bend
                forces = self._slip(problem, model, states, refinement, d, find)
        except ConvergenceError:
            model.forget()
            raise
        finally:
            model.close()
        energies = np.array(refinement.energies) / max(1, np.count_nonzero(problem.tissue))
        displacement = host.gathered(d)
        host.reuse(d, observed)
        if limit is None:
            model.found.add(displacement, Quality(refinement.estimate, refinement.residual))
        return Outcome(
            displacement=displacement,
            energy=energies,
            levels=(LevelRun(0, problem.shape, len(energies) if refinement.cycles else 0),),
            convergence=Convergence(refinement.estimate, refinement.residual / max(forces, _TINY)),
        )

    def _known(self, start: Beginning | None, model: LinearModel) -> Quality | None:
        """How good what a solve begins with is, if it is all that is observed."""
        if start is None or start.missing > _NOTHING * self.tolerance:
            return None
        return model.found.quality(start)

    def _slip(
        self,
        problem: Problem,
        model: LinearModel,
        states: ActiveSet,
        refinement: _Refinement,
        d: Planes,
        find: Callable[..., FreeMotion | None],
    ) -> float:
        """Solve in place for ever other states of what is observed, until none contradicts itself.

        Returns the norm of the forces at the end.
        """

        def free(held: HeldPlanes) -> Planes | None:
            found = find(problem, np.moveaxis(held[:, 2:-2, 2:-2], 0, -1))
            return None if found is None else host.planes(found.motion)

        if free(states.held) is not None:
            states.hold_all()
        steepness, bound = model.steepness, model.bounds[1]
        forces, before = 0.0, None
        for tolerance in (_ROUGHLY * self.tolerance, self.tolerance):
            near = tolerance / 2
            for _ in range(_MOST_EXCHANGES):
                states.place(d)
                model.hold(states.held)
                refinement.run(d, states.load, tolerance)
                arrived = True
                if before is not None:
                    way = d - before
                    far, pulls = float(np.abs(way).max()), model.pull(before).copy()
                    # How a way within the tolerance goes on is left to chance.
                    arrived = states.step(d, before, way, pulls, model.pull(way)) or far <= near
                elif states.lost:
                    states.follow(d)
                    if free(states.held) is not None:
                        states.hold_all()
                        states.place(d)
                    arrived = False
                if states.lost:
                    before = d.copy()
                energy, forces = model.work(d)
                refinement.settle(energy + states.cost(d))
                if states.lost:
                    if arrived and not states.contradicted(d, model.pull(d), steepness, near):
                        break
                    if states.relax(d, model.pull, bound * steepness, free):
                        before = d.copy()
                        continue
                if not states.exchange(d, model.pull(d), steepness, near, free) and arrived:
                    break
            else:
                raise ConvergenceError(
                    f"which observations slip is open after {_MOST_EXCHANGES} attempts. Raise "
                    "the penalty, or hold more of the tissue"
                )
        return forces


class _Refinement:
    """An iteration in single precision, begun anew from each residual in double.

    Attributes
    ----------
    estimate : float
        How far the field is from converged, in pixels, as far as is known.
    residual : float
        The norm of the forces that are left over, in double precision.
    energies : list of float
        The total energy after each cycle; at the beginning, if there is none.
    cycles : int
        How many there were.
    """

    def __init__(
        self, settings: Multigrid, model: LinearModel, smoothing: Smoothing, report: Report
    ) -> None:
        self._settings, self._model, self._report = settings, model, report
        self._iteration = ConjugateGradients(Cycle(model, smoothing))
        self.estimate = math.inf
        self.residual = 0.0
        self.energies: list[float] = []
        self.cycles = 0
        self._gains: list[float] = []
        self._first: float | None = None

    def run(
        self, d: Planes, load: Planes | None, tolerance: float, known: Quality | None = None
    ) -> None:
        """Move `d` in place to where tissue and load balance, but for `tolerance` pixels.

        If `d` is known to be that good, it stays, once its residual has been seen to be as known.
        """
        balance = self._model.balance(d, load)
        self.residual = balance.norm
        if known is not None and known.suffices(tolerance, balance.norm):
            self.estimate = known.error
            return
        before = math.inf
        while True:
            if balance.most == 0:
                self.estimate = 0.0
                return
            step: Step | None = None

            def enough(latest: Step, unit: float = balance.unit) -> bool:
                nonlocal step
                step = latest
                self.cycles += 1
                self._gains.append(unit**2 * latest.gain)
                self._say(unit * latest.error, tolerance)
                return unit * latest.error <= tolerance

            correction = self._iteration.run(balance.rest, balance.norm / balance.unit, enough)
            if step is not None:
                host.add(d, correction, balance.unit)
                balance = self._model.balance(d, load, balance.most)
                self.residual = balance.norm
                self.estimate = step.reach * self.residual
                if self.estimate <= tolerance:
                    return
            if step is None or not self.estimate < 0.5 * before:
                raise ConvergenceError(
                    f"the field stays {self.estimate:.2g} px from converged after "
                    f"{self.cycles} cycles: single precision does not carry these "
                    "stiffnesses. Bring the softest and the stiffest tissue closer together"
                )
            before = self.estimate

    def settle(self, energy: float) -> None:
        """Take the total energy that the last run ended with, and know those before."""
        gains = self._gains or [0.0]
        self.energies += list(energy + np.cumsum([0.0, *gains[:0:-1]])[::-1])
        self._gains = []

    def _say(self, estimate: float, tolerance: float) -> None:
        """Report, and give up in time."""
        cycles = len(self._gains)
        self._first = self._first or estimate
        done = part_done(self._first, estimate, tolerance)
        self._report(Monitor(f"cycle {self.cycles}, {estimate:.2g} px to go", done))
        if cycles >= self._settings.max_iterations and estimate > tolerance:
            raise ConvergenceError(
                f"the field is still {estimate:.2g} px from converged after {cycles} cycles. "
                "Raise max_iterations, or bring the softest and the stiffest tissue closer together"
            )
