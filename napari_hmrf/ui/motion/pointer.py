"""Drawing on the visible slice: the current tool, and its mouse and key actions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from psygnal import Signal

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.frame import SlicePlace
from napari_hmrf.layers.compat import text_of
from napari_hmrf.layers.paint_layer import tissue_colours
from napari_hmrf.layers.painted_overlay import Seen
from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.study.edit_history import Step
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Drawing, Landmark, Mark, Stroke
from napari_hmrf.tissue.drawing.marks import Point
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.messages import in_short
from napari_hmrf.ui.motion import motion_messages
from napari_hmrf.ui.motion.brush import Brush
from napari_hmrf.ui.motion.display import Display
from napari_hmrf.ui.motion.hands import Hand, Pull
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.motion.tools import BY_NAME, TOOLS, Tool, tool_of

#: In a drag the arrows are painted together with the tissue that follows them, once rather than
#: twice; if the tissue takes longer than this, in milliseconds, the arrows are painted first.
_AHEAD = 250
#: Factor by which a key enlarges the brush.
_LARGER = 1.25


class Pointer:
    """Editor of the drawing of each slice of each image, driven by events of the layer *Motion*.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    fields : ToolFields
        Settings of the tools.
    undo : ViewerUndo
        With the `StudyModel` whose drawings are edited.

    Attributes
    ----------
    tool : Tool
        Current tool.
    hand : Hand
        Drag and selection state of the tool; replaced for each tool and slice.
    tissue : napari.layers.Labels or Image, optional
        Layer whose colours the painted tissue takes.
    display : Display
        View of the drawing and the tissue.
    """

    #: The drawing has changed.
    drawn = Signal()
    #: The drawing, the undo steps, the selection or the tool has changed, or the mouse starts or
    #: stops drawing.
    changed = Signal()
    #: Status message; "" shows what the user can do next.
    said = Signal(str)
    #: Reason why an action of a tool has no effect.
    refused = Signal(str)
    #: A new action begins: earlier messages are out of date.
    begun = Signal()

    def __init__(self, native: Any, viewer: Any, fields: ToolFields, undo: ViewerUndo) -> None:
        self._fields, self._undo, self._model = fields, undo, undo.model
        self._model.select_slice(None)
        self.tool: Tool = BY_NAME["pull"]
        # True if the selected mark was picked up, rather than just made.
        self._picked = False
        # Mark that was held when the button was pressed.
        self._pressed: Mark | None = None
        self.display = Display(native, viewer, self)
        self._open_hand()
        # Text overlay in a corner of the canvas, and the text last written there by this object.
        self._corner, self._in_corner = text_of(viewer), ""
        self._drawing_waits = single_shot(native, _AHEAD, self.draw)
        self.tissue: Any = None
        self._in_error = False
        undo.said.connect(self._on_step)
        self._model.changed.connect(self._on_drawn)
        fields.changed.connect(self._on_field)

    # State

    @property
    def drawing(self) -> Drawing:
        """Drawing of the visible slice."""
        return self._model.drawing

    @property
    def active(self) -> bool:
        """True if the mouse draws."""
        return self.display.seen is not None and self.display.arrows.active

    @property
    def keys(self) -> dict[str, Callable[[], object]]:
        """Actions of the keys while the mouse draws."""
        return {
            "Delete": self.remove,
            "Backspace": self.remove,
            "Escape": self.cancel,
            "[": partial(self.resize, 1 / _LARGER),
            "]": partial(self.resize, _LARGER),
            **{tool.key: partial(self.take_up, tool.name) for tool in TOOLS},
        }

    # Actions

    def stand_on(self, study: Study | None, image: Any = None) -> None:
        """Switch to the drawing of another slice, or of none.

        Parameters
        ----------
        study : Study or None
            None if there is nothing to draw on.
        image : napari.layers.Image, optional
            Image to draw on.
        """
        self.release()
        place = None if study is None else SlicePlace.of(study.grid.known_place)
        self._model.select_slice(None if study is None else image, place)
        self.display.stand_on(study, image, bool(self.drawing.marks))
        self._open_hand()
        self.draw()

    def take_up(self, name: str) -> None:
        """Switch to a tool, with nothing selected.

        Raises
        ------
        ValueError
            If there is no tool of that name.
        """
        if name not in BY_NAME:
            raise ValueError(f"there is no tool {name!r}, only {', '.join(BY_NAME)}")
        tool = BY_NAME[name]
        if tool is self.tool:
            return
        self.release()
        self.tool = tool
        self._open_hand()
        self._fields.show_for(tool)
        self.draw()
        self.say_tool()
        if self.active:
            self.said.emit("")

    def take(self) -> None:
        """Start drawing with the mouse."""
        seen = self.display.seen
        if seen is None:
            return
        moved, radius = seen.moved, self._fields.radius.value
        grid = moved.study.grid
        with self.display.own_doing():
            self.display.arrows.take(grid.known_place, grid.shape, radius)
        if moved.ground is not None and not moved.moves:
            self.display.show(seen, self.hand)
        self.draw()
        self.said.emit("" if moved.ground else motion_messages.PREPARING)
        self.say_tool()

    def say_tool(self) -> None:
        """Show the current tool on the canvas while the mouse draws; text of other origin stays."""
        corner = self._corner
        if not corner.visible or corner.text == self._in_corner:
            self._in_corner = corner.text = self._fields.words if self.active else ""
            corner.visible = self.active

    def set_drawing(self, drawing: Drawing, word: str) -> None:
        """Replace the drawing, as an undo step named `word`; if that is "", without a step."""
        self.release()
        if self._model.slice.layer is not None:  # else there is nothing to draw on
            self._model.draw(drawing, word)

    def clear(self) -> None:
        """Remove all marks of the drawing."""
        self.set_drawing(Drawing(), "removed all")
        self.said.emit(motion_messages.REMOVED_ALL)

    def draw(self) -> None:
        """Show the current drawing."""
        self._drawing_waits.stop()
        self.display.draw(self.drawing, self.hand)
        self.changed.emit()

    def show(self, seen: Seen) -> None:
        """Show the tissue as it follows the drawing."""
        ground = seen.moved.ground
        if seen.moved.error is not None:
            self._show_error(seen)
            return
        before = self.display.seen
        known = None if before is None else before.moved.ground
        if ground is not None and ground is not known:
            self._fields.offer(ground.palette)
            self.display.tissues = tissue_colours(ground.palette, self.tissue)
        self.display.show(seen, self.hand)
        if self._drawing_waits.isActive():
            self.draw()
        elif seen.marks is not None or (before is not None and before.marks is not None):
            self.display.draw(self.drawing, self.hand)  # its marks follow the tissue
        if (known is None and self.active) or self._in_error:
            self._in_error = False
            self.said.emit("")

    def leave(self) -> None:
        """Stop drawing, and remove the layers that no longer respond; the drawing stays."""
        self.stand_on(None)
        self.display.leave()
        self.say_tool()

    def end(self) -> None:
        """Disconnect from the undo steps, and end any drag."""
        self.display.arrows.end_drag()
        self._undo.said.disconnect(self._on_step)
        self._model.changed.disconnect(self._on_drawn)

    # Mouse and key actions on the canvas

    def press(self, point: Point, reach: float) -> None:
        """Take hold of tissue or of an arrow, or begin a stroke of the brush."""
        moved = self.display.moved
        if moved is None or moved.ground is None:
            self.said.emit(motion_messages.PREPARING)
            return
        self.begun.emit()
        other = self.display.covering
        if other is not None:
            self.said.emit(motion_messages.covered(other.name))
            return
        if self.tool.is_brush and not moved.is_inside(point):
            self.said.emit(motion_messages.OUTSIDE)
            return
        hand, self._picked = self.hand, False
        taken = hand.press(point, reach, self._fields.how, moved.came_from)
        self._pressed = hand.mark
        self._show_how()
        if not taken:
            self.said.emit(motion_messages.NOTHING)
        elif isinstance(hand.mark, Stroke) and hand.mark.moves_nowhere:
            self.said.emit(motion_messages.NO_STEP)
        else:
            self.said.emit("")
        if self.tool.is_brush:
            self.display.touch(hand, first=True)
        if hand.holding:
            self.display.arrows.hide_circle()
        self.draw()

    def pick(self, point: Point, reach: float) -> None:
        """Select the mark at a point, and switch to the tool that made it."""
        moved = self.display.moved
        if moved is None:
            return
        drawing, spacing = self.drawing, moved.study.grid.spacing
        hit = drawing.at(point, reach, spacing)
        before = moved.came_from(point) or point
        number = drawing.painted_at(before, spacing) if hit is None else hit.number
        self._picked = number is not None
        if number is not None:
            self.take_up(tool_of(drawing.marks[number]).name)
        self.hand.select(number)
        self._show_how()
        self.said.emit(motion_messages.PICKED if self._picked else motion_messages.NOTHING_DRAWN)
        self.draw()

    def move(self, point: Point) -> None:
        """Continue to pull or to paint."""
        self.hand.move(point)
        if self.tool.is_brush and self.hand.holding:
            self.display.touch(self.hand, first=False)

    def release(self) -> None:
        """End the pull or the stroke."""
        self.display.arrows.end_drag()
        held, done = self.hand.holding, ""
        try:
            done = self.hand.release()
        except HmrfError:
            self._in_error = False
            self.refused.emit(motion_messages.NO_OUTSIDE)
        if held:
            mark = self.hand.mark
            self._show_how()
            pushed = isinstance(mark, Stroke) and mark.action == "move" and not mark.moves_nowhere
            if pushed:  # the stroke needs no further input
                self.said.emit("")
            elif done and isinstance(mark, Landmark) and mark == self._pressed:
                self.said.emit(motion_messages.NO_WAY)
            self.draw()

    def turn(self) -> None:
        """Respond to a change of the visible slice; in a volume the drag continues there."""
        moved = self.display.moved
        if moved is None or len(moved.study.grid.shape) == 2:
            self.release()
        else:
            self.draw()

    def cancel(self) -> None:
        """Cancel the current drag; without a drag, clear the selection."""
        self.display.arrows.end_drag()
        if self.hand.cancel():
            self.said.emit(motion_messages.CANCELLED)
        else:
            self.hand.select(None)
            self.said.emit("")
        self.draw()

    def remove(self) -> None:
        """Remove the selected mark."""
        self.release()
        removed = self.hand.remove()
        self.said.emit(motion_messages.REMOVED if removed else motion_messages.NOTHING_SELECTED)

    def resize(self, factor: float) -> None:
        """Multiply the radius of the brush by a factor."""
        radius = self._fields.radius
        radius.value = min(max(float(f"{radius.value * factor:.3g}"), radius.min), radius.max)

    # Reactions to changes

    def _open_hand(self) -> None:
        """Create the hand of the current tool, with nothing selected."""
        moved = self.display.moved
        grid = () if moved is None else (moved.study.grid.spacing, moved.study.grid.shape)
        self.hand: Hand = (Brush if self.tool.is_brush else Pull)(self._model, *grid)

    def _show_how(self) -> None:
        mark = self.hand.mark
        if mark is not None:
            self._fields.show_how(mark)

    def _on_drawn(self, part: Any) -> None:
        if part != self._model.slice:
            return
        self.drawn.emit()
        if not self.hand.holding:
            self.draw()
        elif not self._drawing_waits.isActive():
            self._drawing_waits.start()

    def _on_step(self, _: str, step: Step | None) -> None:
        """Select the mark that undo or redo changed or restored, if the current tool made it."""
        if step is None or step.part != self._model.slice:
            return
        marks = self.drawing.marks
        new = [number for number, mark in enumerate(marks) if mark not in step.value.marks]
        if len(new) == 1 and tool_of(marks[new[0]]) is self.tool:
            self.hand.select(new[0])
            self._show_how()
            self.draw()

    def _on_field(self, *_: Any) -> None:
        how = self._fields.how
        self.display.arrows.show_radius(how.radius)
        self.say_tool()
        # A new choice of tissue applies to the next stroke; other tools also adjust the last mark.
        if self.tool.name == "tissue" and not self._picked:
            return
        self.hand.change(how)

    def _show_error(self, seen: Seen) -> None:
        error, hand = seen.moved.error, self.hand
        assert error is not None
        self._in_error, words = self.active, in_short(error)
        if not (hand.holding and isinstance(hand.mark, Stroke)):
            self.display.show_painted(seen, hand)
        elif hand.mark.action == "expand":  # a ring is an open line until it is closed
            words = motion_messages.OPEN
        if self.active:
            self.said.emit(words)
