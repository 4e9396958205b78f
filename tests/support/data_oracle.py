"""Posterior mean of elastic tissue with a data term, by a sparse matrix in double precision."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf.loads import Loads
from napari_hmrf.solver.priors.elements import element_stiffness
from napari_hmrf.solver.problem import Problem
from validation.oracles.followed import followed


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


def with_data(problem, matrix, load) -> tuple[sp.csr_array, np.ndarray]:
    """Add the precision and the landmarks of a problem to a matrix and a load."""
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
    return matrix, load


@followed(lambda prior: prior)
def posterior_mean(problem, prior) -> np.ndarray:
    """Return the field of least energy, in the unit of the problem; prescribed where c = 1."""
    matrix = elastic_matrix(problem, prior)
    has_elements = matrix.diagonal() > 0
    y = problem.observed.astype(float).ravel()
    load = np.zeros(y.size)
    matrix, load = with_data(problem, matrix, load)
    held = problem.confidence.ravel() == 1
    field, free = np.where(held, y, 0.0), ~held & has_elements
    matrix = matrix.tocsr()
    field[free] = spl.spsolve(matrix[free][:, free].tocsc(), (load - matrix @ field)[free])
    return field.reshape(problem.observed.shape)


def drift_growth(problem, unit) -> np.ndarray:
    """Return a uniform growth of all tissue that is not rigid."""
    soft = problem.tissue & ~problem.rigid
    return soft[..., None, None] * np.asarray(unit, np.float32)


def posterior_mean_with_drift(problem, prior) -> tuple[np.ndarray, np.ndarray]:
    """Return the field of least energy and the drift, with the drift as further unknowns."""
    axes, marks = len(problem.shape), problem.landmarks
    scale = prior.force_unit(problem) / problem.unit
    units = []
    for i in range(axes):
        for j in range(i, axes):
            unit = np.zeros((axes, axes))
            unit[i, j] = unit[j, i] = 1
            units.append(unit)

    def load_of(growth, force=None):
        loads = Loads(growth=growth, force=force)
        other = Problem(
            observed=problem.observed,
            confidence=problem.confidence,
            stiffness=problem.stiffness,
            spacing=problem.spacing,
            precision=problem.precision,
            landmarks=marks,
            loads=loads,
        )
        return prior.load(other)

    matrix = elastic_matrix(problem, prior)
    has_elements = matrix.diagonal() > 0
    y, load = problem.observed.astype(float).ravel(), np.zeros(problem.observed.size)
    # In the unit of the problem, a force of the model is its unit times `scale` times a pixel.
    to_force = scale * problem.unit
    given = problem.loads
    grown = None if given is None else given.growth
    if given is not None:
        load = load + to_force * load_of(grown, given.force).forces.ravel()
    matrix, load = with_data(problem, matrix, load)
    held = problem.confidence.ravel() == 1
    free = ~held & has_elements
    to_energy = to_force * problem.unit

    def energy_of(growth):
        return 0.0 if growth is None else to_energy * load_of(growth).energy

    def of_both(one, other):
        if other is None:
            return 0.0
        both = Loads(growth=one) + Loads(growth=other)
        return energy_of(both.growth) - energy_of(one) - energy_of(other)

    growths = [drift_growth(problem, unit) for unit in units]
    coupling = np.stack([to_force * load_of(each).forces.ravel() for each in growths], axis=1)
    own = np.array([[of_both(one, other) for other in growths] for one in growths])
    field = np.where(held, y, 0.0)
    beside = sp.csr_array(-coupling[free])
    whole = sp.block_array(
        [[matrix.tocsr()[free][:, free], beside], [beside.T, sp.csr_array(own)]], format="csc"
    )
    right = np.concatenate(
        [
            (load - matrix @ field)[free],
            coupling.T @ field - np.array([of_both(each, grown) for each in growths]),
        ]
    )
    solved = spl.spsolve(whole, right)
    field[free] = solved[: free.sum()]
    amounts = solved[free.sum() :]
    return field.reshape(problem.observed.shape), np.einsum("k,kij->ij", amounts, np.array(units))
