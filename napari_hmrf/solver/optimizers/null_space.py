"""Null space of a model: motions at no cost, or almost none, computed from its factors."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ConvergenceError, ProblemError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.direct.dissection import HELD, Singular
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.optimizers.base import Report
from napari_hmrf.solver.optimizers.refinement import HELD_BY_NOTHING, Refinement, factorise
from napari_hmrf.solver.rigid_modes import FreeMotion, refusal

Float64Array = npt.NDArray[np.float64]

# Springs that make the model invertible, as a part of its diagonal; relative cost below which a
# motion is soft; and relative cost below which it is free.
_SPRINGS, _LITTLE, _NOTHING = 1e-13, 1e-11, 1e-28
_ITERATIONS = 4
_FIRST, _MOST = 8, 64
_EXACT, _FLOOR = 1e-12, 1e-14
_BALANCINGS = 4
# Largest distance of a motion from balance, in pixels where tissue moves by one; and the part of
# a load that may remain in a free motion.
_ASTRAY, _BALANCED = 1e-6, 1e-9
_MIXINGS = 2
# Least eigenvalue, where the diagonal is 1, that factors resolve; number of inverse iterations that
# estimate it; and factor on it, for each root of an unknown, above which one iteration is enough.
_RESOLVED, _ESTIMATES, _CLEAR = 1e-15, 3, 1e3
# Largest number of soft motions that a refusal analyses: more take seconds to separate.
_EXPLAINED = 16
# Part of the largest displacement above which a site belongs to a motion.
_TAKES_PART = 0.1


class Play(NamedTuple):
    """Soft motions of tissue, and components that stop them if held.

    Attributes
    ----------
    pins : ndarray of bool, planes
        Components that stop all of these motions if they are held.
    ways : ndarray, shape (ways, planes)
        The motions that cost something.
    cost : ndarray, shape (ways, ways)
        Their second derivatives of the energy.
    free : list of ndarray, each of shape (ways, H, W, 2)
        The motions that cost nothing: one item, if there are any.
    """

    pins: HeldPlanes
    ways: Float64Array
    cost: Float64Array
    free: list[Float64Array]

    def balance(
        self, model: LinearModel, refinement: Refinement, d: Planes, load: Planes, tolerance: float
    ) -> None:
        """Move `d` in place to where tissue and load balance, including pins that cost something.

        The lengths come from energies, which unlike forces are sums of squares and stay accurate.

        Raises
        ------
        ConvergenceError
            If double precision is too coarse for that.
        """
        refinement.run(d, load, tolerance)
        size = np.sqrt(np.diagonal(self.cost).clip(1e-300))
        inverse = np.linalg.pinv(self.cost / np.outer(size, size), _FLOOR, True)
        far = np.inf
        for _ in range(_BALANCINGS):
            left = [(load * way).sum() - _product(model, d, way) for way in self.ways]
            go = np.tensordot(inverse @ (np.array(left) / size) / size, self.ways, 1)
            far = float(np.abs(go).max(initial=0.0))
            if far <= tolerance:
                return
            d += go
            refinement.run(d, load, tolerance)
        if far > _ASTRAY * max(1.0, float(np.abs(d).max())):
            raise ConvergenceError("soft motions of the tissue do not reach balance")

    def adrift(self, load: Planes) -> Planes | None:
        """Return a free motion on which a load does work, or None."""
        for ways in self.free:
            for way in ways:
                motion = host.planes(way)
                work = load * motion
                if abs(work.sum()) > _BALANCED * np.abs(work).sum():
                    return motion
        return None


def resolves(model: LinearModel) -> bool:
    """Return whether a model's factors can tell its softest motion from a free one.

    Pivots alone cannot: where stiff tissue hangs on soft tissue its last pivot is small, and the
    rounding of that pivot passes for resistance in the pivots that follow.
    """
    factors, moves = model.found.factors, model.moves
    weights = np.sqrt(model.steepness[moves])
    if factors is None or not len(weights):
        return True
    load: Planes = np.zeros(moves.shape)
    motion = np.random.default_rng(0).standard_normal(len(weights))
    least = np.inf
    for _ in range(_ESTIMATES):
        load[moves] = motion / np.linalg.norm(motion) * weights
        motion = factors.solve(load)[moves] * weights
        least = 1 / float(np.linalg.norm(motion))
        if least > _CLEAR * np.sqrt(len(weights)) * _RESOLVED:
            break
    return bool(least > _RESOLVED)


def refuse_free(
    model: LinearModel, held: HeldPlanes, refinement: Refinement, report: Report
) -> None:
    """Refuse tissue that moves at no cost although the model has factors.

    Raises
    ------
    ProblemError
        Naming the tissue.
    """
    free = find_play(model, held, refinement, report).free
    if free:
        raise refusal(_as_free_motion(free[0][0]))


def why_unsolvable(
    model: LinearModel, held: HeldPlanes, refinement: Refinement, report: Report
) -> ProblemError | ConvergenceError:
    """Return the error that explains why a system without factors has no solution.

    Either some tissue can move at no cost, or at so little that the solution depends on digits
    beyond double precision.

    Parameters
    ----------
    model : LinearModel
    held : ndarray of bool, planes
        Observed components.
    refinement : Refinement
    report : callable
    """
    steep = model.steepness
    moves = (steep > 0) & ~held
    weights = np.sqrt(steep[moves])
    try:
        soft = _soft(model, moves, weights)
        if 0 < soft.shape[1] <= _EXPLAINED:
            play = find_play(model, held, refinement, report)
            if play.free:
                return refusal(_as_free_motion(play.free[0][0]))
    except ConvergenceError as error:
        return error
    if not soft.shape[1]:
        return ConvergenceError(HELD_BY_NOTHING)
    d: Planes = np.zeros(moves.shape)
    d[moves] = soft[:, 0] / weights
    cost = 2 * model.work(d)[0] / float((steep * d**2).sum())
    motion = _as_free_motion(host.field(d))
    if cost < _NOTHING:
        return refusal(motion)
    return ConvergenceError(
        f"the tissue around {motion.centre} is barely held: it can move at {cost:.0e} of what its "
        f"sites cost one by one, and double precision resolves no less than {HELD:.0e}. "
        "Hold more of it, or bring the softest and the stiffest tissue closer together"
    )


def _as_free_motion(motion: Float64Array) -> FreeMotion:
    """Return a motion (H, W, 2) as a `FreeMotion`, with the tissue that takes part in it."""
    sizes = np.abs(motion)
    axis = int(np.argmax(sizes.max(axis=tuple(range(motion.ndim - 1)))))
    piece = sizes[..., axis] > _TAKES_PART * sizes[..., axis].max()
    names = ("along planes", "along rows", "along columns")[-motion.shape[-1] :]
    return FreeMotion(piece, f"could still bend {names[axis]} at no cost", motion)


def find_play(model: LinearModel, held: HeldPlanes, refinement: Refinement, report: Report) -> Play:
    """Find the soft motions of tissue that is held at some components only.

    Inverse iteration with the model on weak springs, for a few random motions at once.
    """
    steep = model.steepness
    moves = (steep > 0) & ~held
    pins, weights = np.zeros_like(held), np.sqrt(steep[moves])
    some = _soft(model, moves, weights)
    count, every = some.shape[1], tuple(range(1, 1 + held.ndim))
    if not count:
        return Play(pins, np.zeros((0, *held.shape)), np.zeros((0, 0)), [])
    *_, order = scipy.linalg.qr(some.T, mode="economic", pivoting=True)
    at = np.flatnonzero(moves)[order[:count]]
    pins.ravel()[at] = True
    model.hold(held | pins)
    factorise(model, report)
    ways = np.zeros((count, *held.shape))
    for way, pin in zip(ways, at, strict=True):
        way.ravel()[pin] = 1.0
        refinement.run(way, None, _EXACT)
    for _ in range(_MIXINGS):
        # Products lose small costs beside those of other motions, until the motions are separated.
        ways /= np.sqrt((steep * ways**2).sum(axis=every, keepdims=True))
        cost = _costs(model, ways)
        _, mixes = np.linalg.eigh(cost)
        ways = np.tensordot(mixes.T, ways, 1)
    cost = _costs(model, ways)
    nothing = np.diagonal(cost) < _NOTHING * (steep * ways**2).sum(axis=every)
    free, ways, cost = ways[nothing], ways[~nothing], cost[~nothing][:, ~nothing]
    free /= np.abs(free).max(axis=every, keepdims=True)
    motions = [np.stack([host.field(way) for way in free])] if len(free) else []
    return Play(pins, ways, cost, motions)


def _costs(model: LinearModel, ways: Float64Array) -> Float64Array:
    """Return the inner products of all pairs of motions in the energy, a symmetric matrix.

    They come from energies, which are sums of squares: those of stiff tissue do not cancel there.
    """
    energies = np.array([model.work(way)[0] for way in ways])
    costs = np.diag(2 * energies)
    for one, two in itertools.combinations(range(len(ways)), 2):
        both, _ = model.work(ways[one] + ways[two])
        costs[one, two] = costs[two, one] = both - energies[one] - energies[two]
    return costs


def _product(model: LinearModel, one: Planes, two: Planes) -> float:
    """Return the inner product of two motions in the energy (an energy is half a square)."""
    return (model.work(one + two)[0] - model.work(one - two)[0]) / 2


def _soft(model: LinearModel, moves: HeldPlanes, weights: Float64Array) -> Float64Array:
    """Return the soft motions, scaled by roots of the diagonal: (components, motions)."""
    if not len(weights):
        return np.zeros((0, 0))
    springs = np.where(moves, _SPRINGS * model.steepness, 0.0)
    try:
        factors = Factors(model.material, moves, lambda part: None, springs)
    except Singular:
        raise ConvergenceError(
            "double precision cannot resolve how tissue moves at no cost. Hold more of it, "
            "or bring the softest and the stiffest tissue closer together"
        ) from None
    random, count = np.random.default_rng(0), _FIRST
    while True:
        some = random.standard_normal((len(weights), min(count, len(weights))))
        for _ in range(_ITERATIONS):
            some, _ = np.linalg.qr(_inverse(factors, moves, weights, some))
        images = np.stack([_image(model, moves, weights, way) for way in some.T], axis=1)
        costs, mixes = scipy.linalg.eigh(some.T @ images)
        soft = costs < _LITTLE
        if not soft.all() or count >= min(_MOST, len(weights)):
            return np.asarray(some @ mixes[:, soft])
        count *= 2


def _inverse(
    factors: Factors, moves: HeldPlanes, weights: Float64Array, some: Float64Array
) -> Float64Array:
    """Apply the inverse, scaled by the roots of the diagonal, to each column."""
    made = np.empty_like(some)
    for number, column in enumerate(some.T):
        load: Planes = np.zeros(moves.shape)
        load[moves] = column * weights
        made[:, number] = factors.solve(load)[moves] * weights
    return made


def _image(
    model: LinearModel, moves: HeldPlanes, weights: Float64Array, way: Float64Array
) -> Float64Array:
    """Apply the scaled model to a motion."""
    d: Planes = np.zeros(moves.shape)
    d[moves] = way / weights
    return np.asarray(-model.pull(d)[moves] / weights)
