"""Null space of a model: motions with zero or almost zero energy, computed by factorization."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.optimizers.base import Report
from napari_hmrf.solver.optimizers.refinement import Refinement, factorise
from napari_hmrf.solver.rigid_modes import FreeMotion, refusal

Float64Array = npt.NDArray[np.float64]

# Stiffness of the springs that make the model invertible, as a fraction of its diagonal.
_SPRINGS = 1e-13
# Energy below which a motion is soft, relative to the energy of moving its sites one by one.
_SOFT = 1e-11
# Energy below which a motion is free, relative to the energy of moving its sites one by one.
_FREE = 1e-28
# Number of inverse iterations that compute the soft motions.
_ITERATIONS = 4
# Initial number of random motions in the inverse iteration.
_FIRST_MOTIONS = 8
# Largest number of motions in the inverse iteration.
_MOST_MOTIONS = 64
# Largest error of a soft motion with a prescribed displacement of 1 pixel, in pixels.
_EXACT = 1e-12
# Number of passes to separate the soft motions.
_SEPARATIONS = 2
# Smallest eigenvalue of the scaled model (unit diagonal) that a factorization resolves.
_RESOLVED = 1e-15
# Number of inverse iterations that estimate the smallest eigenvalue.
_ESTIMATES = 3
# Factor on `_RESOLVED` times the square root of the number of unknowns. No further iteration is
# needed once the estimate exceeds this product.
_CLEAR = 1e3
# Fraction of the largest displacement above which a site is part of a motion.
_PARTICIPATION = 0.1


def resolves(model: LinearModel) -> bool:
    """Return whether the factorization of a model proves that its solution is unique.

    The pivots alone do not prove this. If stiff tissue is attached to soft tissue only, the last
    pivot of the stiff tissue is small, and its rounding error looks like stiffness in later pivots.
    """
    factors, moves = model.earlier.factors, model.moves
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
    """Raise an error if the tissue has a free motion although all observations hold it.

    Raises
    ------
    ProblemError
        If there is a free motion; the message describes the tissue and its motion.
    """
    free = find_free_motions(model, held, refinement, report)
    if free:
        raise refusal(_as_free_motion(free[0][0]))


def _as_free_motion(motion: Float64Array) -> FreeMotion:
    """Return a motion, shape (H, W, 2), as a `FreeMotion` with a mask of its moving tissue."""
    sizes = np.abs(motion)
    axis = int(np.argmax(sizes.max(axis=tuple(range(motion.ndim - 1)))))
    piece = sizes[..., axis] > _PARTICIPATION * sizes[..., axis].max()
    names = ("plane", "row", "column")[-motion.shape[-1] :]
    return FreeMotion(
        piece, f"could still bend along the {names[axis]} axis without resistance", motion
    )


def find_free_motions(
    model: LinearModel, held: HeldPlanes, refinement: Refinement, report: Report
) -> list[Float64Array]:
    """Return all free motions of tissue with the constrained components `held`.

    The method is inverse iteration of a block of random motions. Weak springs make the model
    invertible. The result is one array of shape (n, H, W, 2), or an empty list.
    """
    steep = model.steepness
    moves = (steep > 0) & ~held
    pins, weights = np.zeros_like(held), np.sqrt(steep[moves])
    soft = _soft(model, moves, weights)
    count, planes = soft.shape[1], tuple(range(1, 1 + held.ndim))
    if not count:
        return []
    *_, order = scipy.linalg.qr(soft.T, mode="economic", pivoting=True)
    at = np.flatnonzero(moves)[order[:count]]
    pins.ravel()[at] = True
    model.hold(held | pins)
    factorise(model, report)
    ways = np.zeros((count, *held.shape))
    for way, pin in zip(ways, at, strict=True):
        way.ravel()[pin] = 1.0
        refinement.run(way, None, _EXACT)
    for _ in range(_SEPARATIONS):
        # Rounding errors of large energies hide small energies until the motions are separated.
        ways /= np.sqrt((steep * ways**2).sum(axis=planes, keepdims=True))
        _, modes = np.linalg.eigh(_costs(model, ways))
        ways = np.tensordot(modes.T, ways, 1)
    energies = 2 * np.array([model.work(way)[0] for way in ways])
    free = ways[energies < _FREE * (steep * ways**2).sum(axis=planes)]
    free /= np.abs(free).max(axis=planes, keepdims=True)
    return [np.stack([host.field(way) for way in free])] if len(free) else []


def _costs(model: LinearModel, ways: Float64Array) -> Float64Array:
    """Return the matrix of the energy inner products of all pairs of motions.

    Energies are sums of squares, so the large contributions of stiff tissue do not cancel.
    """
    energies = np.array([model.work(way)[0] for way in ways])
    costs = np.diag(2 * energies)
    for one, two in itertools.combinations(range(len(ways)), 2):
        both, _ = model.work(ways[one] + ways[two])
        costs[one, two] = costs[two, one] = both - energies[one] - energies[two]
    return costs


def _soft(model: LinearModel, moves: HeldPlanes, weights: Float64Array) -> Float64Array:
    """Return the soft motions, times the square root of the diagonal.

    The result has shape (components, motions).
    """
    if not len(weights):
        return np.zeros((0, 0))
    springs = np.where(moves, _SPRINGS * model.steepness, 0.0)
    try:
        factors = Factors(model.material, moves, lambda part: None, springs)
    except Singular:
        raise ConvergenceError(
            "double precision cannot resolve the free motions of the tissue. Hold more of it, or "
            "reduce the ratio of the stiffest to the softest tissue"
        ) from None
    random, count = np.random.default_rng(0), _FIRST_MOTIONS
    while True:
        motions = random.standard_normal((len(weights), min(count, len(weights))))
        for _ in range(_ITERATIONS):
            motions, _ = np.linalg.qr(_inverse(factors, moves, weights, motions))
        images = np.stack([_image(model, moves, weights, way) for way in motions.T], axis=1)
        costs, modes = scipy.linalg.eigh(motions.T @ images)
        is_soft = costs < _SOFT
        if not is_soft.all() or count >= min(_MOST_MOTIONS, len(weights)):
            return np.asarray(motions @ modes[:, is_soft])
        count *= 2


def _inverse(
    factors: Factors, moves: HeldPlanes, weights: Float64Array, columns: Float64Array
) -> Float64Array:
    """Apply the inverse of the model, scaled to a unit diagonal, to each column."""
    images = np.empty_like(columns)
    for number, column in enumerate(columns.T):
        load: Planes = np.zeros(moves.shape)
        load[moves] = column * weights
        images[:, number] = factors.solve(load)[moves] * weights
    return images


def _image(
    model: LinearModel, moves: HeldPlanes, weights: Float64Array, way: Float64Array
) -> Float64Array:
    """Apply the model, scaled to a unit diagonal, to a motion."""
    d: Planes = np.zeros(moves.shape)
    d[moves] = way / weights
    return np.asarray(-model.pull(d)[moves] / weights)
