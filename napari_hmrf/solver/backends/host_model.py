"""Common part of the linear models of all priors, on the host."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.found import Found
from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.rigid.bodies import Bodies
from napari_hmrf.solver.backends.rigid.entrained import Entrained
from napari_hmrf.solver.backends.thread import compute_thread

# Squares of values between these are far from the ends of single precision.
_SMALL, _GREAT = 1e-6, 1e6


class HostModel:
    """The part of `LinearModel` that is the same for all.

    Attributes
    ----------
    levels : sequence
        Finest first; the finest has ``hold(held)``, the others ``hold_as(finer)``.
    bodies : Bodies or None
        Of rigid tissue, with what is held now.
    iterates : bool
        Whether cycles can move bodies as one.
    found : Found
        For the tissue with what is held now.
    """

    levels: Sequence[Any]
    material: Any
    found: Found
    bodies: Bodies | None = None
    iterates: bool = True
    #: The finest level for an iteration in double precision; volumes have it.
    exactly: Any = None
    #: Loops go through a cycle in a hundredth of the time that factors take.
    slow = False
    _held: HeldPlanes | None
    #: Residual of a load: 0 where held.
    _rest: npt.NDArray[np.float32]

    @property
    def mild(self) -> bool:
        """True if a cycle sees every motion of such tissue."""
        return bool(self.material.mild)

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the finest level."""
        moves: HeldPlanes = self.levels[0].inverse > 0
        return moves

    @property
    def shape(self) -> tuple[int, ...]:
        """The finest grid, (H, W)."""
        return tuple(self.levels[0].grid)

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on all levels."""
        if self._held is not None and np.array_equal(held, self._held):
            return
        self._held = None  # until all levels are done: this may be stopped on the way
        self.found = Found()
        self._rest.fill(0)
        compute_thread.look()
        self.levels[0].hold(held)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            compute_thread.look()
            coarse.hold_as(fine)
        self._begin()
        self._held = held.copy() if len(held) == 2 else held  # nothing changes that of a volume

    def _begin(self) -> None:
        """Other components are held: forget what was found before, if it is kept."""

    def balance(self, d: Planes, load: Planes | None, unit: float = 1.0) -> Balance:
        """Return the residual of a load for a displacement."""
        compute_thread.look()
        most, norm = self._balance(d, load, unit)
        if most > 0 and not _SMALL < most < _GREAT:
            unit *= most
            compute_thread.look()
            most, norm = self._balance(d, load, unit)
        compute_thread.look()
        if self.bodies is not None:
            self.bodies.project(self._rest)
            most, square = self.levels[0].weigh(self._rest, self._rest)
            norm = math.sqrt(square)
        return Balance(self._rest, unit, unit * most, unit * norm)

    def entrained(self, steps: Steps, coarsest: Steps) -> Entrained | None:
        """Return None: there is nothing rigid."""
        return None

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        """Write (load - A d) / unit to `_rest`; its largest absolute value, and its norm."""
        raise NotImplementedError

    def clear(self) -> None:
        """Make all corrections zero."""
        for level in self.levels:
            level.clear()

    def close(self) -> None:
        """Ignore the call: memory goes with the last reference."""
