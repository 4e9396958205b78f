"""What was observed, from arrows drawn elsewhere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.place import Frame

FloatArray = npt.NDArray[np.float32]


def arrow_observations(
    vectors: npt.NDArray[np.float64],
    own: Frame,
    spacing: tuple[float, float],
    shape: tuple[int, int],
) -> tuple[FloatArray, FloatArray, int]:
    """Displacement and confidence from arrows, each counting for the pixel it starts in.

    Parameters
    ----------
    vectors : ndarray, shape (N, 2, D)
        Of a Vectors layer, in the pixels of the image.
    own : Frame
        The layer's slice.
    spacing : (float, float)
        Size of a pixel in (row, col) direction.
    shape : (int, int)
        The grid.

    Returns
    -------
    y, c : ndarray, shape (H, W, 2), float32
        Displacement in the unit of `spacing`, and 1 where an arrow starts.
    int
        How many arrows of the slice point straight out of it, and so say nothing of a motion in it:
        they do not count.

    Raises
    ------
    ProblemError
        By the arrow's number, if it starts outside the grid, disagrees with another in its pixel,
        or holds NaN.
    """
    bad = np.flatnonzero(~np.isfinite(vectors).all(axis=(1, 2)))
    if len(bad):
        raise ProblemError("observed", f"has NaN or infinity in vector {bad[0]}. Remove it.")
    others = [axis for axis in range(own.ndim) if axis not in own.plane]
    here = np.rint(vectors[:, 0, others]) == np.array(own.index)[others]
    inward = vectors[:, 1][:, list(own.plane)].any(axis=1)
    outward = vectors[:, 1][:, others].any(axis=1) & ~inward
    here = here.all(axis=1)
    rows = np.flatnonzero(here & ~outward)
    arrows = vectors[rows][:, :, list(own.plane)]
    at = np.rint(arrows[:, 0]).astype(int)
    outside = np.flatnonzero(((at < 0) | (at >= shape)).any(axis=1))
    if len(outside):
        first = outside[0]
        raise ProblemError(
            "observed",
            f"has {len(outside)} vectors that start outside the image of {shape[0]} x {shape[1]} "
            f"pixels, the first being vector {rows[first]} at {tuple(at[first].tolist())}. "
            "Remove them.",
        )
    y = np.zeros((*shape, 2), dtype=np.float32)
    c = np.zeros_like(y)
    steps = (arrows[:, 1] * spacing).astype(np.float32)
    y[tuple(at.T)] = steps
    c[tuple(at.T)] = 1
    conflict = np.flatnonzero((y[tuple(at.T)] != steps).any(axis=1))
    if len(conflict):
        first = conflict[0]
        raise ProblemError(
            "observed",
            f"has vectors that start in the same pixel and differ, as vector {rows[first]} at "
            f"{tuple(at[first].tolist())}. Keep one for each pixel.",
        )
    return y, c, int((here & outward).sum())
