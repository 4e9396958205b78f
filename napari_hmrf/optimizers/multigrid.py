"""The converged field: a Krylov iteration, preconditioned by a V-cycle over the hierarchy.

Work per pixel does not depend on the size of the image: each level removes the error that its own
pixels can see.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from napari_hmrf.backends import host
from napari_hmrf.backends.base import Backend
from napari_hmrf.backends.linear import LinearModel, Planes
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.optimizers.base import LevelRun, Monitor, Outcome, Report
from napari_hmrf.optimizers.cycle import Cycle
from napari_hmrf.optimizers.krylov import ConjugateGradients, Step
from napari_hmrf.priors import ElasticPrior, Prior
from napari_hmrf.problem import Problem


@dataclass(frozen=True)
class Multigrid:
    """Conjugate gradients with a V(2, 2) cycle, Chebyshev-Jacobi smoothing, and refinement.

    The iteration runs in single precision; the residual that decides is computed in double.

    Parameters
    ----------
    tolerance : float
        Stop when no site is estimated to be further than this from the converged field, in
        pixels. The estimate is what the last cycle corrected, times the residual it left, over
        the least eigenvalue of the preconditioned system as the iteration has come to know it.
    max_iterations : int
        Give up after so many cycles, with an error.
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

    def run(self, problem: Problem, prior: Prior, backend: Backend[Any], report: Report) -> Outcome:
        """Solve; lengths are in pixels from here on."""
        if not isinstance(prior, ElasticPrior):
            raise ValueError(
                f"Multigrid is for ElasticPrior, so far; {type(prior).__name__} takes ICM"
            )
        model = backend.elastic_model(prior.material(problem))
        try:
            d, held = host.prescribed(problem)
            model.hold(held)
            refinement = _Refinement(self, model, report)
            refinement.run(d, None)
            energies = refinement.energies(model.energy(d))
        finally:
            model.close()
        return Outcome(
            displacement=host.gathered(d),
            energy=energies / max(1, int(problem.tissue.sum())),
            levels=(LevelRun(0, problem.shape, len(energies)),),
        )


class _Refinement:
    """An iteration in single precision, begun anew from each residual in double.

    Attributes
    ----------
    estimate : float
        How far the field is from converged, in pixels, as far as is known.
    """

    def __init__(self, settings: Multigrid, model: LinearModel, report: Report) -> None:
        self._settings, self._model, self._report = settings, model, report
        self._iteration = ConjugateGradients(Cycle(model))
        self.estimate = math.inf
        self._gains: list[float] = []
        self._first: float | None = None

    def run(self, d: Planes, load: Planes | None) -> None:
        """Move `d` to where no component that moves is pulled, in place."""
        rest = self._model.residual(d, load)
        scale, _ = host.measure(rest)
        before = math.inf
        while True:
            if scale == 0:
                self.estimate = 0.0
                return
            step: Step | None = None

            def enough(latest: Step, scale: float = scale) -> bool:
                nonlocal step
                step = latest
                self._gains.append(scale**2 * latest.gain)
                self._say(scale * latest.error)
                return scale * latest.error <= self._settings.tolerance

            # What float32 holds of a residual must not depend on how small it is.
            correction = self._iteration.run(host.shrunk(rest, scale), enough)
            if step is not None:
                host.add(d, correction, scale)
                rest = self._model.residual(d, load)
                scale, norm = host.measure(rest)
                self.estimate = step.reach * norm
                if self.estimate <= self._settings.tolerance:
                    return
            if step is None or not self.estimate < 0.5 * before:
                raise ConvergenceError(
                    f"the field stays {self.estimate:.2g} px from converged after "
                    f"{len(self._gains)} cycles: single precision does not carry these "
                    "stiffnesses. Bring the softest and the stiffest tissue closer together"
                )
            before = self.estimate

    def energies(self, last: float) -> Any:
        """The energy after each cycle, given the last."""
        gains = self._gains or [0.0]
        return last + np.cumsum([0.0, *gains[:0:-1]])[::-1]

    def _say(self, estimate: float) -> None:
        """Report, and give up in time."""
        tolerance, cycles = self._settings.tolerance, len(self._gains)
        self._first = self._first or estimate
        way = math.log(max(self._first / tolerance, 1 + 1e-9))
        done = 1 - math.log(max(estimate / tolerance, 1.0)) / way
        self._report(Monitor(f"cycle {cycles}, {estimate:.2g} px to go", min(max(done, 0.0), 1.0)))
        if cycles >= self._settings.max_iterations and estimate > tolerance:
            raise ConvergenceError(
                f"the field is still {estimate:.2g} px from converged after {cycles} cycles. "
                "Raise max_iterations, or bring the softest and the stiffest tissue closer together"
            )
