"""Reference field of the paper's model in a volume by an independent direct solve in float64."""

import itertools

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from followed import followed

from napari_hmrf import SeilerPrior


def weights_of(step, spacing):
    """Return the weight of a line for each component, as defined in docs/method.md."""
    sizes = np.array(spacing) ** 2 / np.prod(spacing) ** (2 / 3)
    along, in_space = np.flatnonzero(step), 1 / sizes.max()

    def on_face(i, j):
        return 3 / max(sizes[i], sizes[j]) - 2 * in_space

    made = np.zeros(3)
    if len(along) == 3:
        made[:] = in_space
    elif len(along) == 2:
        made[along] = on_face(*along)
    else:
        (axis,) = along
        for k in range(3):
            made[k] = 6 / sizes[axis] - 6 / max(sizes[axis], sizes[k])
        first, second = (k for k in range(3) if k != axis)
        faces = on_face(axis, first) + on_face(axis, second)
        made[axis] = 9 / sizes[axis] - 2 * faces - 4 * in_space
    return made


def cliques(problem):
    """Yield for each line the indices of s, t and u of its cliques, and the line's weights."""
    m = problem.stiffness.astype(float)
    number = np.arange(m.size).reshape(m.shape)
    for step in itertools.product((-1, 0, 1), repeat=3):
        if step <= (0, 0, 0):
            continue
        sites = np.argwhere(m > 0)
        beyond = np.concatenate([sites - step, sites + step], axis=1).reshape(-1, 2, 3)
        inside = ((beyond >= 0) & (beyond < m.shape)).all(axis=(1, 2))
        s, t, u = (
            number[tuple(each.T)] for each in (beyond[inside, 0], sites[inside], beyond[inside, 1])
        )
        there = (m.flat[s] > 0) & (m.flat[u] > 0)
        yield s[there], t[there], u[there], weights_of(step, problem.spacing)


@followed(lambda: SeilerPrior())
def field_of_means(problem):
    """Return the field in which each site is the weighted mean of its neighbours, by SuperLU."""
    m = problem.stiffness.astype(float).ravel()
    field = np.where(problem.known, problem.observed, 0).astype(float).reshape(-1, 3)
    for k in range(3):
        rows, columns, values = [], [], []
        for s, t, u, weights in cliques(problem):
            r_s, r_u = m[t] / m[s], m[t] / m[u]
            to_s = weights[k] * (r_u * (1 + r_u) + (1 + r_s))
            to_u = weights[k] * ((1 + r_u) + r_s * (1 + r_s))
            rows += [t, t, t]
            columns += [s, u, t]
            values += [-to_s, -to_u, to_s + to_u]
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        matrix = sp.csr_matrix(entries, shape=(m.size, m.size))
        free = (matrix.diagonal() > 0) & ~problem.known.reshape(-1, 3)[:, k]
        right = -(matrix[free][:, ~free] @ field[~free, k])
        field[free, k] = spl.spsolve(matrix[free][:, free].tocsc(), right)
    return field.reshape(problem.observed.shape)
