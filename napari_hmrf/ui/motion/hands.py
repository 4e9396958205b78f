"""What draws with a pointer that is pressed, moved and released: arrows and landmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from napari_hmrf.study.study_model import StudyModel
from napari_hmrf.tissue.drawing.drawing import Drawing, Hit, ends_of
from napari_hmrf.tissue.drawing.marks import COMPONENTS, Arrow, Landmark, Mark, Point, between

#: Rounding of where tissue is seen must not move what stays.
_NOTHING = 1e-9

#: Where the tissue seen at a point is when nothing moves; None if there is none.
Origin = Callable[[Point], Point | None]


def unmoved(point: Point) -> Point | None:
    """The `Origin` of tissue that is seen where it is."""
    return point


class Hand:
    """What holds a tool and draws; each press to release is one step that can be undone.

    Parameters
    ----------
    model : StudyModel
        Whose selected slice is drawn on.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    shape : tuple of int
        Of the image.

    Attributes
    ----------
    selected : int or None
        The number of the mark made or taken hold of last.
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
        """Whether something is held."""
        return self._model.drawing_in_progress

    @property
    def selected(self) -> int | None:
        """The number of the mark made or taken hold of last; None once something else was done."""
        if self._model.drawing is not self._ours:
            self._selected = None
        return self._selected

    @property
    def mark(self) -> Mark | None:
        """The mark that is selected."""
        number = self.selected
        return None if number is None else self._model.drawing.marks[number]

    def press(self, point: Point, reach: float, how: Any, came_from: Origin = unmoved) -> bool:
        """Begin.

        Parameters
        ----------
        point : tuple of float
            Of the picture as it is seen, in pixels.
        reach : float
            How near to what can be picked up is near enough, in the unit of the spacing.
        how : Arrow, Landmark or Stroke
            A mark as new ones are to be; where it lies does not count.
        came_from : callable
            Where the tissue seen at a point is when nothing moves; None if there is none.

        Returns
        -------
        bool
            Whether there was anything to take hold of, so that a drag begins.
        """
        raise NotImplementedError

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless something is held."""
        raise NotImplementedError

    def release(self) -> str:
        """Let go; what was done, as one step that can be undone, or nothing.

        Raises
        ------
        ProblemError
            If what is to expand is an open line; nothing has changed then.
        """
        return self._model.end_drawing()

    def cancel(self) -> bool:
        """Let go, and have everything as it was before; whether anything was held."""
        held, number = self.holding, self._selected
        if held:
            self._model.cancel_drawing()
            self.select(number if number in range(len(self._model.drawing.marks)) else None)
        return held

    def select(self, number: int | None) -> None:
        """Have a mark be the one that is changed or removed next."""
        self._ours, self._selected = self._model.drawing, number

    def remove(self) -> bool:
        """Remove the mark that is selected; whether there was one."""
        mark, number = self.mark, self.selected
        if mark is None or number is None:
            return False
        self.select(None)
        self._model.draw(self._model.drawing.without(number), f"removed {name_of(mark)}")
        return True

    def change(self, how: Any) -> None:
        """Make the selected mark as another one is, but where it lies."""
        mark, number = self.mark, self.selected
        if mark is None or number is None or self.holding:
            return
        if (changed := self._changed(mark, how)) != mark:
            drawing = self._model.drawing.replaced(number, changed)
            self._ours = drawing  # before those who listen ask what is selected
            self._model.draw(drawing, f"changed {name_of(changed)}")

    def _changed(self, mark: Any, how: Any) -> Mark:
        raise NotImplementedError

    def _show(self, drawing: Drawing, number: int) -> None:
        self._ours, self._selected = drawing, number
        self._model.update_drawing(drawing)
        # The same drawing stays the one it was.
        self._ours = self._model.drawing

    def _remake(self, mark: Mark) -> None:
        """Have another mark in the place of the one that is held."""
        if self._selected is not None:
            self._show(self._model.drawing.replaced(self._selected, mark), self._selected)


class Pull(Hand):
    """Takes hold of tissue and pulls it, or takes hold of the end of an arrow or landmark again."""

    _part: Literal["head", "base"] = "head"
    #: Where the pointer is, and how far from the end that is held.
    _at: Point = (0.0, 0.0)
    _offset: Point = (0.0, 0.0)

    def press(
        self, point: Point, reach: float, how: Arrow | Landmark, came_from: Origin = unmoved
    ) -> bool:
        """Take hold of the end of a mark, or of tissue; as in `Hand`.

        A new mark begins where the tissue seen there is when nothing moves, and at first leaves it
        where it is seen.
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
        """Go on to a point; nothing happens unless something is held."""
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
        """A mark that leads tissue from one place to another."""
        if isinstance(how, Landmark):
            return replace(how, source=at, target=to)
        by, which = np.zeros(len(at)), COMPONENTS[how.components]
        by[which] = between(at, to, self._spacing)[which]
        by[np.abs(by) < _NOTHING] = 0
        return replace(how, at=at, by=tuple(by.tolist()))


def name_of(mark: Mark) -> str:
    """What a mark is, with its article: "an arrow"."""
    kind = type(mark).__name__.lower()
    return f"an {kind}" if kind == "arrow" else f"a {kind}"
