"""Use the field of a registration as boundary, where the image has edges.

SimpleITK registers two images of one brain. It has no model of tissue: it bends bone, and guesses
where the image has no features. Elastic tissue takes this field at the edges of the image only,
keeps bone rigid, and computes the rest. The second image is made from the first, so the distance of
both fields from the truth is known.
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

# The truth: the outline is held on the left and pushed on the right; bone is rigid.
y, c = np.zeros((2, *tissue.shape, 2))
outline = (brain.problem.confidence > 0).any(axis=-1) & ~bone
outline &= np.hypot(*(np.indices(tissue.shape) - 75)) > 40
c[outline] = 1
right = outline & (np.indices(tissue.shape)[1] > 105)
y[right, 1] = -6
truth = solve(Problem(y, c, stiffness))
later = truth.warp(brain.image)
noise = 0.05 * np.ptp(later) * np.random.default_rng(0).normal(size=(2, *later.shape))

# SimpleITK's demons compute, for each pixel of the first image, its position in the second.
demons = sitk.FastSymmetricForcesDemonsRegistrationFilter()
demons.SetNumberOfIterations(150)
demons.SetStandardDeviations(2.0)
seen = np.array([brain.image, later]) + noise
fixed, moving = (sitk.GetImageFromArray(each.astype(np.float32)) for each in seen)
registered = sitk.GetArrayFromImage(demons.Execute(fixed, moving))[..., ::-1]

# This field is y. c is 1 at the edges of the image, and 0 elsewhere, also in bone and beside it,
# because bone moves as one body.
sure = edge_confidence(seen[0]) * ~binary_dilation(bone, iterations=2)
edges = np.repeat(sure[..., None], 2, axis=-1)
elastic = solve(Problem(registered, edges, stiffness), ElasticPrior()).displacement

for name, field in (("demons alone", registered), ("with tissue", elastic)):
    away = np.linalg.norm(field - truth.displacement, axis=-1)[tissue]
    strain = 100 * equivalent_strain(green_lagrange_strain(field, spacing=1, tissue=bone))[bone]
    print(f"{name}: {away.mean():.2f} px from the truth, bone is strained by {strain.mean():.2f} %")
