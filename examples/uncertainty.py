"""Brain shift during an operation, and the error bar of the place of a deep tumour.

A brain sinks under its weight, somewhat farther than expected. The surgeon sees points of its
surface, measures their displacement with an error of 0.5 pixels, and asks where the tumour is now.
The answer has an error bar, and the error bars of the surface show where to measure next.
"""

import numpy as np
from scipy.ndimage import binary_erosion

from napari_hmrf import Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import weight
from napari_hmrf.posterior import uncertainty

SD = 0.5

brain = phantom("mass-effect", size=160)
stiffness, tumour = brain.problem.stiffness, brain.tissue_labels == 3
tissue = stiffness > 0
surface = tissue & ~binary_erosion(tissue)
rows, cols = np.indices(tissue.shape)
held = surface & (rows > 105)  # the base of the skull
confidence = np.repeat(held[..., None], 2, axis=2).astype(float)
still = np.zeros_like(confidence)
expected = weight(stiffness, (0.04, 0), spacing=1)
sunk = Problem(
    observed=still,
    confidence=confidence,
    stiffness=stiffness,
    loads=weight(stiffness, (0.05, 0), spacing=1),
)
truth = solve(sunk).displacement
scale = StrainScale(0.1)  # patches of brain are strained by about 10 % besides
rng = np.random.default_rng(0)


def predicted(points):
    """Return the displacement and its uncertainty, from landmarks measured at some points."""
    seen = truth[tuple(np.transpose(points))] + SD * rng.normal(size=(len(points), 2))
    marks = Landmarks(points, points + seen, sd=SD, scale=scale)
    problem = Problem(
        observed=still, confidence=confidence, stiffness=stiffness, loads=expected, landmarks=marks
    )
    return uncertainty(problem, patch=5, labels=tumour)


true_motion = truth[tumour].mean(axis=0)
print(f"tumour: {true_motion[0]:.1f} px down in truth")
exposed = binary_erosion(tissue, iterations=2) & ~binary_erosion(tissue, iterations=4) & (rows < 70)
points = [tuple(np.argwhere(exposed & (cols == 80))[0])]
centre = tuple(np.rint(np.argwhere(tumour).mean(axis=0)).astype(int))
results = []
for number in range(1, 5):
    result = predicted(np.array(points))
    down, spread = result.labels[1].mean[0], result.labels[1].sd[0]
    print(f"landmarks: {number}, tumour: {down:.1f} +- {spread:.1f} px down")
    error_bars = np.linalg.norm(result.sd, axis=-1)
    results.append((points, error_bars))
    # Next, where the error bar of the surface is longest; last, the tumour, seen by ultrasound.
    longest = np.unravel_index(np.argmax(error_bars * exposed), tissue.shape)
    points = [*points, longest if number < 3 else centre]
