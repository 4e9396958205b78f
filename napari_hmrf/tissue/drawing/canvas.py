"""Conversion of marks to boundary conditions: images of a problem, and functions that draw marks.

This package calls these images a canvas. They are unrelated to the canvas of napari.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

from napari_hmrf.tissue.drawing.marks import (
    COMPONENTS,
    Action,
    Arrow,
    Landmark,
    Mark,
    Point,
    Stroke,
    grows,
    is_painted,
)
from napari_hmrf.tissue.normals import outward_normals

FloatArray = npt.NDArray[np.float32]
#: Box of an image, one slice per axis; an empty box has slices of length 0.
Box = tuple[slice, ...]

#: Value of each stroke action in `Canvas.kinds`. Painted tissue is stored in the labels instead.
KINDS: dict[Action, int] = {
    "pin": 1,
    "free": 2,
    "move": 3,
    "expand": 4,
    "confidence": 5,
    "slide": 6,
    "remove": 7,
}

#: Label of the surfaces that strokes paint; labels of boundary rules are above 0.
STROKES_SLIDE = -1


@dataclass(frozen=True, eq=False)
class Canvas:
    """Images of a problem on which marks are drawn; not the canvas of napari.

    In these images, marks become the boundary conditions of the tissue: `observed` and `confidence`
    are the arguments of `Problem` with the same names.

    Attributes
    ----------
    observed : ndarray, shape ([D,] H, W, n), float32
        Observed material displacement along each axis, in the unit of `spacing`. Where tissue
        slides, the first component is the displacement along the outward normal of the surface.
    confidence : ndarray, shape ([D,] H, W, n), float32
        Confidence of each component, from 0 to 1.
    labels : ndarray of int, shape ([D,] H, W)
        Tissue labels, for strokes that paint tissue.
    kinds : ndarray of uint8, shape ([D,] H, W)
        Value in `KINDS` of the last painted action, for display only; 0 in unpainted pixels.
        Painted confidence does not change this value.
    spacing : tuple of float, shape (n,)
        Size of a pixel along each axis.
    slides : ndarray of int, shape ([D,] H, W)
        Labels of the paint along which tissue slides: the label of a boundary rule, or
        `STROKES_SLIDE` under strokes; 0 elsewhere. The sites and their normals are known only with
        the stiffness; see `sliding_surface`.
    surroundings : ndarray of bool, shape ([D,] H, W), optional
        Mask of void and dark surroundings; growing patches do not extend into them.
    removed : ndarray of bool, shape ([D,] H, W)
        Mask of the paint that removes tissue.
    marked : ndarray of bool, shape ([D,] H, W)
        Mask of the marks that prescribe or free motion.
    edge : ndarray of bool, shape ([D,] H, W)
        Mask of the outer edge of the tissue, if it is held without paint; see `Arrow.slack`.
    """

    observed: FloatArray
    confidence: FloatArray
    labels: npt.NDArray[Any]
    kinds: npt.NDArray[np.uint8]
    spacing: tuple[float, ...]
    slides: npt.NDArray[np.int32]
    removed: npt.NDArray[np.bool_]
    marked: npt.NDArray[np.bool_]
    edge: npt.NDArray[np.bool_]
    surroundings: npt.NDArray[np.bool_] | None = None

    @classmethod
    def blank(
        cls,
        shape: Sequence[int],
        spacing: Sequence[float] | None = None,
        labels: npt.NDArray[Any] | None = None,
    ) -> Canvas:
        """Create a canvas without observations; if `labels` is None, there is a single tissue."""
        n = len(shape)
        y, kinds = np.zeros((*shape, n), dtype=np.float32), np.zeros(shape, dtype=np.uint8)
        tissue = kinds.copy() if labels is None else labels
        sizes = (1.0,) * n if spacing is None else tuple(map(float, spacing))
        slides = np.zeros(shape, dtype=np.int32)
        removed, marked, edge = (np.zeros(shape, dtype=bool) for _ in range(3))
        return cls(y, y.copy(), tissue, kinds, sizes, slides, removed, marked, edge)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of pixels along each axis."""
        return self.kinds.shape

    @property
    def whole(self) -> Box:
        """Box of all pixels."""
        return tuple(slice(0, size) for size in self.shape)

    @property
    def images(self) -> tuple[npt.NDArray[Any], ...]:
        """Tuple of the images that marks change."""
        motion = self.observed, self.confidence
        return *motion, self.labels, self.kinds, self.slides, self.removed, self.marked

    def copy(self) -> Canvas:
        """Return a deep copy."""
        return deepcopy(self)


