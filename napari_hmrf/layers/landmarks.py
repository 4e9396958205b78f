"""Reading of landmarks (positions and target positions) from Points and Shapes layers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from napari.layers import Shapes

from napari_hmrf.errors import LayerError
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.results.landmark_pairs import LandmarkPairs
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.tissue.usual_lengths import largest_spread, usual_radius

#: Name of the feature with the standard deviations of landmarks, in the unit of the image.
SD_FEATURE = "sd"
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
    sd: float | None = None,
) -> tuple[Landmark, ...]:
    """Read landmarks from two Points layers, paired by order, or from a Shapes layer of lines.

    The layers can have different transforms, because points are matched in world coordinates.

    Parameters
    ----------
    where : napari.layers.Points or napari.layers.Shapes
        Layer with positions, or with lines and paths from positions to target positions.
        Landmarks on other slices of a stack are ignored. A layer that lacks an axis of the image
        applies to all slices along this axis.
    should : napari.layers.Points or None
        Layer with target positions; None if `where` is a Shapes layer.
    frame : Frame
        Slice of the image.
    shape : (int, int)
        Shape of the slice.
    view : View, optional
        Visible slice. If the points have more axes than the image, points on other slices are
        ignored.
    radius : float, optional
        Radius of the patch of tissue that moves with each landmark, in the unit of the image; by
        default `usual_radius`. It is reduced where patches would overlap.
    confidence : float
        Confidence of the landmarks, greater than 0 and at most 1 (certain).
    sd : float, optional
        Standard deviation of all landmarks, in the unit of the image; 0 if they are exact. By
        default, the values of the feature "sd" of `should`, or of `where` if it has lines. Missing
        values are 0.

    Returns
    -------
    tuple of Landmark
        Landmarks in pixels of the image.

    Raises
    ------
    ProblemError
        If the layers have different numbers of points, or no points; if a shape is not a line; or
        if a landmark has an invalid position or standard deviation, is outside the image, or
        contradicts another landmark. The message names the layer.
    """
    pairs = landmark_pairs(where, should, frame, shape, view, sd=sd)
    wanted = usual_radius(shape, frame.spacing) if radius is None else radius
    radii = pairs.radii(wanted, frame.spacing)
    places = zip(pairs.at.tolist(), pairs.to.tolist(), radii, pairs.spreads.tolist(), strict=True)
    return tuple(
        Landmark(tuple(a), tuple(b), size, confidence, sd=spread) for a, b, size, spread in places
    )


def with_spreads_of(drawing: Drawing, marks: Iterable[Landmark]) -> tuple[Landmark, ...]:
    """Return landmarks with the standard deviations of a drawing's landmarks of equal source.

    Parameters
    ----------
    drawing : Drawing
    marks : iterable of Landmark
        Landmarks; those without an equal source in the drawing are returned unchanged.
    """
    known = {mark.source: mark.sd for mark in drawing.marks if isinstance(mark, Landmark)}
    return tuple(replace(mark, sd=known.get(mark.source, mark.sd)) for mark in marks)


def landmark_pairs(
    where: Any,
    should: Any,
    frame: Frame,
    shape: tuple[int, ...],
    view: View | None = None,
    *,
    sd: float | None = None,
) -> LandmarkPairs:
    """Return the pairs of positions on a slice; for arguments and errors, see `read_landmarks`."""
    kind: Literal["point", "line"] = "line" if isinstance(where, Shapes) else "point"
    begins, ends = _ends_of_lines(where) if kind == "line" else _point_pairs(where, should)
    should = where if kind == "line" else should
    sources, on_slice = _place_on_image(where, begins, kind, frame, view)
    targets, target_on_slice = _place_on_image(should, ends, kind, frame, view)
    numbers = np.flatnonzero(on_slice)
    if not len(numbers):
        slice_name = frame.slice_seen or "this slice"
        raise LayerError(where, f"has no {kind}s on {slice_name}. Add some, or show another slice.")
    if not target_on_slice[on_slice].all():
        raise LayerError(
            should,
            f"has {kind} {numbers[~target_on_slice[on_slice]][0]} with its target on another "
            f"slice, but tissue moves within a slice. Move the {kind}, or remove it.",
        )
    at, to = (places[on_slice][:, list(frame.plane)] for places in (sources, targets))
    outside = ((at < -0.5) | (at > np.array(shape) - 0.5)).any(axis=1)
    if outside.any():
        raise LayerError(
            where, f"has {kind} {numbers[outside][0]} outside the image. Move it, or remove it."
        )
    spreads = _spreads(should, len(ends), kind) if sd is None else np.full(len(ends), float(sd))
    pairs = LandmarkPairs(numbers, at, to, spreads[on_slice])
    most = largest_spread(shape, frame.spacing)
    too_large = np.flatnonzero(pairs.spreads > most)
    if len(too_large):
        raise LayerError(
            should,
            f"has a standard deviation of {pairs.spreads[too_large[0]]:.4g} for {kind} "
            f"{numbers[too_large[0]]}. Use at most {most:g} in the unit of the image, the diagonal "
            "of the image.",
        )
    if (contradiction := pairs.contradiction) is not None:
        one, other = contradiction
        raise LayerError(
            where,
            f"has {kind}s {one} and {other} in one pixel, but with different targets. "
            "Remove one of them.",
        )
    return pairs


def _spreads(layer: Any, count: int, kind: str) -> FloatArray:
    """Return the standard deviations in the features of a layer, with 0 for missing values."""
    if SD_FEATURE not in layer.features:
        return np.zeros(count)
    column = layer.features[SD_FEATURE]
    spreads = np.array([_number(value) for value in column.fillna(0)], dtype=np.float64)
    invalid = np.flatnonzero(~(np.isfinite(spreads) & (spreads >= 0)))
    if len(invalid):
        raise LayerError(
            layer,
            f"has an invalid standard deviation in the feature '{SD_FEATURE}' of {kind} "
            f"{invalid[0]}. Use a length in the unit of the image, or 0 if the landmark is exact.",
        )
    return spreads


def _number(value: Any) -> float:
    """Return a value as a number; NaN for any other value."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def _place_on_image(
    layer: Any, places: FloatArray, kind: str, frame: Frame, view: View | None
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Convert points of a layer to pixel coordinates of an image.

    Returns
    -------
    pixels : ndarray, shape (N, D)
        Points in pixels of the image.
    on_slice : ndarray of bool, shape (N,)
        True for points on the slice of the image.
    """
    invalid = np.flatnonzero(~np.isfinite(places).all(axis=1))
    if len(invalid):
        raise LayerError(layer, f"has NaN or infinity in {kind} {invalid[0]}. Remove it.")
    # Points of a layer that lacks an axis of the image are on every slice along this axis.
    to = frame.from_pixels_of(frame_of(layer))
    if to is None:
        raise LayerError(
            layer,
            "has a different unit from that of the image. If its coordinates are in the unit of "
            f"the image, type in napari's console: viewer.layers['{layer.name}'].units = "
            f"'{frame.unit}'.",
        )
    pixels = places @ to[:, :-1].T + to[:, -1]
    on_slice = frame.has(pixels)
    extra = layer.ndim - frame.ndim
    if extra > 0 and view is not None:  # use only the visible slice along axes the image lacks
        shown = np.array(frame_of(layer, view).index)[:extra]
        on_slice &= (np.rint(places[:, :extra]) == shown).all(axis=1)
    return pixels, on_slice


def _point_pairs(where: Any, should: Any) -> tuple[FloatArray, FloatArray]:
    """Return the points of two layers, which must have the same number of points."""
    if should is None or where is should:
        raise LayerError(
            where,
            "contains positions without targets. Choose another Points layer as 'should be at', "
            "or a Shapes layer of lines.",
        )
    count, other = len(where.data), len(should.data)
    if count != other:
        points = "1 point" if other == 1 else f"{other} points"
        raise LayerError(
            should,
            f"has {points}, but '{where.name}' has {count}. Points are paired by their order, so "
            "add or remove points until the numbers are equal.",
        )
    return np.asarray(where.data, dtype=float), np.asarray(should.data, dtype=float)


def _ends_of_lines(layer: Any) -> tuple[FloatArray, FloatArray]:
    """Return the first and the last point of each line."""
    for number, kind in enumerate(layer.shape_type):
        if kind not in ("line", "path"):
            raise LayerError(
                layer,
                f"has shape {number} ({kind}), which is not a line. Draw lines from positions to "
                "their targets. To move a whole region, paint it in a Labels layer (key 3 draws an "
                "outline).",
            )
    ends = np.array([line[[0, -1]] for line in layer.data], dtype=float)
    ends = ends.reshape(-1, 2, layer.ndim)  # gives the correct shape even if there are no lines
    return ends[:, 0], ends[:, 1]
