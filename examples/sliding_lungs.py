"""A breath moves the diaphragm down, and the lungs slide along the chest wall.

The same chest is solved again with lungs that stick to the wall. The slip is the mean difference
between the lung and the wall beside it, and the mean strain is that of both lungs.
"""

from dataclasses import replace

import numpy as np

from napari_hmrf import Grid, Motion, Study, Tissue, solve_study
from napari_hmrf.data import chest_phantom
from napari_hmrf.fields import measure

chest = chest_phantom(breath=14)  # pixels
lungs = next(row for row in chest.materials if row.name == "lungs")
inside = chest.tissue_labels == lungs.label
rows = np.arange(100, 170)
side = inside[rows].argmax(axis=1)  # the leftmost pixel of the lung in each row

solutions = {}
for name, slides in (("sliding", True), ("sticking", False)):
    materials = [replace(row, slides=slides and row == lungs) for row in chest.materials]
    tissue = Tissue(labels=chest.tissue_labels, materials=tuple(materials))
    motion = Motion(labels=chest.boundary_labels, rules=chest.boundary)
    solution = solve_study(Study(Grid(chest.image.shape, 1.0), tissue, motion))
    down = solution.displacement[..., 0]
    slip = (down[rows, side + 1] - down[rows, side - 2]).mean()
    measured = {each.label: each for each in measure(solution, chest.tissue_labels)}
    print(
        f"{name} lungs: slip {slip:.1f} px, strain {measured[lungs.label].mean_strain:.1f} %, "
        f"volume {measured[lungs.label].size_change:+.1f} %, folds {solution.count_folds()}"
    )
    solutions[name] = solution
images = {name: solution.warp(chest.image) for name, solution in solutions.items()}
