"""Tools that pull tissue with an arrow, or from a landmark to its target."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar, Literal, cast

import numpy as np

from napari_hmrf.tissue.drawing import Arrow, Landmark, Mark, Stroke
from napari_hmrf.tissue.drawing.drawing import Hit, ends_of
from napari_hmrf.tissue.drawing.growth import patch_at
from napari_hmrf.tissue.drawing.marks import COMPONENTS, Point, between, grows, is_painted
from napari_hmrf.ui.motion import motion_messages
from napari_hmrf.ui.motion.tool import (
    LandmarkSettings,
    Origin,
    Tool,
    ToolSettings,
    identity,
    name_of,
)

#: Displacements below this value, in the unit of the spacing, are rounding errors and set to 0.
_NOTHING = 1e-9
#: Slack of the outer edge around a new arrow, which bends there without a visible kink.
_SLACK = 2.0


class PullTool(Tool):
    """Tool that pulls tissue with a new arrow, or drags an end of an existing arrow or landmark."""

    name = "pull"
    title = "Pull"
    key = "G"
    fields: ClassVar[tuple[str, ...]] = ("radius", "confidence", "components")
    hint = "Drag tissue to pull it, or click to hold a patch as it is now."
    grabs_ends = True

    #: Dragged end of the mark.
    _part: Literal["head", "base"] = "head"
    #: Position of the mouse, and offset of the mouse from the dragged end.
    _at: Point = (0.0, 0.0)
    _offset: Point = (0.0, 0.0)
    #: Mark that was selected just after the button press.
    _pressed: Arrow | Landmark | None = None
    #: Names of the undo steps of a new mark: for a drag, and for a click without a drag.
    _drag_step: ClassVar[str] = "pulled tissue"
    _click_step: ClassVar[str] = "held tissue"

    @classmethod
    def makes(cls, mark: Mark) -> bool:
        """Return whether a mark is an arrow."""
        return isinstance(mark, Arrow)

    @property
    def mark(self) -> Arrow | Landmark | None:
        """Selected arrow or landmark, or None."""
        mark = super().mark
        return mark if isinstance(mark, Arrow | Landmark) else None

    @property
    def pulled(self) -> Point | None:
        """Displacement of the mark that is being dragged, or None."""
        mark = self.mark if self.is_dragging else None
        if isinstance(mark, Landmark):
            mark = mark.arrow(self._spacing)
        return None if mark is None else mark.by

    def press(
        self, point: Point, reach: float, settings: ToolSettings, origin: Origin = identity
    ) -> str:
        """Begin dragging an end of a mark, or tissue; see `Tool.press`.

        A new mark starts at the undeformed position of the tissue and ends at the visible position.
        Until it is dragged, it holds each pixel of its patch at its present displacement.
        """
        self.release()
        drawing, at = self._session.drawing, origin(point)
        hit = drawing.at(point, reach, self._spacing)
        if hit is not None:
            word = f"moved {name_of(drawing.marks[hit.number])}"
        elif at is not None and (number := self._grown_patch(at, settings)) is not None:
            hit = Hit(number, "head")
            drawing = drawing.replaced(number, self._pulled(drawing.marks[number], settings))
            word = "pulled a growing patch"
        elif at is not None:
            hit = Hit(len(drawing.marks), "head")
            drawing = drawing.with_mark(self._held(self._new_mark(at, point, settings)))
            word = self._drag_step
        else:
            self.select(None)
            return motion_messages.NOTHING
        head, base = ends_of(drawing.marks[hit.number], self._spacing)
        end = head if hit.part == "head" else base
        self._offset = tuple(x - y for x, y in zip(point, end, strict=True))
        self._part, self._at = hit.part, point
        self._session.begin_drawing(word)
        self._show(drawing, hit.number)
        self._pressed = self.mark
        return ""

    def move(self, point: Point) -> None:
        """Move the dragged end to a point; do nothing if no drag is in progress."""
        if not self.is_dragging or point == self._at:
            return
        self._at, mark = point, self.mark
        to = tuple(x - away for x, away in zip(point, self._offset, strict=True))
        if mark is not None:
            head, base = ends_of(mark, self._spacing)
            ends = (base, to) if self._part == "head" else (to, head)
            # A dragged patch moves as a block.
            self._replace(self._with_ends(replace(mark, motion=None), *ends))

    def release(self) -> str | None:
        """End the drag as one undo step, which has another name after a click."""
        self._end()
        return None

    def _end(self) -> bool:
        """End the drag, and return whether a click has drawn a mark that holds tissue in place."""
        is_click = self.is_dragging and self.mark == self._pressed
        is_new = bool(self._session.end_drawing(self._click_step if is_click else ""))
        return is_click and is_new

    def _held(self, mark: Arrow | Landmark) -> Arrow | Landmark:
        """Return a mark that holds its patch as it is now."""
        return replace(mark, motion=self._motion_under(mark)) if is_painted(mark) else mark

    def _grown_patch(self, at: Point, settings: ToolSettings) -> int | None:
        """Find the round patch whose growth a new mark at an undeformed position would hide."""
        drawing = self._session.drawing
        number = patch_at(drawing, at, self._spacing)
        mark = None if number is None else drawing.marks[number]
        if not isinstance(mark, Stroke) or not grows(mark) or mark.lines != ((mark.lines[0][0],),):
            return None
        apart = math.hypot(*between(at, mark.lines[0][0], self._spacing))
        is_within = apart + settings["radius"] < mark.radius - max(self._spacing)
        return None if is_within else number

    def _pulled(self, patch: Mark, settings: ToolSettings) -> Arrow | Landmark:
        """Return a mark that grows and moves as a round patch does."""
        assert isinstance(patch, Stroke)
        at = patch.lines[0][0]
        steps = zip(at, patch.by, self._spacing, strict=True)
        to = tuple(x + by / size for x, by, size in steps)
        settings = {
            **settings,
            "radius": patch.radius,
            "confidence": patch.confidence,
            "components": patch.components,
        }
        mark = self._new_mark(at, to, settings)
        return replace(mark, amount=patch.amount)

    def _new_mark(self, at: Point, to: Point, settings: ToolSettings) -> Arrow | Landmark:
        """Return a mark that moves tissue from one position to another."""
        still = (0.0,) * len(at)
        arrow = Arrow(
            at,
            still,
            settings["radius"],
            settings["confidence"],
            settings["components"],
            slack=_SLACK,
        )
        return self._with_ends(arrow, at, to)

    def _changed(self, settings: ToolSettings) -> Mark | None:
        mark = self.mark
        if mark is None:
            return None
        head, base = ends_of(mark, self._spacing)
        mark = replace(mark, radius=settings["radius"], confidence=settings["confidence"])
        if isinstance(mark, Arrow) and "components" in settings:
            mark = replace(mark, components=settings["components"])
        if isinstance(mark, Landmark):
            mark = replace(mark, sd=_spread(settings, mark.sd))
        return self._with_ends(mark, base, head)

    def _with_ends(self, mark: Arrow | Landmark, at: Point, to: Point) -> Arrow | Landmark:
        """Return the mark with new ends."""
        if isinstance(mark, Landmark):
            return replace(mark, source=at, target=to)
        by, which = np.zeros(len(at)), COMPONENTS[mark.components]
        by[which] = between(at, to, self._spacing)[which]
        by[np.abs(by) < _NOTHING] = 0
        return replace(mark, at=at, by=tuple(by.tolist()))


class LandmarkTool(PullTool):
    """Tool that draws landmarks, or drags an end of an existing arrow or landmark."""

    name = "landmark"
    title = "Landmark"
    key = "L"
    fields = ("radius", "confidence", "sd")
    hint = "Drag from a point of the tissue to its target, or click a point that must stay."

    _drag_step = _click_step = "drew a landmark"

    @classmethod
    def makes(cls, mark: Mark) -> bool:
        """Return whether a mark is a landmark."""
        return isinstance(mark, Landmark)

    def release(self) -> str | None:
        """End the drag; after a click, explain that the landmark holds tissue in place."""
        return motion_messages.NO_WAY if self._end() else None

    def _new_mark(self, at: Point, to: Point, settings: ToolSettings) -> Arrow | Landmark:
        sd = _spread(settings)
        return Landmark(at, to, settings["radius"], settings["confidence"], sd=sd)

    def cursor(self, settings: ToolSettings) -> float | None:
        """Return the uncertainty, or the radius of an exact landmark; see `Tool.cursor`."""
        radius = super().cursor(settings)
        return radius and (_spread(settings) or radius)


def _spread(settings: ToolSettings, otherwise: float = 0.0) -> float:
    """Return the uncertainty in the settings of a tool, or another value if there is none."""
    return cast(LandmarkSettings, settings).get("sd", otherwise)
