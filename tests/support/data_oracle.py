"""Posterior mean of elastic tissue with a data term, by a sparse matrix in double precision."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf.solver.priors.elements import element_stiffness


def elastic_matrix(problem, prior) -> sp.csr_array:
    """Return the matrix of the elastic energy, in the unit of `Problem.precision`."""
    grid, axes = problem.shape, len(problem.shape)
    first, shear = element_stiffness(prior.shape(problem.spacing))
    lame = prior.lame(problem)
    matrices = lame.first[..., None, None] * first + lame.shear[..., None, None] * shear
    number = np.arange(np.prod(grid) * axes).reshape(*grid, axes)
    corners = [
        number[tuple(slice(at, at + size - 1) for at, size in zip(corner, grid, strict=True))]
        for corner in np.ndindex(*(2,) * axes)
    ]
    places = np.stack(corners, axis=-2).reshape(*matrices.shape[:-1])
    rows = np.broadcast_to(places[..., :, None], matrices.shape).ravel()
    cols = np.broadcast_to(places[..., None, :], matrices.shape).ravel()
    matrix = sp.coo_array((matrices.ravel(), (rows, cols)), shape=(number.size,) * 2)
    return matrix.tocsr() * (prior.force_unit(problem) / problem.unit)


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


def posterior_mean(problem, prior) -> np.ndarray:
    """Return the field of least energy, in the unit of the problem; prescribed where c = 1."""
    matrix = elastic_matrix(problem, prior)
    has_elements = matrix.diagonal() > 0
    y, axes = problem.observed.astype(float).ravel(), len(problem.shape)
    load = np.zeros(y.size)
    if problem.precision is not None:
        data = sp.block_diag(list(problem.precision.reshape(-1, axes, axes)), format="csr")
        matrix, load = matrix + data, load + data @ y
    if problem.landmarks is not None:
        marks = problem.landmarks
        weights = marks.scale.energy(problem.stiffness, problem.spacing) / marks.sd.ravel() ** 2
        moves = ((marks.targets - marks.points) * problem.spacing).ravel()
        at = interpolation(marks.points, problem.shape)
        matrix = matrix + at.T @ sp.diags_array(weights) @ at
        load = load + at.T @ (weights * moves)
    held = problem.confidence.ravel() == 1
    field, free = np.where(held, y, 0.0), ~held & has_elements
    matrix = matrix.tocsr()
    field[free] = spl.spsolve(matrix[free][:, free].tocsc(), (load - matrix @ field)[free])
    return field.reshape(problem.observed.shape)
