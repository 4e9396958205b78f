"""Problems used by several test files."""

import numpy as np

from napari_hmrf import Problem


def frame_problem(shape, seed=0, ratio=4.0, amplitude=2.0, spacing=(1.0, 1.0)) -> Problem:
    """Return random tissue with random prescribed displacements at its border."""
    rng = np.random.default_rng(seed)
    m = ratio ** rng.random(shape)
    y = rng.normal(scale=amplitude, size=(*shape, 2))
    c = np.zeros((*shape, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)


def pulled_problem(vector=(2.0, -1.0), at=(10, 8), stiff=30.0, size=20, radius=2.5) -> Problem:
    """Return a body with a fixed border, a stiff inclusion and a pulled patch."""
    m = np.full((size, size), 10.0)
    m[size // 4 : size // 2, size // 2 : -3] = stiff
    y, c = np.zeros((size, size, 2)), np.zeros((size, size, 2))
    c[0] = c[-1] = 1
    c[:, 0] = c[:, -1] = 1
    rows, cols = np.indices((size, size))
    patch = np.hypot(rows - at[0], cols - at[1]) <= radius
    y[patch], c[patch] = vector, 1
    return Problem(observed=y, confidence=c, stiffness=m)
