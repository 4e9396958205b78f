"""A tumour is removed from a brain, whose upper part is free: the skull is open.

The brain also sinks without the removal, because its image has no stress. The effect of the removal
is therefore the difference between two solutions. Fluid in the cavity presses on its floor.
"""

import numpy as np

from napari_hmrf import BoundaryRule, Cavity, Grid, Motion, Study, Tissue, solve_study
from napari_hmrf.data import phantom

brain = phantom("mass-effect", size=200)
tissue, tumour = brain.problem.tissue, brain.tissue_labels == 3
rows = np.indices(tissue.shape)[0]
held = brain.problem.known.any(axis=-1) & ~tumour & (rows > 70)
held |= tissue & (rows > 70) & (np.roll(~tissue, 3, 1) | np.roll(~tissue, -3, 1))  # the skull
stiffness = np.where(tissue, np.where(tumour, 4.0, 2.0), 0.0)  # kPa
row, col = np.argwhere(tumour).mean(axis=0).round().astype(int)
above, below = np.flatnonzero(tumour[:, col])[[0, -1]] + (-1, 1)


def sunk(*removed: BoundaryRule, **contents: float):
    """Return the solution with weight, and with a removed tumour if there is a rule for it."""
    motion = Motion(
        labels=np.where(held, 1, np.where(tumour & bool(removed), 2, 0)),
        rules=(BoundaryRule(1, "fixed"), *removed),
        weight=(0.00981, 0),  # water, downwards, in kPa / mm
        cavity=Cavity(**contents),
    )
    grid = Grid(tissue.shape, (0.8, 0.8), "mm")
    return solve_study(Study(grid, Tissue(stiffness=stiffness, unit="kPa"), motion))


intact, remove = sunk(), BoundaryRule(2, "remove")
images = {"intact": brain.image}
for name, contents in (("empty", {}), ("half full", {"level": 0.5}), ("full", {"level": 1.0})):
    solution = sunk(remove, fluid=0.00981 if contents else 0.0, **contents)
    images[name] = solution.warp(brain.image)
    roof, floor = (solution.displacement - intact.displacement)[[above, below], col, 0]
    print(f"{name} cavity: its roof sinks by {roof:.2f} mm, its floor by {floor:.2f} mm")
