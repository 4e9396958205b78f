"""A stack of serial sections, registered section to section.

Each section of a block is cut, stretched and mounted separately, so that adjacent sections do not
match. Here, sections of a known block are deformed at random, and have different brightness. Each
section is registered to the section before it, which is already registered.
"""

from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_hmrf import warp
from napari_hmrf.registration import register

count, shape = 10, (96, 128)
random = np.random.default_rng(0)


def smooth(shape, width):
    """Return a smooth random image with values from 0 to 1."""
    image = gaussian_filter(random.normal(size=shape), width)
    return (image - image.min()) / np.ptp(image)


# The block: tissue in an ellipse, with structures that change slowly from section to section.
block = smooth((count, *shape), (3, 2, 2)) + smooth((count, *shape), (4, 6, 6))
rows, cols = np.indices(shape) - np.reshape(shape, (2, 1, 1)) / 2
block *= np.clip(6 * (1 - (rows / 44) ** 2 - (cols / 60) ** 2), 0, 1)

# The sections: each is deformed by up to 4 pixels, and stained more or less strongly.
cut = []
for section in block:
    push = np.stack([smooth(shape, 16), smooth(shape, 16)], axis=-1) - 0.5
    moved = warp(section, 8 * push, spacing=1)
    cut.append(moved * random.uniform(0.6, 1.4) + 0.02 * random.normal(size=shape))

# Each section is compared with the registered section before it, and resampled to its grid.
stack, folds = [cut[0]], 0
for section in cut[1:]:
    found = register(stack[-1], section, spacing=1)
    stack.append(found.resample(section))
    folds += found.folds
print(f"last section: {found}")


def agreement(sections):
    """Return the mean correlation of adjacent sections."""
    pairs = pairwise(sections)
    return np.mean([np.corrcoef(one.ravel(), other.ravel())[0, 1] for one, other in pairs])


for name, sections in (("block", block), ("as cut", cut), ("registered", stack)):
    print(f"{name}: adjacent sections correlate by {agreement(sections):.3f}")
print(f"folds: {folds}")
