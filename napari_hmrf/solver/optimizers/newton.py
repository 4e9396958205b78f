"""Newton's method for tissue that moves far: no field it accepts is folded anywhere.

Each step solves a linear model of the tissue as it is, with the V-cycle and conjugate gradients,
and closes the gap of what is held within the same step. How far it goes the corners tell: the
Jacobian of each is quadratic along a step, and none may lose more than three quarters of it. Where
that stops a pull the tissue relaxes before it is pulled again, and what cannot be pulled any
further stays where it got to.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.dissection import Singular
from napari_hmrf.solver.backends.factors import Factors
from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.poses import Poses
from napari_hmrf.solver.neighbours import around_sites
from napari_hmrf.solver.optimizers.base import Monitor, Report, part_done
from napari_hmrf.solver.optimizers.cycle import Cycle, Smoothing
from napari_hmrf.solver.optimizers.doubt import BELIEVABLE, Rehearsal
from napari_hmrf.solver.optimizers.krylov import ConjugateGradients, Step
from napari_hmrf.solver.optimizers.outside import Outside

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
# Of the fall of energy that a step promises; what is rounding, of energy and for each component;
# and how often a step is halved.
_ARMIJO, _ROUNDING, _OF_SITE, _HALVINGS = 1e-4, 1e-12, 1e-3, 12
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
# Tissue creeps that in so many steps loses this part of its energy only; that is as good as at rest
# this close to balance, in pixels.
_LONG, _LITTLE, _CREEPS = 30, 1e-7, 0.1
# The least part to leave out of what lets tissue buckle, but none, and how many times more next.
_LEAST, _MORE = 0.05, 2.0
# A short step, in tolerances.
_SHORT = 10.0
#: Least Jacobian of any corner of a field: far above what rounding in double precision takes.
LEAST_JACOBIAN = 1e-9


class Strategy(NamedTuple):
    """How an iteration goes about some tissue.

    Attributes
    ----------
    doubtful : bool
        Whether there may be motions that cycles hardly see: the last step must be a short one, and
        cycles are rehearsed.
    stiff : bool
        Whether parts of it are so stiff, or all of it so loose, that they must be free to turn, and
        that rounding there looks like buckling.
    by_factors : bool
        Whether cycles are not tried at all.
    steps : int
        Steps after which a run is given up.
    """

    doubtful: bool
    stiff: bool
    by_factors: bool
    steps: int = _MOST_STEPS


class Distance(NamedTuple):
    """Distance of a field from balance.

    Attributes
    ----------
    estimate : float
        Estimated largest distance of any site, in pixels; infinite if unknown.
    residual : float
        Norm of the remaining forces.
    remaining : ndarray, planes, or None
        Remaining step of each component, up to a factor.
    """

    estimate: float = math.inf
    residual: float = math.inf
    remaining: Planes | None = None

    @property
    def worst(self) -> tuple[int, ...] | None:
        """Site furthest from balance, or None if unknown."""
        if self.remaining is None:
            return None
        far = np.linalg.norm(host.field(self.remaining), axis=-1)
        return tuple(int(index) for index in np.unravel_index(int(np.argmax(far)), far.shape))


class _Linear(NamedTuple):
    """A step of the linear model: where to, how far for a unit of residual, and how far at most."""

    way: Planes
    reach: float
    far: float
    #: How much of what lets the tissue buckle was left out for it.
    positive: float = 0.0
    #: What it was found by, if not by cycles.
    factors: Factors | None = None


class Newton:
    """The iteration.

    Parameters
    ----------
    model : FiniteModel
    smoothing : Smoothing
    report : Report
    strategy : Strategy
    poses : Poses
        Those of rigid bodies, with what is held of them.
    outside : Outside or None
        What pulls besides tissue.
    """

    def __init__(
        self,
        model: FiniteModel,
        smoothing: Smoothing,
        report: Report,
        strategy: Strategy,
        poses: Poses,
        outside: Outside | None,
    ) -> None:
        self._model, self._smoothing, self._report = model, smoothing, report
        self._strategy, self._poses = strategy, poses
        #: What pulls besides tissue.
        self.outside = outside
        self._tolerance = math.inf
        #: Distance of the field from balance.
        self.distance = Distance()
        #: The energy after each step.
        self.energies: list[float] = []
        self.cycles = 0
        self.by_factors = strategy.by_factors
        self._first = 0.0
        # After how many steps it was pulled last.
        self._pulled = 0
        # Whether all that is held can be met, as far as is known.
        self._met = True
        # How much of what lets the tissue buckle was left out last, or a little less; and whether
        # cycles have met a direction in which it does.
        self._positive = 0.0
        self._buckles = False

    def run(self, d: Planes, y: Planes, held: HeldPlanes, tolerance: float) -> None:
        """Move `d`, which is not folded, to balance, with what is held as near `y` as may be.

        Parameters
        ----------
        d, y : ndarray, planes
        held : ndarray of bool, planes
        tolerance : float
            In pixels.

        Raises
        ------
        ConvergenceError
            If the field is far from balance though nothing is in its way, or if its distance from
            balance is unknown.
        """
        self._tolerance, self._met = tolerance, True
        y = np.where(held, y, d)
        relaxations, stuck, patience, near = 0, 0, _PATIENCE, _RELAXED
        self._first, self._pulled = float(np.abs(y - d).max()), len(self.energies)
        for number in range(self._strategy.steps):
            if number == _MOST_PULLS and (held & (y != d)).any():
                np.copyto(y, d)
                self._met = False
            gap = np.where(held, y - d, 0.0)
            left = float(np.abs(gap).max())
            pulls = left > 0 and relaxations == 0
            aim = self._poses.aim(d, y)
            if aim is not y:
                gap = np.where(held, aim - d, 0.0)
            self._say(number, left)
            before, known = d.copy(), self.distance
            step = self._step(d, gap if pulls else None, held)
            if step is None:
                # Crushed so far that nothing solves it any more, it is as far as it goes.
                self._met = self._met and (left == 0 or math.isinf(self.distance.estimate))
                break
            if pulls:
                taken, self._pulled = self._pull(d, step.way, aim, held), len(self.energies) + 1
                if taken < 1.0:
                    stays = taken < _STUCK and taken * left < _STUCK_PIXELS
                    stuck = stuck + 1 if stays and near == _AT_EASE else 0
                    near = _AT_EASE if stays else _RELAXED
                    relaxations = _MORE_RELAXATIONS if stays else _RELAXATIONS
                    if stuck == patience:
                        stuck, patience = 0, 1
                        self._let_be(d, y, held, step.way)
            else:
                step, taken = self._relax(d, held, step)
                relaxations = max(relaxations - 1, 0)
            if not self._judge(d, step):
                # The last field that is one stands; a pull ends there.
                np.copyto(d, before)
                self.distance = known
                self._met = self._met and left == 0
                break
            if taken == 1.0 and min(self.distance.estimate, step.far) <= near and not pulls:
                relaxations = 0
            arrived = taken == 1.0 and ((pulls and aim is y) or left == 0)
            if arrived and self._is_balanced(d, held, step):
                return
            if left == 0 and (taken == 0.0 or self._creeps(step.far)):
                far = max(self.distance.estimate, step.far)
                self.distance = self.distance._replace(estimate=far)
                break
        # Crushed, tissue creeps: it is as far as it goes.
        estimate = self.distance.estimate
        if not math.isfinite(estimate) or (self._met and estimate > _CREEPS):
            self._give_up()

    def _give_up(self) -> None:
        if not math.isfinite(self.distance.estimate):
            raise ConvergenceError(
                "cycles cannot be sure of this tissue. Crop the image, or bring the softest and "
                "the stiffest tissue closer together"
            )
        raise ConvergenceError(
            f"the tissue is still {self.distance.estimate:.2g} px from balance after "
            f"{len(self.energies)} steps of large motion. Move, press or grow it less, or bring "
            "the softest and the stiffest tissue closer together"
        )

    def _judge(self, d: Planes, step: _Linear) -> bool:
        """Measure the distance from balance after a step; return whether the field is one.

        A field is none if a corner folds, or if its energy or its distance is not a number.
        """
        energy, least = self._energy(d)
        if not (math.isfinite(energy) and least >= LEAST_JACOBIAN):
            return False
        rest = np.where(self._model.moves, self.forces(d), 0.0)
        self._model.project(rest)
        residual = norm(rest)
        estimate, remaining = step.reach * residual, rest * self._model.levels[0].inverse
        if step.factors is not None:
            # A solve by known factors costs next to nothing.
            left = step.factors.solve(rest)
            self._model.project(left)
            far = float(np.abs(left).max())
            if math.isfinite(far):
                estimate, remaining = far, left
        if not math.isfinite(estimate):
            return False
        self.distance = Distance(estimate, residual, remaining)
        self.energies.append(energy)
        return True

    def _is_balanced(self, d: Planes, held: HeldPlanes, step: _Linear) -> bool:
        """Whether tissue is as near to balance as it is asked to be, as far as can be told."""
        if self.distance.estimate > self._tolerance:
            return False
        if not self._strategy.doubtful:
            return True
        # What does not let tissue buckle does not let stiff parts of it turn.
        if self._strategy.stiff and step.positive > 0:
            return False
        if step.factors is not None:
            return True
        if step.far > _SHORT * self._tolerance:
            return False
        # Such tissue was rehearsed as it was pulled before, or is now.
        model, known = self._model, self._model.rehearsed
        if known is None or not np.array_equal(known[0], held):
            model.linearise(d, held, self.forces(d), 1.0, model.springs)
            error = np.where(model.moves, host.noise(d.shape), 0.0)
            model.project(error)
            iteration = ConjugateGradients(Cycle(model, self._smoothing))
            doubt = Rehearsal().run(
                iteration, error, lambda d: model.balance(-model.image(d)), self._report
            )
            known = model.rehearsed = held.copy(), doubt
        if known[1] <= BELIEVABLE:
            return True
        self.by_factors = Factors.fit(model.shape)
        return not self.by_factors

    def _step(
        self, d: Planes, gap: Planes | None, held: HeldPlanes, positive: float = 0.0
    ) -> _Linear | None:
        """Where the linear model would go from here, all of the gap closed; None if unknown."""
        forces = self.forces(d)
        springs = None if self.outside is None else self.outside.springs(d)
        if gap is not None:
            gap = self._poses.extend(gap)
        for stiff in _shares(positive or self._positive):
            self._model.linearise(d, held, forces, stiff, springs)
            rest = -forces
            if gap is not None:
                rest -= self._model.image(gap)
            found = None if self.by_factors else self._iterate(rest)
            # What looks like buckling may be the rounding of a large contrast.
            sure = stiff == 1 or not self._buckles or self._strategy.stiff
            if found is None and sure and Factors.fit(self._model.shape):
                found = self._solve(rest)
            if found is not None:
                self._positive = stiff / _MORE if stiff > _LEAST else 0.0
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

        moves = self._model.moves
        load = np.where(moves, load, 0.0)
        self._model.project(load)
        try:
            factors = Factors(self._model.tangents, moves, tell, self._model.springs)
            way = factors.solve(load)
        except Singular:
            return None
        self._model.project(way)
        if not np.isfinite(way).all() or float((way * load).sum()) < 0:
            return None
        self.by_factors = True
        far, most = float(np.abs(way).max()), norm(load)
        return _Linear(way, far / most if most > 0 else 0.0, far, factors=factors)

    def _creeps(self, far: float) -> bool:
        """Whether short steps have led on for long, and to hardly less energy."""
        late = self.energies[self._pulled :][-_LONG:]
        short = len(late) == _LONG and far <= _CREEPS
        return short and late[0] - late[-1] <= _LITTLE * abs(late[-1])

    def _energy(self, d: Planes) -> tuple[float, float]:
        """All energy there is, and the least Jacobian of any corner."""
        energy, least = self._model.energy(d)
        return energy if self.outside is None else energy + self.outside.energy(d), least

    def forces(self, d: Planes) -> Planes:
        """The derivative of all energy there is; valid until the next call."""
        forces = self._model.forces(d)
        return forces if self.outside is None else forces + self.outside.forces(d)

    def _pull(self, d: Planes, way: Planes, y: Planes, held: HeldPlanes) -> float:
        """Move along a step, in place, until a corner nearly folds; return the part moved."""
        length, _ = self._model.length(d, way, _KEPT, _FLOOR)
        taken, start = 1.0 if length >= 1 else _SHARE * length, d.copy()
        for _ in range(_HALVINGS):
            np.copyto(d, start + taken * way)
            if taken == 1.0:
                np.copyto(d, y, where=held)
            # Rigid bodies turn although the step is straight.
            self._poses.settle(d)
            energy, least = self._model.energy(d)
            if math.isfinite(energy) and least >= LEAST_JACOBIAN:
                return taken
            taken /= 2
        np.copyto(d, start)
        return 0.0

    def _relax(self, d: Planes, held: HeldPlanes, step: _Linear) -> tuple[_Linear, float]:
        """Go downwards by a step or, if that leads nowhere, by one without what buckles."""
        taken = self._descend(d, step.way)
        if taken < _HARDLY and step.positive < 1:
            again = self._step(d, None, held, positive=1.0)
            if again is not None:
                return again, max(taken, self._descend(d, again.way))
        return step, taken

    def _descend(self, d: Planes, way: Planes) -> float:
        """Go along a way as far as the energy falls, in place; which part of it that was."""
        before = d.copy()
        taken = self._fall(d, way)
        if self.outside is not None and taken > 0:
            self.outside.follow(before, d)
        return taken

    def _fall(self, d: Planes, way: Planes) -> float:
        """Go along a way as far as the energy falls, in place; which part of it that was."""
        before, _ = self._energy(d)
        slope = float((self.forces(d) * way).sum())
        length, _ = self._model.length(d, way, _KEPT, LEAST_JACOBIAN)
        taken, start = min(1.0, length), d.copy()
        for _ in range(_HALVINGS):
            d += taken * way
            self._poses.settle(d)
            energy, least = self._energy(d)
            promise = _ARMIJO * taken * slope + _ROUNDING * (abs(before) + _OF_SITE * d.size)
            if least >= LEAST_JACOBIAN and energy <= before + promise:
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
        for body in self._model.bodies:
            stops[body] |= stops[body].any()
        stay = np.zeros_like(held)
        stay[:, 2:-2, 2:-2] = stops
        np.copyto(y, d, where=stay)

    def _say(self, number: int, left: float) -> None:
        done = part_done(max(self._first, 1e-3), max(left, 1e-3), 1e-3) if self._first else 1.0
        what = f"{left:.2g} px to pull" if left else "relaxing"
        self._report(Monitor(f"step {number + 1}, {what}", done))


def _shares(first: float) -> Iterator[float]:
    """How much to leave out of what lets tissue buckle, until it does not."""
    share = first
    while share < 1:
        yield share
        share = max(_MORE * share, _LEAST)
    yield 1.0


def norm(values: Planes) -> float:
    """The norm; without the threads of a larger product, which would go on to wait for more."""
    return math.sqrt(float(np.square(values).sum()))
