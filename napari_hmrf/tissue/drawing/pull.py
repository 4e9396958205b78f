"""Drawing arrows with a pointer: pressed, moved, released."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from napari_hmrf.tissue.drawing.drawing import Drawing, Hit
from napari_hmrf.tissue.drawing.marks import Arrow, Components, Landmark, Mark, Point
from napari_hmrf.tissue.drawing.tool import Hand, Origin, unmoved

DREW, MOVED, HELD = "drew an arrow", "moved an arrow", "held a place"


@dataclass(frozen=True)
class Grip:
    """How new arrows take hold of tissue; as in `Arrow`."""

    radius: float
    confidence: float = 1.0
    components: Components = "both"


class Pull(Hand):
    """Takes hold of tissue and pulls it, or takes hold of the end of an arrow or landmark again."""

    def __init__(self, history: Any, spacing: Any = (1.0, 1.0)) -> None:
        super().__init__(history, spacing)
        self._held: Hit | None = None
        self._offset: Point = (0.0, 0.0)
        self._begun: Point = (0.0, 0.0)
        self._new = self._moved = False

    @property
    def arrow(self) -> Arrow | Landmark | None:
        """The mark that is selected."""
        mark = self.mark
        return mark if isinstance(mark, Arrow | Landmark) else None

    @property
    def how(self) -> Grip | None:
        """How the selected mark holds."""
        mark = self.arrow
        if mark is None:
            return None
        components = mark.components if isinstance(mark, Arrow) else "both"
        return Grip(mark.radius, mark.confidence, components)

    def press(self, point: Point, reach: float, how: Grip, came_from: Origin = unmoved) -> bool:
        """Take hold of the end of an arrow, or of tissue; as in `Hand`.

        A new arrow begins where the tissue seen there is when nothing moves, and at first leaves
        it where it is seen.
        """
        self.release()
        drawing = self._history.drawing
        hit = drawing.at(point, reach, self._spacing)
        if hit is not None:
            self._hold(drawing, hit, point)
            return True
        at = came_from(point)
        if at is None:
            self.select(None)
            return False
        arrow = Arrow(
            at, self._between(at, point, how.components), how.radius, how.confidence,
            how.components,
        )  # fmt: skip
        self._hold_new(arrow, point, DREW)
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless something is held."""
        if not self.holding or self._held is None:
            return
        number, part = self._held
        to = (point[0] - self._offset[0], point[1] - self._offset[1])
        mark = self._history.drawing.marks[number]
        self._moved = self._moved or point != self._begun
        if isinstance(mark, Landmark):
            mark = replace(mark, target=to) if part == "head" else replace(mark, source=to)
        elif isinstance(mark, Arrow):
            at, head = (mark.at, to) if part == "head" else (to, mark.head(self._spacing))
            mark = replace(mark, at=at, by=self._between(at, head, mark.components))
        self._show(self._history.drawing.replaced(number, mark), number)

    def release(self) -> str:
        """Let go; what was done, as one step that can be undone, or nothing."""
        if not self.holding or self._held is None:
            self._holds = False
            return ""
        word = self._word(self._history.drawing.marks[self._held.number])
        self._holds = False
        self._history.end(word)
        return word if self._new or self._moved else ""

    def _word(self, mark: Mark) -> str:
        """What was done to what is held."""
        if not self._new:
            return MOVED if isinstance(mark, Arrow) else "moved a landmark"
        return DREW if self._moved else HELD

    def _hold(self, drawing: Drawing, hit: Hit, point: Point) -> None:
        """Take hold of what is there."""
        self._new = False
        self._history.begin(MOVED)
        self._take(drawing, hit, point)

    def _hold_new(self, mark: Arrow | Landmark, point: Point, word: str) -> None:
        """Take hold of the head of what was not there before."""
        self._new = True
        self._history.begin(word)
        drawing = self._history.drawing
        self._take(drawing.with_mark(mark), Hit(len(drawing.marks), "head"), point)

    def _take(self, drawing: Drawing, hit: Hit, point: Point) -> None:
        self._held, self._moved, self._begun, self._holds = hit, False, point, True
        end = self._end(drawing.marks[hit.number], hit.part)
        self._offset = (point[0] - end[0], point[1] - end[1])
        self._show(drawing, hit.number)

    def _changed(self, mark: Mark, values: dict[str, Any]) -> Mark:
        if isinstance(mark, Landmark):
            values.pop("components", None)
        changed = super()._changed(mark, values)
        if isinstance(changed, Arrow):
            by = self._between(changed.at, changed.head(self._spacing), changed.components)
            changed = replace(changed, by=by)
        return changed

    def _selected_before(self) -> int | None:
        return None if self._new or self._held is None else self._held.number

    def _end(self, mark: Any, part: str) -> Point:
        if isinstance(mark, Landmark):
            return mark.target if part == "head" else mark.source
        end: Point = mark.head(self._spacing) if part == "head" else mark.at
        return end

    def _between(self, at: Point, head: Point, components: Components) -> Point:
        row, col = (
            (to - start) * size for start, to, size in zip(at, head, self._spacing, strict=True)
        )
        # Rounding of where it is seen must not move what stays.
        row, col = (0.0 if math.isclose(0, step, abs_tol=1e-9) else step for step in (row, col))
        return (0.0 if components == "col" else row, 0.0 if components == "row" else col)
