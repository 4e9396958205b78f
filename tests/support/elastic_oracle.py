"""Elastic tissue by a sparse matrix and a direct solve, in double precision."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf.solver.priors.elements import element_forces


def stiffness_matrix(problem, prior):
    """Return the matrix of the elastic energy, computed by impulses three sites apart."""
    lame, shape = prior.lame(problem), prior.shape(problem.spacing)
    height, width = problem.shape
    number = np.arange(height * width * 2).reshape(height, width, 2)
    parts = []
    for a, b, component in np.ndindex(3, 3, 2):
        impulse = np.zeros((height, width, 2))
        impulse[a::3, b::3, component] = 1
        forces = element_forces(lame, shape, impulse)
        source = np.full((height + 2, width + 2), -1)
        source[1:-1, 1:-1][a::3, b::3] = number[a::3, b::3, component]
        for i, j, along in np.ndindex(3, 3, 2):
            column = source[i : i + height, j : j + width]
            there = column >= 0
            parts.append((forces[..., along][there], number[..., along][there], column[there]))
    values, rows, columns = (np.concatenate(each) for each in zip(*parts, strict=True))
    return sp.csr_matrix((values, (rows, columns)), shape=(number.size, number.size))


def direct_solution(problem, prior) -> np.ndarray:
    """Return the field of least energy with exact boundaries, in the unit of the problem."""
    matrix = stiffness_matrix(problem, prior)
    field = np.where(problem.confidence > 0, problem.observed, 0).astype(float).ravel()
    free = (problem.confidence.ravel() == 0) & (matrix.diagonal() > 0)
    right = -(matrix[free][:, ~free] @ field[~free])
    factors = spl.splu(
        matrix[free][:, free].tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    field[free] = factors.solve(right)
    return field.reshape(*problem.shape, 2)
