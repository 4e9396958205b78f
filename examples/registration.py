"""Registration field as a boundary condition, at the edges in an image.

SimpleITK registers two images of the same brain. The registration does not model tissue: it bends
bone, and its field is unreliable where the image has no features. The elastic model uses this field
only at edges in the image, keeps bone rigid, and computes the remaining displacement. The second
image is computed from the first image with a known displacement, so the error of both fields is
known.
"""

import numpy as np
import SimpleITK as sitk
from scipy.ndimage import binary_dilation

from napari_hmrf import ElasticPrior, Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.fields import equivalent_strain, green_lagrange_strain
from napari_hmrf.tissue import edge_confidence

brain = phantom("mass-effect", size=150)
tissue, bone = brain.tissue_labels > 0, brain.tissue_labels == 3
stiffness = np.where(bone, np.inf, brain.problem.stiffness)

# True motion: the outline is fixed on the left and pushed on the right, and bone is rigid.
y, c = np.zeros((2, *tissue.shape, 2))
outline = (brain.problem.confidence > 0).any(axis=-1) & ~bone
outline &= np.hypot(*(np.indices(tissue.shape) - 75)) > 40
c[outline] = 1
right = outline & (np.indices(tissue.shape)[1] > 105)
y[right, 1] = -6
truth = solve(Problem(observed=y, confidence=c, stiffness=stiffness))
later = truth.warp(brain.image)
noise = 0.05 * np.ptp(later) * np.random.default_rng(0).normal(size=(2, *later.shape))

# The demons algorithm computes the displacement of each pixel from the first to the second image.
demons = sitk.FastSymmetricForcesDemonsRegistrationFilter()
demons.SetNumberOfIterations(150)
demons.SetStandardDeviations(2.0)
seen = np.array([brain.image, later]) + noise
fixed, moving = (sitk.GetImageFromArray(each.astype(np.float32)) for each in seen)
registered = sitk.GetArrayFromImage(demons.Execute(fixed, moving))[..., ::-1]

# This field is the observation y. Its confidence c is high at edges in the image and low elsewhere.
# It is 0 in bone and next to bone, because bone moves as a rigid body.
sure = edge_confidence(seen[0]) * ~binary_dilation(bone, iterations=2)
edges = np.repeat(sure[..., None], 2, axis=-1)
elastic = solve(
    Problem(observed=registered, confidence=edges, stiffness=stiffness), ElasticPrior()
).displacement

for name, field in (("demons alone", registered), ("with tissue", elastic)):
    away = np.linalg.norm(field - truth.displacement, axis=-1)[tissue]
    strain = 100 * equivalent_strain(green_lagrange_strain(field, spacing=1, tissue=bone))[bone]
    print(f"{name}: {away.mean():.2f} px from the truth, bone is strained by {strain.mean():.2f} %")
