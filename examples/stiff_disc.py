"""Stretching of soft tissue around a stiff disc.

The left edge is fixed, and the right edge is pulled 8 pixels to the right. The disc is twenty times
as stiff as its surroundings, so it hardly stretches.
"""

import numpy as np

from napari_hmrf import Problem, solve
from napari_hmrf.fields import principal_strains

shape = (96, 96)
rows, cols = np.indices(shape)
disc = np.hypot(rows - 48, cols - 48) < 16

stiffness = np.where(disc, 20.0, 1.0)
observed = np.zeros((*shape, 2))  # displacement: (row, col), in pixels
confidence = np.zeros((*shape, 2))  # 1 where the displacement is known
observed[:, -2:] = (0, 8)
confidence[:, :2] = confidence[:, -2:] = 1

solution = solve(Problem(observed=observed, confidence=confidence, stiffness=stiffness))
print(solution)

stretch = principal_strains(solution.strain("small"))[..., 0]
row, col = solution.displacement[48, 48]
print(f"the middle of the disc moves {row:.2f} pixels down and {col:.2f} to the right")
print(f"largest strain, mean within the disc: {100 * stretch[disc].mean():.1f} %")
print(f"largest strain, mean around the disc: {100 * stretch[~disc].mean():.1f} %")
