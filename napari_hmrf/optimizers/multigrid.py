"""The converged field: conjugate gradients, preconditioned by a V-cycle over the hierarchy.

Work per pixel does not depend on the size of the image: each level removes the error that its own
pixels can see.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy

from napari_hmrf.backends.base import Backend
from napari_hmrf.coarsening import elastic_levels, smoother_bounds
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.optimizers.base import LevelRun, Monitor, Outcome, Report
from napari_hmrf.priors import ElasticPrior, Prior
from napari_hmrf.problem import Problem

# The part of the spectrum of D^-1 A that a level's smoother is for, as a fraction of its largest.
_SMOOTHED = 0.3
_COARSEST_SMOOTHED = 0.02
_SWEEPS = 2
_COARSEST_SWEEPS = 20
# How far single precision is trusted to reduce a residual before it is computed again in double.
_INNER = 1e-5
# Below this an eigenvalue is rounding.
_LEAST = 1e-6


@dataclass(frozen=True)
class Multigrid:
    """Conjugate gradients with a V(2, 2) cycle, Chebyshev-Jacobi smoothing, and refinement.

    The iteration runs in single precision; the residual that decides is computed in double.

    Parameters
    ----------
    tolerance : float
        Stop when no site is estimated to be further than this from the converged field, in
        pixels. The estimate is what one more cycle would correct, over the least eigenvalue of
        the preconditioned system as the iteration has come to know it.
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
        prescribed = (problem.c > 0) & problem.tissue[..., None]
        lame, shape = prior.lame(problem), prior.shape(problem.spacing)
        levels = [
            backend.elastic_level(level, shape) for level in elastic_levels(lame, shape, prescribed)
        ]
        iteration = _Iteration(self, _Cycle(levels, *smoother_bounds(lame, shape)), report)
        finest = levels[0]
        d = finest.planes(np.where(prescribed, problem.y, 0.0) / problem.unit, np.float64)
        no_load = np.zeros_like(d)
        rest = finest.exact_residual(d, no_load)
        start = _norm(rest)
        before = math.inf
        while start > 0:
            # What float32 holds of a residual must not depend on how small it is.
            scale = float(np.abs(rest).max())
            correction = iteration.run((rest / scale).astype(np.float32), scale)
            if correction is None:
                break
            if not iteration.estimate < 0.5 * before:
                raise ConvergenceError(
                    f"the field stays {iteration.estimate:.2g} px from converged after "
                    f"{iteration.cycles} cycles: single precision does not carry these "
                    "stiffnesses. Bring the softest and the stiffest tissue closer together"
                )
            before = iteration.estimate
            d += scale * correction
            rest = finest.exact_residual(d, no_load)
        result = np.moveaxis(d[:, 2:-2, 2:-2], 0, -1)
        energy = finest.energy(d) / max(1, int(problem.tissue.sum()))
        cycles = max(1, iteration.cycles)
        return Outcome(
            displacement=result.astype(np.float32),
            energy=np.full(cycles, energy),
            levels=(LevelRun(0, problem.shape, cycles),),
        )


