"""Tissue with terms of data: posterior means and covariances by sparse and dense algebra.

The energy of linear elastic tissue, and the terms of a precision and of landmarks with a drift are
quadratic. Their matrices are summed, and the sum is solved directly.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from validation.oracles import followed
from validation.oracles.elasticity import load_vector, stiffness_matrix


def interpolation(points, grid) -> sp.csr_array:
    """Return the matrix that interpolates a displacement at points, in pixels."""
    axes = len(grid)
    rows, cols, values = [], [], []
    for number, point in enumerate(points):
        first = np.minimum(np.floor(point).astype(int), np.array(grid) - 2)
        within = point - first
        for corner in np.ndindex(*(2,) * axes):
            site = np.ravel_multi_index(tuple(first + corner), grid)
            share = np.prod(np.where(corner, within, 1 - within))
            for axis in range(axes):
                rows.append(number * axes + axis)
                cols.append(site * axes + axis)
                values.append(share)
    return sp.coo_array((values, (rows, cols)), (len(points) * axes, np.prod(grid) * axes)).tocsr()


def data_matrix(problem) -> tuple[sp.csr_array, np.ndarray]:
    """Return the matrix and the load of the precision and the landmarks of a problem."""
    size = problem.observed.size
    matrix, load = sp.csr_array((size, size)), np.zeros(size)
    if problem.precision is not None:
        axes = len(problem.shape)
        data = sp.block_diag(list(problem.precision.reshape(-1, axes, axes)), format="csr")
        matrix, load = matrix + data, load + data @ problem.observed.astype(float).ravel()
    if problem.landmarks is not None:
        marks = problem.landmarks
        weights = marks.scale.energy(problem.stiffness, problem.spacing) / marks.sd.ravel() ** 2
        moves = ((marks.targets - marks.points) * problem.spacing).ravel()
        at = interpolation(marks.points, problem.shape)
        matrix = matrix + at.T @ sp.diags_array(weights) @ at
        load = load + at.T @ (weights * moves)
    return matrix.tocsr(), load


def with_data(problem, matrix, load) -> tuple[sp.csr_array, np.ndarray]:
    """Add the precision and the landmarks of a problem to a matrix and a load."""
    data, pull = data_matrix(problem)
    return (matrix + data).tocsr(), load + pull


@followed(lambda prior: prior)
def posterior_mean(problem, prior) -> np.ndarray:
    """Return the field of least energy, in the unit of the problem; prescribed where c = 1."""
    elastic = stiffness_matrix(problem, prior)
    matrix, load = with_data(problem, elastic, load_vector(problem, prior))
    held = problem.confidence.ravel() == 1
    free = ~held & (elastic.diagonal() > 0)
    field = np.where(held, problem.observed.astype(float).ravel(), 0.0)
    field[free] = spl.spsolve(matrix[free][:, free].tocsc(), (load - matrix @ field)[free])
    return field.reshape(problem.observed.shape)


def posterior_mean_with_drift(problem, prior) -> tuple[np.ndarray, np.ndarray]:
    """Return the field of least energy and the drift, with the drift as further unknowns.

    A drift is a uniform strain that costs no energy: the elastic energy is that of the displacement
    minus an affine motion.
    """
    motions, units = affine_motions(problem), _unit_strains(len(problem.shape))
    grown, pulled = load_vector(problem, prior), np.zeros(motions.shape[0])
    if problem.loads is not None and problem.loads.force is not None:
        pulled = problem.loads.force.astype(float).ravel()
    # A force does work on the whole displacement, but growth only on that without the drift.
    elastic = stiffness_matrix(problem, prior)
    matrix, load = with_data(problem, elastic, grown)
    coupling = elastic @ motions
    held = problem.confidence.ravel() == 1
    free = ~held & (elastic.diagonal() > 0)
    field = np.where(held, problem.observed.astype(float).ravel(), 0.0)
    beside = sp.csr_array(-coupling[free])
    whole = sp.block_array(
        [
            [matrix[free][:, free], beside],
            [beside.T, sp.csr_array(motions.T @ coupling)],
        ],
        format="csc",
    )
    rest = [(load - matrix @ field)[free], coupling.T @ field - motions.T @ (grown - pulled)]
    solved = spl.spsolve(whole, np.concatenate(rest))
    field[free] = solved[: free.sum()]
    strain = np.einsum("k,kij->ij", solved[free.sum() :], np.array(units))
    return field.reshape(problem.observed.shape), strain


def affine_motions(problem) -> np.ndarray:
    """Return the displacement of all components in each uniform strain, as columns."""
    places = np.moveaxis(np.indices(problem.shape), 0, -1) * problem.spacing
    strains = _unit_strains(len(problem.shape))
    return np.stack([(places @ unit).ravel() for unit in strains], axis=1)


def _unit_strains(axes) -> list[np.ndarray]:
    units = []
    for i in range(axes):
        for j in range(i, axes):
            unit = np.zeros((axes, axes))
            unit[i, j] = unit[j, i] = 1
            units.append(unit)
    return units


def posterior_covariance(problem, prior, scale) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of the components that are free to move, and a mask of them."""
    elastic = stiffness_matrix(problem, prior)
    matrix, _ = with_data(problem, elastic, np.zeros(problem.observed.size))
    matrix = matrix.toarray()
    free = (matrix.diagonal() > 0) & ~problem.known.ravel()
    energy = scale.energy(problem.stiffness, problem.spacing)
    return energy * np.linalg.inv(matrix[np.ix_(free, free)]), free


def data_covariance(problem, prior, scale, rows) -> tuple[np.ndarray, np.ndarray]:
    """Return combinations of observations, and their covariance under the prior.

    The combinations, in columns, are unaffected by the rigid motions of tissue that nothing holds.
    `rows` is the matrix of the observations.
    """
    matrix = stiffness_matrix(problem, prior).toarray()
    free = (matrix.diagonal() > 0) & ~problem.known.ravel()
    sizes, ways = np.linalg.eigh(matrix[np.ix_(free, free)])
    stores = sizes > 1e-9 * sizes[-1]
    seen = rows[:, free] @ ways
    combinations = np.eye(len(rows))
    if not stores.all():
        turned, amounts, _ = np.linalg.svd(seen[:, ~stores], full_matrices=True)
        combinations = turned[:, int((amounts > 1e-9).sum()) :]
    seen = combinations.T @ seen[:, stores]
    energy = scale.energy(problem.stiffness, problem.spacing)
    return combinations, energy * (seen / sizes[stores]) @ seen.T
