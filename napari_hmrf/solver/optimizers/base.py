"""Input and output of an optimizer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem


@dataclass(frozen=True)
class Monitor:
    """Progress report of a running schedule.

    Attributes
    ----------
    message : str
        Description of the current step, for a progress bar.
    fraction : float
        Completed fraction of the work, 0 to 1.
    so_far : callable, optional
        Returns the field at this step of a solve of large motion, without folds: an `Outcome` from
        an optimizer, a `Solution` from `solve`, or None if the field folds on the finest grid.
        Valid on the compute thread, until the report returns.
    """

    message: str
    fraction: float
    so_far: Callable[[], Any] | None = field(default=None, compare=False, repr=False)

    def with_field(self, convert: Callable[[Any], Any]) -> Monitor:
        """Return the same report, with what `convert` makes of each field."""
        found = self.so_far
        if found is None:
            return self

        def so_far() -> Any:
            value = found()
            return None if value is None else convert(value)

        return replace(self, so_far=so_far)


Report = Callable[[Monitor], None]
# Largest estimate of an error that is reported, in pixels; far from the solution it is arbitrary.
_LARGEST_ERROR = 1000.0


def words_of_cycle(cycle: int, error: float) -> str:
    """Return the description of a cycle, with the estimated error in pixels if it is meaningful."""
    return f"cycle {cycle}" + (f", error {error:.2g} px" if error < _LARGEST_ERROR else "")


def part_done(first: float, now: float, tolerance: float) -> float:
    """Return the progress from an initial error to a tolerance, on a logarithmic scale, 0 to 1."""
    whole = math.log(max(first / tolerance, 1 + 1e-9))
    return min(max(1 - math.log(max(now / tolerance, 1.0)) / whole, 0.0), 1.0)


def factorizing(report: Report) -> Callable[[float], None]:
    """Return a function that reports the part of a factorization that is done, from 0 to 1."""
    return lambda part: report(Monitor(f"factorizing, {part:.0%}", part))


@dataclass(frozen=True)
class LevelRun:
    """Record of the iterations on one scale level."""

    number: int
    shape: tuple[int, ...]
    iterations: int


@dataclass(frozen=True)
class Convergence:
    """Distance from the converged field at the end of an iteration.

    Attributes
    ----------
    error : float
        Estimated largest distance of any site from the converged field, in pixels.
    residual : float
        Norm of the residual forces, relative to the norm of all forces of the tissue, computed in
        double precision.
    way : {"cycles", "factors"}
        Method that solved the system: multigrid cycles, or a direct factorization if cycles are
        not reliable.
    """

    error: float
    residual: float
    way: str = "cycles"


@dataclass(frozen=True)
class Reach:
    """Extent to which large motion satisfies the observations.

    No element is folded. Crushed tissue may not be in equilibrium yet: `unbalanced` is its distance
    from equilibrium.

    Attributes
    ----------
    least_jacobian : float
        Smallest Jacobian at any corner of a pixel, above 0; 0.5 means half the area.
    part : float
        Completed fraction of the motion of the site that is farthest from its observed position; 1
        if all observations are satisfied.
    missing : float
        Distance of that site from its observed position, in the unit of the spacing.
    where : tuple of int, or None
        Index of that site; None if all observations are satisfied.
    sites : int
        Number of sites that are not at their observed positions.
    grown : float
        Completed fraction of the growth; below 1 if more growth would have crushed tissue.
    unbalanced : float
        Estimated largest distance of any site from equilibrium, in the unit of the spacing; 0 if
        the field converged to the tolerance.
    unbalanced_at : tuple of int, or None
        Index of that site; None if the field converged to the tolerance.
    stopped : bool
        True if the budget of the optimizer ended the solve; a larger budget leads further.
    regions : tuple of tuple of int
        Index of the farthest site of each connected region of sites that are not at their observed
        positions, such as the region of one arrow; farthest first.
    """

    least_jacobian: float
    part: float = 1.0
    missing: float = 0.0
    where: tuple[int, ...] | None = None
    sites: int = 0
    grown: float = 1.0
    unbalanced: float = 0.0
    unbalanced_at: tuple[int, ...] | None = None
    stopped: bool = False
    regions: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a schedule, in pixels.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2)
    energy : ndarray, shape (iterations,) or (1,)
        Mean total energy per site of tissue after each iteration, coarse to fine, in pixels
        squared. If there was no iteration, the initial energy.
    levels : tuple of LevelRun
        Levels in the order in which they ran. Their iterations add up to ``len(energy)``, or to 0.
    convergence : Convergence or None
        None if the schedule does not measure convergence.
    reach : Reach or None
        Extent to which observations are satisfied; for large motion only.
    """

    displacement: npt.NDArray[np.floating]
    energy: npt.NDArray[np.float64]
    levels: tuple[LevelRun, ...]
    convergence: Convergence | None = None
    reach: Reach | None = None


class Optimizer(Protocol):
    """Schedule of named kernels on the levels of the hierarchy."""

    def run(
        self,
        problem: Problem,
        prior: Prior,
        backend: Backend[Any],
        report: Report,
        start: WarmStart | None = None,
    ) -> Outcome:
        """Run the schedule, on the compute thread only.

        Parameters
        ----------
        problem : Problem
        prior : Prior
        backend : Backend
        report : callable
            Called with a `Monitor`; raises an exception to cancel.
        start : WarmStart, optional
            Initial displacement; by default zero (cold start).

        Returns
        -------
        Outcome
        """
        ...

    def rehearsal(self) -> Optimizer:
        """Return the shortest schedule that runs the same kernels, to compile them."""
        ...

    @property
    def kernels(self) -> str:
        """Kernels of the schedule: "sweeps", "exact sweeps" or "cycles"."""
        ...

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the schedule, for the record (JSON types only)."""
        ...
