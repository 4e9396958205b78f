"""States of observations, held or slipping, as an exact solution of the L1 data term (eq. 19).

The force of an observation is at most ``p = K c``. If a smaller force is enough to keep a component
at its observed position, the component is *held*. Otherwise the component *slips*: it is away from
this position and is pulled towards it with the force p. The search exchanges the states of all
components that contradict their state and solves again (a semismooth Newton method). If the
exchanges make no progress, a few proximal gradient steps set the states, and the field is moved
towards the solution for these states only while the energy decreases (a truncated nonsmooth Newton
method: Gräser and Kornhuber, J. Comput. Math. 27, 2009). The second method always ends, because the
energy is convex and has one minimum value for each set of states.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.linear import HeldPlanes, Planes

#: Function that returns a free motion (planes) for a mask of constrained components, or None.
FreeMotion = Callable[[HeldPlanes], Planes | None]

#: Number of exchanges without a decrease in the smallest number of contradictions, after which
#: another method is used.
PATIENCE = 6
# Distance from its observed position, in pixels, up to which a component is held.
_AT_POSITION = 1e-7
# If at most this fraction of a step can be taken, the step counts as no progress.
_NO_STEP = 1e-6
# Number of proximal gradient steps.
_SWEEPS = 10


class States:
    """States of the observed components: held or slipping.

    Parameters
    ----------
    observed : ndarray of bool, planes
        Observed components.
    y : ndarray, planes
        Observed displacement, in pixels.
    limit : ndarray, planes
        Largest force of each observation, in units of the model's residual; infinite for a
        component that never slips.
    d : ndarray, planes
        Displacement, in pixels. Components away from their observed position slip at first.

    Attributes
    ----------
    fixed : ndarray of bool, planes
        Observed components that never slip.
    at : ndarray of int
        Indices of the components that may slip, in the flattened planes.
    y, limit : ndarray
        Observed displacement and limit of the components that may slip.
    """

    def __init__(self, observed: HeldPlanes, y: Planes, limit: Planes, d: Planes) -> None:
        self._grid = observed.shape
        self.fixed = observed & np.isinf(limit)
        self._fixed_at = np.flatnonzero(self.fixed)
        self._fixed_y = y.ravel()[self._fixed_at]
        self.at = np.flatnonzero(observed & ~self.fixed)
        self.y, self.limit = y.ravel()[self.at], limit.ravel()[self.at]
        # Sign of the force on each slipping component; 0 for held components.
        self._slips: npt.NDArray[Any] = np.sign(self.y - d.ravel()[self.at])
        self._fewest = len(self.at) + 1
        self._patience = PATIENCE

    @property
    def held(self) -> HeldPlanes:
        """Mask of the held components."""
        held: HeldPlanes = self.fixed.copy()
        held.ravel()[self.at[self._slips == 0]] = True
        return held

    @property
    def any_slip(self) -> bool:
        """True if any component slips."""
        return bool(self._slips.any())

    @property
    def load(self) -> Planes:
        """Forces of the observations on the slipping components."""
        load = np.zeros(self._grid)
        load.ravel()[self.at] = self._slips * self.limit
        return load

    def hold_all(self) -> None:
        """Hold all observed components."""
        self._slips = np.zeros_like(self._slips)

    def slip_as(self, sides: npt.NDArray[Any]) -> None:
        """Set the states of all components: the sign of ``y - d`` if slipping, and 0 if held."""
        self._slips = sides

    def place(self, d: Planes) -> None:
        """Move the held components to their observed position, in place."""
        held = self._slips == 0
        d.ravel()[self.at[held]] = self.y[held]
        self.place_fixed(d)

    def place_fixed(self, d: Planes) -> None:
        """Move the components that never slip to their observed position, in place."""
        d.ravel()[self._fixed_at] = self._fixed_y


class ActiveSet(States):
    """States of the observations, for a model with an energy.

    Here `limit` is the largest force of an observation.
    """

    def __init__(self, observed: HeldPlanes, y: Planes, limit: Planes, d: Planes) -> None:
        super().__init__(observed, y, limit, d)
        self._barred = np.zeros(len(self.at), dtype=np.bool_)

    @property
    def lost(self) -> bool:
        """True once exchanges alone have made no progress; never reset."""
        return self._patience == 0

    def cost(self, d: Planes) -> float:
        """Return ``sum(p |y - d|)``."""
        return float((self.limit * np.abs(self.y - d.ravel()[self.at])).sum())

    def exchange(
        self, d: Planes, pull: Planes, steepness: Planes, tolerance: float, free: FreeMotion
    ) -> bool:
        """Release held components above their limit; hold slipping components that have passed y.

        Parameters
        ----------
        d : ndarray, planes
            Displacement for the current states. If the release would leave tissue free, the tissue
            slides until an observation holds it again; `d` is then changed in place.
        pull : ndarray, planes
            Force of the tissue on each component.
        steepness : ndarray, planes
            Diagonal of the model, which converts a force to a displacement.
        tolerance : float
            Contradiction, in pixels, up to which a component keeps its state.
        free : callable
            Function that returns a free motion of tissue for a mask of constrained components, or
            None.

        Returns
        -------
        bool
            True if any state has changed.
        """
        needed = -pull.ravel()[self.at]
        excess = self._excess(pull, steepness)
        held = self._slips == 0
        wrong = self._wrong(d, excess, tolerance) & ~self._barred
        count = int(wrong.sum())
        if 0 < count < self._fewest and not self.lost:
            self._fewest, self._patience = count, PATIENCE
        elif count and not self.lost:
            self._patience -= 1
        before, exchanged = self._slips, np.where(held, np.sign(needed), 0.0)
        while count:
            self._slips = np.where(wrong, exchanged, before)
            released = np.flatnonzero(wrong & held)
            motion = free(self.held) if len(released) else None
            if motion is None:
                break
            if len(released) == 1:
                return self.slide(d, motion) or int(wrong.sum()) > 1
            # Too many components were released: release only the half with the largest excess.
            wrong[released[np.argsort(excess[released])[: len(released) // 2]]] = False
        return count > 0

    def contradicted(
        self,
        d: Planes,
        pull: Planes,
        steepness: Planes,
        tolerance: float,
        share: float = math.inf,
    ) -> bool:
        """Return whether any component contradicts its state; parameters as for `exchange`.

        A force that exceeds its limit by the fraction `share` is a contradiction, regardless of the
        stiffness of the tissue.
        """
        more = np.abs(pull.ravel()[self.at]) - self.limit
        over = (self._slips == 0) & (more > share * self.limit)
        return bool(over.any() or self._wrong(d, self._excess(pull, steepness), tolerance).any())

    @property
    def every(self) -> HeldPlanes:
        """Mask of all observed components."""
        observed: HeldPlanes = self.fixed.copy()
        observed.ravel()[self.at] = True
        return observed

    def relax(
        self, d: Planes, pull_at: Callable[[Planes], Planes], steepness: Planes, free: FreeMotion
    ) -> bool:
        """Take a few proximal gradient steps from `d`, in place.

        Parameters
        ----------
        d : ndarray, planes
            Displacement.
        pull_at : callable
            Function that returns the force of the tissue on each component for a displacement.
        steepness : ndarray, planes
            Diagonal D of the model, times an upper bound on the spectrum of D^-1 A.
        free : callable
            As for `exchange`.

        Returns
        -------
        bool
            True if the components were moved; False if that would leave tissue free.
        """
        steep = steepness.ravel()[self.at]
        moved, before = d.copy(), self._slips
        flat = moved.ravel()
        for _ in range(_SWEEPS):
            off = flat[self.at] - self.y + pull_at(moved).ravel()[self.at] / steep
            less = np.maximum(np.abs(off) - self.limit / steep, 0)
            flat[self.at] = self.y + np.sign(off) * less
        self.follow(moved)
        if free(self.held) is not None:
            self._slips = before
            return False
        np.copyto(d, moved)
        return True

    def _excess(self, pull: Planes, steepness: Planes) -> npt.NDArray[Any]:
        """Return the excess of each force over its limit, divided by the diagonal, in pixels."""
        more = np.abs(pull.ravel()[self.at]) - self.limit
        return np.asarray(more / steepness.ravel()[self.at])

    def _wrong(
        self, d: Planes, excess: npt.NDArray[Any], tolerance: float
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of the components that contradict their state by more than `tolerance`."""
        passed = self._slips * (d.ravel()[self.at] - self.y)
        return np.asarray(np.where(self._slips == 0, excess, passed) > tolerance)

    def certain(self, pull: Planes, margin: float, noise: Planes | float = 0.0) -> HeldPlanes:
        """Return a mask of the components that are held by a force below their limit.

        Their force is below the limit by at least the fraction `margin` of the limit, plus `noise`,
        the uncertainty of the force.
        """
        held: HeldPlanes = self.fixed.copy()
        uncertainty = np.broadcast_to(noise, self._grid).ravel()[self.at]
        less = np.abs(pull.ravel()[self.at]) < (1 - margin) * self.limit - uncertainty
        held.ravel()[self.at] = (self._slips == 0) & less
        return held

    def correct(
        self, d: Planes, pull: Planes, tolerance: float, share: float, singly: bool
    ) -> bool:
        """Exchange components that contradict their state; return whether there were any.

        A held component contradicts its state if its force exceeds the limit by the fraction
        `share`. A slipping component contradicts its state if it has passed y by `tolerance`
        pixels. If `singly`, only the last such component is exchanged, so that the exchanges always
        end (Murty's rule).
        """
        force, held = -pull.ravel()[self.at], self._slips == 0
        passed = self._slips * (d.ravel()[self.at] - self.y)
        wrong = np.where(held, np.abs(force) > (1 + share) * self.limit, passed > tolerance)
        if singly:
            wrong[: np.flatnonzero(wrong)[-1:].sum()] = False
        self._slips = np.where(wrong, np.where(held, np.sign(force), 0.0), self._slips)
        return bool(wrong.any())

    def sides(self, d: Planes, pull: Planes) -> tuple[Planes, Planes]:
        """Return ``y - d`` of each component (0 if held), and the required sign of ``y - d``."""
        off, side = np.zeros((2, *self._grid))
        off.ravel()[self.at] = np.where(self._slips == 0, 0.0, self.y - d.ravel()[self.at])
        needed = -pull.ravel()[self.at]
        side.ravel()[self.at] = np.where(self._slips == 0, np.sign(needed), self._slips)
        return off, side

    def step(self, d: Planes, before: Planes, way: Planes, pull: Planes, change: Planes) -> bool:
        """Move `d` from `before` along `way` to the lowest energy within the step.

        Returns True if `d` is at the end of the step. `d` is changed in place.

        Parameters
        ----------
        d : ndarray, planes
            End of the step.
        before, way : ndarray, planes
            Start of the step, and the step.
        pull : ndarray, planes
            Force of the tissue at `before`.
        change : ndarray, planes
            Change in this force over the step.
        """
        slope, bend = -float((pull * way).sum()), -float((change * way).sum())
        part = self._lowest(before, way, slope, bend)
        # Without progress, components that were released but are still at y stay held.
        slipped = self._slips != 0
        if part < 1:
            np.copyto(d, before + part * way)
            self.follow(d)
        self._barred = slipped & (self._slips == 0) if part < _NO_STEP else np.zeros_like(slipped)
        return part >= 1

    def follow(self, d: Planes) -> None:
        """Set the states from `d`: a component is held if it is at its observed position."""
        off = self.y - d.ravel()[self.at]
        self._slips = np.where(np.abs(off) <= _AT_POSITION, 0.0, np.sign(off))
        self.place(d)

    def slide(self, d: Planes, motion: Planes) -> bool:
        """Move tissue along a free motion to the lowest energy, in place; return whether it moved.

        Afterwards, an observation holds the tissue. If the energy has no minimum along the motion,
        components at their observed position are held again instead.
        """
        for way in (motion, -motion):
            part = self._lowest(d, way, 0.0, 0.0)
            if 0 < part < math.inf:
                np.copyto(d, d + part * way)
                self.follow(d)
                return True
        off = self.y - d.ravel()[self.at]
        self._slips = np.where(np.abs(off) <= _AT_POSITION, 0.0, self._slips)
        return False

    def _lowest(self, d: Planes, way: Planes, slope: float, bend: float) -> float:
        """Return the multiple of `way` from `d` at which the energy is lowest."""
        # `slope` and `bend` are the first and second derivative of the energy without observations.
        off, moves = d.ravel()[self.at] - self.y, way.ravel()[self.at]
        off[self._slips == 0] = 0
        at = np.divide(-off, moves, out=np.full_like(off, -1.0), where=moves != 0)
        signs = np.where(off != 0, np.sign(off), np.sign(moves))
        slope += float((self.limit * signs * moves).sum())
        if slope >= 0:
            return 0.0
        # The slope jumps where a component passes its observed position.
        for k in np.argsort(at):
            if at[k] <= 0:
                continue
            if slope + bend * at[k] >= 0:
                break
            slope += 2 * float(self.limit[k] * abs(moves[k]))
            if slope + bend * at[k] >= 0:
                return float(at[k])
        return -slope / bend if bend > 0 else math.inf
