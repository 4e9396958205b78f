"""Large motion of a few sites by Newton's method, with an independently assembled matrix."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.priors import NeoHookeanPrior
from napari_hmrf.solver.problem import Problem

Field = npt.NDArray[np.float64]
# D_r, D_c and D_x of the corners 00, 01, 10 and 11.
_SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1], [1, -1, -1, 1]], dtype=float)


def bar(height: int, width: int, end: Field, m: npt.ArrayLike = 1.0) -> Problem:
    """Return a bar with a fixed left end and a right end displaced by `end` (height, 2)."""
    c = np.zeros((height, width, 2))
    c[:, 0] = c[:, -1] = 1
    y = np.zeros_like(c)
    y[:, -1] = end
    return Problem(observed=y, confidence=c, stiffness=np.broadcast_to(m, (height, width)))


def turned(height: int, width: int, degrees: float) -> Field:
    """Return the displacement of the right end of a bar whose middle line is bent to an arc."""
    angle = np.deg2rad(degrees)
    radius = (width - 1) / angle
    off = np.arange(height) - (height - 1) / 2
    row = radius - (radius - off) * np.cos(angle) - off
    return np.stack([row, (radius - off) * np.sin(angle) - (width - 1)], axis=-1)


def least_corner(problem: Problem, displacement: npt.NDArray[np.floating]) -> float:
    """Return the smallest Jacobian at the corners of all elements; NaN if any of them is NaN."""
    place = np.indices(problem.shape, dtype=np.float64)
    place += np.moveaxis(displacement.astype(np.float64) / np.array(problem.spacing), -1, 0)
    tissue = problem.tissue
    exist = tissue[:-1, :-1] & tissue[1:, :-1] & tissue[:-1, 1:] & tissue[1:, 1:]
    a, b = place[:, :-1, :-1], place[:, :-1, 1:]
    c, d = place[:, 1:, :-1], place[:, 1:, 1:]
    corners = [
        down[0] * along[1] - down[1] * along[0]
        for down, along in ((c - a, b - a), (d - b, b - a), (c - a, d - c), (d - b, d - c))
    ]
    return float(np.stack(corners)[:, exist].min())


def solved(problem: Problem, prior: NeoHookeanPrior, parts: int = 20) -> Field:
    """Return the field of a problem with pixels of size 1, loaded in `parts` increments."""
    height, width = problem.shape
    numbers = np.arange(2 * height * width).reshape(height, width, 2)
    corners = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]
    nodes = np.stack(corners, axis=2).reshape(height - 1, width - 1, 8)
    differences = np.kron(_SIGNS, np.eye(2))
    free = np.flatnonzero(~problem.known & problem.tissue[..., None])
    known = np.flatnonzero(problem.known)
    d = np.zeros((height, width, 2))

    def step(way: Field) -> Field:
        tangents = differences.T @ prior.tangents(problem, d) @ differences
        rows = np.repeat(nodes[..., None], 8, axis=-1)
        at = rows.ravel(), rows.swapaxes(-1, -2).ravel()
        matrix = scipy.sparse.csc_matrix((tangents.ravel(), at), shape=(d.size, d.size))
        load = -prior.forces(problem, d).ravel() - matrix @ way.ravel()
        way.ravel()[free] = scipy.sparse.linalg.spsolve(matrix[free][:, free], load[free])
        return way

    for part in range(1, parts + 1):
        way = np.zeros_like(d)
        goal = problem.observed.ravel()[known] * part / parts
        way.ravel()[known] = goal - d.ravel()[known]
        way = step(way)
        for _ in range(30):
            length = 1.0
            while prior.corner_jacobians(problem, d + length * way).min() <= 0:
                length /= 2
            d += length * way
            far = float(np.abs(way).max())
            if length == 1.0 and far < (1e-9 if part == parts else 1e-2):
                break
            way = np.zeros_like(d)
            way.ravel()[known] = goal - d.ravel()[known]
            way = step(way)
    return d
