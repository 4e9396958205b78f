"""Problems that tests and benchmarks share."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf import Problem
from napari_hmrf.loads import Loads

Array = npt.NDArray[np.float64]


def bar(height: int, width: int, end: npt.ArrayLike, m: npt.ArrayLike = 1.0) -> Problem:
    """Return a bar with a fixed left end and a right end displaced by (2,) or (height, 2)."""
    c = np.zeros((height, width, 2))
    c[:, 0] = c[:, -1] = 1
    y = np.zeros_like(c)
    y[:, -1] = end
    return Problem(observed=y, confidence=c, stiffness=np.broadcast_to(m, (height, width)))


def turned(height: int, width: int, degrees: float) -> Array:
    """Return the displacement of the right end of a bar whose middle line is bent to an arc."""
    angle = np.deg2rad(degrees)
    radius = (width - 1) / angle
    off = np.arange(height) - (height - 1) / 2
    row = radius - (radius - off) * np.cos(angle) - off
    return np.stack([row, (radius - off) * np.sin(angle) - (width - 1)], axis=-1)


def framed_volume(
    size: int, inside: npt.NDArray[np.bool_], y: npt.ArrayLike, loads: Loads | None = None
) -> Problem:
    """Return a cube with a fixed border, in which the sites `inside` are displaced by `y`."""
    c = np.ones((size, size, size, 3))
    middle = (slice(1, -1),) * 3
    c[middle] = inside[middle][..., None]
    return Problem(
        observed=np.where(inside[..., None], y, 0.0),
        confidence=c,
        stiffness=np.ones((size, size, size)),
        loads=loads,
    )


def growing_ball(size: int, factor: float) -> Problem:
    """Return a cube with a fixed border and a central ball whose free radius grows by a factor."""
    around = np.indices((size, size, size)) - (size - 1) / 2
    ball = np.linalg.norm(around, axis=0) <= size / 8
    loads = Loads(growth=np.where(ball, factor - 1, 0.0))
    return framed_volume(size, np.zeros_like(ball), np.zeros((*ball.shape, 3)), loads)
