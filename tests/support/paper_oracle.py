"""Slow, literal evaluations of the equations, independent of the package."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from napari_hmrf import Problem

#: (step from t to u, components of the potential) for the four kinds of cliques of figure 2.
KINDS = (((0, 1), (1,)), ((1, 0), (0,)), ((1, 1), (0, 1)), ((1, -1), (0, 1)))
Site = tuple[int, int]


def cliques(m: np.ndarray) -> Iterator[tuple[Site, Site, Site, tuple[int, ...]]]:
    """Yield every existing clique (s, t, u) with the components of its potential."""
    height, width = m.shape
    for i in range(height):
        for j in range(width):
            for (di, dj), components in KINDS:
                s, t, u = (i - di, j - dj), (i, j), (i + di, j + dj)
                inside = all(0 <= a < height and 0 <= b < width for a, b in (s, u))
                if inside and all(m[site] > 0 for site in (s, t, u)):
                    yield s, t, u, components


def potential(m, d, s, t, u, component) -> float:
    """Return V of one clique (eqs. 9 to 11) for one component."""
    ds, dt, du = (float(d[site][component]) for site in (s, t, u))
    ms, mt, mu = (float(m[site]) for site in (s, t, u))
    return (mt / mu * (dt - ds) - (du - dt)) ** 2 + (mt / ms * (dt - du) - (ds - dt)) ** 2


def total_energy(problem: Problem, d: np.ndarray, penalty: float) -> float:
    """Return U_total (eq. 7) as a sum over the cliques."""
    energy = sum(
        potential(problem.stiffness, d, s, t, u, component)
        for s, t, u, components in cliques(problem.stiffness)
        for component in components
    )
    held = problem.tissue[..., None] * penalty * problem.confidence.astype(float)
    return energy + float((held * np.abs(problem.observed - d)).sum())


def local_energy(problem: Problem, d: np.ndarray, penalty: float, site: Site, blanket: bool):
    """Return the local energy of a site as a function of its displacement."""
    mine = [
        clique
        for clique in cliques(problem.stiffness)
        if clique[1] == site or (blanket and site in clique[:3])
    ]

    def energy(value: np.ndarray) -> float:
        changed = d.astype(float).copy()
        changed[site] = value
        prior = sum(
            potential(problem.stiffness, changed, s, t, u, component)
            for s, t, u, components in mine
            for component in components
        )
        off = np.abs(problem.observed[site].astype(float) - value)
        return prior + float((penalty * problem.confidence[site].astype(float) * off).sum())

    return energy


def centred_fixed_point(problem: Problem) -> np.ndarray:
    """Return the field in which every site is the weighted mean of its neighbours, in float64.

    Observed components (c > 0) are equal to y; free components without a clique are 0.
    """
    height, width = problem.shape
    m = problem.stiffness.astype(float)
    field = np.zeros((height, width, 2))
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    diagonal = np.zeros((height, width, 2))

    def number(site: Site, component: int) -> int:
        return (site[0] * width + site[1]) * 2 + component

    for s, t, u, components in cliques(problem.stiffness):
        to_u, to_s = m[t] / m[u], m[t] / m[s]
        weight_s = to_u * (1 + to_u) + (1 + to_s)
        weight_u = (1 + to_u) + to_s * (1 + to_s)
        for k in components:
            if problem.confidence[t][k] > 0:
                continue
            diagonal[t][k] += weight_s + weight_u
            rows += [number(t, k)] * 2
            columns += [number(s, k), number(u, k)]
            values += [-weight_s, -weight_u]
    right = np.where(problem.confidence > 0, problem.observed, 0).astype(float).ravel()
    diagonal = np.where(diagonal > 0, diagonal, 1).ravel()
    size = height * width * 2
    matrix = sp.coo_matrix((values, (rows, columns)), shape=(size, size)).tocsc()
    field = spl.spsolve((matrix + sp.diags(diagonal)).tocsc(), right)
    return field.reshape(height, width, 2)
