"""Base class of the linear models on the host."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.backends.earlier_results import EarlierResults, WarmStart
from napari_hmrf.solver.backends.linear import (
    Balance,
    HeldPlanes,
    OnDevice,
    Planes,
    Review,
    Steps,
)
from napari_hmrf.solver.backends.planes import planes, work_of
from napari_hmrf.solver.backends.rigid.bodies import Bodies, BodySites
from napari_hmrf.solver.backends.rigid.deflation import Deflation

if TYPE_CHECKING:
    from napari_hmrf.solver.problem import Problem

# The squares of values between these bounds are representable in single precision.
_SMALL, _GREAT = 1e-6, 1e6


class HostModel:
    """Part of `LinearModel` that is common to the host models of all priors.

    Attributes
    ----------
    levels : sequence
        Levels, finest first. The finest level has ``hold(held)``, the others ``hold_as(finer)``.
    bodies : Bodies or None
        Rigid bodies under the current constraints; None without rigid tissue.
    iterates : bool
        True if cycles can be used with this tissue.
    earlier : EarlierResults
        Results of earlier solves with the current constraints.
    """

    levels: Sequence[Any]
    material: Any
    earlier: EarlierResults
    bodies: Bodies | None = None
    iterates: bool = True
    #: Finest level for an iteration in double precision; only volumes have such a level.
    double_level: Any = None
    #: True if a direct factorization is faster than cycles. By default, a cycle is faster by a
    #: factor of a hundred.
    slow = False
    _held: HeldPlanes | None
    #: Indices of the sites of each rigid body; None without rigid tissue.
    _sites: Sequence[BodySites] | None = None
    #: Residual of a load; 0 at constrained components.
    _rest: npt.NDArray[np.float32]

    @property
    def mild(self) -> bool:
        """True if a cycle reduces the error of every motion of this tissue."""
        return bool(self.material.mild)

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the free components of the finest level."""
        moves: HeldPlanes = self.levels[0].inverse > 0
        return moves

    @property
    def shape(self) -> tuple[int, ...]:
        """Finest grid, (H, W) or (D, H, W)."""
        return tuple(self.levels[0].grid)

    def hold(self, held: HeldPlanes) -> None:
        """Set the constrained components on all levels."""
        if are_equal(held, self._held):
            return
        self._held = None  # set only at the end, because a cancellation may interrupt the update
        self.earlier = EarlierResults()
        self._rest.fill(0)
        compute_thread.check_cancelled()
        if self._sites is not None:
            self.bodies = self.levels[0].bodies = Bodies(self._sites, self.material, held)
        self.levels[0].hold(held)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            compute_thread.check_cancelled()
            coarse.hold_as(fine)
        self._start_cycles()
        self._held = held.copy() if len(held) == 2 else held  # the mask of a volume never changes

    def _start_cycles(self) -> None:
        """Prepare the levels for cycles with new constraints; by default, nothing is needed."""

    def balance(self, d: Planes, load: Planes | None, unit: float = 1.0) -> Balance:
        """Return the residual of a load at a displacement."""
        compute_thread.check_cancelled()
        most, norm = self._balance(d, load, unit)
        if most > 0 and not _SMALL < most < _GREAT:
            unit *= most
            compute_thread.check_cancelled()
            most, norm = self._balance(d, load, unit)
        compute_thread.check_cancelled()
        if self.bodies is not None:
            self.bodies.project(self._rest)
            most, square = self.levels[0].weigh(self._rest, self._rest)
            norm = math.sqrt(square)
        return Balance(self._rest, unit, unit * most, unit * norm)

    def deflation(self, steps: Steps, coarsest: Steps) -> Deflation | None:
        """Return None; models of rigid tissue override this method."""
        return None

    def on_device(
        self, problem: Problem, load: Planes | None, start: WarmStart | None
    ) -> OnDevice | None:
        """Return None, because displacements are on the host."""
        return None

    def review(self, values: npt.NDArray[np.float32], load: Planes | None) -> Review:
        """Return what decides whether a displacement, shape (H, W, 2), is a solution."""
        d = planes(values)
        balance, (energy, forces) = self.balance(d, load), self.work(d)
        farthest = float(np.abs(values).max())
        return Review(balance.most, balance.norm, energy, forces, work_of(load, d), farthest)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the norm of its forces A d."""
        raise NotImplementedError

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        """Write (load - A d) / unit to `_rest`; return its largest absolute value and its norm."""
        raise NotImplementedError

    def clear(self) -> None:
        """Reset all corrections to zero."""
        for level in self.levels:
            level.clear()

    def close(self) -> None:
        """Ignore the call; memory is freed with the last reference."""
