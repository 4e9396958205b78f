"""Landmarks from layers of points or lines: where things are, and where they should be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from napari_hmrf.layers.landmark_ends import Ends, ends_of
from napari_hmrf.layers.layer_names import LayerError, Named, naming
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View
from napari_hmrf.tissue.drawing import Landmark
from napari_hmrf.tissue.drawing.canvas import common, distance_to

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkLayers:
    """Two layers whose points are pairs, by their order, or one of lines; and what goes with each.

    Attributes
    ----------
    where : napari.layers.Points or napari.layers.Shapes
        Where things are; or lines and paths that begin there, and end where they should be.
    should : napari.layers.Points, optional
        Where they should be; none beside lines.
    radius : float, optional
        Of the patch of tissue that goes with each landmark, in the unit of the image; by default
        `usual_radius`. Patches that would overlap are made smaller.
    confidence : float
        How sure that is, from above 0 to 1 (certain).
    """

    where: Any
    should: Any = None
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
    layer : Named
        Of where things are.
    what : {"point", "line"}
        What they were made from.
    notes : tuple of str
        What the user should know about them.
    """

    marks: tuple[Landmark, ...]
    numbers: tuple[int, ...]
    layer: Named
    what: str = "point"
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
                begins, partner = (
                    (", which begins", "") if self.what == "line" else ("", " and its partner")
                )
                raise LayerError(
                    self.layer,
                    f"has {self.what} {number}{begins} where there is no tissue (stiffness 0 in "
                    f"'{named.name}'). Move it onto tissue, or remove it{partner}.",
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


def usual_step(shape: Sequence[int], spacing: Sequence[float]) -> float:
    """How far tissue is pushed to begin with: enough to be seen. As `usual_radius`."""
    return float(f"{0.02 * max(shape) * min(spacing):.1g}")


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
    """Pair the points of two layers by their order, or the ends of lines, as they lie in the world.

    Parameters
    ----------
    layers : LandmarkLayers
        Of a stack, the pairs of other slices do not count; those without an axis lie on each of
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
        Naming the layer: if the layers do not hold as many points, or none, or a shape is no line,
        or a landmark cannot be placed, lies outside the image, or contradicts another.
    """
    where, should = ends = ends_of(layers.where, layers.should)
    what = where.what
    sources, targets = (each.in_pixels(frame) for each in ends)
    here, there = (
        each.on_slice(places, frame, view)
        for each, places in zip(ends, (sources, targets), strict=True)
    )
    numbers = np.flatnonzero(here)
    if not len(numbers):
        here_said = frame.slice_said or "this slice"
        raise LayerError(where.layer, f"has no {what}s on {here_said}. Go to one that has.")
    if not there[here].all():
        leaves = numbers[~there[here]][0]
        raise LayerError(
            should.layer,
            f"has line {leaves}, which ends on another slice: tissue moves within a slice. Remove "
            "it."
            if should.layer is where.layer
            else f"has point {leaves} on another slice than '{where.layer.name}': tissue moves "
            "within a slice. Move the point, or remove both.",
        )
    at, to = (places[here][:, list(frame.plane)] for places in (sources, targets))
    outside = np.flatnonzero(_outside(at, shape))
    if len(outside):
        raise LayerError(
            where.layer,
            f"has {what} {numbers[outside[0]]}{', which begins' if what == 'line' else ''} outside "
            "the image. Move it, or remove it.",
        )
    _refuse_contradiction(where, at, to, numbers)
    beyond = [
        f"{what} {number} of '{should.layer.name}' {'ends' if what == 'line' else 'lies'} outside "
        "the image"
        for number in numbers[_outside(to, shape)]
    ]
    radii = _radii(at, layers.radius, frame, shape)
    with naming(observed=where.layer, confidence=where.layer):
        marks = tuple(
            Landmark((a[0], a[1]), (b[0], b[1]), size, layers.confidence)
            for a, b, size in zip(at.tolist(), to.tolist(), radii, strict=True)
        )
    return Landmarks(
        marks=marks,
        numbers=tuple(numbers.tolist()),
        layer=Named.of(where.layer),
        what=what,
        notes=tuple(beyond[:1]),
    )


def _outside(places: FloatArray, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    return np.asarray(((places < -0.5) | (places > np.array(shape) - 0.5)).any(axis=1))


def _refuse_contradiction(
    where: Ends, at: FloatArray, to: FloatArray, numbers: npt.NDArray[np.intp]
) -> None:
    """Refuse landmarks of one pixel that should go to different places."""
    first: dict[tuple[float, ...], int] = {}
    for each, pixel in enumerate(np.rint(at).tolist()):
        earlier = first.setdefault(tuple(pixel), each)
        if not np.allclose(to[each] - at[each], to[earlier] - at[earlier], atol=1e-3):
            raise LayerError(
                where.layer,
                f"has lines {numbers[earlier]} and {numbers[each]}, which begin in one pixel "
                "and lead to different places. Remove one of them."
                if where.what == "line"
                else f"has points {numbers[earlier]} and {numbers[each]} in one pixel, which "
                "should go to different places. Remove one of them, and its partner.",
            )


def _radii(
    at: FloatArray, radius: float | None, frame: Frame, shape: tuple[int, int]
) -> list[float]:
    """The radius of each patch; where points are close, half of the way to the next one.

    Of two patches that overlap the later would win, and the earlier point not go where it should.
    """
    wanted = usual_radius(shape, frame.spacing) if radius is None else radius
    # Those of one pixel lead to one place: they are one patch, and not in each other's way.
    _, first, which = np.unique(np.rint(at), axis=0, return_index=True, return_inverse=True)
    if len(first) == 1:
        return [wanted] * len(at)
    lengths = at[first] * frame.spacing
    away = KDTree(lengths).query(lengths, k=2)[0][:, 1]
    return [min(wanted, half) for half in (away / 2)[which.reshape(-1)].tolist()]
