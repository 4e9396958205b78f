"""Drawing: marks in the order of their creation, and their rendering on top of images."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter, ValidationError

from napari_hmrf.archive import STORED, ByClass, first_fault
from napari_hmrf.arguments import tuple_of
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.tissue.drawing.canvas import (
    Box,
    Canvas,
    box_of,
    covers,
    is_empty,
    paint,
    with_surroundings,
)
from napari_hmrf.tissue.drawing.marks import (
    Arrow,
    Landmark,
    Mark,
    Point,
    Stroke,
    between,
    grows,
    is_painted,
)


class Hit(NamedTuple):
    """Mark found at a position: its index in the drawing, and the end that was hit."""

    number: int
    part: Literal["head", "base"]


@dataclass(frozen=True)
class Drawing:
    """Immutable sequence of marks drawn on an image; an edit returns a new drawing.

    Attributes
    ----------
    marks : tuple of Arrow, Landmark or Stroke
        Marks in the order of their creation. Where marks overlap, later marks take precedence.

    Raises
    ------
    ArgumentError
        If `marks` is not a tuple or list of marks.
    """

    __pydantic_config__ = STORED

    marks: tuple[Annotated[Mark, ByClass()], ...] = ()

    def __post_init__(self) -> None:
        marks = tuple_of(Mark, "marks", self.marks, "Drawing((Arrow(...),))")
        object.__setattr__(self, "marks", marks)

    def __repr__(self) -> str:
        kinds = Counter(type(mark).__name__ for mark in self.marks)
        return f"Drawing({', '.join(f'{n} {kind}' for kind, n in kinds.items()) or 'empty'})"

    @classmethod
    def from_landmarks(
        cls,
        source: npt.ArrayLike,
        target: npt.ArrayLike,
        *,
        radius: npt.ArrayLike,
        confidence: float = 1.0,
        shape: Sequence[int] | None = None,
        sd: npt.ArrayLike | None = None,
    ) -> Drawing:
        """Create a drawing from pairs of landmarks.

        Parameters
        ----------
        source, target : array_like, shape (N, 2) or (N, 3)
            Positions of tissue before and after the motion, (row, col) or (plane, row, col) in
            pixels; `Grid.to_pixels` converts positions in mm from landmark files.
        radius : float or array_like, shape (N,)
            Radius of the patch that moves with each landmark, in the unit of the pixel spacing.
            Where patches overlap, the later landmark determines the motion.
        confidence : float
            Confidence in each pair, above 0 and up to 1 (certain).
        shape : sequence of int, optional
            Shape of the image. If given, sources outside the image raise an error; otherwise
            `solve_study` reports them in a note.
        sd : float or array_like, shape (N,), optional
            Standard deviation of the difference between target and source, for all pairs or for
            each pair, in the unit of the pixel spacing. At 0, the default, a pair is exact. Above
            0, which requires the elastic model, `radius` and `confidence` have no effect.

        Returns
        -------
        Drawing

        Raises
        ------
        ProblemError
            If there are no pairs, if sources and targets differ in number, if a value is NaN or
            infinite, if a standard deviation is negative, if two sources of exact pairs are in the
            same pixel, or if a source is outside the image.
        """
        sources, targets = _points("source", source), _points("target", target)
        if sources.shape != targets.shape:
            raise ProblemError(
                "landmarks",
                f"have sources of shape {sources.shape} and targets of shape {targets.shape}. Pass "
                "a target for each source.",
            )
        spreads, radii = _spreads(sd, len(sources)), _of_pairs("radius", radius, len(sources))
        exact = np.rint(sources[spreads == 0])
        pixels, counts = np.unique(exact, axis=0, return_counts=True)
        if counts.max(initial=0) > 1:
            twice = tuple(pixels[counts.argmax()].astype(int).tolist())
            raise ProblemError(
                "landmarks", f"have two sources in the pixel {twice}. Keep one for each pixel."
            )
        if shape is not None:
            if len(shape) != sources.shape[1]:
                raise ProblemError(
                    "landmarks",
                    f"have {sources.shape[1]} coordinates each, but the image has {len(shape)} "
                    "axes. Pass a coordinate for each axis.",
                )
            last = np.array(shape) - 0.5
            outside = ((sources < -0.5) | (sources > last)).any(axis=1)
            if outside.any():
                first = int(np.flatnonzero(outside)[0])
                raise ProblemError(
                    "landmarks",
                    f"have {int(outside.sum())} of {len(sources)} sources outside the image, the "
                    f"first being number {first} at {tuple(sources[first].tolist())}. Pass pixel "
                    "positions, (row, col) or (plane, row, col), and remove the pairs outside.",
                )
        columns = (each.tolist() for each in (sources, targets, radii, spreads))
        return cls(
            tuple(
                Landmark(tuple(at), tuple(to), size, confidence, sd=spread)
                for at, to, size, spread in zip(*columns, strict=True)
            )
        )

    def with_mark(self, mark: Mark) -> Drawing:
        """Return the drawing with a mark added at the end."""
        return Drawing((*self.marks, mark))

    def replaced(self, number: int, mark: Mark) -> Drawing:
        """Return the drawing with one mark replaced.

        Raises
        ------
        IndexError
            If there is no mark with this index.
        """
        self._check(number)
        return Drawing((*self.marks[:number], mark, *self.marks[number + 1 :]))

    def without(self, number: int) -> Drawing:
        """Return the drawing without one of its marks.

        Raises
        ------
        IndexError
            If there is no mark with this index.
        """
        self._check(number)
        return Drawing((*self.marks[:number], *self.marks[number + 1 :]))

    def at(self, point: Point, reach: float, spacing: Sequence[float]) -> Hit | None:
        """Find the end of an arrow or a landmark near a position.

        Parameters
        ----------
        point : tuple of float
            Position, (row, col) or (plane, row, col) in pixels.
        reach : float
            Largest distance of a hit, in the unit of `spacing`.
        spacing : sequence of float
            Size of a pixel along each axis.

        Returns
        -------
        Hit or None
            Nearest end, or None if there is no end within `reach`. At equal distances, heads take
            precedence over bases, and later marks over earlier marks.
        """
        ends = (
            (math.hypot(*between(point, end, spacing)), order, -number)
            for number, mark in enumerate(self.marks)
            for order, end in enumerate(ends_of(mark, spacing))
        )
        away, order, number = min(ends, default=(math.inf, 0, 0))
        return Hit(-number, "base" if order else "head") if away <= reach else None

    def painted_at(self, point: Point, spacing: Sequence[float]) -> int | None:
        """Find the last stroke that covers a position.

        Parameters
        ----------
        point : tuple of float
            Position, (row, col) or (plane, row, col) in pixels.
        spacing : sequence of float
            Size of a pixel along each axis.

        Returns
        -------
        int or None
            Index of the stroke, or None if no stroke covers the position.
        """
        for number in reversed(range(len(self.marks))):
            mark = self.marks[number]
            if isinstance(mark, Stroke) and covers(mark, point, spacing):
                return number
        return None

    def render(self, base: Canvas) -> Canvas:
        """Draw all marks on a copy of the images.

        For repeated edits, such as a drag, `Rendering` draws the same images faster.

        Parameters
        ----------
        base : Canvas
            Observations and tissues without the drawing.

        Returns
        -------
        Canvas
            New images with the drawing.

        Raises
        ------
        ProblemError
            If an expanding stroke is an open line.
        """
        canvas = base.copy()
        for mark in self.marks:
            paint(mark, canvas, canvas.whole)
        return canvas

    def as_dict(self) -> dict[str, Any]:
        """Return the drawing as a dictionary of JSON types and, for held patches, arrays."""
        return dict(_STORED.dump_python(self))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Drawing:
        """Create a drawing from a dictionary that `as_dict` returned.

        Raises
        ------
        ValueError
            If the dictionary is not from `as_dict`.
        """
        try:
            return _STORED.validate_python(values)
        except ValidationError as error:
            raise ValueError(f"not a drawing: {first_fault(error)}") from None

    def _check(self, number: int) -> None:
        if not 0 <= number < len(self.marks):
            raise IndexError(f"there is no mark {number}: the drawing has {len(self.marks)}")


#: Validator of drawings that are stored.
_STORED = TypeAdapter(Drawing)


class Rendering:
    """Rendering of a drawing on images; an edit redraws only pixels that may have changed.

    `Engine` uses a rendering for all solves of the window. Its images equal those of
    `Drawing.render`.

    Parameters
    ----------
    base : Canvas
        Images without the drawing; must not be modified while the rendering is used.

    Attributes
    ----------
    base : Canvas
    canvas : Canvas
        Images with the drawing; updated in place.
    drawing : Drawing
        The current drawing.
    """

    def __init__(self, base: Canvas) -> None:
        self.base = base
        self.canvas = base.copy()
        self.drawing = Drawing()

    def show(self, drawing: Drawing) -> Box | None:
        """Update the images to another drawing.

        Parameters
        ----------
        drawing : Drawing

        Returns
        -------
        Box or None
            Box of the pixels that may have changed; None if no pixel has changed.

        Raises
        ------
        ProblemError
            As for `Drawing.render`; the images then still show the previous drawing.
        """
        window = self._changed(drawing)
        if window is not None:
            try:
                self._redraw(drawing, window)
            except Exception:
                self._redraw(self.drawing, window)
                raise
        self.drawing = drawing
        return window

    def _redraw(self, drawing: Drawing, window: Box) -> None:
        base, canvas = self.base, self.canvas
        for image, beneath in zip(canvas.images, base.images, strict=True):
            image[window] = beneath[window]
        for mark in drawing.marks:
            paint(mark, canvas, window)

    def _changed(self, drawing: Drawing) -> Box | None:
        """Return the box of all marks that differ between the current and another drawing."""
        canvas, pairs = self.canvas, zip_longest(self.drawing.marks, drawing.marks)
        marks = [mark for pair in pairs if pair[0] != pair[1] for mark in _differing(*pair)]
        marks = [with_surroundings(mark, canvas) for mark in marks if is_painted(mark)]
        boxes = [box_of(mark, canvas.spacing, canvas.whole) for mark in marks]
        boxes = [box for box in boxes if not is_empty(box)]
        if not boxes:
            return None
        return tuple(
            slice(min(side.start for side in sides), max(side.stop for side in sides))
            for sides in zip(*boxes, strict=True)
        )


def _points(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return points as an array of shape (N, 2) or (N, 3); raise an error if they are invalid."""
    points = as_numbers("landmarks", values).astype(np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
        raise ProblemError(
            "landmarks",
            f"have a {name} of shape {points.shape}. Pass (N, 2) or (N, 3).",
        )
    if not np.isfinite(points).all():
        raise ProblemError("landmarks", f"have a {name} that is NaN or infinite. Remove that pair.")
    return points


def _spreads(sd: npt.ArrayLike | None, count: int) -> npt.NDArray[np.float64]:
    """Return the standard deviation of each pair; raise an error if they are invalid."""
    spreads = _of_pairs("sd", 0.0 if sd is None else sd, count)
    if not (np.isfinite(spreads) & (spreads >= 0)).all():
        raise ProblemError(
            "sd", "has values that are negative, NaN or infinite. Pass lengths, or 0 for exact."
        )
    return spreads


def _of_pairs(name: str, values: npt.ArrayLike, count: int) -> npt.NDArray[np.float64]:
    """Return one number for each pair; raise an error if there are more or fewer."""
    array = as_numbers(name, values).astype(np.float64)
    if array.shape not in ((), (count,)):
        raise ProblemError(
            name, f"has shape {array.shape}. Pass one number, or one for each of {count} pairs."
        )
    return np.broadcast_to(array, count)


def ends_of(mark: Mark, spacing: Sequence[float]) -> tuple[Point, ...]:
    """Return the head and base of an arrow or landmark, or an empty tuple for other marks."""
    if isinstance(mark, Arrow):
        return mark.head(spacing), mark.at
    if isinstance(mark, Landmark):
        return mark.target, mark.source
    return ()


def _differing(old: Mark | None, new: Mark | None) -> tuple[Mark, ...]:
    """Return the marks of a differing pair, or only the new part of a continued stroke."""
    if isinstance(old, Stroke) and isinstance(new, Stroke) and not grows(new):
        added = new.added_to(old)
        if added is not None:
            return (added,)
    return tuple(mark for mark in (old, new) if mark is not None)
