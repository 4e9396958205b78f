"""Drags that draw: their base class, and the tool for arrows and landmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from napari_hmrf.study.study_model import StudyModel
from napari_hmrf.tissue.drawing.drawing import Drawing, Hit, ends_of
from napari_hmrf.tissue.drawing.marks import COMPONENTS, Arrow, Landmark, Mark, Point, between

#: Displacements below this, in the unit of the spacing, are rounding errors and become 0.
_NOTHING = 1e-9

#: Map from a visible point to that of the undeformed tissue; None without tissue.
Origin = Callable[[Point], Point | None]


def unmoved(point: Point) -> Point | None:
    """Return the point itself, as the `Origin` of undeformed tissue."""
    return point


class Hand:
    """Base class of drawing by drags; each drag is one undo step.

    Parameters
    ----------
    model : StudyModel
        Model with the drawing of the selected slice.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    shape : tuple of int
        Shape of the image.

    Attributes
    ----------
    selected : int or None
        Number of the selected mark.
    """

    def __init__(
        self,
        model: StudyModel,
        spacing: Sequence[float] = (1.0, 1.0),
        shape: tuple[int, ...] = (1, 1),
    ) -> None:
        self._model = model
        self._spacing = tuple(map(float, spacing))
        self._shape = shape
        self._selected: int | None = None
        self._ours = Drawing()

    @property
    def holding(self) -> bool:
        """True while a drag is in progress."""
        return self._model.drawing_in_progress

    @property
    def selected(self) -> int | None:
        """Number of the mark made or picked up last; None after another edit of the drawing."""
        if self._model.drawing is not self._ours:
            self._selected = None
        return self._selected

    @property
    def mark(self) -> Mark | None:
        """Selected mark, or None."""
        number = self.selected
        return None if number is None else self._model.drawing.marks[number]

    def press(self, point: Point, reach: float, how: Any, came_from: Origin = unmoved) -> bool:
        """Begin a drag.

        Parameters
        ----------
        point : tuple of float
            Point on the visible image, in pixels.
        reach : float
            Largest distance of a mark that can be picked up, in the unit of the spacing.
        how : Arrow, Landmark or Stroke
            Settings for a new mark; its place is ignored.
        came_from : callable
            An `Origin`.

        Returns
        -------
        bool
            Whether a drag has begun.
        """
        raise NotImplementedError

    def move(self, point: Point) -> None:
        """Continue to a point; without effect unless a drag is in progress."""
        raise NotImplementedError

    def release(self) -> str:
        """End the drag as one undo step; return the name of the step, or "" if there is none.

        Raises
        ------
        ProblemError
            If an expanding stroke is an open line; nothing has changed then.
        """
        return self._model.end_drawing()

    def cancel(self) -> bool:
        """Cancel the drag and restore the drawing; return whether there was a drag."""
        held, number = self.holding, self._selected
        if held:
            self._model.cancel_drawing()
            self.select(number if number in range(len(self._model.drawing.marks)) else None)
        return held

    def select(self, number: int | None) -> None:
        """Select the mark to change or remove next; None selects none."""
        self._ours, self._selected = self._model.drawing, number

    def remove(self) -> bool:
        """Remove the selected mark; return whether there was one."""
        mark, number = self.mark, self.selected
        if mark is None or number is None:
            return False
        self.select(None)
        self._model.draw(self._model.drawing.without(number), f"removed {name_of(mark)}")
        return True

    def change(self, how: Any) -> None:
        """Apply the settings of another mark to the selected one, but not its place."""
        mark, number = self.mark, self.selected
        if mark is None or number is None or self.holding:
            return
        if (changed := self._changed(mark, how)) != mark:
            drawing = self._model.drawing.replaced(number, changed)
            self._ours = drawing  # before callbacks read the selection
            self._model.draw(drawing, f"changed {name_of(changed)}")

    def _changed(self, mark: Any, how: Any) -> Mark:
        raise NotImplementedError

    def _show(self, drawing: Drawing, number: int) -> None:
        self._ours, self._selected = drawing, number
        self._model.update_drawing(drawing)
        # The model keeps its own object if the drawing is equal.
        self._ours = self._model.drawing

    def _remake(self, mark: Mark) -> None:
        """Replace the mark that is being dragged."""
        if self._selected is not None:
            self._show(self._model.drawing.replaced(self._selected, mark), self._selected)


class Pull(Hand):
    """Tool that pulls tissue by a new arrow or landmark, or drags an end of an earlier one."""

    _part: Literal["head", "base"] = "head"
    #: Place of the pointer, and its offset from the end that is dragged.
    _at: Point = (0.0, 0.0)
    _offset: Point = (0.0, 0.0)

    def press(
        self, point: Point, reach: float, how: Arrow | Landmark, came_from: Origin = unmoved
    ) -> bool:
        """Pick up the end of a mark, or tissue; as in `Hand`.

        A new mark begins at the undeformed place of the tissue, and ends at its visible place.
        """
        self.release()
        drawing, at = self._model.drawing, came_from(point)
        hit = drawing.at(point, reach, self._spacing)
        if hit is not None:
            word = f"moved {name_of(drawing.marks[hit.number])}"
        elif at is not None:
            hit = Hit(len(drawing.marks), "head")
            drawing = drawing.with_mark(self._led(how, at, point))
            word = f"drew {name_of(drawing.marks[hit.number])}"
        else:
            self.select(None)
            return False
        head, base = ends_of(drawing.marks[hit.number], self._spacing)
        end = head if hit.part == "head" else base
        self._offset = tuple(x - y for x, y in zip(point, end, strict=True))
        self._part, self._at = hit.part, point
        self._model.begin_drawing(word)
        self._show(drawing, hit.number)
        return True

    def move(self, point: Point) -> None:
        """Continue to a point; without effect unless a drag is in progress."""
        if not self.holding or point == self._at:
            return
        self._at, mark = point, self.mark
        to = tuple(x - away for x, away in zip(point, self._offset, strict=True))
        if isinstance(mark, Arrow | Landmark):
            head, base = ends_of(mark, self._spacing)
            leads = self._part == "head"
            self._remake(self._led(mark, base, to) if leads else self._led(mark, to, head))

    def _changed(self, mark: Any, how: Arrow | Landmark) -> Mark:
        if type(how) is not type(mark):
            how = replace(mark, radius=how.radius, confidence=how.confidence)
        head, base = ends_of(mark, self._spacing)
        return self._led(how, base, head)

    def _led(self, how: Arrow | Landmark, at: Point, to: Point) -> Arrow | Landmark:
        """Return the mark changed to lead tissue from one place to another."""
        if isinstance(how, Landmark):
            return replace(how, source=at, target=to)
        by, which = np.zeros(len(at)), COMPONENTS[how.components]
        by[which] = between(at, to, self._spacing)[which]
        by[np.abs(by) < _NOTHING] = 0
        return replace(how, at=at, by=tuple(by.tolist()))


def name_of(mark: Mark) -> str:
    """Return the kind of a mark with its article, such as "an arrow"."""
    kind = type(mark).__name__.lower()
    return f"an {kind}" if kind == "arrow" else f"a {kind}"
