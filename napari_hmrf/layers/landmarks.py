"""Landmarks from two layers of points: where things are, and where they should be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from napari_hmrf.drawing import Landmark
from napari_hmrf.drawing.canvas import common, distance_to
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.naming import LayerError, Named, naming
from napari_hmrf.layers.view import View, unit_factor

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkLayers:
    """Two layers whose points are pairs, by their order, and what goes with each.

    Attributes
    ----------
    where, should : napari.layers.Points
        Where things are, and where they should be.
    radius : float, optional
        Of the patch of tissue that goes with each landmark, in the unit of the image; by default
        `usual_radius`. Patches that would overlap are made smaller.
    confidence : float
        How sure that is, from above 0 to 1 (certain).
    """

    where: Any
    should: Any
    radius: float | None = None
    confidence: float = 1.0


@dataclass(frozen=True)
class Landmarks:
    """The pairs of one slice; no layer is kept.

    Attributes
    ----------
    marks : tuple of Landmark
        In pixels of the image.
    numbers : tuple of int
        Which points of their layer they are.
    where, should : Named
    notes : tuple of str
        What the user should know about them.
    """

    marks: tuple[Landmark, ...]
    numbers: tuple[int, ...]
    where: Named
    should: Named
    notes: tuple[str, ...] = ()

    def refuse_void(
        self, tissue: npt.NDArray[np.bool_], spacing: tuple[float, float], named: Named
    ) -> None:
        """Refuse a landmark with no tissue to go with it.

        Parameters
        ----------
        tissue : ndarray of bool, shape (H, W)
        spacing : (float, float)
        named : Named
            Of the tissue.

        Raises
        ------
        ProblemError
            Naming the layer and the point.
        """
        rows, cols = tissue.shape
        for mark, number in zip(self.marks, self.numbers, strict=True):
            reach = [max(1, math.ceil(mark.radius / size)) for size in spacing]
            (row, col), (down, along) = (round(at) for at in mark.source), reach
            around = (row - down, row + down + 1, col - along, col + along + 1)
            box = common(around, (0, rows, 0, cols))
            near = distance_to(((mark.source,),), mark.radius, spacing, box)
            # However small the patch, the nearest pixel counts.
            patch = near <= max(mark.radius, float(near.min()))
            if not (patch & tissue[box[0] : box[1], box[2] : box[3]]).any():
                raise LayerError(
                    self.where,
                    f"has point {number} where there is no tissue (stiffness 0 in "
                    f"'{named.name}'). Move it onto tissue, or remove it and its partner.",
                )


def usual_radius(shape: Sequence[int], spacing: Sequence[float]) -> float:
    """A radius to take hold of tissue with, in the unit of the spacing.

    Parameters
    ----------
    shape : sequence of int, shape (2,)
        Of the image.
    spacing : sequence of float, shape (2,)
        Size of a pixel.
    """
    shorter = min(size * step for size, step in zip(shape, spacing, strict=True))
    return float(f"{shorter / 16:.2g}")


def landmarks_of(
    where: Any,
    should: Any,
    frame: Frame,
    shape: tuple[int, int],
    radius: float,
    confidence: float = 1.0,
) -> tuple[Landmark, ...]:
    """Pair the points of two layers by their order; as the marks of `read_landmarks`."""
    return read_landmarks(LandmarkLayers(where, should, radius, confidence), frame, shape).marks


def read_landmarks(
    layers: LandmarkLayers, frame: Frame, shape: tuple[int, int], view: View | None = None
) -> Landmarks:
    """Pair the points of two layers by their order, as they lie in the world.

    Parameters
    ----------
    layers : LandmarkLayers
        Of a stack, the pairs of other slices do not count; points without an axis lie on each of
        its slices.
    frame : Frame
        The slice of the image.
    shape : (int, int)
        Of the image.
    view : View, optional
        What is shown, for points with more axes than the image: those of other slices do not
        count then.

    Returns
    -------
    Landmarks

    Raises
    ------
    ProblemError
        Naming the layer: if the layers do not hold as many points, or none, or a point cannot be
        placed, lies outside the image, or contradicts another.
    """
    where, should = layers.where, layers.should
    if where is should:
        raise LayerError(
            where, "cannot be both where things are and where they should be. Choose two layers."
        )
    count, other = len(where.data), len(should.data)
    if count != other:
        raise LayerError(
            should,
            f"has {_points(other)}, but '{where.name}' has {count}: they are paired by their "
            "order. Add or remove some.",
        )
    if not count:
        raise LayerError(where, "has no points. Add some, and as many to the other layer.")
    sources, targets = (_pixels(layer, frame) for layer in (where, should))
    here, there = (
        _on_slice(layer, places, frame, view)
        for layer, places in ((where, sources), (should, targets))
    )
    numbers = np.flatnonzero(here)
    if not len(numbers):
        slice_name = f" ({frame.slice_name})" if frame.slice_name else ""
        raise LayerError(where, f"has no points on this slice{slice_name}. Move to one.")
    if not there[here].all():
        raise LayerError(
            should,
            f"has point {numbers[~there[here]][0]} on another slice than '{where.name}': tissue "
            "moves within a slice. Move the point, or remove both.",
        )
    at, to = (places[here][:, list(frame.plane)] for places in (sources, targets))
    outside = np.flatnonzero(_outside(at, shape))
    if len(outside):
        raise LayerError(
            where, f"has point {numbers[outside[0]]} outside the image. Move it, or remove it."
        )
    _refuse_contradiction(where, at, to, numbers)
    beyond = numbers[_outside(to, shape)]
    notes = (f"point {beyond[0]} of '{should.name}' lies outside the image" if len(beyond) else "",)
    radii = _radii(at, layers.radius, frame, shape)
    with naming(y=where, c=where):
        marks = tuple(
            Landmark((a[0], a[1]), (b[0], b[1]), size, layers.confidence)
            for a, b, size in zip(at.tolist(), to.tolist(), radii, strict=True)
        )
    return Landmarks(
        marks=marks,
        numbers=tuple(numbers.tolist()),
        where=Named.of(where),
        should=Named.of(should),
        notes=tuple(note for note in notes if note),
    )


def _points(count: int) -> str:
    return "1 point" if count == 1 else f"{count} points"


def _outside(places: FloatArray, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return np.asarray(((places < -0.5) | (places > np.array(shape) - 0.5)).any(axis=1))


def _on_slice(
    layer: Any, places: FloatArray, frame: Frame, view: View | None
) -> npt.NDArray[np.bool_]:
    """Which points lie on the slice of the image; and on that shown, on axes it has not."""
    others = [axis for axis in range(frame.ndim) if axis not in frame.plane]
    here: npt.NDArray[np.bool_]
    here = (np.rint(places[:, others]) == np.array(frame.index)[others]).all(axis=1)
    extra = layer.ndim - frame.ndim
    if extra > 0 and view is not None:
        own = np.asarray(layer.data, dtype=float)[:, :extra]
        here = here & (np.rint(own) == np.array(Frame.of(layer, view).index)[:extra]).all(axis=1)
    return here


def _refuse_contradiction(
    where: Any, at: FloatArray, to: FloatArray, numbers: npt.NDArray[np.intp]
) -> None:
    """Refuse points of one pixel that should go to different places."""
    first: dict[tuple[float, ...], int] = {}
    for each, pixel in enumerate(np.rint(at).tolist()):
        earlier = first.setdefault(tuple(pixel), each)
        if not np.allclose(to[each] - at[each], to[earlier] - at[earlier], atol=1e-3):
            raise LayerError(
                where,
                f"has points {numbers[earlier]} and {numbers[each]} in one pixel, which should go "
                "to different places. Remove one of them, and its partner.",
            )


def _radii(
    at: FloatArray, radius: float | None, frame: Frame, shape: tuple[int, int]
) -> list[float]:
    """The radius of each patch; where points are close, half of the way to the next one.

    Of two patches that overlap the later would win, and the earlier point not go where it should.
    """
    wanted = usual_radius(shape, frame.spacing) if radius is None else radius
    if len(at) == 1:
        return [wanted]
    lengths = at * frame.spacing
    away = KDTree(lengths).query(lengths, k=2)[0][:, 1]
    return [min(wanted, half) if half > 0 else wanted for half in (away / 2).tolist()]


def _pixels(layer: Any, frame: Frame) -> FloatArray:
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
    placed: FloatArray = np.linalg.solve(
        matrix, np.concatenate([world, np.ones((len(world), 1))], axis=1).T
    ).T[:, :-1]
    return placed
