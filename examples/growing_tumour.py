"""Growth of a tumour in a brain, with measurements of the surrounding tissue.

The sample is synthetic: normal tissue, soft tissue and a tumour, with a fixed outline. Without
constraints, the diameter of the tumour would grow by 40 %; the surrounding tissue reduces this
growth. The result is saved to a file that napari can open. With larger growth, tissue folds in the
linear elastic model, but not in the large-motion model.
"""

import numpy as np

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Solution, solve
from napari_hmrf.data import phantom

brain = phantom("mass-effect", size=150).growing(0.4)
solution = solve(brain.problem)

# Factor by which the area around each pixel has changed; NaN in void.
jacobian = solution.jacobian()
for label, name in ((3, "tumour"), (2, "ventricles"), (1, "normal tissue")):
    there = brain.tissue_labels == label
    print(f"area of the {name}: {100 * np.nanmean(jacobian[there]):.1f} % of its original area")
print(f"pixels at which tissue folds: {solution.count_folds()}")

# The image is interpolated linearly, and the labels with the nearest neighbour.
image = solution.warp(brain.image)
labels = solution.warp(brain.tissue_labels, order=0)
before, after = (brain.tissue_labels == 3).sum(), (labels == 3).sum()
print(f"pixels of tumour: {before} before, {after} after")

path = solution.write("growing-tumour.npz")
print(f"{path}: {Solution.read(path)}")
np.save("growing-tumour-image.npy", image)

more = phantom("mass-effect", size=150).growing(1.5).problem
for prior in (ElasticPrior(), NeoHookeanPrior()):
    grown = solve(more, prior)
    print(f"{grown.provenance.model}, grown by 150 %: folds at {grown.count_folds()} pixels")
