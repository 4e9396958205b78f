"""Compiled loops that interpolate displacements to the next finer level, and padded arrays."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import (
    disjoint_strict_parallel,
    portion,
    strict_callee,
)

#: Width of the border of void around every array, in sites.
PAD = 2


def padded(components: int, shape: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return zero planes for a grid, including the border of void."""
    return np.zeros((components, *(size + 2 * PAD for size in shape)), dtype=np.float32)


@disjoint_strict_parallel
def prolong(thread, coarse, coarse_stiffness, target, stiffness):
    """Interpolate a displacement bilinearly to the next finer level.

    Coarse sites in void have weight 0, and border sites are repeated outward.
    """
    height, width = target.shape[1] - 2 * PAD, target.shape[2] - 2 * PAD
    coarse_height, coarse_width = coarse.shape[1] - 2 * PAD, coarse.shape[2] - 2 * PAD
    for i in portion(thread, height):
        near_i = min(i // 2, coarse_height - 1)
        far_i = min(max(near_i + (1 if i % 2 else -1), 0), coarse_height - 1)
        for j in range(width):
            if stiffness[0, i + PAD, j + PAD] <= float32(0):
                continue
            near_j = min(j // 2, coarse_width - 1)
            far_j = min(max(near_j + (1 if j % 2 else -1), 0), coarse_width - 1)
            total = float32(0)
            sum0 = float32(0)
            sum1 = float32(0)
            for k in range(4):
                a = (near_i if k < 2 else far_i) + PAD
                b = (near_j if k % 2 == 0 else far_j) + PAD
                weight = (float32(0.75) if k < 2 else float32(0.25)) * (
                    float32(0.75) if k % 2 == 0 else float32(0.25)
                )
                if coarse_stiffness[0, a, b] > float32(0):
                    total += weight
                    sum0 += weight * coarse[0, a, b]
                    sum1 += weight * coarse[1, a, b]
            if total > float32(0):
                target[0, i + PAD, j + PAD] = sum0 / total
                target[1, i + PAD, j + PAD] = sum1 / total


@strict_callee
def _nearest(i, size):
    """Return the padded indices of the two coarse sites around a fine site, nearest first."""
    near = min(i // 2, size - 1)
    far = min(max(near + (1 if i % 2 else -1), 0), size - 1)
    return near + PAD, far + PAD


@disjoint_strict_parallel
def prolong_volume(thread, coarse, coarse_stiffness, target, stiffness):
    """Interpolate a displacement trilinearly to the next finer level of a volume."""
    for n in portion(thread, target.shape[1] - 2 * PAD):
        planes = _nearest(n, coarse.shape[1] - 2 * PAD)
        for i in range(target.shape[2] - 2 * PAD):
            rows = _nearest(i, coarse.shape[2] - 2 * PAD)
            for j in range(target.shape[3] - 2 * PAD):
                if stiffness[0, n + PAD, i + PAD, j + PAD] <= float32(0):
                    continue
                cols = _nearest(j, coarse.shape[3] - 2 * PAD)
                total = sum0 = sum1 = sum2 = float32(0)
                for k in range(8):
                    a, b, c = k // 4, k // 2 % 2, k % 2
                    weight = float32(27 / 64) / float32(3 ** (a + b + c))
                    at = planes[a], rows[b], cols[c]
                    if coarse_stiffness[0, at[0], at[1], at[2]] > float32(0):
                        total += weight
                        sum0 += weight * coarse[0, at[0], at[1], at[2]]
                        sum1 += weight * coarse[1, at[0], at[1], at[2]]
                        sum2 += weight * coarse[2, at[0], at[1], at[2]]
                if total > float32(0):
                    target[0, n + PAD, i + PAD, j + PAD] = sum0 / total
                    target[1, n + PAD, i + PAD, j + PAD] = sum1 / total
                    target[2, n + PAD, i + PAD, j + PAD] = sum2 / total
