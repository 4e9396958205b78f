"""Random deformations of a brain, with its labels, points and displacement, to train a network.

A few unit solutions are computed once. Each deformation is a weighted sum of these solutions, and
is as accurate as a full solve. Bone stays rigid, tissue does not fold, and labels and points move
with the image.
"""

import numpy as np

from napari_hmrf import Material, solve_study
from napari_hmrf.data import phantom
from napari_hmrf.fields import equivalent_strain, green_lagrange_strain
from napari_hmrf.random import RandomDeformation

brain = phantom("mass-effect", size=96)
materials = [
    Material(0, "air", 0.0),
    Material(1, "brain", 3.0, 0.45),
    Material(2, "ventricles", 1.0, 0.3),
    Material(3, "bone", float("inf")),
]
random = RandomDeformation(brain.tissue_labels, materials, amplitude=(0.5, 1), spacing=1)
print(random)

tips = np.argwhere(brain.tissue_labels == 2)[[0, -1]]
samples = [random.sample(seed) for seed in range(8)]
images = np.stack([sample.image(brain.image) for sample in samples])
labels = np.stack([sample.labels(brain.tissue_labels) for sample in samples])
points = np.stack([sample.points(tips) for sample in samples])
fields = np.stack([sample.displacement for sample in samples])
np.savez("deformed.npz", images=images, labels=labels, points=points, fields=fields)

folded = sum(sample.solution.count_folds() for sample in samples)
farthest = np.linalg.norm(fields, axis=-1).max()
print(f"{len(samples)} images: tissue moved up to {farthest:.2f} px, and folds at {folded} pixels")
bone = brain.tissue_labels == 3
strained = max(
    equivalent_strain(green_lagrange_strain(d, spacing=1, tissue=bone))[bone].max() for d in fields
)
print(f"bone is strained by {100 * strained:.3f} %")

solved = solve_study(samples[0].study).displacement
apart = np.abs(solved - samples[0].displacement).max()
print(f"a full solve of the first deformation agrees within {apart:.4f} px")
