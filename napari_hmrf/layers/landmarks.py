"""Landmarks from two layers of points: where things are, and where they should be."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.drawing import Landmark
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.naming import LayerError
from napari_hmrf.layers.view import unit_factor


def landmarks_of(
    where: Any,
    should: Any,
    frame: Frame,
    shape: tuple[int, int],
    radius: float,
    confidence: float = 1.0,
) -> tuple[Landmark, ...]:
    """Pair the points of two layers by their order, as they lie in the world.

    Parameters
    ----------
    where, should : napari.layers.Points
        Where things are, and where they should be. Of a stack, the pairs of other slices do not
        count; points without an axis lie on each of its slices.
    frame : Frame
        The slice of the image.
    shape : (int, int)
        Of the image.
    radius : float
        Of each landmark, in the unit of the frame's spacing.
    confidence : float

    Returns
    -------
    tuple of Landmark
        In pixels of the image.

    Raises
    ------
    ProblemError
        Naming the layer: if the layers do not hold as many points, or none, or a point cannot be
        placed.
    """
    if where is should:
        raise LayerError(
            where, "cannot be both where things are and where they should be. Choose two layers."
        )
    count, other = len(where.data), len(should.data)
    if count != other:
        raise LayerError(
            should,
            f"has {other} points, but '{where.name}' has {count}: they are paired by their order. "
            "Add or remove some.",
        )
    if not count:
        raise LayerError(where, "has no points. Add some, and as many to the other layer.")
    sources, targets = (_pixels(layer, frame) for layer in (where, should))
    others = [axis for axis in range(frame.ndim) if axis not in frame.plane]
    here, there = (
        (np.rint(places[:, others]) == np.array(frame.index)[others]).all(axis=1)
        for places in (sources, targets)
    )
    numbers = np.flatnonzero(here)
    if not len(numbers):
        raise LayerError(where, f"has no points on this slice ({frame.slice_name}). Move to one.")
    if not there[here].all():
        raise LayerError(
            should,
            f"has point {numbers[~there[here]][0]} on another slice than '{where.name}': tissue "
            "moves within a slice. Move the point, or remove both.",
        )
    at, to = (places[here][:, list(frame.plane)] for places in (sources, targets))
    outside = np.flatnonzero(((at < -0.5) | (at > np.array(shape) - 0.5)).any(axis=1))
    if len(outside):
        raise LayerError(
            where, f"has point {numbers[outside[0]]} outside the image. Move it, or remove it."
        )
    return tuple(
        Landmark((a[0], a[1]), (b[0], b[1]), radius, confidence)
        for a, b in zip(at.tolist(), to.tolist(), strict=True)
    )


def _pixels(layer: Any, frame: Frame) -> npt.NDArray[np.float64]:
    """Points in the pixels of the layer a frame is of, shape (N, D)."""
    points = np.asarray(layer.data, dtype=float)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise LayerError(layer, f"has NaN or infinity in point {bad[0]}. Remove it.")
    own = np.array([layer.data_to_world(point) for point in points], dtype=float)
    # Where the points lack an axis they lie on the slice.
    matrix = np.array(frame.matrix)
    world = np.tile((matrix @ np.array([*frame.index, 1.0]))[:-1], (len(points), 1))
    shared = min(own.shape[1], frame.ndim)
    units = zip(layer.units[-shared:], frame.units[-shared:], strict=True)
    factors = np.array([unit_factor(str(unit), to) for unit, to in units])
    if not np.isfinite(factors).all():
        raise LayerError(
            layer, "is measured in other units than the image. Give both a unit of length."
        )
    world[:, -shared:] = own[:, -shared:] * factors
    placed: npt.NDArray[np.float64] = np.linalg.solve(
        matrix, np.concatenate([world, np.ones((len(world), 1))], axis=1).T
    ).T[:, :-1]
    return placed
