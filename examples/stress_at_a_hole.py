"""Stress at a hole in a pulled plate, against the exact solution of Kirsch.

Pixels make a staircase of the round hole, which is free of forces. The exact tension beside the
hole is three times the tension far away. The largest stress of any pixel does not tend to three:
the corners of the staircase are sharp, and concentrate the stress at each step. Three pixels away
from the hole, the stress is right, and tends to three as the pixels become smaller.
"""

import numpy as np

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve

YOUNG, NU, TENSION = 1.0, 0.3, 0.01


def exact_displacement(rows, cols, radius):
    """Return the displacement of an infinite plate that is pulled along its columns."""
    r, angle = np.maximum(np.hypot(rows, cols), 1.0), np.arctan2(rows, cols)
    mu, kappa = YOUNG / (2 * (1 + NU)), (3 - NU) / (1 + NU)
    near, far, third = 2 * radius / r, r / radius, 2 * (radius / r) ** 3
    along = far * (kappa + 1) * np.cos(angle)
    along += near * ((1 + kappa) * np.cos(angle) + np.cos(3 * angle)) - third * np.cos(3 * angle)
    across = far * (kappa - 3) * np.sin(angle)
    across += near * ((1 - kappa) * np.sin(angle) + np.sin(3 * angle)) - third * np.sin(3 * angle)
    return TENSION * radius / (8 * mu) * np.stack([across, along], axis=-1)


def exact_tension(ratio):
    """Return the tension beside the hole at a distance of radius / ratio from its centre."""
    return 1 + 0.5 * ratio**2 + 1.5 * ratio**4


print("radius   any pixel   3 px away (exact)   at 1.2 radii (exact)")
for radius in (10, 20, 40):
    half = 3 * radius
    rows, cols = np.indices((2 * half + 1, 2 * half + 1)) - float(half)
    away = np.hypot(rows, cols)
    plate = away >= radius
    observed = exact_displacement(rows, cols, radius) * plate[..., None]
    confidence = np.zeros_like(observed)
    confidence[[0, -1]] = confidence[:, [0, -1]] = 1
    problem = Problem(observed=observed, confidence=confidence, stiffness=plate.astype(float))
    solution = solve(problem, ElasticPrior(NU), optimizer=Multigrid(1e-4))
    tension = solution.stress()[..., 2, 2] / TENSION
    beside = np.nanmax(tension[away >= radius + 3])
    there = tension[half + round(1.2 * radius), half]
    print(
        f"{radius:3d} px {np.nanmax(tension):9.2f}"
        f"{beside:13.2f} ({exact_tension(radius / (radius + 3)):.2f})"
        f"{there:14.2f} ({exact_tension(1 / 1.2):.2f})"
    )
