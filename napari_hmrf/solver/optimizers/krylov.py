"""Krylov iterations preconditioned by a V-cycle, with estimates of the spectrum and the error.

Let B be the cycle and r the residual. The error is A^-1 r, and in the norm of B^-1 it is at most
that of the correction B r, divided by the smallest eigenvalue of B A. The estimate uses the largest
component in place of this norm, and the smallest eigenvalue that the iteration has found (Lanczos).
This value is never below the smallest eigenvalue: a soft motion that the iteration has not found
yet makes the estimate too small. `refinement` guards against that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.linear import (
    Balance,
    OnDevice,
    Planes,
    Steps,
    UnsymmetricLevel,
)
from napari_hmrf.solver.backends.rigid.deflation import Deflation
from napari_hmrf.solver.optimizers.cycle import Cycle

# Reduction of the residual after which a run in single precision ends, so that the caller can
# compute the residual in double precision.
_INNER = 1e-5
# Reduction of the residual after which a run in double precision ends.
_INNER_DOUBLE = 1e-12
# Residual, relative to the initial residual, that is due to rounding in single precision.
_ROUNDING = 1e-7
# Smallest eigenvalue that is resolved in single precision.
_LEAST = 1e-6
# Smallest eigenvalue that is resolved in double precision.
_LEAST_DOUBLE = 1e-12
# Residual, relative to the solution, at the limit of single precision.
_ATTAINED = 3e-7
# Smallest ratio of the error after a step to the error before it that an estimate assumes.
_FASTEST = 0.2
#: Largest value of the smallest eigenvalue that an estimate assumes before `RELIABLE_STEPS`.
USUAL_LEAST = 0.3
# Multiple of the expected smallest eigenvalue up to which an eigenvalue counts as expected.
_MET = 1.2
#: Number of steps after which the estimate of the smallest eigenvalue is reliable.
RELIABLE_STEPS = 6


@dataclass(frozen=True)
class Step:
    """Estimates after one step of an iteration, in the units of the initial residual.

    Attributes
    ----------
    reach : float
        Estimated largest distance of any site from the solution, per unit of the norm of the
        residual. The estimate uses the correction of the last cycle and the smallest eigenvalue
        found so far.
    rest : float
        Norm of the residual after the step.
    gain : float
        Decrease in energy during the step.
    worst_reach : float
        The same as `reach` if the smallest eigenvalue is one that the iteration may have missed.
    """

    reach: float
    rest: float
    gain: float
    worst_reach: float = math.inf

    @property
    def error(self) -> float:
        """Estimated largest distance of any site from the solution."""
        return self.reach * self.rest

    @property
    def worst_error(self) -> float:
        """The same as `error` if the iteration has missed a small eigenvalue."""
        return self.worst_reach * self.rest


#: Callback after each step; returns True to end the iteration.
Watch = Callable[[Step], bool]


class ConjugateGradients:
    """Conjugate gradients for symmetric models; spectrum estimates accumulate over runs.

    Parameters
    ----------
    cycle : Cycle
    double_level_of : callable, optional
        Function that returns the finest level in double precision, or None if there is none.
    """

    def __init__(self, cycle: Cycle, double_level_of: Callable[[], Any] = lambda: None) -> None:
        self._cycle, self._exactly = cycle, double_level_of
        self._spectrum, self._expected = _Spectrum(), 1.0
        #: Number of steps in all runs.
        self._step_count = 0
        #: Finest level in double precision, or None while the iteration runs in single precision.
        self._double: Any = None
        #: Motions induced by rigid bodies, which cycles do not reduce; None without rigid bodies.
        self.deflation: Deflation | None = None
        #: Eigenvalue that the iteration may miss; 1 if it finds all that matter.
        self.unseen = 1.0

    @property
    def steps(self) -> tuple[Steps, Steps]:
        """Smoothing steps of the cycles: on all levels except the coarsest, and on the coarsest."""
        return self._cycle.steps

    @property
    def care(self) -> int:
        """Number of switches to better cycles or to double precision."""
        return self._cycle.care + self.in_double

    @property
    def in_double(self) -> bool:
        """True if the iteration runs in double precision."""
        return self._double is not None

    def take_care(self) -> bool:
        """Switch to better cycles or to double precision; return False if neither is available.

        A switch resets the estimate of the spectrum.
        """
        if not self._cycle.smooth_more():
            if self.in_double:
                return False
            self._double = self._exactly()
            if self._double is None:
                return False
        self._spectrum = _Spectrum(_LEAST_DOUBLE if self.in_double else _LEAST)
        return True

    def _steepest(self, rest: Any) -> Any:
        """Apply the preconditioner to a residual."""
        return self._cycle.run(self._double.rounded(rest) if self.in_double else rest)

    @property
    def least(self) -> float:
        """Smallest eigenvalue found in any run."""
        return self._spectrum.least

    @least.setter
    def least(self, value: float) -> None:
        self._spectrum.least = value

    @property
    def run_least(self) -> float:
        """Smallest eigenvalue found in the current run."""
        return self._spectrum.run_least

    def expect(self, least: float) -> None:
        """Set the expected smallest eigenvalue.

        Parameters
        ----------
        least : float
            Smallest eigenvalue found in earlier runs and in the solves of the warm start.
        """
        self._expected = least
        self.least = min(self.least, least)

    @np.errstate(over="ignore", invalid="ignore")
    def run(self, balance: Balance, d: Planes | OnDevice, enough: Watch) -> None:
        """Add a correction for a residual to `d`, in place.

        The run overwrites the residual. If numbers overflow, `d` is still valid.

        Parameters
        ----------
        balance : Balance
            Residual of the system at `d`.
        d : ndarray, planes, or OnDevice
            Displacement, in pixels. On the device, the residual has the unit 1.
        enough : callable
            Called with a `Step` after each step; returns True to end the run.

        Raises
        ------
        FloatingPointError
            If numbers overflow, or the residual vanishes.
        """
        unit = balance.unit
        norm = balance.norm / unit
        level: Any = self._double if self.in_double else self._cycle.levels[0]
        inner = _INNER_DOUBLE if self.in_double else _INNER
        rest = level.vector(balance.rest)
        at_once = getattr(level, "sums_up", False) and level.bodies is None
        found = None if at_once else level.vector()
        direction, image = level.vector(), level.scratch_vector()
        square = first = norm**2
        before: Any = None
        settled, deflation = 0.0, self.deflation
        if deflation is not None:
            settled = deflation.deflate(level.planes(found), level.planes(rest))
            square = level.product(rest, rest)
        self._spectrum.restart()
        while True:
            steepest = self._steepest(rest)
            if deflation is None:
                level.project(steepest)
            compute_thread.check_cancelled()
            most, slope = level.weigh(steepest, rest)
            turn = slope if before is None else level.ratio(slope, before)
            compute_thread.check_cancelled()
            if deflation is None:
                level.turn(steepest, direction, turn)
            else:
                most = max(most, deflation.turn(steepest, direction, turn))
            compute_thread.check_cancelled()
            curvature = level.apply(direction, image)
            level.project(image)
            compute_thread.check_cancelled()
            length = level.ratio(slope, curvature)
            if at_once:
                if not all(map(math.isfinite, (most, curvature, length))):
                    raise FloatingPointError
                left = level.advance_by(d, unit * length, rest, direction, image, length)
            else:
                left = level.advance(found, rest, direction, image, length)
            values = level.read(most, slope, curvature, turn, left)
            if square == 0 or not all(math.isfinite(value) for value in values):
                raise FloatingPointError
            far, down, bend, turned, after = values
            if not (down > 0 and bend > 0):
                if after > 0 and self._cycle.use_safe_bound():
                    level.free(direction)
                    direction = None  # free its memory before the next allocation
                    direction = level.vector()
                    before = None
                    self._spectrum.restart()
                    continue
                break
            self._spectrum.add(down / bend, 0.0 if before is None else turned)
            step = self._judged(far, first, square, after, down**2 / bend / 2 + settled)
            settled = 0.0
            before, square = slope, after
            if enough(step) or after <= inner**2 * first:
                break
        if not at_once:
            level.project(found)
            if isinstance(d, np.ndarray):
                host.add(d, np.asarray(level.planes(found)), unit)
            else:
                d.add(found)
            level.free(found)
        level.free(direction, image)

    def _judged(self, far: float, first: float, before: float, after: float, gain: float) -> Step:
        """Return the estimates after a step, given the largest value `far` of its correction."""
        # `first`, `before` and `after` are squared norms of residuals.
        # In the first steps, residuals decrease faster than errors, because jumps next to
        # constrained sites are smoothed, and the smallest eigenvalues have not been found yet.
        rounding = _INNER_DOUBLE if self.in_double else _ROUNDING
        rest = max(math.sqrt(after), rounding * math.sqrt(first))
        least = self._spectrum.least
        # A single step may reduce the error faster than this, but later steps do not.
        lasting = (1 - math.sqrt(least)) / (1 + math.sqrt(least))
        fall = max(math.sqrt(after / before), _FASTEST, lasting)
        if self._spectrum.run_least > _MET * self._expected:
            fall = max(fall, 1 - self._expected)  # reduction of a slow motion before it is found
        if self._spectrum.steps < RELIABLE_STEPS:
            least = min(least, USUAL_LEAST)
        self._step_count += 1
        if self._step_count < RELIABLE_STEPS:
            fall = max(fall, 1 - least)  # reduction of slow motions in early cycles
        left = far * fall / rest
        return Step(left / least, rest, gain, left / min(least, self.unseen))


class StabilisedGradients:
    """Stabilized biconjugate gradients (BiCGSTAB) for nonsymmetric models.

    Each step runs two cycles and reports the largest absolute value of the residual. The iteration
    does not estimate the error of the solution.

    Parameters
    ----------
    cycle : Cycle
    """

    def __init__(self, cycle: Cycle) -> None:
        self._cycle = cycle

    @np.errstate(over="ignore", invalid="ignore")
    def run(self, residual: npt.NDArray[np.float32], enough: Watch) -> npt.NDArray[np.float32]:
        """Return a correction for a residual, in single precision.

        Parameters
        ----------
        residual : ndarray of float32, planes
        enough : callable
            Called with a `Step` after each step; returns True to end the run.

        Raises
        ------
        FloatingPointError
            If numbers overflow.
        """
        level = cast(UnsymmetricLevel, self._cycle.levels[0])
        rest, shadow = level.vector(residual.copy()), level.vector(residual)
        found, direction, image, second = (level.vector() for _ in range(4))
        along = level.product(shadow, rest)
        (first,) = level.read(along)
        level.turn(rest, direction, along)
        while True:
            steepest = self._cycle.run(direction)
            level.multiply(steepest, image)
            length = level.quotient(along, level.product(shadow, image))
            level.advance(found, rest, steepest, image, length)
            steepest = self._cycle.run(rest)
            level.multiply(steepest, second)
            stride = level.quotient(level.product(second, rest), level.product(second, second))
            left = level.advance(found, rest, steepest, second, stride)
            before, (most, along) = along, level.weigh(rest, shadow)
            share = level.quotient(level.times(along, length), level.times(before, stride))
            level.lean(rest, direction, image, share, stride)
            values = level.read(most, level.largest(found), left, share)
            if not all(math.isfinite(value) for value in values):
                raise FloatingPointError
            most, far, square, again = values
            step = Step(math.inf, most, 0.0)
            # A residual this small relative to the solution consists of rounding errors.
            small = square <= _INNER**2 * first or most <= _ATTAINED * far
            if enough(step) or small or again == 0:
                break
        level.free(rest, direction, image, second)
        return np.asarray(level.planes(found))


class _Spectrum:
    """Estimate of the smallest eigenvalue, from the Lanczos matrix of conjugate gradients."""

    def __init__(self, rounding: float = _LEAST) -> None:
        self.least, self._rounding = 1.0, rounding
        self.restart()

    @property
    def steps(self) -> int:
        """Number of steps in the current run."""
        return len(self._diagonal)

    def restart(self) -> None:
        """Start a new run, retaining the smallest eigenvalue of all runs."""
        self._diagonal: list[float] = []
        self._beside: list[float] = []
        self._length = 0.0
        #: Smallest eigenvalue found in the current run.
        self.run_least = 1.0

    def add(self, length: float, turn: float) -> None:
        """Add a step of size `length`; `turn` is the coefficient of the previous direction."""
        self._diagonal.append(1 / length + (turn / self._length if self._length else 0.0))
        if self._length:
            self._beside.append(math.sqrt(turn) / self._length)
        self._length = length
        if self._beside:
            least = scipy.linalg.lapack.dsterf(self._diagonal, self._beside)[0][0]
            self.run_least = min(self.run_least, max(float(least), self._rounding))
            self.least = min(self.least, self.run_least)
