"""Model of Seiler et al.: cliques, energies, and exact fields of both readings, in float64.

A clique consists of three sites s, t, u in a line. With the stiffness m and the displacement d of
its sites, its potential is (eqs. 9 to 11), for each component,

    V = w [ (m_t/m_u (d_t - d_s) - (d_u - d_t))^2 + (m_t/m_s (d_t - d_u) - (d_s - d_t))^2 ]

With the weights w of square pixels, 0 and 1, these are the cliques of figure 2; for oblong pixels
and volumes, docs/method.md defines them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf import Problem, SeilerPrior
from validation.oracles.followed import followed

Array = npt.NDArray[np.float64]
Sites = npt.NDArray[np.intp]
#: Flat indices of s, t and u of all cliques of a line, and the weight of each component.
Cliques = tuple[Sites, Sites, Sites, Array]


def line_weights(step: tuple[int, ...], spacing: tuple[float, ...]) -> Array:
    """Return the weight of a line for each component, shape (2,) or (3,).

    Parameters
    ----------
    step : tuple of int
        Step from t to u along each axis: -1, 0 or 1.
    spacing : tuple of float
        Sides of a pixel or a voxel.
    """
    axes, along = len(spacing), np.flatnonzero(step)
    sizes = np.array(spacing) ** 2 / np.prod(spacing) ** (2 / axes)
    slant = 1 / sizes.max()
    weights = np.zeros(axes)
    if len(along) == axes:
        weights[:] = slant
    elif axes == 2:
        weights[:] = 2 / sizes[along[0]] - 2 * slant
        weights[along[0]] += 1 / sizes[along[0]]
    elif len(along) == 2:
        weights[along] = _on_face(sizes, *along)
    else:
        (axis,) = along
        others = [k for k in range(3) if k != axis]
        weights[:] = 6 / sizes[axis] - 6 / np.maximum(sizes[axis], sizes)
        faces = sum(_on_face(sizes, axis, k) for k in others)
        weights[axis] = 9 / sizes[axis] - 2 * faces - 4 * slant
    return weights


def _on_face(sizes: Array, i: int, j: int) -> float:
    """Return the weight of a diagonal of a face of a voxel, for the components in the face."""
    return float(3 / max(sizes[i], sizes[j]) - 2 / sizes.max())


def cliques(problem: Problem) -> Iterator[Cliques]:
    """Yield the cliques of each line."""
    m = problem.stiffness
    number = np.arange(m.size).reshape(m.shape)
    for step in product((-1, 0, 1), repeat=m.ndim):
        if step <= (0,) * m.ndim:
            continue
        s, t, u = (
            number[
                tuple(
                    slice(1 + side * i, n - 1 + side * i) if i else slice(None)
                    for i, n in zip(step, m.shape, strict=True)
                )
            ].ravel()
            for side in (-1, 0, 1)
        )
        exist = (m.flat[s] > 0) & (m.flat[t] > 0) & (m.flat[u] > 0)
        yield s[exist], t[exist], u[exist], line_weights(step, problem.spacing)


def _potentials(problem: Problem, d: Array, some: Cliques) -> Array:
    """Return V of cliques for each component, (cliques, 2) or (cliques, 3)."""
    m, moved = problem.stiffness.astype(np.float64).ravel(), d.reshape(-1, d.shape[-1])
    s, t, u, weights = some
    first = (m[t] / m[u])[:, None] * (moved[t] - moved[s]) - (moved[u] - moved[t])
    second = (m[t] / m[s])[:, None] * (moved[t] - moved[u]) - (moved[s] - moved[t])
    return np.asarray(weights * (first**2 + second**2))


def total_energy(problem: Problem, d: Array, penalty: float) -> float:
    """Return U_total (eq. 7) of a displacement, as a sum over the cliques."""
    d = np.asarray(d, np.float64) / problem.unit
    energy = sum(_potentials(problem, d, some).sum() for some in cliques(problem))
    held = problem.tissue[..., None] * penalty * problem.confidence.astype(np.float64)
    return float(energy + (held * np.abs(problem.observed / problem.unit - d)).sum())


def local_energy(
    problem: Problem, d: Array, penalty: float, site: tuple[int, ...], blanket: bool
) -> Callable[[Array], float]:
    """Return the local energy of a site as a function of its displacement.

    In the blanket reading, it is the energy of all cliques that contain the site; in the centred
    reading, of those with the site in the middle.
    """
    at = np.ravel_multi_index(site, problem.shape)
    mine = []
    for s, t, u, weights in cliques(problem):
        own = (t == at) | (blanket & ((s == at) | (u == at)))
        mine.append((s[own], t[own], u[own], weights))
    confidence = problem.confidence[site].astype(np.float64)
    y = problem.observed[site].astype(np.float64) / problem.unit

    def energy(value: Array) -> float:
        changed = np.array(d, np.float64) / problem.unit
        changed[site] = np.asarray(value) / problem.unit
        prior = sum(_potentials(problem, changed, some).sum() for some in mine)
        return float(prior + (penalty * confidence * np.abs(y - changed[site])).sum())

    return energy


def _residuals(problem: Problem, component: int) -> tuple[sp.csr_array, sp.csr_array]:
    """Return the squared terms of all cliques as rows over the sites, and their part at t."""
    m = problem.stiffness.astype(np.float64).ravel()
    parts = []
    for s, t, u, weights in cliques(problem):
        scale = np.full(len(t), np.sqrt(weights[component]))
        to_s, to_u = m[t] / m[s], m[t] / m[u]
        parts.append((s, t, u, -to_u * scale, (1 + to_u) * scale, -scale))
        parts.append((s, t, u, -scale, (1 + to_s) * scale, -to_s * scale))
    s, t, u, at_s, at_t, at_u = (np.concatenate(each) for each in zip(*parts, strict=True))
    row, shape = np.arange(len(t)), (len(t), m.size)
    middle = sp.csr_array((at_t, (row, t)), shape=shape)
    ends = np.concatenate([at_s, at_u]), (np.tile(row, 2), np.concatenate([s, u]))
    return middle + sp.csr_array(ends, shape=shape), middle


def residual_matrix(problem: Problem) -> sp.csr_array:
    """Return the squared terms of all cliques as rows over all components, in flattened order.

    The energy of a displacement in pixels, without observations, is the sum of their squares.
    """
    axes = problem.stiffness.ndim
    parts = [sp.kron(_residuals(problem, k)[0], np.eye(axes)[[k]]) for k in range(axes)]
    return sp.csr_array(sp.vstack(parts))


@followed(lambda reading: SeilerPrior(conditional=reading))
def solve_exactly(problem: Problem, reading: str) -> Array:
    """Return the field at which every site is at its minimum, prescribed where c > 0.

    Parameters
    ----------
    problem : Problem
        Image or volume to solve.
    reading : {"centred", "blanket"}
        Blanket is the exact minimizer of eq. 7; centred is the fixed point of the site updates, in
        which each site is the weighted mean of its neighbours.

    Returns
    -------
    ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of ``problem.spacing``.
    """
    axes = problem.stiffness.ndim
    field = np.where(problem.known, problem.observed, 0).astype(np.float64)
    for component in range(axes):
        residual, middle = _residuals(problem, component)
        matrix = sp.csr_array((middle if reading == "centred" else residual).T @ residual)
        free = ~problem.known[..., component].ravel() & (matrix.diagonal() > 0)
        values = field[..., component].ravel()
        if free.any():
            right = -(matrix[free][:, ~free] @ values[~free])
            values[free] = spl.spsolve(matrix[free][:, free].tocsc(), right)
        field[..., component] = values.reshape(problem.shape)
    return field