def box_of(mark: Mark, spacing: Sequence[float], whole: Box) -> Box:
    """Return the box of pixels that a mark covers; empty if the mark is outside `whole`."""
    reach = [brush_reach(mark.radius, spacing) / size for size in spacing]
    points = np.array([point for line in mark.lines for point in line])
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    if _moves_its_corners(mark):
        low = np.minimum(low, np.floor(mark.source))
        high = np.maximum(high, np.ceil(mark.source))
    sides = []
    for first, last, side in zip(low, high, whole, strict=True):
        begin = max(math.ceil(first), side.start)
        sides.append(slice(begin, max(begin, min(math.floor(last) + 1, side.stop))))
    return tuple(sides)


def is_empty(box: Box) -> bool:
    """Return whether a box contains no pixels."""
    return any(side.start >= side.stop for side in box)


def paint(mark: Mark, canvas: Canvas, window: Box) -> None:
    """Draw a mark on the canvas in place, without changing pixels outside the window.

    Here a mark becomes a boundary condition: its displacement is written to `canvas.observed`, and
    its confidence to `canvas.confidence`. `Ground.statement` passes both images to `Problem`. A
    landmark with a standard deviation is not painted.

    Parameters
    ----------
    mark : Mark
    canvas : Canvas
        Images, modified in place.
    window : Box
        Pixels that may change.

    Raises
    ------
    ProblemError
        If a mark that grows is an open line.
    """
    _free_edge(mark, canvas, window)
    box = box_of(mark, canvas.spacing, window)
    if is_empty(box) or not is_painted(mark):
        return
    point = mark.source if _moves_its_corners(mark) else None
    if isinstance(mark, Landmark):
        mark = mark.arrow(canvas.spacing)
    distance = distance_to(mark.lines, mark.radius, canvas.spacing, box)
    reach = brush_reach(mark.radius, canvas.spacing)
    where = distance <= reach
    if point is not None:
        where |= _free_corners(point, canvas, box)
    components = COMPONENTS[mark.components]
    y, c = canvas.observed[box][..., components], canvas.confidence[box][..., components]
    if isinstance(mark, Arrow) or mark.action not in ("confidence", "tissue", "remove"):
        _stop_sliding(canvas, box, where)
        canvas.marked[box] |= where
    if grows(mark):
        normals, region = _outward_in_tissue(mark, canvas)
        sides = zip(box, region, strict=True)
        at = tuple(slice(side.start - of.start, side.stop - of.start) for side, of in sides)
        moves = normals[at][where]
        # The interior of a patch is free, even where earlier marks prescribe a displacement.
        is_prescribed = moves.any(axis=-1, keepdims=True)
        y[where] = np.float32(mark.amount) * moves[:, components]
        if isinstance(mark, Arrow) or mark.action == "move":
            y[where] += is_prescribed * _steps(mark, box, where)[:, components]
        c[where] = mark.confidence * is_prescribed
        if isinstance(mark, Arrow):  # the centre moves as far as without growth
            middle = [round(x) - side.start for x, side in zip(mark.at, box, strict=True)]
            centre = tuple(slice(max(x, 0), max(x + 1, 0)) for x in middle)
            y[centre], c[centre] = mark.by[components], mark.confidence
    elif isinstance(mark, Arrow) or mark.action == "move":
        y[where], c[where] = _steps(mark, box, where)[:, components], mark.confidence
    elif mark.action == "pin":
        y[where], c[where] = 0, mark.confidence
    elif mark.action == "free":
        y[where], c[where] = 0, 0
    elif mark.action == "remove":
        canvas.removed[box][where] = True
    elif mark.action == "slide":
        y[where], c[where] = 0, 0
        canvas.observed[box][where, 0] = mark.amount
        canvas.slides[box][where] = STROKES_SLIDE
    elif mark.action == "confidence":
        soft = mark.softness * reach
        share = np.clip((reach - distance) / soft, 0, 1) if soft > 0 else np.ones_like(distance)
        share = np.where(where, share, 0)[..., None] * (c > 0)
        c += share * (np.float32(mark.confidence) - c)
    else:
        canvas.labels[box][where] = mark.label
        canvas.kinds[box][where & canvas.removed[box]] = 0
        canvas.removed[box][where] = False
        return
    kinds = canvas.kinds[box]
    if isinstance(mark, Arrow):
        kinds[where] = 0
    elif mark.action != "confidence":  # confidence does not change the kind
        kinds[where] = KINDS[mark.action]


