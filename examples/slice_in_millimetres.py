"""Landmarks in a slice with non-square pixels.

The distance between rows is 1.5 mm, and between columns 0.75 mm. All lengths, such as radii and
displacements, are in millimetres, but positions are (row, col) in pixels. The outer edge of the
tissue is fixed.
"""

import numpy as np

from napari_hmrf import Drawing, Grid, Landmark, Motion, Study, Tissue, build_problem, solve_study

grid = Grid(shape=(60, 120), spacing=(1.5, 0.75), unit="mm")
landmarks = Drawing(
    (
        Landmark(source=(20, 40), target=(22, 40), radius=2),
        Landmark(source=(30, 70), target=(30, 74), radius=2),
        Landmark(source=(42, 90), target=(42, 90), radius=2),
    )
)
study = Study(
    grid,
    Tissue(stiffness=np.ones(grid.shape)),
    Motion(hold_edge=True, drawing=landmarks),
)

problem = build_problem(study).problem  # inputs of the solver: three images on one grid
print(f"{int(problem.known.any(axis=-1).sum())} of {problem.tissue.size} pixels are known")

solution = solve_study(study)
for number, mark in enumerate(landmarks.marks):
    row, col = (round(place) for place in mark.source)
    down, right = solution.displacement[row, col]
    print(f"landmark {number} moves {down:.2f} mm down and {right:.2f} mm to the right")
farthest = np.linalg.norm(solution.displacement, axis=-1).max()
print(f"no pixel moves further than {farthest:.2f} mm")
