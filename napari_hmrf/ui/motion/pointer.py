"""Mouse and key actions on the visible slice, passed to the current tool."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from psygnal import Signal

from napari_hmrf.field.units import as_seen
from napari_hmrf.layers.compat import text_of
from napari_hmrf.layers.line_of_sight import LineOfSight
from napari_hmrf.layers.paint_layer import tissue_colours
from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.study.edit_history import Step
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.study import Study
from napari_hmrf.study.without_effect import lacks_motion, slides_inside
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.drawing.drawing import ends_of
from napari_hmrf.tissue.drawing.growth import is_pull
from napari_hmrf.tissue.drawing.marks import Point
from napari_hmrf.ui.events import Return, single_shot
from napari_hmrf.ui.messages import in_short
from napari_hmrf.ui.motion import motion_messages
from napari_hmrf.ui.motion.display import Display
from napari_hmrf.ui.motion.region_growth import RegionGrowth
from napari_hmrf.ui.motion.tool import Tool, ToolError
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.motion.tools import BY_NAME, TOOLS, tool_of

#: Longest time that arrows wait for the updated tissue during a drag, in milliseconds. Painting
#: both together saves a repaint.
_AHEAD = 250
#: Factor by which a key press enlarges the brush.
_LARGER = 1.25
#: Time without a turn of the mouse wheel after which its undo step ends, in milliseconds.
_WHEEL_REST = 400
#: Time after the return from another application in which a click has no effect, in seconds.
_RETURN = 0.3


class EarlyDrag(NamedTuple):
    """Drag from before the tissue was ready: hit distance and points, as in `CanvasListener`."""

    reach: float
    points: list[Point]


class Pointer:
    """Dispatcher that passes mouse and key actions on the layer *Motion* to the current tool.

    The pointer edits the drawing of each slice of each image, and works with any tool.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    fields : ToolFields
        Settings of the tools.
    undo : ViewerUndo
        Undo commands of the viewer, with the `Session` that contains the edited drawings.

    Attributes
    ----------
    tool : Tool
        Current tool, with its drag and selection; a new tool is created for each slice.
    tissue : napari.layers.Labels or Image, optional
        Layer that defines the colours of painted tissue.
    display : Display
        View of the drawing and the tissue.
    """

    #: Emitted when the drawing has changed.
    drawn = Signal()
    #: Emitted when the drawing, the undo steps, the selection or the tool has changed, or when the
    #: mouse has started or stopped drawing.
    changed = Signal()
    #: Emitted with a status message; "" shows a hint about the next step.
    message = Signal(str)
    #: Emitted with the reason why an action of a tool has no effect.
    refusal = Signal(str)
    #: Emitted with the distance of the drag in progress; "" shows the result again.
    pulled = Signal(str)
    #: Emitted when a new action begins and earlier messages are out of date.
    action_started = Signal()

    def __init__(self, native: Any, viewer: Any, fields: ToolFields, undo: ViewerUndo) -> None:
        self._fields, self._undo, self._session = fields, undo, undo.session
        self._session.select_slice(None)
        self.display = Display(native, viewer, undo.session, self)
        self.tool = self._create_tool(BY_NAME["pull"])
        self._show_cursor()
        # Text overlay in a corner of the canvas, and the text last written there by this object.
        self._corner, self._in_corner = text_of(viewer), ""
        self._draw_timer = single_shot(native, _AHEAD, self.draw)
        # The undo step of the wheel ends after a rest and all pending turns of the wheel, which may
        # have waited for a repaint.
        self._wheel_end = single_shot(native, 0, self.release)
        self._wheel_timer = single_shot(native, _WHEEL_REST, self._wheel_end.start)
        self.tissue: Any = None
        self._in_error = False
        # Drags that began before the tissue was ready, and True while the last one continues.
        self._early_drags: list[EarlyDrag] = []
        self._is_early = False
        # Drawing before the drag.
        self._undragged = Drawing()
        # True once the user has pressed the mouse button on the image.
        self._is_used = False
        self._return = Return()
        # Time of the last press of the mouse button, and drawing just after it.
        self._pressed_at, self._pressed = 0.0, Drawing()
        self._regions = RegionGrowth(self._session)
        undo.message.connect(self._on_step)
        self._session.changed.connect(self._on_drawn)
        fields.changed.connect(self._on_field)

    # State

    @property
    def drawing(self) -> Drawing:
        """Drawing of the visible slice."""
        return self._session.drawing

    @property
    def active(self) -> bool:
        """True if the mouse draws instead of moving the view."""
        return self.display.moved is not None and self.display.arrows.active

    @property
    def keys(self) -> dict[str, Callable[[], object]]:
        """Key actions while the mouse draws; see `CanvasListener.keys`."""
        return {
            "Delete": self.remove,
            "Backspace": self.remove,
            "Escape": self.cancel,
            "[": partial(self.resize, 1 / _LARGER),
            "]": partial(self.resize, _LARGER),
            **{tool.key: partial(self.select_tool, tool.name) for tool in TOOLS},
        }

    # Actions

    def select_slice(self, study: Study | None, image: Any = None) -> None:
        """Select the drawing of another slice, or no drawing.

        Parameters
        ----------
        study : Study or None
            Study of the slice; None if there is nothing to draw on.
        image : napari.layers.Image, optional
            Image to draw on.
        """
        self.release()
        self._early_drags.clear()
        self.display.close_slice()
        if study is None:
            self._session.select_slice(None)
        else:
            self._session.select_slice(image, study.grid.place)
            self.display.open_slice(study)
        self.tool = self._create_tool(type(self.tool))
        self.pulled.emit("")
        self.draw()

    def select_tool(self, name: str) -> None:
        """Switch to a tool, and clear the selection.

        Raises
        ------
        ValueError
            If there is no tool with this name.
        """
        if name not in BY_NAME:
            raise ValueError(f"unknown tool {name!r}; use one of {', '.join(BY_NAME)}")
        tool = BY_NAME[name]
        if tool is type(self.tool):
            return
        self.release()
        self._early_drags.clear()
        self.tool = self._create_tool(tool)
        self._fields.show_for(tool)
        self._show_settings()
        self._show_cursor()
        self.display.arrows.update_wheel()
        self.draw()
        self.report_tool()
        if self.active:
            self.message.emit("")

    def start_drawing(self) -> None:
        """Start drawing with the mouse."""
        moved, circle = self.display.moved, self.tool.cursor(self._fields.settings)
        if moved is None:
            return
        grid = moved.study.grid
        with self.display.program_changes():
            self.display.arrows.activate(grid.known_place, grid.shape, circle)
        if moved.ground is not None and not moved.moves:
            self.display.show(moved, self.tool.stroke)
        self.draw()
        self.message.emit("" if moved.ground else motion_messages.PREPARING)
        self.report_tool()

    def report_tool(self) -> None:
        """Show the name of the tool on the canvas, unless other text is shown there.

        The painted confidence is shown while its brush draws.
        """
        self.display.show_confidence(self.active and self.tool.name == "confidence")
        corner = self._corner
        if not corner.visible or corner.text == self._in_corner:
            self._in_corner = corner.text = self._words if self.active else ""
            corner.visible = self.active

    @property
    def _words(self) -> str:
        """Text on the canvas: the tool, and until its first use where to drag."""
        words = self._fields.words
        is_new = not (self._is_used or self.drawing.marks) and words == BY_NAME["pull"].title
        return motion_messages.ON_CANVAS.format(words) if is_new else words

    def set_drawing(self, drawing: Drawing, word: str) -> None:
        """Replace the drawing as an undo step named `word`, or without a step if `word` is ""."""
        self.release()
        if self._session.slice.layer is not None:  # else there is nothing to draw on
            self._session.draw(drawing, word)

    def clear(self) -> None:
        """Remove all marks of the drawing."""
        self.set_drawing(Drawing(), "removed all")
        self.message.emit(motion_messages.REMOVED_ALL)

    def draw(self) -> None:
        """Show the current drawing, and the distance of a drag."""
        self._draw_timer.stop()
        self._show_drawing()
        moved, by = self.display.moved, self.tool.pulled
        if moved is not None and by is not None and any(by):
            far = as_seen(math.hypot(*by), moved.study.grid.spacing)
            self.pulled.emit(motion_messages.pulling(far, self._fields.unit))
        self.changed.emit()

    def show(self, moved: Deformation) -> None:
        """Show the new state of the tissue after a change to the drawing."""
        ground = moved.ground
        if moved.error is not None:
            self._early_drags.clear()
            self._show_error(moved, moved.error)
            return
        before = self.display.moved
        known = None if before is None else before.ground
        if ground is not None and ground is not known:
            self._fields.offer(ground.palette)
            self.display.tissues = tissue_colours(ground.palette, self.tissue)
        self.display.show(moved, self.tool.stroke)
        if self._draw_timer.isActive():
            self.draw()
        elif moved.lines is not None or (before is not None and before.lines is not None):
            self._show_drawing()  # the marks move with the tissue
        if (known is None and self.active) or self._in_error:
            self._in_error = False
            self.message.emit("")
        if ground is not None and self._early_drags:
            self._replay()

    def leave(self) -> None:
        """Stop drawing and remove the layer *Motion*, but keep the drawing."""
        self.select_slice(None)
        self.display.leave()
        self.report_tool()

    def end(self) -> None:
        """Disconnect from the undo steps, and end any drag."""
        self.display.arrows.end_drag()
        self.display.release()
        self._return.release()
        self._undo.message.disconnect(self._on_step)
        self._session.changed.disconnect(self._on_drawn)

    # Mouse and key actions on the canvas

    @property
    def follows_surface(self) -> bool:
        """True if the current drag follows the surface in the 3-D view; see `Tool`."""
        return self.tool.follows_surface

    def find(
        self, line: LineOfSight, reach: float | None = None, picks: bool = False
    ) -> Point | None:
        """Return the point to draw at on a line of sight of the 3-D view, or None.

        Parameters
        ----------
        line : LineOfSight
        reach : float, optional
            Largest distance from the line to an end of a mark, in the unit of the spacing. By
            default, only tissue is found.
        picks : bool
            True if ends of marks are found with any tool, to select a mark. By default, only ends
            that the current tool grabs are found.
        """
        moved = self.display.moved
        if moved is None or moved.ground is None:
            self.message.emit(motion_messages.PREPARING)
            return None
        seen, hides = self.display.tissue_on(line), self.display.hides_inside
        end, spacing = None, moved.study.grid.spacing
        if reach is not None and (picks or self.tool.grabs_ends):
            ends = [
                end
                for mark in self.drawing.marks
                for end in ends_of(mark, spacing)
                if not (hides and seen is not None and line.is_hidden(end, seen, mark.radius))
            ]
            end = line.nearest(ends, reach)
        return seen if end is None else end

    def press(self, point: Point, reach: float) -> None:
        """Begin a drag with the tool if the tissue is ready and visible."""
        moved = self.display.moved
        if moved is None or moved.ground is None:
            self._early_drags.append(EarlyDrag(reach, [point]))
            self._is_early = True
            self.message.emit(motion_messages.EARLY)
            return
        result = self.display.result
        if result is not None and result.is_before:  # the pressed tissue is seen at its origin
            moved = replace(moved, solution=None)
        self._is_used = True
        self.action_started.emit()
        other = self.display.covering
        if other is not None:
            self.message.emit(motion_messages.covered(other.name))
            return
        self._undragged = self.drawing
        self._pressed_at = time.monotonic()
        self.tool.present = moved.motion_of
        message = self.tool.press(point, reach, self._fields.settings, moved.origin_of)
        self._pressed = self.drawing
        if self.tool.is_dragging:
            self._show_settings()
            if self.display.arrows.is_hidden:
                message = message or motion_messages.HIDDEN
        self.message.emit(message)
        self._show_stroke(at_once=True)
        self._show_cursor()
        self.draw()

    def pick(self, point: Point, reach: float) -> None:
        """Select the mark at a point, and switch to the tool that makes such marks."""
        moved = self.display.moved
        if moved is None:
            return
        drawing, spacing = self.drawing, moved.study.grid.spacing
        hit = drawing.at(point, reach, spacing)
        before = moved.origin_of(point) or point
        number = drawing.painted_at(before, spacing) if hit is None else hit.number
        if number is not None:
            self.select_tool(tool_of(drawing.marks[number]).name)
        self.tool.pick(number)
        self._show_settings()
        is_hit = number is not None
        self.message.emit(motion_messages.PICKED if is_hit else motion_messages.NOTHING_DRAWN)
        self.draw()

    def move(self, point: Point) -> None:
        """Continue the drag of the tool."""
        if self._is_early:
            self._early_drags[-1].points.append(point)
            return
        self.tool.move(point)
        self._show_stroke(at_once=False)

    def takes_wheel_at(self, point: Point | None = None) -> bool:
        """Return whether the tool uses the mouse wheel at a point on tissue, or anywhere."""
        if point is None or not self.tool.takes_wheel:
            return self.tool.takes_wheel
        moved = self.display.moved
        return moved is not None and moved.origin_of(point) is not None

    def turn_wheel(self, point: Point, notches: float) -> None:
        """Change a mark with the mouse wheel."""
        moved = self.display.moved
        if moved is None or moved.ground is None:
            self.message.emit(motion_messages.PREPARING)
            return
        if not self.tool.is_dragging:
            self.tool.present = moved.motion_of
            self.action_started.emit()
        if (other := self.display.covering) is not None:
            self.message.emit(motion_messages.covered(other.name))
            return
        material = self._regions.material_at(moved, point) if self.tool.takes_wheel else None
        if material is not None and not self.tool.is_dragging:
            self._wheel_end.stop()
            self._wheel_timer.start()
            self.message.emit(motion_messages.region_grown(self._regions.turn(material, notches)))
            return
        try:
            has_grown = self.tool.turn_wheel(point, notches, self._fields.settings, moved.origin_of)
        except ToolError as error:
            self.refusal.emit(str(error))
            return
        if has_grown and (mark := self.tool.mark) is not None:
            self._wheel_end.stop()
            self._wheel_timer.start()
            self._show_settings()
            self._show_cursor()
            unit, is_pulled = self._fields.unit, is_pull(mark)
            self.message.emit(motion_messages.grown(mark.amount, unit, is_pulled))

    def release(self) -> None:
        """End the drag of the tool."""
        self._wheel_timer.stop()
        self._wheel_end.stop()
        self._regions.end()
        self.display.arrows.end_drag()
        self._is_early = False
        was_dragging, message = self.tool.is_dragging, None
        if was_dragging and self._only_returns:
            self.tool.cancel()
            message = motion_messages.RETURNED
        try:
            message = self.tool.release() or message
        except ToolError as error:
            self._in_error = False
            self.refusal.emit(str(error))
        self._show_cursor()
        if was_dragging:
            if self.drawing == self._undragged:
                self.pulled.emit("")
            if self._lacks_motion:
                self.refusal.emit(motion_messages.NO_MOTION)
                message = None
            elif self._slides_inside:
                message = motion_messages.SLIDES_INSIDE
            self._show_settings()
            if message is not None:
                self.message.emit(message)
            self.draw()

    @property
    def _only_returns(self) -> bool:
        """True if the last press, without a drag, brought the window to the front."""
        is_click = self.drawing is self._pressed
        return is_click and self._return.is_since(self._pressed_at - _RETURN)

    def turn(self) -> None:
        """Respond to a change in the visible slice: end the drag, or continue it in a volume."""
        moved = self.display.moved
        if moved is None or len(moved.study.grid.shape) == 2:
            self.release()
        else:
            self.draw()

    def cancel(self) -> None:
        """Cancel the current drag; without a drag, clear the selection."""
        self.display.arrows.end_drag()
        self._is_early = False
        if self._early_drags:
            self._early_drags.clear()
            self.message.emit(motion_messages.CANCELLED)
        elif self.tool.cancel():
            self.pulled.emit("")
            self.message.emit(motion_messages.CANCELLED)
        else:
            self.tool.select(None)
            self._show_settings()
            self.message.emit("")
        self._show_cursor()
        self.draw()

    def remove(self) -> None:
        """Remove the selected mark."""
        self.release()
        removed = self.tool.remove()
        self.message.emit(motion_messages.REMOVED if removed else motion_messages.NOTHING_SELECTED)

    def suggest_radius(self, radius: float) -> None:
        """Set the radius of new marks, unless the user has set one."""
        self._fields.suggest_radius(radius)
        self._show_settings()
        self._show_cursor()

    def resize(self, factor: float) -> None:
        """Multiply the brush radius by a factor."""
        radius, (least, largest) = self._fields.radius, self._fields.radius_range
        radius.value = min(max(float(f"{radius.value * factor:.3g}"), least), largest)

    def _replay(self) -> None:
        """Apply the drags that began before the tissue was ready."""
        drags, self._early_drags = self._early_drags, []
        goes_on, self._is_early = self._is_early, False
        for drag in drags:
            first, *others = drag.points
            if len(set(drag.points)) == 1 and not (goes_on and drag is drags[-1]):
                continue  # a click has no visible effect until the tissue is ready
            self.press(first, drag.reach)
            for point in others:
                self.move(point)
            if drag is not drags[-1] or not goes_on:
                self.release()

    @property
    def _lacks_motion(self) -> bool:
        """True if the selected stroke paints confidence where nothing is held or moved."""
        moved, number = self.display.moved, self.tool.selected
        if moved is None or moved.ground is None or number is None:
            return False
        return lacks_motion(self.drawing, number, moved.ground.base)

    @property
    def _slides_inside(self) -> bool:
        """True if the selected stroke paints a sliding surface inside tissue."""
        moved, number = self.display.moved, self.tool.selected
        if moved is None or moved.ground is None or number is None:
            return False
        ground = moved.ground
        return slides_inside(self.drawing, number, ground.stiffness > 0, ground.base)

    # Reactions to changes

    def _create_tool(self, kind: type[Tool]) -> Tool:
        """Create a tool for the visible slice, without a selection."""
        moved = self.display.moved
        if moved is None:
            return kind(self._session)
        grid = moved.study.grid
        return kind(self._session, grid.spacing, grid.shape)

    def _show_settings(self) -> None:
        """Show the settings of the selected mark in the fields."""
        settings = self.tool.mark_settings
        if settings is not None:
            self._fields.show_settings(settings)
        if settings is None or "radius" not in settings:
            self._fields.show_new_radius()

    def _show_cursor(self) -> None:
        """Show the radius of the tool as a circle on the canvas."""
        self.display.arrows.show_cursor(self.tool.cursor(self._fields.settings))

    def _show_stroke(self, at_once: bool) -> None:
        """Show the stroke that is being painted, if there is one."""
        stroke = self.tool.stroke
        if stroke is not None:
            self.display.show_stroke(stroke, at_once)

    def _show_drawing(self) -> None:
        self.display.draw(self.drawing, self.tool.selected, self.tool.is_dragging)

    def _on_drawn(self, part: Hashable) -> None:
        if part != self._session.slice:
            return
        self.drawn.emit()
        if not self.tool.is_dragging:
            self.draw()
        elif not self._draw_timer.isActive():
            self._draw_timer.start()

    def _on_step(self, _: str, step: Step | None) -> None:
        """Select the mark that undo or redo changed, if the current tool makes such marks."""
        if step is None or step.part != self._session.slice:
            return
        marks = self.drawing.marks
        new = [number for number, mark in enumerate(marks) if mark not in step.value.marks]
        if len(new) == 1 and self.tool.makes(marks[new[0]]):
            self.tool.select(new[0])
            self._show_settings()
            self.draw()

    def _on_field(self, *_: object) -> None:
        self._show_cursor()
        self.report_tool()
        self.tool.change(self._fields.shown_settings)
        if refusal := self._fields.pop_refusal():
            self.refusal.emit(refusal)

    def _show_error(self, moved: Deformation, error: Exception) -> None:
        if not self.tool.is_dragging:
            self.pulled.emit("")
        self._in_error = self.active
        if self.tool.stroke is None:
            self.display.show_painted(moved)
        if self.active:
            self.message.emit(self.tool.error_message or in_short(error))
