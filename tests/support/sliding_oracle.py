"""Field of sliding parts, by a sparse matrix in double precision from the NumPy definitions."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf.solver.unfolded import unfolded
from tests.support.data_oracle import elastic_matrix, with_data


def least_energy(problem, prior) -> np.ndarray:
    """Return the field of least energy of a problem with sliding parts, in its unit of length."""
    parts, of_parts = unfolded(problem, prior)
    between, axes = parts.coupling, len(problem.shape)
    pairs = np.arange(len(between.first))
    rows = np.repeat(pairs, axes)
    gaps = sum(
        sp.coo_array(
            (
                (sign * between.normals).ravel(),
                (rows, (axes * at[:, None] + np.arange(axes)).ravel()),
            ),
            shape=(len(pairs), parts.observed.size),
        )
        for sign, at in ((1, between.first), (-1, between.second))
    ).tocsr()
    elastic = elastic_matrix(parts, of_parts)
    has_elements = elastic.diagonal() > 0
    matrix, load = with_data(parts, elastic, np.zeros(parts.observed.size))
    matrix = (matrix + gaps.T @ sp.diags_array(between.strength) @ gaps).tocsr()
    loads = of_parts.load(parts)
    if loads is not None:
        load = load + of_parts.force_unit(parts) * loads.forces.ravel()
    held = parts.confidence.ravel() == 1
    free = ~held & has_elements
    field = np.where(held, parts.observed.astype(float).ravel(), 0.0)
    field[free] = spl.spsolve(matrix[free][:, free].tocsc(), (load - matrix @ field)[free])
    return between.folded(field.reshape(parts.observed.shape))
