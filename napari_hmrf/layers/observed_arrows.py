"""What was observed, from arrows drawn elsewhere; and arrows that show what is painted."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.arrow_thinning import apart, one_per_cell
from napari_hmrf.layers.pixel_copy import copy_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View
from napari_hmrf.study.layer_names import naming
from napari_hmrf.tissue.boundary_rules import BoundaryRule, boundary_images

FloatArray = npt.NDArray[np.float32]

#: Arrows of a preview that fit beside each other across the image.
PREVIEW_ACROSS = 40
#: Of a slice this large, in pixels, every stroke would have to wait for its preview.
PREVIEW_LARGEST = 2_000_000


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


def preview_arrows(
    layer: Any,
    rules: tuple[BoundaryRule, ...],
    view: View | None,
    reference: Frame | None = None,
) -> tuple[Frame, FloatArray]:
    """Arrows that show what painted rules will do, few enough to see the paint.

    Parameters
    ----------
    layer : napari.layers.Labels
    rules : tuple of BoundaryRule
    view : View, optional
    reference : Frame, optional
        The slice of the image, in whose unit of length the rules are; by default the layer's own.

    Returns
    -------
    Frame
        The slice they lie on.
    ndarray, shape (N, 2, 2), float32
        (start, step) in pixels of the slice; none where tissue stays fixed.

    Raises
    ------
    ProblemError
        As `boundary_images`, naming the layer.
    """
    frame = Frame.of(layer, view)
    labels = copy_slice(layer, frame)
    spacing = (reference or frame).spacing
    known = {rule.label for rule in rules}
    with naming(observed=layer, confidence=layer):
        painted = np.where(np.isin(labels, list(known)), labels, 0)
        y, c = boundary_images(painted, rules, spacing=spacing)
    # An arrow shows what is believed: components without confidence are not drawn.
    steps = np.where(c > 0, y, 0) / np.array(spacing, dtype=np.float32)
    starts = np.argwhere(steps.any(axis=-1))
    across = max(size * step for size, step in zip(labels.shape, spacing, strict=True))
    width = max(across / PREVIEW_ACROSS, *spacing)
    starts = starts[one_per_cell(starts, width / 2, spacing)]
    arrows = np.stack([starts, steps[tuple(starts.T)]], axis=1).astype(np.float32)
    return frame, arrows[apart(arrows, width / 2, spacing)]
