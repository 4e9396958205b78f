"""Landmarks from layers of points or lines: where things are, and where they should be."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from napari.layers import Shapes

from napari_hmrf.errors import LayerError, naming
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.landmark_pairs import LandmarkPairs
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.tissue.drawing import Landmark
from napari_hmrf.tissue.usual_lengths import usual_radius

FloatArray = npt.NDArray[np.float64]


def read_landmarks(
    where: Any,
    should: Any,
    frame: Frame,
    shape: tuple[int, ...],
    view: View | None = None,
    *,
    radius: float | None = None,
    confidence: float = 1.0,
) -> tuple[Landmark, ...]:
    """Pair the points of two layers by their order, or the ends of lines, as they lie in the world.

    Parameters
    ----------
    where : napari.layers.Points or napari.layers.Shapes
        Where things are; or lines and paths that begin there, and end where they should be. Of a
        stack, the pairs of other slices do not count; those without an axis lie on each of its
        slices.
    should : napari.layers.Points or None
        Where they should be; none beside lines.
    frame : Frame
        The slice of the image.
    shape : (int, int)
        Of the image.
    view : View, optional
        What is shown, for points with more axes than the image: those of other slices do not
        count then.
    radius : float, optional
        Of the patch of tissue that goes with each landmark, in the unit of the image; by default
        `usual_radius`. Patches that would overlap are made smaller.
    confidence : float
        How sure that is, from above 0 to 1 (certain).

    Returns
    -------
    tuple of Landmark
        In pixels of the image.

    Raises
    ------
    ProblemError
        Naming the layer: if the layers do not hold as many points, or none, or a shape is no line,
        or a landmark cannot be placed, lies outside the image, or contradicts another.
    """
    pairs = landmark_pairs(where, should, frame, shape, view)
    wanted = usual_radius(shape, frame.spacing) if radius is None else radius
    radii = pairs.radii(wanted, frame.spacing)
    with naming(observed=where, confidence=where):
        return tuple(
            Landmark(tuple(a), tuple(b), size, confidence)
            for a, b, size in zip(pairs.at.tolist(), pairs.to.tolist(), radii, strict=True)
        )


def landmark_pairs(
    where: Any, should: Any, frame: Frame, shape: tuple[int, ...], view: View | None = None
) -> LandmarkPairs:
    """Find the pairs on a slice; arguments and errors are those of `read_landmarks`."""
    what: Literal["point", "line"] = "line" if isinstance(where, Shapes) else "point"
    begins, ends = _ends_of_lines(where) if what == "line" else _paired(where, should)
    should = where if what == "line" else should
    sources, here = _placed(where, begins, what, frame, view)
    targets, there = _placed(should, ends, what, frame, view)
    numbers = np.flatnonzero(here)
    if not len(numbers):
        here_said = frame.slice_seen or "this slice"
        raise LayerError(where, f"has no {what}s on {here_said}. Add some, or go to one that has.")
    if not there[here].all():
        raise LayerError(
            should,
            f"has {what} {numbers[~there[here]][0]}, which leads to another slice: tissue moves "
            "within a slice. Move it, or remove it.",
        )
    at, to = (places[here][:, list(frame.plane)] for places in (sources, targets))
    outside = ((at < -0.5) | (at > np.array(shape) - 0.5)).any(axis=1)
    if outside.any():
        raise LayerError(
            where, f"has {what} {numbers[outside][0]} outside the image. Move it, or remove it."
        )
    pairs = LandmarkPairs(numbers, at, to)
    if (contradiction := pairs.contradiction) is not None:
        one, other = contradiction
        raise LayerError(
            where,
            f"has {what}s {one} and {other} in one pixel, which lead to different places. "
            "Remove one of them.",
        )
    return pairs


def _placed(
    layer: Any, places: FloatArray, what: str, frame: Frame, view: View | None
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Places of a layer in the pixels of the image, (N, D), and which of them lie on its slice."""
    bad = np.flatnonzero(~np.isfinite(places).all(axis=1))
    if len(bad):
        raise LayerError(layer, f"has NaN or infinity in {what} {bad[0]}. Remove it.")
    to = frame.from_pixels_of(frame_of(layer))  # where they lack an axis they lie on the slice
    if to is None:
        raise LayerError(
            layer,
            "is not in the image's unit. If its numbers are, type in napari's console: "
            f"viewer.layers['{layer.name}'].units = '{frame.unit}'.",
        )
    pixels = places @ to[:, :-1].T + to[:, -1]
    here = frame.has(pixels)
    extra = layer.ndim - frame.ndim
    if extra > 0 and view is not None:  # and on that shown, on axes that the image has not
        shown = np.array(frame_of(layer, view).index)[:extra]
        here &= (np.rint(places[:, :extra]) == shown).all(axis=1)
    return pixels, here


def _paired(where: Any, should: Any) -> tuple[FloatArray, FloatArray]:
    """The points of two layers."""
    if should is None or where is should:
        raise LayerError(
            where,
            "says where things are: choose another Points layer as 'should be at', or a Shapes "
            "layer of lines.",
        )
    count, other = len(where.data), len(should.data)
    if count != other:
        points = "1 point" if other == 1 else f"{other} points"
        raise LayerError(
            should,
            f"has {points}, but '{where.name}' has {count}: they are paired by their "
            "order. Add or remove some.",
        )
    return np.asarray(where.data, dtype=float), np.asarray(should.data, dtype=float)


def _ends_of_lines(layer: Any) -> tuple[FloatArray, FloatArray]:
    """The first and the last place of every line."""
    for number, kind in enumerate(layer.shape_type):
        if kind not in ("line", "path"):
            raise LayerError(
                layer,
                f"has shape {number} ({kind}), which leads nowhere. Draw lines, from "
                "where things are to where they should be; what a whole region does is painted in "
                "a Labels layer (its key 3 draws an outline).",
            )
    ends = np.array([line[[0, -1]] for line in layer.data], dtype=float)
    ends = ends.reshape(-1, 2, layer.ndim)  # without any, too
    return ends[:, 0], ends[:, 1]
