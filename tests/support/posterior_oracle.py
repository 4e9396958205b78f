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
