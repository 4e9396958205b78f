"""Large motion of a small volume by Newton's method, with independent elements and assembly.

The elements use inverses of the deformation gradient instead of cofactors, and have no barrier, so
that the oracle agrees with the solver where no element is close to folding.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf import Problem
from napari_hmrf.loads import Loads

Field = npt.NDArray[np.float64]
_CORNERS = np.array(list(product((0, 1), repeat=3)))


def smallest_jacobian(displacement: npt.NDArray[np.floating], points: int = 10) -> float:
    """Return the smallest Jacobian at a dense grid of points in all elements, for cubic voxels."""
    return float(smallest_jacobians(at_corners(displacement), points).min())


def at_corners(values: npt.NDArray[np.floating]) -> Field:
    """Return the values (D, H, W, 3) at the corners of each element, (..., 8, 3)."""
    return np.stack([values[_at(corner)].astype(np.float64) for corner in _CORNERS], axis=-2)


def smallest_jacobians(corners: Field, points: int = 10) -> Field:
    """Return the smallest Jacobian in elements whose corners are displaced by (..., 8, 3)."""
    least = np.full(corners.shape[:-2], np.inf)
    for place in product(np.linspace(0, 1, points), repeat=3):
        gradient = np.eye(3) + np.einsum("...ck,ca->...ka", corners, _slopes(np.array(place)))
        np.minimum(least, np.linalg.det(gradient), out=least)
    return least


def framed_volume(size: int, inside: npt.NDArray[np.bool_], y: Field) -> Problem:
    """Return a cube with a fixed border, in which the sites `inside` are displaced by `y`."""
    c = np.ones((size, size, size, 3))
    middle = (slice(1, -1),) * 3
    c[middle] = inside[middle][..., None]
    return Problem(
        observed=np.where(inside[..., None], y, 0.0),
        confidence=c,
        stiffness=np.ones((size, size, size)),
    )


def growing_ball(size: int, factor: float) -> Problem:
    """Return a cube with a fixed border and a central ball whose free radius grows by a factor."""
    around = np.indices((size, size, size)) - (size - 1) / 2
    ball = np.linalg.norm(around, axis=0) <= size / 8
    still = framed_volume(size, np.zeros_like(ball), np.zeros((*ball.shape, 3)))
    growth = Loads(growth=np.where(ball, factor - 1, 0.0))
    return Problem(
        observed=still.observed,
        confidence=still.confidence,
        stiffness=still.stiffness,
        loads=growth,
    )


def solved(problem: Problem, poisson: float, parts: int = 8, locking: bool = False) -> Field:
    """Return the field of a problem with cubic voxels, loaded in `parts` increments.

    The change of volume counts as the mean of an element, or at each Gauss point if `locking`.
    """
    shape = problem.shape
    numbers = np.arange(3 * np.prod(shape)).reshape(*shape, 3)
    nodes = np.concatenate([numbers[_at(corner)] for corner in _CORNERS], axis=-1)
    nodes = nodes.reshape(-1, 24)
    m = np.mean([problem.stiffness[_at(corner)] for corner in _CORNERS], axis=0).ravel()
    mu = m / problem.stiffness.max() / (2 * (1 + poisson))
    lam = 2 * mu * poisson / (1 - 2 * poisson)
    free = np.flatnonzero(~problem.known)
    known = np.flatnonzero(problem.known)
    d = np.zeros((*shape, 3))
    for part in range(1, parts + 1):
        goal = problem.observed.ravel()[known] * part / parts
        for _ in range(40):
            forces, tangents = _elements(d.ravel()[nodes].reshape(-1, 8, 3), mu, lam, locking)
            load = -np.bincount(nodes.ravel(), forces.ravel(), d.size)
            rows = np.repeat(nodes[..., None], 24, axis=-1)
            at = rows.ravel(), rows.swapaxes(-1, -2).ravel()
            matrix = scipy.sparse.csc_matrix((tangents.ravel(), at), shape=(d.size, d.size))
            step = np.zeros(d.size)
            step[known] = goal - d.ravel()[known]
            rest = (load - matrix @ step)[free]
            step[free] = scipy.sparse.linalg.spsolve(matrix[free][:, free], rest)
            length = 1.0
            while smallest_jacobian(d + length * step.reshape(d.shape), 2) <= 0:
                length /= 2
            d += length * step.reshape(d.shape)
            if length == 1.0 and np.abs(step).max() < (1e-9 if part == parts else 1e-2):
                break
    return d


def _elements(corners: Field, mu: Field, lam: Field, locking: bool) -> tuple[Field, Field]:
    """Return the forces (N, 24) and second derivatives (N, 24, 24) of elements."""
    count = len(corners)
    forces, tangents = np.zeros((count, 8, 3)), np.zeros((count, 8, 3, 8, 3))
    volume, rates, parts = np.zeros(count), np.zeros((count, 8, 3)), []
    for place in product((0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5), repeat=3):
        slopes = _slopes(np.array(place))
        inverse = np.linalg.inv(np.eye(3) + np.einsum("nck,ca->nka", corners, slopes))
        jacobian = 1 / np.linalg.det(inverse)
        # Derivative of ln J with respect to each component of each corner.
        rate = np.einsum("nak,ca->nck", inverse, slopes)
        volume += jacobian / 8
        rates += (jacobian / 8)[:, None, None] * rate
        parts.append((slopes, jacobian, rate))
    for slopes, jacobian, rate in parts:
        change = jacobian if locking else volume
        pressure, bulk = lam / 2 * (change - 1 / change), lam / 2 * (1 + 1 / change**2)
        gradient = np.eye(3) + np.einsum("nck,ca->nka", corners, slopes)
        forces += mu[:, None, None] / 8 * np.einsum("nka,ca->nck", gradient, slopes)
        weight = (jacobian * pressure - mu) / 8
        forces += weight[:, None, None] * rate
        same = np.einsum("ca,ea,kl->ckel", slopes, slopes, np.eye(3))
        tangents += mu[:, None, None, None, None] / 8 * same
        crossed = np.einsum("ncl,nek->nckel", rate, rate)
        tangents -= weight[:, None, None, None, None] * crossed
        both = np.einsum("nck,nel->nckel", rate, rate)
        tangents += (jacobian * pressure / 8)[:, None, None, None, None] * both
        if locking:
            tangents += (bulk * jacobian**2 / 8)[:, None, None, None, None] * both
    if not locking:
        both = np.einsum("nck,nel->nckel", rates, rates)
        tangents += (lam / 2 * (1 + 1 / volume**2))[:, None, None, None, None] * both
    return forces.reshape(count, 24), tangents.reshape(count, 24, 24)


def _slopes(place: Field) -> Field:
    """Return the derivatives of the shape function of each corner at a point of [0, 1]^3."""
    values = np.where(_CORNERS == 1, place, 1 - place)
    signs = 2.0 * _CORNERS - 1
    others = np.stack([np.prod(np.delete(values, axis, 1), axis=1) for axis in range(3)], axis=1)
    return signs * others


def _at(corner: npt.NDArray[np.intp]) -> tuple[slice, ...]:
    return tuple(slice(1, None) if far else slice(None, -1) for far in corner)