def with_surroundings(mark: Mark, canvas: Canvas) -> Mark:
    """Return a mark that covers all pixels that the given mark may change.

    An arrow that takes part of the held outer edge along frees the edge around it.
    """
    if not (isinstance(mark, Arrow) and mark.slack > 0 and mark.motion is None and any(mark.by)):
        return mark
    patch = box_of(mark, canvas.spacing, canvas.whole)
    if is_empty(patch) or not (canvas.edge[patch] & covered(mark, canvas.spacing, patch)).any():
        return mark
    return replace(mark, radius=mark.radius * (1 + mark.slack), slack=0.0)


def _free_edge(mark: Mark, canvas: Canvas, window: Box) -> None:
    """Free the outer edge around an arrow that takes part of it along, but not under marks."""
    around = with_surroundings(mark, canvas)
    box = box_of(around, canvas.spacing, window)
    if around is not mark and not is_empty(box):
        free = covered(around, canvas.spacing, box) & canvas.edge[box] & ~canvas.marked[box]
        canvas.confidence[box][free] = 0


def _moves_its_corners(mark: Mark) -> TypeGuard[Landmark]:
    """Return whether a mark moves all pixels around its point by the same displacement."""
    return isinstance(mark, Landmark) and mark.motion is None and not grows(mark)


def _free_corners(point: Point, canvas: Canvas, box: Box) -> npt.NDArray[np.bool_]:
    """Return a mask of the pixels between which a point lies, without those that a mark holds.

    If these pixels move with a landmark, so does the point between them, also where its patch is
    smaller than the distance of the slices.
    """
    corners = np.zeros([side.stop - side.start for side in box], np.bool_)
    ends = [
        [at - side.start for at in {math.floor(x), math.ceil(x)} if side.start <= at < side.stop]
        for x, side in zip(point, box, strict=True)
    ]
    corners[np.ix_(*ends)] = True
    is_held = (canvas.confidence[box] > 0).any(axis=-1) | (canvas.slides[box] != 0)
    free: npt.NDArray[np.bool_] = corners & ~is_held
    return free


