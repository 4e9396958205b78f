"""Covariance of the posterior of a small problem, by a dense inverse matrix."""

from __future__ import annotations

import numpy as np

from tests.support.data_oracle import elastic_matrix, with_data


def posterior_covariance(problem, prior, scale) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of the components that are free to move, and a mask of them."""
    matrix, _ = with_data(problem, elastic_matrix(problem, prior), np.zeros(problem.observed.size))
    matrix = matrix.toarray()
    free = (matrix.diagonal() > 0) & ~problem.known.ravel()
    energy = scale.energy(problem.stiffness, problem.spacing)
    return energy * np.linalg.inv(matrix[np.ix_(free, free)]), free


def data_covariance(problem, prior, scale, rows) -> tuple[np.ndarray, np.ndarray]:
    """Return combinations of observations, and their covariance under the prior.

    The combinations, in columns, are unaffected by the rigid motions of tissue that nothing holds.
    `rows` is the matrix of the observations.
    """
    matrix = elastic_matrix(problem, prior).toarray()
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
