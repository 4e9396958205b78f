"""Requirements of a solve, which determine its backend and its compiled loops."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from napari_hmrf.compute.compile_cache.sets import (
    DATA,
    LARGE_DATA,
    LARGE_IMAGES,
    LARGE_VOLUME_DATA,
    LARGE_VOLUMES,
    VOLUME_DATA,
)
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior

if TYPE_CHECKING:
    from napari_hmrf.solver.problem import Problem


class Schedule(Protocol):
    """Part of an optimizer that determines the compiled loops."""

    @property
    def kernels(self) -> str:
        """Kernels of the schedule: "sweeps", "exact sweeps" or "cycles"."""
        ...


@dataclass(frozen=True, eq=False)
class SolveJob:
    """Requirements of a solve.

    Attributes
    ----------
    shape : tuple of int
        Grid, (H, W) or (D, H, W).
    spacing : tuple of float
        Size of a pixel or voxel along each axis.
    prior : Prior
        Prior, as returned by its method `resolved`.
    optimizer : Schedule
    has_loads : bool
        True if growth of tissue or external forces are given.
    has_rigid_tissue : bool
        True if some stiffness is infinite.
    has_data : bool
        True if there is a quadratic data term.
    has_sliding_parts : bool
        True if parts of the tissue slide along each other.
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    prior: Prior
    optimizer: Schedule
    has_loads: bool = False
    has_rigid_tissue: bool = False
    has_data: bool = False
    has_sliding_parts: bool = False

    @classmethod
    def of(cls, problem: Problem, prior: Prior, optimizer: Schedule) -> SolveJob:
        """Return the requirements for solving a problem."""
        return cls(
            problem.shape,
            problem.spacing,
            prior,
            optimizer,
            has_loads=problem.loads is not None,
            has_rigid_tissue=problem.has_rigid,
            has_data=problem.has_data,
            has_sliding_parts=problem.coupling is not None,
        )

    @property
    def is_volume(self) -> bool:
        """True if the grid has three axes."""
        return len(self.shape) == 3

    @property
    def has_large_motion(self) -> bool:
        """True if the prior describes large motion."""
        return isinstance(self.prior, NeoHookeanPrior)

    @property
    def can_slip(self) -> bool:
        """True if the penalty is finite, so that observations may be violated."""
        return not isinstance(self.prior, SeilerPrior) and self.prior.penalty != math.inf

    @property
    def loops(self) -> str:
        """Name of the set of compiled loops that contains most of the required loops."""
        if self.has_large_motion and self.has_data:
            return LARGE_VOLUME_DATA if self.is_volume else LARGE_DATA
        if self.has_large_motion:
            return LARGE_VOLUMES if self.is_volume else LARGE_IMAGES
        if self.has_data or self.has_sliding_parts:
            return VOLUME_DATA if self.is_volume else DATA
        if isinstance(self.prior, ElasticPrior):
            if self.is_volume:
                return "volume"
            return "elastic" if self.prior.kernels == "elastic" else "slipping"
        name = "converged" if self.optimizer.kernels == "cycles" else "schedule"
        if self.is_volume:
            return f"volume-{name}"
        if self.prior.kernels == "blanket":
            return f"blanket-{name}"
        if len(set(self.spacing)) > 1:
            return f"{name}-oblong"
        return "exact-steps" if self.optimizer.kernels == "exact sweeps" else name
