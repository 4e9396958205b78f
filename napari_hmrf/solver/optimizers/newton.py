"""Newton's method for tissue that moves far: no field it accepts is folded anywhere.

Each step solves a linear model of the tissue as it is, with the V-cycle and conjugate gradients,
and closes the gap of what is held within the same step. How far it goes the corners tell: the
Jacobian of each is quadratic along a step, and none may lose more than three quarters of it. Where
that stops a pull the tissue relaxes before it is pulled again, and what cannot be pulled any
further stays where it got to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends.dissection import Singular
from napari_hmrf.solver.backends.factors import Factors
from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.neighbours import around_sites
from napari_hmrf.solver.optimizers.base import Monitor, Report, part_done
from napari_hmrf.solver.optimizers.cycle import Cycle, Smoothing
from napari_hmrf.solver.optimizers.krylov import ConjugateGradients, Step

# What every corner keeps of its Jacobian in a step; of a pull that this cuts short, the part that
# is gone; and the Jacobian below which nothing is pulled any further.
_KEPT, _SHARE, _FLOOR = 0.25, 0.85, 1e-5
# What is left of a linear system's error, as a part of it and of the tolerance, or of its residual,
# which is as far as single precision goes.
_INNER, _OF_TOLERANCE, _ROUNDED = 0.03, 0.3, 2e-5
# Cycles after which a system is factorised, of so few sites, and of more: there that takes longer.
_CYCLES, _FEW, _MORE_CYCLES = 40, 20_000, 200
# A step that gets hardly further than this part of its way is tried without what buckles.
_HARDLY = 0.1
# Of the fall of energy that a step promises; what is rounding; and how often a step is halved.
_ARMIJO, _ROUNDING, _HALVINGS = 1e-4, 1e-12, 12
# Tissue is relaxed when it is this close to balance, in pixels, or after so many steps; and before
# it is said that it cannot be pulled.
_RELAXED, _RELAXATIONS = 0.3, 6
_AT_EASE, _MORE_RELAXATIONS = 0.02, 25
# A pull is stuck that goes less than this part of its way and so little, in pixels, so often in a
# row; then what stands in its way is what would stop this much more.
_STUCK, _STUCK_PIXELS, _PATIENCE, _IN_THE_WAY = 0.05, 0.1, 2, 0.3
# How much the ways of what is pulled as one piece may differ, as a part of them.
_AS_ONE = 0.2
# Steps after which nothing is pulled any more, and after which it is given up.
_MOST_PULLS, _MOST_STEPS = 150, 400


class _Linear(NamedTuple):
    """A step of the linear model: where to, how far for a unit of residual, and how far at most."""

    way: Planes
    reach: float
    far: float
    #: Whether directions in which the tissue buckles were made stiff for it.
    positive: bool = False


class Newton:
    """The iteration.

    Parameters
    ----------
    model : FiniteModel
    smoothing : Smoothing
    report : Report
    tolerance : float
        In pixels.
    """

    def __init__(
        self, model: FiniteModel, smoothing: Smoothing, report: Report, tolerance: float
    ) -> None:
        self._model, self._smoothing, self._report = model, smoothing, report
        self._tolerance = tolerance
        #: How far any site is from balance, in pixels, as estimated.
        self.estimate = math.inf
        #: The norm of the forces that are left.
        self.residual = math.inf
        #: The energy after each step.
        self.energies: list[float] = []
        self.cycles = 0
        self.by_factors = False
        self._first = 0.0
        # Whether all that is held can be met, as far as is known.
        self._met = True
        # Whether cycles have met a direction in which the tissue buckles.
        self._buckles = False

    def run(self, d: Planes, y: Planes, held: HeldPlanes) -> None:
        """Move `d`, which is not folded, to balance, with what is held as near `y` as may be.

        Raises
        ------
        ConvergenceError
        """
        y = np.where(held, y, d)
        relaxations, stuck, patience, near = 0, 0, _PATIENCE, _RELAXED
        self._first = float(np.abs(y - d).max())
        for number in range(_MOST_STEPS):
            if number == _MOST_PULLS and (held & (y != d)).any():
                np.copyto(y, d)
                self._met = False
            gap = np.where(held, y - d, 0.0)
            left = float(np.abs(gap).max())
            pulls = left > 0 and relaxations == 0
            self._say(number, left)
            step = self._step(d, gap if pulls else None, held)
            if step is None:
                # Crushed so far that nothing solves it any more, it is as far as it goes.
                self._met = self._met and (left == 0 or math.isinf(self.estimate))
                break
            if pulls:
                length, _ = self._model.length(d, step.way, _KEPT, _FLOOR)
                taken = 1.0 if length >= 1 else _SHARE * length
                d += taken * step.way
                if taken == 1.0:
                    np.copyto(d, y, where=held)
                else:
                    stays = taken < _STUCK and taken * left < _STUCK_PIXELS
                    stuck = stuck + 1 if stays and near == _AT_EASE else 0
                    near = _AT_EASE if stays else _RELAXED
                    relaxations = _MORE_RELAXATIONS if stays else _RELAXATIONS
                    if stuck == patience:
                        stuck, patience = 0, 1
                        self._let_be(d, y, held, step.way)
            else:
                taken = self._descend(d, step.way)
                if taken < _HARDLY and not step.positive:
                    again = self._step(d, None, held, positive=True)
                    if again is not None:
                        step, taken = again, max(taken, self._descend(d, again.way))
                relaxations = max(relaxations - 1, 0)
            rest = np.where(self._model.moves, self._model.forces(d), 0.0)
            self.residual = norm(rest)
            self.estimate = step.reach * self.residual
            self.energies.append(self._model.energy(d)[0])
            if taken == 1.0 and min(self.estimate, step.far) <= near and not pulls:
                relaxations = 0
            if taken == 1.0 and (pulls or left == 0) and self.estimate <= self._tolerance:
                return
            if taken == 0.0 and left == 0:
                break
        # Crushed by what cannot be met, tissue creeps: it is as far as it goes.
        if self._met and math.isinf(self.estimate):
            raise ConvergenceError(
                "cycles cannot be sure of this tissue. Crop the image, or bring the softest and "
                "the stiffest tissue closer together"
            )
        if self._met and not self.estimate <= self._tolerance:
            raise ConvergenceError(
                f"the tissue is still {self.estimate:.2g} px from balance after "
                f"{len(self.energies)} steps of large motion. Pull it less far at a time, or bring "
                "the softest and the stiffest tissue closer together"
            )

    def _step(
        self, d: Planes, gap: Planes | None, held: HeldPlanes, positive: bool = False
    ) -> _Linear | None:
        """Where the linear model would go from here, all of the gap closed; None if unknown."""
        for stiff in (True,) if positive else (False, True):
            self._model.linearise(d, held, stiff)
            rest = -self._model.forces(d)
            if gap is not None:
                rest -= self._model.image(gap)
            found = None if self.by_factors else self._iterate(rest)
            if found is None and (stiff or not self._buckles) and Factors.fit(self._model.shape):
                found = self._solve(rest)
            if found is not None:
                way = found.way if gap is None else found.way + gap
                return found._replace(way=way, positive=stiff)
        return None

    def _iterate(self, load: Planes) -> _Linear | None:
        """A correction for a load by cycles; None if they did not get there."""
        self._buckles = False
        balance, way = self._model.balance(load), np.zeros_like(load)
        if balance.most == 0:
            return _Linear(way, 0.0, 0.0)
        latest: Step | None = None
        first, count, done = 0.0, 0, False
        patience = _CYCLES if math.prod(self._model.shape) <= _FEW else _MORE_CYCLES

        def enough(step: Step) -> bool:
            nonlocal latest, first, count, done
            latest, count = step, count + 1
            error = step.error * balance.unit
            first = first or error
            self.cycles += 1
            self._report(Monitor(f"cycle {self.cycles}, {error:.2g} px to go", 0.0))
            done = error <= max(_INNER * first, _OF_TOLERANCE * self._tolerance)
            return done or count >= patience

        try:
            iteration = ConjugateGradients(Cycle(self._model, self._smoothing))
            iteration.run(balance, way, enough)
        except FloatingPointError:
            self._model.clear()
            return None
        # Else it has met a direction in which the tissue buckles, or that it does not get out of.
        if latest is not None and latest.rest * balance.unit <= _ROUNDED * balance.norm:
            done = True
        self._buckles = not done and count < patience
        if latest is None or not done:
            return None
        return _Linear(way, latest.reach, float(np.abs(way).max()))

    def _solve(self, load: Planes) -> _Linear | None:
        """The same by factors; None if what is solved is not positive."""

        def tell(part: float) -> None:
            self._report(Monitor(f"factorising, {part:.0%}", part))

        load = np.where(self._model.moves, load, 0.0)
        try:
            way = Factors(self._model.tangents, self._model.moves, tell).solve(load)
        except Singular:
            return None
        if not np.isfinite(way).all() or float((way * load).sum()) < 0:
            return None
        self.by_factors = True
        far, most = float(np.abs(way).max()), norm(load)
        return _Linear(way, far / most if most > 0 else 0.0, far)

    def _descend(self, d: Planes, way: Planes) -> float:
        """Go along a way as far as the energy falls, in place; which part of it that was."""
        before, _ = self._model.energy(d)
        slope = float((self._model.forces(d) * way).sum())
        length, _ = self._model.length(d, way, _KEPT, 0.0)
        taken, start = min(1.0, length), d.copy()
        for _ in range(_HALVINGS):
            d += taken * way
            energy, least = self._model.energy(d)
            promise = _ARMIJO * taken * slope + _ROUNDING * abs(before)
            if least > 0 and energy <= before + promise:
                return taken
            np.copyto(d, start)
            taken /= 2
        return 0.0

    def _let_be(self, d: Planes, y: Planes, held: HeldPlanes, way: Planes) -> None:
        """Leave what is held where it is if it stands in the way of the rest."""
        self._met = False
        _, lengths = self._model.length(d, way, _KEPT, _FLOOR, each=True)
        sites = around_sites(lengths < _IN_THE_WAY, np.logical_or)
        pulled = (held & (y != d)).any(axis=0)[2:-2, 2:-2]
        stops = sites & pulled
        if not stops.any():
            # Free tissue is in the way of all: what is left of it cannot be met.
            np.copyto(y, d)
            return
        # What is pulled as one piece stops as one, or it would be crushed in itself.
        pieces, _ = scipy.ndimage.label(pulled, structure=np.ones((3, 3)))
        gap = (y - d)[:, 2:-2, 2:-2]
        for number in np.unique(pieces[stops]):
            piece = pieces == number
            ways = gap[:, piece]
            mean = ways.mean(axis=1, keepdims=True)
            if norm(ways - mean) <= _AS_ONE * norm(ways):
                stops |= piece
        stay = np.zeros_like(held)
        stay[:, 2:-2, 2:-2] = stops
        np.copyto(y, d, where=stay)

    def _say(self, number: int, left: float) -> None:
        done = part_done(max(self._first, 1e-3), max(left, 1e-3), 1e-3) if self._first else 1.0
        what = f"{left:.2g} px to pull" if left else "relaxing"
        self._report(Monitor(f"step {number + 1}, {what}", done))


def norm(values: Planes) -> float:
    """The norm; without the threads of a larger product, which would go on to wait for more."""
    return math.sqrt(float(np.square(values).sum()))
