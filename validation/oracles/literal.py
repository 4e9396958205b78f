"""Literal implementation of the paper's algorithm: one thread, all cliques for every candidate.

It is the baseline of the speed tables, written like a careful C program of 2008: compiled (numba),
in single precision, without allocation in loops, and with one branch per clique that may not exist.
It shares no code with the package's kernels, and computes exactly the same moves.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from napari_hmrf import ICM, Problem, SeilerPrior
from napari_hmrf.solver.quadtree import levels, nearest_pixels

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
_f = np.float32


def candidates(steps: tuple[float, ...]) -> npt.NDArray[np.float32]:
    """Return Gamma: no move, then {0, e, -e} x {0, e, -e} for each step e; the first tie wins."""
    gamma = [(0.0, 0.0)]
    for step in steps:
        gamma += [(i * step, j * step) for i in (0, 1, -1) for j in (0, 1, -1) if i or j]
    return np.array(gamma, dtype=np.float32)


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


@_compiled
def prolong(coarse, coarse_m, m, d):
    """Set `d` to the means of the coarse sites around each site of tissue, by their distance."""
    for i in range(m.shape[0]):
        for j in range(m.shape[1]):
            if m[i, j] == 0:
                continue
            total = _f(0)
            row = _f(0)
            col = _f(0)
            for a in range(2):
                near = i // 2 if a == 0 else i // 2 + (1 if i % 2 else -1)
                ci = min(max(near, 0), coarse_m.shape[0] - 1)
                for b in range(2):
                    near = j // 2 if b == 0 else j // 2 + (1 if j % 2 else -1)
                    cj = min(max(near, 0), coarse_m.shape[1] - 1)
                    weight = _f(0.75 if a == 0 else 0.25) * _f(0.75 if b == 0 else 0.25)
                    if coarse_m[ci, cj] > 0:
                        total += weight
                        row += weight * coarse[ci, cj, 0]
                        col += weight * coarse[ci, cj, 1]
            if total > 0:
                d[i, j, 0] = row / total
                d[i, j, 1] = col / total


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
    coarse = coarse_m = None
    for level in reversed(levels(problem.shape)):
        at = np.ix_(*nearest_pixels(level, problem.shape))
        m, y, p = (np.ascontiguousarray(image[at]) for image in (finest_m, finest_y, finest_p))
        d = np.zeros((*level.shape, 2), dtype=np.float32)
        if coarse is not None:
            prolong(coarse, coarse_m, m, d)
        target = np.zeros_like(d)
        for _ in range(optimizer.iterations):
            _sweep(m, y, p, d, target, gamma)
            d, target = target, d
        coarse, coarse_m = d, m
    return d * _f(problem.unit)
