"""What an optimizer is given and what it gives back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.found import Beginning
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem


@dataclass(frozen=True)
class Monitor:
    """One report of a running schedule: what is being done and how much of the work is behind.

    Attributes
    ----------
    message : str
        In words, for a progress bar.
    fraction : float
        Work done, 0 to 1.
    """

    message: str
    fraction: float


Report = Callable[[Monitor], None]


def part_done(first: float, now: float, tolerance: float) -> float:
    """How much of the way from a first error to a tolerance is behind, in orders of magnitude."""
    way = math.log(max(first / tolerance, 1 + 1e-9))
    return min(max(1 - math.log(max(now / tolerance, 1.0)) / way, 0.0), 1.0)


@dataclass(frozen=True)
class LevelRun:
    """What happened on one scale level."""

    number: int
    shape: tuple[int, ...]
    iterations: int


@dataclass(frozen=True)
class Convergence:
    """How close to the converged field an iteration ended.

    Attributes
    ----------
    error : float
        How far any site may be from the converged field, in pixels: an estimate.
    residual : float
        The norm of the forces that are left over, over that of all forces of the tissue, in double
        precision.
    way : {"cycles", "factors"}
        Whether cycles over the levels led there or, where they cannot be trusted, the factors of
        the whole system.
    """

    error: float
    residual: float
    way: str = "cycles"


@dataclass(frozen=True)
class Reach:
    """How far large motion got: nothing is folded, and what cannot be met is met as far as it goes.

    Crushed tissue may creep on: `unbalanced` says how far, and `unbalanced_at` where.

    Attributes
    ----------
    least_jacobian : float
        The least Jacobian at any corner of a pixel: above 0. A pixel of 0.5 has half its area.
    part : float
        Which part of its way the site has come that is furthest from what was observed: 1 if all
        of it was met.
    missing : float
        How far that site is from what was observed, in the unit of the spacing.
    where : tuple of int, or None
        That site; None if all of it was met.
    sites : int
        How many sites are not where they were observed.
    grown : float
        By which part of its growth tissue has grown: 1 but where it would have been crushed.
    unbalanced : float
        Estimated largest distance of any site from its place of balance, in the unit of the
        spacing; 0 if the field converged to the tolerance.
    unbalanced_at : tuple of int, or None
        That site; None if the field converged to the tolerance.
    """

    least_jacobian: float
    part: float = 1.0
    missing: float = 0.0
    where: tuple[int, ...] | None = None
    sites: int = 0
    grown: float = 1.0
    unbalanced: float = 0.0
    unbalanced_at: tuple[int, ...] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a schedule brings back, in pixels.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2)
    energy : ndarray, shape (iterations,) or (1,)
        Mean total energy per site of tissue after each iteration, coarse to fine, pixels squared;
        that of what it began with, if nothing was left to do.
    levels : tuple of LevelRun
        In the order they were run; their iterations add up to ``len(energy)``, or to 0.
    convergence : Convergence or None
        None where the schedule does not look.
    reach : Reach or None
        Of large motion.
    """

    displacement: npt.NDArray[np.floating]
    energy: npt.NDArray[np.float64]
    levels: tuple[LevelRun, ...]
    convergence: Convergence | None = None
    reach: Reach | None = None


class Optimizer(Protocol):
    """A schedule of named kernels on the levels of the hierarchy."""

    def run(
        self,
        problem: Problem,
        prior: Prior,
        backend: Backend[Any],
        report: Report,
        start: Beginning | None = None,
    ) -> Outcome:
        """Run the schedule; on the compute thread only.

        `start` is a displacement to begin with.
        """
        ...

    def rehearsal(self) -> Optimizer:
        """Return the shortest schedule that runs the same kernels, to have them compiled."""
        ...

    @property
    def parameters(self) -> dict[str, Any]:
        """What it would take to run it again, for the record (JSON types only)."""
        ...
