"""Seiler et al.: cliques, energies, exact fields of both readings, and the literal algorithm.

A clique consists of three sites s, t, u in a line. With the stiffness m and the displacement d of
its sites, its potential is (eqs. 9 to 11), for each component,

    V = w [ (m_t/m_u (d_t - d_s) - (d_u - d_t))^2 + (m_t/m_s (d_t - d_u) - (d_s - d_t))^2 ]

With the weights w of square pixels, 0 and 1, these are the cliques of figure 2; for oblong pixels
and volumes, docs/method.md defines them. All of these are in float64.

`solve_literally` is the paper's algorithm, with one thread and all cliques for every candidate. It
is the baseline of the speed tables, written like a careful C program of 2008: compiled (numba), in
single precision, without allocation in loops, and with one branch per clique that may not exist. It
shares no code with the package's kernels, and computes exactly the same moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf import ICM, Problem, SeilerPrior
from napari_hmrf.solver.quadtree import levels, nearest_pixels
from validation.oracles import followed

Array = npt.NDArray[np.float64]
Sites = npt.NDArray[np.intp]
#: Flat indices of s, t and u of all cliques of a line, and the weight of each component.
Cliques = tuple[Sites, Sites, Sites, Array]
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
_f = np.float32


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


def cliques(m: npt.NDArray[Any], spacing: tuple[float, ...]) -> Iterator[Cliques]:
    """Yield the cliques of each line of tissue with stiffness (H, W) or (D, H, W)."""
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
        yield s[exist], t[exist], u[exist], line_weights(step, spacing)


def _potential(
    m: Array, some: Cliques, at_s: Array, at_t: Array, at_u: Array
) -> npt.NDArray[np.floating[Any]]:
    """Return V of cliques for each component, (cliques, 2) or (cliques, 3), from displacements."""
    s, t, u, weights = some
    first = (m[t] / m[u])[:, None] * (at_t - at_s) - (at_u - at_t)
    second = (m[t] / m[s])[:, None] * (at_t - at_u) - (at_s - at_t)
    return np.asarray(weights * (first**2 + second**2))


def total_energy(problem: Problem, d: Array, penalty: float) -> float:
    """Return U_total (eq. 7) of a displacement, as a sum over the cliques."""
    d = np.asarray(d, np.float64) / problem.unit
    m, moved = problem.stiffness.astype(np.float64).ravel(), d.reshape(-1, d.shape[-1])
    energy = 0.0
    for some in cliques(problem.stiffness, problem.spacing):
        s, t, u, _ = some
        energy += _potential(m, some, moved[s], moved[t], moved[u]).sum()
    held = problem.tissue[..., None] * penalty * problem.confidence.astype(np.float64)
    return float(energy + (held * np.abs(problem.observed / problem.unit - d)).sum())


def local_energies(
    m: Array, y: Array, p: Array, d: Array, spacing: tuple[float, ...], blanket: bool = False
) -> Callable[[Array], Array]:
    """Return the local energies of all sites as a function of where each of them would be.

    A site at its own displacement is compared with the other sites at `d`. In the blanket reading,
    its energy is that of all cliques that contain the site; in the centred reading, of those with
    the site in the middle. All displacements are in pixels.

    Parameters
    ----------
    m : ndarray, shape (H, W) or (D, H, W)
        Stiffness.
    y, p, d : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Observations, their penalties K c, and the present displacement.
    spacing : tuple of float
    blanket : bool
    """
    m = np.asarray(m, np.float64)
    every, flat, now = list(cliques(m, spacing)), m.ravel(), np.asarray(d).reshape(-1, m.ndim)

    def energies(there: Array) -> Array:
        moved = np.asarray(there).reshape(-1, m.ndim)
        energy = (p * np.abs(y - there)).sum(axis=-1).ravel()
        for some in every:
            s, t, u, _ = some
            energy[t] += _potential(flat, some, now[s], moved[t], now[u]).sum(axis=-1)
            if blanket:
                energy[s] += _potential(flat, some, moved[s], now[t], now[u]).sum(axis=-1)
                energy[u] += _potential(flat, some, now[s], now[t], moved[u]).sum(axis=-1)
        return energy.reshape(m.shape)

    return energies


def equations(
    stiffness: npt.NDArray[Any], spacing: tuple[float, ...], reading: str
) -> sp.csr_array:
    """Return the matrix of the equations of all components, in flattened order.

    Its product with a displacement in pixels is 0 at sites that are at the minimum of their local
    energy, without observations. In the blanket reading, it is half of the matrix of second
    derivatives of eq. 7.

    Parameters
    ----------
    stiffness : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    reading : {"centred", "blanket"}
    """
    axes, m = stiffness.ndim, stiffness.astype(np.float64).ravel()
    matrix = sp.csr_array((m.size * axes,) * 2)
    for component in range(axes):
        parts = []
        for s, t, u, weights in cliques(stiffness, spacing):
            scale = np.full(len(t), np.sqrt(weights[component]))
            to_s, to_u = m[t] / m[s], m[t] / m[u]
            parts.append((s, t, u, -to_u * scale, (1 + to_u) * scale, -scale))
            parts.append((s, t, u, -scale, (1 + to_s) * scale, -to_s * scale))
        s, t, u, at_s, at_t, at_u = (np.concatenate(each) for each in zip(*parts, strict=True))
        row, shape = np.arange(len(t)), (len(t), m.size)
        middle = sp.csr_array((at_t, (row, t)), shape=shape)
        ends = np.concatenate([at_s, at_u]), (np.tile(row, 2), np.concatenate([s, u]))
        # The energy is the sum of the squares of the residuals.
        residual = middle + sp.csr_array(ends, shape=shape)
        own = (middle if reading == "centred" else residual).T @ residual
        matrix += sp.kron(own, np.diag(np.arange(axes) == component))
    return sp.csr_array(matrix)


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
    matrix, held = equations(problem.stiffness, problem.spacing, reading), problem.known.ravel()
    field = np.where(held, problem.observed.ravel(), 0).astype(np.float64)
    free = ~held & (matrix.diagonal() > 0)
    if free.any():
        field[free] = spl.spsolve(matrix[free][:, free].tocsc(), -(matrix @ field)[free])
    return field.reshape(problem.observed.shape)


# The literal algorithm.


def candidates(steps: tuple[float, ...], axes: int = 2) -> npt.NDArray[np.float32]:
    """Return Gamma: no move, then {0, e, -e} along all axes for each step e; the first tie wins."""
    gamma = [(0.0,) * axes]
    for step in steps:
        gamma += [tuple(step * i for i in way) for way in product((0, 1, -1), repeat=axes)][1:]
    return np.array(gamma, dtype=np.float32)


def prolonged(
    coarse: npt.NDArray[Any], coarse_m: npt.NDArray[Any], m: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """Return the displacement on the next finer level: linear, without void, repeated borders."""
    total = np.zeros((*m.shape, 1), coarse.dtype)
    moved = np.zeros((*m.shape, m.ndim), coarse.dtype)
    for farther in product((False, True), repeat=m.ndim):
        around = []
        for size, sites, is_farther in zip(m.shape, coarse_m.shape, farther, strict=True):
            fine = np.arange(size)
            beyond = np.where(fine % 2, 1, -1) if is_farther else 0
            around.append(np.clip(fine // 2 + beyond, 0, sites - 1))
        near = np.ix_(*around)
        share = 0.75 ** farther.count(False) * 0.25 ** farther.count(True)
        weight = coarse.dtype.type(share) * (coarse_m[near] > 0)[..., None]
        total += weight
        moved += weight * coarse[near]
    is_reached = (m > 0)[..., None] & (total > 0)
    return np.divide(moved, total, out=np.zeros_like(moved), where=is_reached)


def start(
    m: npt.NDArray[Any], above: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None, kind: type
) -> npt.NDArray[Any]:
    """Return the displacement with which a level starts: 0 on the coarsest level.

    `above` is the displacement and the stiffness of the coarser level, or None.
    """
    return np.zeros((*m.shape, m.ndim), kind) if above is None else prolonged(*above, m)


def best_candidates(energies: Callable[[Array], Array], d: Array, gamma: npt.NDArray[Any]) -> Array:
    """Return `d` after the first move of least energy of each site."""
    least, best = np.full(d.shape[:-1], np.inf), d
    for move in gamma:
        there = d + move
        energy = energies(there)
        best = np.where((energy < least)[..., None], there, best)
        least = np.minimum(energy, least)
    return best


@followed(lambda *_: SeilerPrior())
def schedule(problem: Problem, iterations: int) -> Array:
    """Return the displacement of the printed schedule, in pixels of a grid of square pixels.

    This is the algorithm of `solve_literally` for images and volumes, in NumPy and float64.
    """
    prior = SeilerPrior()
    gamma = candidates(ICM().steps or (), len(problem.shape))
    penalty = prior.penalty_for(problem)
    above: tuple[Array, Array] | None = None
    d = np.zeros(())
    for level in reversed(levels(problem.shape)):
        at = np.ix_(*nearest_pixels(level, problem.shape))
        y, c, m = (each[at] for each in (problem.observed, problem.confidence, problem.stiffness))
        d = start(m, above, np.float64)
        for _ in range(iterations):
            energies = local_energies(m, y, penalty * c, d, problem.spacing)
            d = np.where((m > 0)[..., None], best_candidates(energies, d, gamma), 0)
        above = d, m
    return d


@_compiled
def _site_energy(m, y, p, d, i, j, row, col):
    """Return the part of U_total at site (i, j) for the displacement (row, col)."""
    height, width = m.shape
    energy = p[i, j, 0] * abs(y[i, j, 0] - row) + p[i, j, 1] * abs(y[i, j, 1] - col)
    for line in range(4):
        di = 0 if line == 1 else 1
        dj = 0 if line == 0 else (-1 if line == 3 else 1)
        si, sj, ui, uj = i - di, j - dj, i + di, j + dj
        if si < 0 or ui >= height or sj < 0 or uj < 0 or sj >= width or uj >= width:
            continue
        ms, mt, mu = m[si, sj], m[i, j], m[ui, uj]
        if ms == 0 or mt == 0 or mu == 0:
            continue
        ratio_s, ratio_u = mt / ms, mt / mu
        if line != 1:
            first = ratio_u * (row - d[si, sj, 0]) - (d[ui, uj, 0] - row)
            second = ratio_s * (row - d[ui, uj, 0]) - (d[si, sj, 0] - row)
            energy += first * first + second * second
        if line != 0:
            first = ratio_u * (col - d[si, sj, 1]) - (d[ui, uj, 1] - col)
            second = ratio_s * (col - d[ui, uj, 1]) - (d[si, sj, 1] - col)
            energy += first * first + second * second
    return energy


@_compiled
def _sweep(m, y, p, d, target, gamma):
    for i in range(m.shape[0]):
        for j in range(m.shape[1]):
            best = 0
            least = _site_energy(m, y, p, d, i, j, d[i, j, 0], d[i, j, 1])
            for k in range(1, len(gamma)):
                energy = _site_energy(
                    m, y, p, d, i, j, d[i, j, 0] + gamma[k, 0], d[i, j, 1] + gamma[k, 1]
                )
                if energy < least:
                    least = energy
                    best = k
            target[i, j, 0] = d[i, j, 0] + gamma[best, 0]
            target[i, j, 1] = d[i, j, 1] + gamma[best, 1]


def solve_literally(
    problem: Problem, prior: SeilerPrior | None = None, optimizer: ICM | None = None
) -> npt.NDArray[np.float32]:
    """Return the displacement, (H, W, 2), of the literal algorithm.

    Only square pixels and the centred reading are supported.
    """
    prior, optimizer = prior or SeilerPrior(), optimizer or ICM()
    if problem.spacing[0] != problem.spacing[1] or prior.conditional != "centred":
        raise ValueError("the literal program supports only square pixels and the centred reading")
    if optimizer.steps is None:
        raise ValueError("the literal program needs a candidate set")
    gamma = candidates(optimizer.steps)
    finest_m = np.asarray(problem.stiffness / problem.stiffness.max())
    finest_y = problem.observed / _f(problem.unit)
    finest_p = _f(prior.penalty_for(problem)) * problem.confidence
    above: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None = None
    for level in reversed(levels(problem.shape)):
        at = np.ix_(*nearest_pixels(level, problem.shape))
        m, y, p = (np.ascontiguousarray(image[at]) for image in (finest_m, finest_y, finest_p))
        d = start(m, above, np.float32)
        target = np.zeros_like(d)
        for _ in range(optimizer.iterations):
            _sweep(m, y, p, d, target, gamma)
            d, target = target, d
        above = d, m
    return d * _f(problem.unit)
