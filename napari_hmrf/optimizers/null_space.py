"""The motions that cost a model nothing, found from its factors."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.linalg

from napari_hmrf.backends.dissection import Singular
from napari_hmrf.backends.factors import Factors
from napari_hmrf.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.optimizers.base import Monitor, Report

Float64Array = npt.NDArray[np.float64]

# The springs that make the model invertible, as a part of its diagonal; and up to which part of it
# a motion costs nothing.
_SPRINGS, _NOTHING = 1e-13, 1e-12
# A cost that is rounding's.
_EXACTLY = 1e-17
_ITERATIONS = 5
_FIRST, _MOST = 8, 64


def null_space(model: LinearModel, held: HeldPlanes, report: Report) -> list[Float64Array]:
    """Find how tissue could move at no cost if only so much were held.

    By iterating on a few random motions at once with the inverse of the model on weak springs.

    Returns
    -------
    list of ndarray, each of shape (ways, H, W, 2)
        One, with all ways; none if there are none.
    """
    steep = model.steepness
    moves = (steep > 0) & ~held
    if not moves.any():
        return []
    try:
        Factors(model.material, moves, lambda part: report(Monitor("looking for play", part)))
        return []
    except Singular:
        springs = np.where(moves, _SPRINGS * steep, 0.0)
        factors = Factors(model.material, moves, lambda part: None, springs)
    weights = np.sqrt(steep[moves])
    random, count = np.random.default_rng(0), _FIRST
    while True:
        some = random.standard_normal((len(weights), min(count, len(weights))))
        for _ in range(_ITERATIONS):
            some, _ = np.linalg.qr(_inverse(factors, moves, weights, some))
        images = np.stack([_image(model, moves, weights, way) for way in some.T], axis=1)
        costs, mixes = scipy.linalg.eigh(some.T @ images)
        free = costs < _NOTHING
        if not free.all() or count >= min(_MOST, len(weights)):
            break
        count *= 2
    if not free.any():
        return []
    ways = (some @ mixes[:, free]) / weights[:, None]
    fields = np.zeros((ways.shape[1], *moves.shape))
    fields[:, moves] = ways.T
    # Energies are sums of squares: they tell nothing from little better than forces do.
    fields = fields[[2 * model.work(field)[0] < _EXACTLY for field in fields]]
    if not len(fields):
        return []
    fields /= np.abs(fields).max(axis=(1, 2, 3), keepdims=True)
    return [np.moveaxis(fields[:, :, 2:-2, 2:-2], 1, -1)]


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
