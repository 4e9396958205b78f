"""A drawing: marks in the order in which they were made."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from napari_hmrf.tissue.drawing.canvas import Canvas, paint
from napari_hmrf.tissue.drawing.marks import (
    Arrow,
    Landmark,
    Mark,
    Point,
    Stroke,
    mark_as_dict,
    mark_from_dict,
)

_VERSION = 1


class Hit(NamedTuple):
    """What of a drawing is at a place: a mark's number, and by which of its ends."""

    number: int
    part: Literal["head", "base"]


@dataclass(frozen=True)
class Drawing:
    """What was drawn on an image; a value, which every edit leaves as it is.

    Attributes
    ----------
    marks : tuple of Arrow, Landmark or Stroke
        In the order they were made. Where they overlap, the later ones win.
    """

    marks: tuple[Mark, ...] = ()

    def with_mark(self, mark: Mark) -> Drawing:
        """The drawing with a mark on top."""
        return Drawing((*self.marks, mark))

    def replaced(self, number: int, mark: Mark) -> Drawing:
        """The drawing with another mark in the place of one.

        Raises
        ------
        IndexError
            If there is no mark of that number.
        """
        self._check(number)
        return Drawing((*self.marks[:number], mark, *self.marks[number + 1 :]))

    def without(self, number: int) -> Drawing:
        """The drawing without one of its marks.

        Raises
        ------
        IndexError
            If there is no mark of that number.
        """
        self._check(number)
        return Drawing((*self.marks[:number], *self.marks[number + 1 :]))

    def at(self, point: Point, reach: float, spacing: Sequence[float] = (1.0, 1.0)) -> Hit | None:
        """Find the end of an arrow or a landmark that can be picked up at a place.

        Parameters
        ----------
        point : (float, float)
            (row, col) in pixels.
        reach : float
            How near is near enough, in the unit of `spacing`.
        spacing : sequence of float, shape (2,)
            Size of a pixel in (row, col) direction.

        Returns
        -------
        Hit or None
            The nearest; of several equally near ones a head before a base, and a later mark before
            an earlier one.
        """
        found: list[tuple[float, int, int]] = []
        for number, mark in enumerate(self.marks):
            for order, end in enumerate(_ends(mark, spacing)):
                away = math.hypot(
                    *((a - b) * size for a, b, size in zip(end, point, spacing, strict=True))
                )
                if away <= reach:
                    found.append((away, order, -number))
        if not found:
            return None
        _, order, number = min(found)
        return Hit(-number, "base" if order else "head")

    def painted_at(self, point: Point, spacing: Sequence[float] = (1.0, 1.0)) -> int | None:
        """Find the stroke that lies uppermost at a place; None if none does.

        Parameters
        ----------
        point : (float, float)
            (row, col) in pixels.
        spacing : sequence of float, shape (2,)
            Size of a pixel in (row, col) direction.
        """
        for number in reversed(range(len(self.marks))):
            mark = self.marks[number]
            if isinstance(mark, Stroke) and mark.distance(point, spacing) <= mark.radius:
                return number
        return None

    def render(self, base: Canvas) -> Canvas:
        """Draw all marks on top of images, which stay as they are.

        Parameters
        ----------
        base : Canvas
            What was observed otherwise, and the tissues.

        Returns
        -------
        Canvas

        Raises
        ------
        ProblemError
            If a stroke that is to expand is an open line, or there are no labels to paint tissue
            in.
        """
        canvas = base.copy()
        for mark in self.marks:
            paint(mark, canvas, canvas.whole)
        return canvas

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON types, to be kept with a project or a solution."""
        return {"version": _VERSION, "marks": [mark_as_dict(mark) for mark in self.marks]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Drawing:
        """The inverse of `as_dict`.

        Raises
        ------
        ValueError
            If it is not what `as_dict` made, or by a newer version.
        """
        try:
            version, marks = values["version"], values["marks"]
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a drawing: it lacks {error}") from error
        if version != _VERSION:
            raise ValueError(
                f"a drawing of version {version!r}, but this program reads version {_VERSION}. "
                "Update napari-hmrf to open it"
            )
        if not isinstance(marks, list | tuple):
            raise ValueError(f"not a drawing: its marks are {marks!r}")
        return cls(tuple(mark_from_dict(mark) for mark in marks))

    def _check(self, number: int) -> None:
        if not 0 <= number < len(self.marks):
            raise IndexError(f"there is no mark {number} of {len(self.marks)}")


def _ends(mark: Mark, spacing: Sequence[float]) -> tuple[Point, ...]:
    """Head and base of what has them."""
    if isinstance(mark, Arrow):
        return mark.head(spacing), mark.at
    if isinstance(mark, Landmark):
        return mark.target, mark.source
    return ()
