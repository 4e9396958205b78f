"""The L1 data term (eq. 19), solved exactly: which observed components are held, and which slip.

An observation pulls with a force of at most p = K c. Where less is needed to keep a component at
what was observed, it is *held* there; elsewhere it *slips* and is pulled with p towards it. Which
is which is found by exchanging all components that contradict their state, then solving again
(a semismooth Newton method). Where that does not lead anywhere, the states are those that a few
proximal gradient steps lead to, and the field goes from there only as far towards the one for these
states as the energy falls (a truncated nonsmooth Newton method: Gräser and Kornhuber, J. Comput.
Math. 27, 2009). That ends for certain: the energy is convex, and each state has one least energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.optimizers.loading import work_of

#: Says how tissue could move at no cost if only so much were held: planes, or None.
FreeMotion = Callable[[HeldPlanes], Planes | None]

# Exchanges of whole blocks that may pass without fewer contradictions than ever before.
PATIENCE = 6
# What is this close to its mark, in pixels, has come to rest there.
_ON_THE_MARK = 1e-7
# A part of a way that is none.
_NO_WAY = 1e-6
# Steps of all components at once, each on its own.
_SWEEPS = 10


class States:
    """Which observed components are held, and which slip.

    Parameters
    ----------
    observed : ndarray of bool, planes
        Which components are observed.
    y : ndarray, planes
        What was observed, in pixels.
    limit : ndarray, planes
        What pulls at those that slip, in units of the model's residuals; infinite where a component
        never slips.
    d : ndarray, planes
        Where the components are: those elsewhere than observed slip from the beginning.

    Attributes
    ----------
    fixed : ndarray of bool, planes
        Observed components that never slip.
    at : ndarray of int
        The other observed components, of flat planes.
    y, limit : ndarray
        Of these.
    """

    def __init__(self, observed: HeldPlanes, y: Planes, limit: Planes, d: Planes) -> None:
        self._grid = observed.shape
        self.fixed = observed & np.isinf(limit)
        self._fixed_at = np.flatnonzero(self.fixed)
        self._fixed_y = y.ravel()[self._fixed_at]
        self.at = np.flatnonzero(observed & ~self.fixed)
        self.y, self.limit = y.ravel()[self.at], limit.ravel()[self.at]
        # The sign of the force of those that slip; 0 where held.
        self._slips: npt.NDArray[Any] = np.sign(self.y - d.ravel()[self.at])
        self._fewest = len(self.at) + 1
        self._patience = PATIENCE

    @property
    def held(self) -> HeldPlanes:
        """Components that are held."""
        made: HeldPlanes = self.fixed.copy()
        made.ravel()[self.at[self._slips == 0]] = True
        return made

    @property
    def any_slip(self) -> bool:
        """Whether there is a load at all."""
        return bool(self._slips.any())

    @property
    def load(self) -> Planes:
        """The forces on those that slip."""
        made = np.zeros(self._grid)
        made.ravel()[self.at] = self._slips * self.limit
        return made

    def hold_all(self) -> None:
        """Hold all that is observed."""
        self._slips = np.zeros_like(self._slips)

    def slip_as(self, sides: npt.NDArray[Any]) -> None:
        """Let components slip that are on one side (1) or the other (-1) of y; 0 is held."""
        self._slips = sides

    def place(self, d: Planes) -> None:
        """Move the held components to what was observed, in place."""
        here = self._slips == 0
        d.ravel()[self.at[here]] = self.y[here]
        self.place_fixed(d)

    def place_fixed(self, d: Planes) -> None:
        """Move the components that never slip to what was observed, in place."""
        d.ravel()[self._fixed_at] = self._fixed_y


class ActiveSet(States):
    """The states of observations of a model that has an energy: `limit` is p of each component.

    Parameters
    ----------
    given : ndarray, planes, optional
        Forces that pull whatever is observed.
    stored : float
        The energy of tissue that does not move.
    """

    def __init__(
        self,
        observed: HeldPlanes,
        y: Planes,
        limit: Planes,
        d: Planes,
        given: Planes | None = None,
        stored: float = 0.0,
    ) -> None:
        super().__init__(observed, y, limit, d)
        self.given, self._stored = given, stored
        self._barred = np.zeros(len(self.at), dtype=np.bool_)

    @property
    def load(self) -> Planes:
        """The forces on those that slip, and all that are given."""
        made = super().load
        return made if self.given is None else made + self.given

    def with_given(self, pull: Planes) -> Planes:
        """What tissue pulls with, and what else does but observations."""
        return pull if self.given is None else pull + self.given

    @property
    def lost(self) -> bool:
        """Whether exchanges alone have led nowhere for a while: from then on, for good."""
        return self._patience == 0

    def cost(self, d: Planes) -> float:
        """The energy of the observations, sum of p |y - d|, less the work of given forces."""
        of_observations = float((self.limit * np.abs(self.y - d.ravel()[self.at])).sum())
        return of_observations + self._stored - work_of(self.given, d)

    def exchange(
        self, d: Planes, pull: Planes, steepness: Planes, tolerance: float, free: FreeMotion
    ) -> bool:
        """Let go of what needs a greater force than it has, and hold what has passed its mark.

        Parameters
        ----------
        d : ndarray, planes
            The displacement for the present states. Where tissue would be let go of altogether, it
            slides to where something holds it again, in place.
        pull : ndarray, planes
            The force of the tissue on each component, with what is given.
        steepness : ndarray, planes
            The model's diagonal: a force over it is the motion it causes.
        tolerance : float
            Contradictions of less than this, in pixels, do not count.
        free : callable
            Finds a motion that costs tissue nothing if only so much is held, or None.

        Returns
        -------
        bool
            Whether any state has changed.
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
            let_go = np.flatnonzero(wrong & held)
            motion = free(self.held) if len(let_go) else None
            if motion is None:
                break
            if len(let_go) == 1:
                return self.slide(d, motion) or int(wrong.sum()) > 1
            # Too much at once: only of what needs most.
            wrong[let_go[np.argsort(excess[let_go])[: len(let_go) // 2]]] = False
        return count > 0

    def contradicted(
        self,
        d: Planes,
        pull: Planes,
        steepness: Planes,
        tolerance: float,
        share: float = math.inf,
    ) -> bool:
        """Whether any component contradicts its state; parameters as for `exchange`.

        So does one that needs more than its limit by this `share` of it, however stiff it is.
        """
        more = np.abs(pull.ravel()[self.at]) - self.limit
        over = (self._slips == 0) & (more > share * self.limit)
        return bool(over.any() or self._wrong(d, self._excess(pull, steepness), tolerance).any())

    @property
    def every(self) -> HeldPlanes:
        """Components that are observed."""
        made: HeldPlanes = self.fixed.copy()
        made.ravel()[self.at] = True
        return made

    def relax(
        self, d: Planes, pull_at: Callable[[Planes], Planes], steepness: Planes, free: FreeMotion
    ) -> bool:
        """Move all components, each as if alone, to where it would have less energy, in place.

        Parameters
        ----------
        d : ndarray, planes
            The displacement.
        pull_at : callable
            Gives the force of the tissue on each component for a displacement, with what is given.
        steepness : ndarray, planes
            The model's diagonal, times a bound of its spectrum over that.
        free : callable
            As for `exchange`.

        Returns
        -------
        bool
            Whether that was done: not if tissue would be let go of altogether.
        """
        steep = steepness.ravel()[self.at]
        moved, before = d.copy(), self._slips
        there = moved.ravel()
        for _ in range(_SWEEPS):
            off = there[self.at] - self.y + pull_at(moved).ravel()[self.at] / steep
            less = np.maximum(np.abs(off) - self.limit / steep, 0)
            there[self.at] = self.y + np.sign(off) * less
        self.follow(moved)
        if free(self.held) is not None:
            self._slips = before
            return False
        np.copyto(d, moved)
        return True

    def _excess(self, pull: Planes, steepness: Planes) -> npt.NDArray[Any]:
        """By how much more each component would have to be held, as the motion that causes."""
        more = np.abs(pull.ravel()[self.at]) - self.limit
        return np.asarray(more / steepness.ravel()[self.at])

    def _wrong(
        self, d: Planes, excess: npt.NDArray[Any], tolerance: float
    ) -> npt.NDArray[np.bool_]:
        """Which components contradict their state, by more than so many pixels."""
        passed = self._slips * (d.ravel()[self.at] - self.y)
        return np.asarray(np.where(self._slips == 0, excess, passed) > tolerance)

    def certain(self, pull: Planes, margin: float, noise: Planes | float = 0.0) -> HeldPlanes:
        """Return the components that are held with less than their limit.

        Less by this part of the limit, and by the uncertainty of forces.
        """
        made: HeldPlanes = self.fixed.copy()
        some = np.broadcast_to(noise, self._grid).ravel()[self.at]
        less = np.abs(pull.ravel()[self.at]) < (1 - margin) * self.limit - some
        made.ravel()[self.at] = (self._slips == 0) & less
        return made

    def correct(
        self, d: Planes, pull: Planes, tolerance: float, share: float, singly: bool
    ) -> bool:
        """Exchange what contradicts its state by so many pixels, or by this share of its limit.

        Returns whether there was any. `singly`, only the last of these: that ends for certain
        (Murty's rule).
        """
        force, held = -pull.ravel()[self.at], self._slips == 0
        passed = self._slips * (d.ravel()[self.at] - self.y)
        wrong = np.where(held, np.abs(force) > (1 + share) * self.limit, passed > tolerance)
        if singly:
            wrong[: np.flatnonzero(wrong)[-1:].sum()] = False
        self._slips = np.where(wrong, np.where(held, np.sign(force), 0.0), self._slips)
        return bool(wrong.any())

    def sides(self, d: Planes, pull: Planes) -> tuple[Planes, Planes]:
        """How far components are from what was observed, y - d, and on which side it must stay."""
        off, side = np.zeros((2, *self._grid))
        off.ravel()[self.at] = np.where(self._slips == 0, 0.0, self.y - d.ravel()[self.at])
        needed = -pull.ravel()[self.at]
        side.ravel()[self.at] = np.where(self._slips == 0, np.sign(needed), self._slips)
        return off, side

    def step(self, d: Planes, before: Planes, way: Planes, pull: Planes, change: Planes) -> bool:
        """Go only as far from `before` along `way` as the energy falls: changes d, in place.

        Returns whether that is the whole way.

        Parameters
        ----------
        d : ndarray, planes
            The end of the way.
        before, way : ndarray, planes
        pull, change : ndarray, planes
            The force of the tissue at `before`, with what is given, and how it changes on the way.
        """
        slope, bend = -float((pull * way).sum()), -float((change * way).sum())
        part = self._lowest(before, way, slope, bend)
        # What was let go of against the way stays held until there is some progress.
        slipped = self._slips != 0
        if part < 1:
            np.copyto(d, before + part * way)
            self.follow(d)
        self._barred = slipped & (self._slips == 0) if part < _NO_WAY else np.zeros_like(slipped)
        return part >= 1

    def follow(self, d: Planes) -> None:
        """Hold what is at its mark, and let the rest slip."""
        off = self.y - d.ravel()[self.at]
        self._slips = np.where(np.abs(off) <= _ON_THE_MARK, 0.0, np.sign(off))
        self.place(d)

    def slide(self, d: Planes, motion: Planes) -> bool:
        """Move tissue at no cost of its own to where observations want it most, in place.

        Something holds it there again. Were there no such place, what was let go is held as before.
        """
        for way in (motion, -motion):
            part = self._lowest(d, way, -work_of(self.given, way), 0.0)
            if 0 < part < math.inf:
                np.copyto(d, d + part * way)
                self.follow(d)
                return True
        off = self.y - d.ravel()[self.at]
        self._slips = np.where(np.abs(off) <= _ON_THE_MARK, 0.0, self._slips)
        return False

    def _lowest(self, d: Planes, way: Planes, slope: float, bend: float) -> float:
        """How many times `way` from `d` the energy is least."""
        # That of the tissue has this slope and bend; that of the observations is added here.
        off, moves = d.ravel()[self.at] - self.y, way.ravel()[self.at]
        off[self._slips == 0] = 0
        at = np.divide(-off, moves, out=np.full_like(off, -1.0), where=moves != 0)
        signs = np.where(off != 0, np.sign(off), np.sign(moves))
        slope += float((self.limit * signs * moves).sum())
        if slope >= 0:
            return 0.0
        # Where an observation passes its mark, the slope grows at once.
        for k in np.argsort(at):
            if at[k] <= 0:
                continue
            if slope + bend * at[k] >= 0:
                break
            slope += 2 * float(self.limit[k] * abs(moves[k]))
            if slope + bend * at[k] >= 0:
                return float(at[k])
        return -slope / bend if bend > 0 else math.inf
