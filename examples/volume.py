"""Growth of a tumour in a volume, with the motion of each tissue in millimetres.

The head is synthetic, with voxels of 3 mm, and the brain is fixed at the skull. A volume is solved
in the same way as a slice. Here the tissue is elastic.
"""

import numpy as np

from napari_hmrf import ElasticPrior, solve
from napari_hmrf.data import head_phantom
from napari_hmrf.fields import magnitude

head = head_phantom(size=64, growth=3.0)
solution = solve(head.problem, ElasticPrior(0.45))
print(solution)

length, ratio = magnitude(solution.displacement), solution.jacobian()
for label, name in ((1, "brain"), (2, "ventricles"), (3, "tumour")):
    there = head.tissue_labels == label
    print(
        f"{name}: moves {length[there].mean():.2f} mm on average and {length[there].max():.2f} mm "
        f"at most; its volume is {100 * np.mean(ratio[there]):.1f} % of the original volume"
    )
print(f"voxels at which tissue folds: {solution.count_folds()}")

image = solution.warp(head.image)
labels = solution.warp(head.tissue_labels, order=0)
before, after = (np.sum(each == 3) for each in (head.tissue_labels, labels))
print(f"voxels of tumour: {before} before, {after} after")
np.save("grown-head.npy", image)
