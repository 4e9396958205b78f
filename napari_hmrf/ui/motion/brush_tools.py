"""Tools that paint strokes, which prescribe the motion or the kind of tissue."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.drawing import Mark, Stroke
from napari_hmrf.tissue.drawing.canvas import covers, rim_of
from napari_hmrf.tissue.drawing.growth import is_pull, patch_at, with_patch
from napari_hmrf.tissue.drawing.marks import Action, Point, between
from napari_hmrf.ui.motion import motion_messages
from napari_hmrf.ui.motion.tool import Origin, Tool, ToolError, ToolSettings, identity

#: Smallest distance between two points of a stroke, as a fraction of the brush radius.
_STEP = 0.1
#: Growth by one notch of the mouse wheel, and largest shrinkage, as fractions of the radius.
_NOTCH, _MOST_SHRINKAGE = 0.05, 0.8
#: Displacement up to which tissue counts as undisplaced, as a fraction of the smallest pixel side.
_NOTHING = 0.05


class BrushTool(Tool):
    """Base class of painting tools; painting over the selected stroke continues it.

    Strokes are placed on the undeformed tissue, even while the tissue moves.

    Attributes
    ----------
    action : Action
        Effect of the strokes.
    step : str
        Name of the undo step for a stroke.
    """

    action: ClassVar[Action]
    step: ClassVar[str]

    #: Map from points visible at the button press to their undeformed positions.
    _origin: Origin

    @classmethod
    def makes(cls, mark: Mark) -> bool:
        """Return whether a mark is a stroke with the action of this brush."""
        return isinstance(mark, Stroke) and mark.action == cls.action

    @property
    def stroke(self) -> Stroke | None:
        """Stroke that is being painted, or None."""
        return self._selected_stroke if self.is_dragging else None

    @property
    def _selected_stroke(self) -> Stroke | None:
        """Selected stroke, or None."""
        mark = self.mark
        return mark if isinstance(mark, Stroke) else None

    @property
    def follows_surface(self) -> bool:
        """True, because strokes are painted on the surface."""
        return True

    @property
    def mark_settings(self) -> ToolSettings | None:
        """Settings of the selected stroke except its radius; None if no stroke is selected."""
        settings = super().mark_settings
        if settings is not None:
            del settings["radius"]
        return settings

    def press(
        self, point: Point, reach: float, settings: ToolSettings, origin: Origin = identity
    ) -> str:
        """Begin or continue a stroke; outside tissue, begin at the visible position."""
        if not self._is_inside(point):
            return motion_messages.OUTSIDE
        self.release()
        self._origin = origin
        self._begin(point, settings)
        stroke = self._selected_stroke
        return motion_messages.NO_STEP if stroke is not None and stroke.moves_nowhere else ""

    def _begin(self, point: Point, settings: ToolSettings) -> None:
        """Begin a drag at a visible point inside the image."""
        at, drawing = self._place(point), self._session.drawing
        new, stroke = self._new_stroke(at, point, settings), self._stroke_at(at)
        self._session.begin_drawing(self.step)
        if stroke is not None and self._continues(new, stroke):
            self._replace(stroke.again(at))
        else:
            self._show(drawing.with_mark(new), len(drawing.marks))

    def _new_stroke(self, at: Point, point: Point, settings: ToolSettings) -> Stroke:
        """Return a spot at an undeformed position, which is visible at a point."""
        return Stroke(self.action, ((at,),), **settings)

    def _continues(self, new: Stroke, stroke: Stroke) -> bool:
        """Return whether a new stroke differs from the selected stroke only in its place."""
        return replace(new, lines=stroke.lines) == stroke

    def move(self, point: Point) -> None:
        """Continue the stroke to a point; do nothing if no drag is in progress."""
        stroke = self.stroke
        if stroke is None:
            return
        at, last = self._place(point), stroke.lines[-1][-1]
        if math.hypot(*between(last, at, self._spacing)) >= _STEP * stroke.radius:
            self._replace(stroke.onward(at))

    def _changed(self, settings: ToolSettings) -> Mark | None:
        stroke = self._selected_stroke
        if stroke is None:
            return None
        kept: ToolSettings = {**settings, "radius": stroke.radius}
        changed = replace(stroke, **kept)
        return changed if changed.by == stroke.by else replace(changed, motion=None)

    def _is_inside(self, point: Point) -> bool:
        """Return whether a point lies inside the image."""
        along = zip(point, self._shape, strict=True)
        return all(-0.5 <= at <= size - 0.5 for at, size in along)

    def _place(self, point: Point) -> Point:
        """Return the undeformed position of a visible point, or the point itself outside tissue."""
        before = self._origin(point)
        return point if before is None else before

    def _stroke_at(self, place: Point) -> Stroke | None:
        """Return the selected stroke if it covers an undeformed position, or None."""
        stroke = self._selected_stroke
        is_hit = stroke is not None and covers(stroke, place, self._spacing)
        return stroke if is_hit else None


class HoldTool(BrushTool):
    """Brush that holds tissue at its original place."""

    name = "pin"
    title = "Hold"
    key = "P"
    fields = ("radius", "confidence", "components")
    hint = "Paint tissue to hold it at its original place."
    action = "pin"
    step = "held tissue"


class FreeTool(BrushTool):
    """Brush that frees the painted tissue from all boundary conditions."""

    name = "free"
    title = "Free"
    key = "F"
    fields = ("radius",)
    hint = "Paint tissue to free it from everything that holds or moves it."
    action = "free"
    step = "freed tissue"


class SlideTool(BrushTool):
    """Brush for the surface of tissue that slides along a wall."""

    name = "slide"
    title = "Slide"
    key = "S"
    fields = ("radius",)
    hint = (
        "Paint the surface of tissue that slides along a wall of stiffness 0. Inside tissue, a "
        "painted surface keeps its place."
    )
    action = "slide"
    step = "painted a sliding surface"


class ResectTool(BrushTool):
    """Brush that removes tissue."""

    name = "remove"
    title = "Resect"
    key = "R"
    fields = ("radius",)
    hint = (
        "Paint tissue to remove it. Gravity, and the contents of the cavity, are set under "
        "'Boundary and gravity'."
    )
    action = "remove"
    step = "removed tissue"


class PushTool(BrushTool):
    """Brush for moving tissue; dragging the selected stroke sets its displacement."""

    name = "move"
    title = "Push"
    key = "M"
    fields = ("radius", "by_row", "by_col", "confidence", "components")
    hint = "Paint tissue, then drag the paint to push the tissue."
    action = "move"
    step = "painted a push"

    #: Start point of the drag, and displacement of the stroke before the drag; None while painting.
    _grip: tuple[Point, Point] | None = None

    @property
    def follows_surface(self) -> bool:
        """True while a stroke is painted; the drag of a stroke follows the screen."""
        return self._grip is None

    @property
    def pulled(self) -> Point | None:
        """Displacement of the painted tissue that is being dragged; None while painting."""
        stroke = self.stroke
        return None if stroke is None or self._grip is None else stroke.by

    def _begin(self, point: Point, settings: ToolSettings) -> None:
        """Begin dragging the selected stroke if the point is on the stroke, else begin painting."""
        self._grip, stroke = None, self._stroke_at(self._place(point))
        if stroke is None:
            super()._begin(point, settings)
        else:
            self._grip = point, stroke.by
            self._session.begin_drawing("pushed painted tissue")

    def move(self, point: Point) -> None:
        """Continue pushing or painting; do nothing if no drag is in progress."""
        stroke = self.stroke
        if stroke is None or self._grip is None:
            super().move(point)
            return
        start, by = self._grip
        step = between(start, point, self._spacing)
        to = tuple(map(sum, zip(by, step, strict=True)))
        # A pushed patch moves as a block.
        self._replace(replace(stroke, by=to, motion=None))

    def release(self) -> str | None:
        """End the drag; clear the message if the stroke has a displacement."""
        stroke = self.stroke
        message = super().release()
        return message if stroke is None or stroke.moves_nowhere else ""


class GrowTool(BrushTool):
    """Brush for a patch or a closed ring of tissue that grows or shrinks.

    Displaced tissue keeps its displacement and its stretch, and grows from there.
    """

    name = "expand"
    title = "Grow"
    key = "E"
    fields = ("radius", "amount", "confidence")
    hint = "Paint a patch or a closed ring that grows."
    flat_hint = (
        "Turn the mouse wheel over a tissue of the table, such as a tumour, to grow all of it, or "
        "over other tissue to grow a disc."
    )
    action = "expand"
    step = "painted growth"
    takes_wheel = True

    #: True while the wheel, rather than a drag, changes the growth.
    _is_turning = False
    #: Visible point at which the wheel was turned last.
    _turned_at: Point = ()
    #: Present displacements along the stroke that is being painted.
    _steps: tuple[Point, ...] = ()

    @property
    def error_message(self) -> str:
        """Advice to close the ring while a stroke is being painted, else ""."""
        return "" if self.stroke is None else motion_messages.OPEN

    def _begin(self, point: Point, settings: ToolSettings) -> None:
        """Begin a stroke that moves by the present displacement of the tissue."""
        self._steps = ()
        super()._begin(point, settings)
        if (stroke := self.stroke) is not None and len(stroke.lines) == 1:
            self._steps = (between(self._place(point), point, self._spacing),)

    def move(self, point: Point) -> None:
        """Continue the stroke, which moves by the mean displacement along its path."""
        before = self.stroke
        super().move(point)
        stroke = self.stroke
        if stroke is None or stroke == before or not self._steps:
            return
        self._steps += (between(self._place(point), point, self._spacing),)
        mean = tuple(sum(along) / len(along) for along in zip(*self._steps, strict=True))
        self._replace(self._moved(stroke, mean))

    def _new_stroke(self, at: Point, point: Point, settings: ToolSettings) -> Stroke:
        stroke = super()._new_stroke(at, point, settings)
        return self._moved(stroke, between(at, point, self._spacing))

    def _continues(self, new: Stroke, stroke: Stroke) -> bool:
        same = replace(new, action=stroke.action, by=stroke.by, motion=stroke.motion)
        return super()._continues(same, stroke)

    def _moved(self, stroke: Stroke, by: Point) -> Stroke:
        """Return a growing stroke that also moves, or only grows if the tissue is not displaced."""
        if math.hypot(*by) <= _NOTHING * min(self._spacing):
            return replace(stroke, action=self.action, by=(0.0,) * len(by), motion=None)
        return replace(stroke, action="move", by=by, motion=self._motion_under(stroke))

    def _changed(self, settings: ToolSettings) -> Mark | None:
        mark = self.mark
        if mark is None or not is_pull(mark):
            return super()._changed(settings)
        return replace(mark, amount=settings["amount"], confidence=settings["confidence"])

    def turn_wheel(
        self, point: Point, notches: float, settings: ToolSettings, origin: Origin = identity
    ) -> bool:
        """Grow or shrink the patch at a point, or a new patch; see `Tool.turn_wheel`.

        Raises
        ------
        ToolError
            If the tissue at the point cannot grow without undoing a pull, or is too small to grow;
            the drawing is then unchanged.
        """
        at = origin(point)
        mark = self.mark if self._is_turning else None
        # The tissue under a resting pointer may leave a patch that shrinks.
        if mark is None or not self._is_resting(point, mark.radius):
            if at is None or not self._is_inside(point):
                return False
            if self.is_dragging and not self._is_turning:
                return False
            if mark is None or not covers(mark, at, self._spacing):
                self.release()
                mark = self._begin_turning(at, point, settings)
        self._turned_at = point
        step = float(f"{mark.radius * _NOTCH:.2g}")
        amount = round(mark.amount + notches * step, 9)
        if mark.lines == ((mark.lines[0][0],),):  # a disc or a ball, which must not vanish
            amount = max(amount, -_MOST_SHRINKAGE * mark.radius)
        self._replace(replace(mark, amount=amount))
        return True

    def _is_resting(self, point: Point, radius: float) -> bool:
        """Return whether the pointer has not moved since the last turn of the wheel."""
        moved = math.hypot(*between(self._turned_at, point, self._spacing))
        return moved < _STEP * radius

    def _begin_turning(self, at: Point, point: Point, settings: ToolSettings) -> Mark:
        """Select the patch at an undeformed position, or add a patch that does not grow yet.

        A new patch keeps the tissue where it is: at the point where it is visible.
        """
        drawing = self._session.drawing
        number = patch_at(drawing, at, self._spacing)
        try:
            if number is None:
                still: ToolSettings = {**settings, "amount": 0.0}
                patch = self._new_stroke(at, point, still)
                added = with_patch(drawing, patch, self._spacing, self._shape)
                if not isinstance(added, tuple):
                    raise ToolError(motion_messages.in_the_way(added, is_pull(added)))
                drawing, number = added
            elif not rim_of(drawing.marks[number], self._spacing, self._shape)[0].any():
                raise ToolError(motion_messages.TOO_SMALL)
        except ProblemError as error:
            raise ToolError(motion_messages.NO_INSIDE) from error
        self._session.begin_drawing("grew tissue with the wheel")
        self._is_turning = True
        self._show(drawing, number)
        return drawing.marks[number]

    def cancel(self) -> bool:
        """Cancel the stroke or the growth; see `Tool.cancel`."""
        self._is_turning = False
        return super().cancel()

    def release(self) -> str | None:
        """End the stroke as one undo step, and refuse an open line.

        Raises
        ------
        ToolError
            If the stroke is an open line; the drawing is then unchanged.
        """
        stroke, was_turning, self._is_turning = self.stroke, self._is_turning, False
        if stroke is not None and not was_turning:
            try:
                rim_of(stroke, self._spacing, self._shape)
            except ProblemError as error:
                self.cancel()
                raise ToolError(motion_messages.NO_OUTSIDE) from error
        message = super().release()
        return None if was_turning else message


class ConfidenceTool(BrushTool):
    """Brush for the confidence of boundary conditions on the painted tissue."""

    name = "confidence"
    title = "Confidence"
    key = "C"
    fields = ("radius", "stroke_confidence", "softness")
    hint = "Paint the confidence of held or moved tissue."
    action = "confidence"
    step = "painted confidence"


class TissueTool(BrushTool):
    """Brush for the kind of tissue.

    A newly chosen kind applies to the next stroke, or to a stroke that the user has selected. The
    stroke painted last does not change, so that several tissues can be painted in turn.
    """

    name = "tissue"
    title = "Tissue"
    key = "T"
    fields = ("radius", "material")
    hint = "Paint tissue to change its kind."
    action = "tissue"
    step = "painted tissue"

    #: True if the user has selected the stroke; False if the stroke was just painted.
    _is_picked = False

    def press(
        self, point: Point, reach: float, settings: ToolSettings, origin: Origin = identity
    ) -> str:
        """Begin or continue a stroke; see `BrushTool.press`."""
        message = super().press(point, reach, settings, origin)
        if self.is_dragging:
            self._is_picked = False
        return message

    def pick(self, number: int | None) -> None:
        """Select a stroke; later changes to the fields apply to this stroke."""
        super().pick(number)
        self._is_picked = number is not None

    def change(self, settings: ToolSettings) -> None:
        """Apply changed settings to the selected stroke, but not to a newly painted stroke."""
        if self._is_picked:
            super().change(settings)