def _steps(mark: Arrow | Stroke, box: Box, where: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the displacement of each pixel of a mask in a box, without the growth of the mark."""
    if mark.motion is None:
        return np.asarray(mark.by, dtype=np.float32)[np.newaxis]
    return mark.motion.on(box)[where].astype(np.float32)


def _stop_sliding(canvas: Canvas, box: Box, where: npt.NDArray[np.bool_]) -> None:
    """Remove the sliding surface under a mark that determines the motion of tissue."""
    slides = canvas.slides[box]
    canvas.observed[box][where & (slides != 0)] = 0
    slides[where] = 0


def rim_of(
    mark: Mark, spacing: tuple[float, ...], shape: tuple[int, ...]
) -> tuple[npt.NDArray[np.bool_], Box]:
    """Return a mask of the pixels that move outward if a mark grows, and the box of the mask.

    Raises
    ------
    ProblemError
        If the mark is an open line, which has no interior.
    """
    normals, box = _outward(_outline(mark), spacing, shape)
    rim: npt.NDArray[np.bool_] = np.asarray(normals.any(axis=-1))
    return rim, box


def _outward_in_tissue(mark: Mark, canvas: Canvas) -> tuple[FloatArray, Box]:
    """Return the outward normals of a growing mark without its surroundings, and their box.

    Tissue at the surface then moves outward with the rest of the patch.
    """
    if canvas.surroundings is not None:
        box = box_of(mark, canvas.spacing, canvas.whole)
        inside = covered(_outline(mark), canvas.spacing, box)
        inner = inside & ~canvas.surroundings[box]
        if inner.any() and not np.array_equal(inner, inside):
            normals = outward_normals(np.pad(inner, 1), canvas.spacing, "a brush stroke")
            return normals[(slice(1, -1),) * inner.ndim], box
    return _outward(_outline(mark), canvas.spacing, canvas.shape)


def covered(mark: Mark, spacing: Sequence[float], box: Box) -> npt.NDArray[np.bool_]:
    """Return a mask of the pixels of a box that a mark covers."""
    reach = brush_reach(mark.radius, spacing)
    return distance_to(mark.lines, mark.radius, spacing, box) <= reach


def covers(mark: Mark, point: Point, spacing: Sequence[float]) -> bool:
    """Return whether a mark covers a position, given in pixels."""
    lines = [np.array(line) - point for line in mark.lines]
    pixel = distance_to(lines, mark.radius, spacing, (slice(0, 1),) * len(point))
    return bool(pixel.item() <= mark.radius)


def distance_to(
    lines: Iterable[npt.ArrayLike],
    radius: float,
    spacing: Sequence[float],
    window: Box,
) -> FloatArray:
    """Compute the distance from each pixel of a window to the nearest line.

    Only the parts of the lines near the window are evaluated.

    Parameters
    ----------
    lines : iterable of array_like, shape (N, n)
        Points of each line, in pixels.
    radius : float
        Distance up to which the result is required, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    window : Box
        Pixels for which the distance is computed.

    Returns
    -------
    ndarray, shape of the window, float32
        Distances in the unit of `spacing`; infinite at pixels far beyond the radius.
    """
    begin, end = ([getattr(side, at) for side in window] for at in ("start", "stop"))
    nearest = np.full(np.subtract(end, begin), np.inf, dtype=np.float32)
    size = np.array(spacing)
    reach = brush_reach(radius, spacing) / size + 1
    for line in lines:
        points = np.asarray(line)
        starts, ends = (points[:-1], points[1:]) if len(points) > 1 else (points, points)
        low = np.ceil(np.minimum(starts, ends) - reach).astype(np.int64)
        high = np.floor(np.maximum(starts, ends) + reach).astype(np.int64) + 1
        low, high = np.maximum(low, begin), np.minimum(high, end)
        for number in np.flatnonzero((low < high).all(axis=1)):
            a, step = starts[number] * size, (ends[number] - starts[number]) * size
            sides = [np.arange(*span) for span in zip(low[number], high[number], strict=True)]
            away = [side * s - at for side, s, at in zip(np.ix_(*sides), size, a, strict=True)]
            squared = float(step @ step)
            if squared > 0:
                on = sum((x * s for x, s in zip(away, step, strict=True)), np.zeros(()))
                along = np.clip(on / squared, 0, 1)
                away = [x - along * s for x, s in zip(away, step, strict=True)]
            far = np.sqrt(sum((x**2 for x in away), np.zeros(())))
            spans = zip(low[number] - begin, high[number] - begin, strict=True)
            part = nearest[tuple(slice(*span) for span in spans)]
            np.minimum(part, far, out=part, casting="same_kind")
    return nearest


def brush_reach(radius: float, spacing: Sequence[float]) -> float:
    """Return the radius of a brush, enlarged so that at least one pixel centre is covered."""
    return max(radius, 0.5 * math.hypot(*spacing)) * (1 + 1e-6)


def _outline(mark: Mark) -> Stroke:
    """Return the region of a mark as a stroke that does not depend on the motion of the mark."""
    return Stroke("expand", mark.lines, mark.radius)


@lru_cache(maxsize=8)
def _outward(
    stroke: Stroke, spacing: tuple[float, ...], shape: tuple[int, ...]
) -> tuple[FloatArray, Box]:
    """Return the outward normals of the region that a stroke covers, and the box of the region."""
    # The region may extend beyond the image, so extend the box by one image size on each side.
    box = box_of(stroke, spacing, tuple(slice(-size, 2 * size) for size in shape))
    normals = outward_normals(covered(stroke, spacing, box), spacing, "a brush stroke")
    normals.setflags(write=False)
    return normals, box
