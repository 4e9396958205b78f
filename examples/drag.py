"""Dragging tissue step by step, with warm starts.

A patch is dragged to the right, one pixel at a time. Each solve starts from the solutions of the
last two steps. Elastic displacement is proportional to the pull, so a solve needs only a few
iterations after the second step.
"""

import numpy as np

from napari_hmrf import Arrow, Drawing, Grid, Motion, Study, Tissue, build_problem, solve

grid = Grid((120, 120), (1, 1))
rows, cols = np.indices(grid.shape)
tissue = Tissue(stiffness=np.where(np.hypot(rows - 40, cols - 80) < 15, 5.0, 1.0))

found = []
cold = warm = 0
for step in range(1, 9):
    pull = Drawing((Arrow(at=(60, 50), by=(0, step), radius=5),))
    stated = build_problem(Study(grid, tissue, Motion(hold_edge=True, drawing=pull)))

    alone = solve(stated.problem, stated.prior)
    solution = solve(stated.problem, stated.prior, initial=found[-2:])
    found.append(solution)

    cold += alone.iterations
    warm += solution.iterations
    apart = np.abs(solution.displacement - alone.displacement).max()
    print(f"dragged {step} px: {solution.iterations} iterations, {apart:.4f} px from a cold start")
print(f"{warm} iterations in all; with a cold start each time, {cold}")