class _Iteration:
    """Conjugate gradients in single precision, begun anew from each residual in double.

    Attributes
    ----------
    cycles : int
        How many there have been.
    estimate : float
        How far the field was from converged when the last run began, in pixels.
    """

    def __init__(self, settings: Multigrid, cycle: _Cycle, report: Report) -> None:
        self._settings, self._cycle, self._report = settings, cycle, report
        self.cycles = 0
        self.estimate = math.inf
        self._first: float | None = None
        self._spectrum = _Spectrum()

    def run(self, rest: Any, scale: float) -> Any:
        """Return a correction for `rest`, both in units of `scale`; None if none is needed."""
        level = self._cycle.levels[0]
        found, direction, image = (np.zeros_like(rest) for _ in range(3))
        start = math.sqrt(level.product(rest, rest))
        before = 0.0
        self._spectrum.restart()
        while True:
            level.load = rest
            steepest = self._cycle.run()
            estimate = scale * float(np.abs(steepest).max()) / self._spectrum.least
            if not before:
                self.estimate = estimate
            self._say(estimate)
            if estimate <= self._settings.tolerance:
                return found if before else None
            slope = level.product(steepest, rest)
            turn = slope / before if before else 0.0
            level.turn(steepest, direction, turn)
            curvature = level.apply(direction, image)
            if not (slope > 0 and curvature > 0):
                if not self._cycle.be_careful():
                    return found
                before = 0.0
                self._spectrum.restart()
                continue
            before = slope
            self._spectrum.add(slope / curvature, turn)
            square = level.advance(found, rest, direction, image, slope / curvature)
            if math.sqrt(square) <= _INNER * start:
                return found

    def _say(self, estimate: float) -> None:
        """Report, count and give up in time."""
        self._first = self._first or estimate
        way = math.log(max(self._first / self._settings.tolerance, 1 + 1e-9))
        done = 1 - math.log(max(estimate / self._settings.tolerance, 1.0)) / way
        self._report(
            Monitor(f"cycle {self.cycles}, {estimate:.2g} px to go", min(max(done, 0.0), 1.0))
        )
        if self.cycles >= self._settings.max_iterations:
            raise ConvergenceError(
                f"the field is still {estimate:.2g} px from converged after {self.cycles} cycles. "
                "Raise max_iterations, or bring the softest and the stiffest tissue closer together"
            )
        self.cycles += 1


class _Spectrum:
    """The least eigenvalue that conjugate gradients have met (their Lanczos matrix has it)."""

    def __init__(self) -> None:
        self.least = 1.0
        self.restart()

    def restart(self) -> None:
        """Begin a new run; what was learnt stays."""
        self._diagonal: list[float] = []
        self._beside: list[float] = []
        self._length = 0.0

    def add(self, length: float, turn: float) -> None:
        """Take in a step: its length along the direction, and the direction's turn before it."""
        self._diagonal.append(1 / length + (turn / self._length if self._length else 0.0))
        if self._length:
            self._beside.append(math.sqrt(turn) / self._length)
        self._length = length
        if self._beside:
            least = scipy.linalg.eigh_tridiagonal(
                self._diagonal, self._beside, True, select="i", select_range=(0, 0)
            )[0]
            self.least = min(self.least, max(float(least), _LEAST))


class _Cycle:
    """A V-cycle from the finest level down and back."""

    def __init__(self, levels: list[Any], usual: float, worst: float) -> None:
        self.levels = levels
        self._worst = worst
        self._smooth_up_to(usual)

    def be_careful(self) -> bool:
        """Smooth for any mixture of materials from now on; False if that is so already.

        A smoother that amplifies what lies beyond its bound makes a preconditioner that is not
        positive, which conjugate gradients notice.
        """
        if self._bound >= self._worst:
            return False
        self._smooth_up_to(self._worst)
        return True

    def _smooth_up_to(self, bound: float) -> None:
        self._bound = bound
        self._steps = _chebyshev(_SMOOTHED * bound, bound, _SWEEPS)
        self._coarsest = _chebyshev(_COARSEST_SMOOTHED * bound, bound, _COARSEST_SWEEPS)

    def run(self) -> Any:
        """Return the correction for the finest level's load."""
        *upper, last = self.levels
        for level, coarse in zip(upper, self.levels[1:], strict=True):
            level.relax(self._steps, from_zero=True)
            level.restrict_to(coarse)
        last.relax(self._coarsest, from_zero=True)
        for level, coarse in zip(reversed(upper), reversed(self.levels[1:]), strict=True):
            level.correct_from(coarse)
            level.relax(self._steps, from_zero=False)
        return self.levels[0].correction


def _chebyshev(low: float, high: float, steps: int) -> list[tuple[float, float]]:
    """(scale, momentum) of each step of the polynomial that is least on [low, high]."""
    centre, half = (high + low) / 2, (high - low) / 2
    sigma = centre / half
    rho = 1 / sigma
    made = [(1 / centre, 0.0)]
    for _ in range(steps - 1):
        following = 1 / (2 * sigma - rho)
        made.append((2 * following / half, following * rho))
        rho = following
    return made


def _norm(values: Any) -> float:
    return float(np.sqrt((values**2).sum()))
