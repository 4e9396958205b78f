"""A tumour grows in a brain, in three dimensions: what moves, and by how much, in millimetres.

The head is drawn, voxels of 3 mm; its brain is held at the skull. A volume is solved as a slice is,
on the compiled loops, with elastic tissue.
"""

import numpy as np

from napari_hmrf import (
    ElasticPrior,
    count_folds,
    head_phantom,
    jacobian_determinant,
    magnitude,
    solve,
    warp,
)

head = head_phantom(size=64, growth=3.0)
solution = solve(head.problem, ElasticPrior(0.45))
print(solution)

field = {"spacing": head.spacing, "tissue": solution.tissue}
d = solution.displacement
length, ratio = magnitude(d), jacobian_determinant(d, **field)
for label, name in ((1, "brain"), (2, "ventricles"), (3, "tumour")):
    there = head.tissue_labels == label
    print(
        f"{name}: moves {length[there].mean():.2f} mm in the mean, {length[there].max():.2f} at "
        f"most; its volume is {100 * np.mean(ratio[there]):.1f} % of what it was"
    )
print(f"voxels at which tissue folds: {count_folds(d, **field)}")

image = warp(head.image, d, **field)
labels = warp(head.tissue_labels, d, order=0, **field)
before, after = (np.sum(each == 3) for each in (head.tissue_labels, labels))
print(f"voxels of tumour: {before} before, {after} after")
np.save("grown-head.npy", image)
