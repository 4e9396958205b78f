"""A brain before and after its tumour was removed: tissue that exists in one image only.

After the operation, the brain relaxes towards the place of the tumour. A cavity with fluid remains,
which is larger than the tumour on one side. If its edge is compared with the edge of the tumour,
the registration moves the brain wrongly. With masks of the remaining tissue in both images, the
removed tissue and the cavity do not count.
"""

import numpy as np
from scipy.ndimage import binary_dilation

from napari_hmrf import solve, warp
from napari_hmrf.data import phantom
from napari_hmrf.registration import register

brain = phantom("mass-effect", size=200)
tumour, tissue = brain.tissue_labels == 3, brain.problem.tissue

# The known motion: the place of the tumour shrinks by 20 %.
truth = solve(brain.growing(-0.2).problem).displacement
removed = binary_dilation(tumour, iterations=4) | np.roll(tumour, (12, 16), axis=(0, 1))
emptied = np.where(removed, 10, brain.image)
after = warp(emptied, truth, spacing=1, tissue=tissue) * 0.8 + 20
after = after + np.random.default_rng(0).normal(scale=4, size=after.shape)

around = binary_dilation(removed, iterations=15) & tissue & ~removed
print(f"known motion around it: {np.linalg.norm(truth, axis=-1)[around].mean():.2f} px")
cavity = warp(removed.astype(np.uint8), truth, spacing=1, order=0) > 0
fields = {}
for name, masks in (("all pixels", None), ("without removed tissue", (~removed, ~cavity))):
    found = register(brain.image, after, spacing=1, stiffness=brain.problem.stiffness, masks=masks)
    fields[name] = found.displacement
    error = np.linalg.norm(found.displacement - truth, axis=-1)
    print(f"{name}: error around it {error[around].mean():.2f} px, folds {found.folds}")
