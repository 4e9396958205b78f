"""What the mouse and the keys do while the layer *Arrows* is the active one."""

from __future__ import annotations

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.paint_layer import touches
from napari_hmrf.tissue.drawing.marks import Point, Stroke
from napari_hmrf.ui.grab.grab_messages import (
    BESIDE,
    CANCELLED,
    HALF,
    NO_OUTSIDE,
    NO_STEP,
    NOTHING,
    NOTHING_DRAWN,
    NOTHING_SELECTED,
    OUTSIDE,
    PICKED,
    REMOVED,
    covered,
)
from napari_hmrf.ui.grab.puller import Puller


class Answers:
    """The `Listener` of *Grab and pull*: gives what happens on the canvas to the hand.

    Parameters
    ----------
    puller : Puller
    """

    def __init__(self, puller: Puller) -> None:
        self._puller = puller

    def press(self, point: Point, reach: float) -> bool:
        """Take hold of tissue, or of an arrow, or put the brush down."""
        puller, seen = self._puller, self._puller.display.seen
        if seen is None:
            return False
        puller.begun.emit()
        other = puller.display.covering
        if other is not None:
            puller.said.emit(covered(other.name))
            return False
        if puller.tool.is_brush and not seen.is_inside(point):
            puller.said.emit(OUTSIDE)
            return False
        hand, puller.picked = puller.hand, False
        taken = hand.press(point, reach, puller.how(), seen.came_from)
        self._show_how()
        if not taken:
            puller.said.emit(NOTHING)
        elif hand.pending is not None:
            puller.said.emit(HALF)
        if puller.tool.is_brush:
            if isinstance(hand.mark, Stroke) and hand.mark.moves_nowhere:
                puller.said.emit(NO_STEP)
            puller.display.touch(hand, point, first=True)
        if hand.holding:
            puller.display.arrows.hide_circle()
        puller.draw()
        return taken

    def pick(self, point: Point, reach: float) -> None:
        """Select what is drawn at a place, and take the tool it was made with."""
        puller, seen = self._puller, self._puller.display.seen
        if seen is None:
            return
        drawing, spacing = puller.history.drawing, seen.ground.study.grid.spacing
        hit = drawing.at(point, reach, spacing)
        if hit is not None:
            number: int | None = hit.number
        else:
            number = drawing.painted_at(seen.came_from(point) or point, spacing)
        if number is not None:
            puller.take_up(puller.tool_for(number))
        puller.hand.select(number)
        puller.picked = number is not None
        self._show_how()
        puller.said.emit(PICKED if number is not None else NOTHING_DRAWN)
        puller.draw()

    def _show_how(self) -> None:
        how = self._puller.hand.how
        if how is not None:
            self._puller.taken.emit(how)

    def move(self, point: Point) -> None:
        """Go on pulling or painting."""
        puller = self._puller
        puller.hand.move(point)
        if puller.tool.is_brush and puller.hand.holding:
            puller.display.touch(puller.hand, point, first=False)

    def release(self) -> None:
        """Let go."""
        self._puller.display.arrows.end_drag()
        try:
            done = self._puller.hand.release()
        except HmrfError:
            self._puller.forgive()
            self._puller.said.emit(NO_OUTSIDE)
            self._puller.draw()
            return
        if done:
            mark, seen = self._puller.hand.mark, self._puller.display.seen
            if isinstance(mark, Stroke) and mark.action != "tissue" and seen is not None:
                ground = seen.ground
                if not touches(mark, ground.base, ground.body):
                    self._puller.said.emit(BESIDE)
            if self._puller.tool.name == "landmark":  # no click is waited for any more
                self._puller.said.emit(self._puller.tool.how)
            self._puller.draw()

    def cancel(self) -> None:
        """Give up the drag or the pair that goes on; without one, select nothing."""
        self._puller.display.arrows.end_drag()
        if self._puller.hand.cancel():
            self._puller.said.emit(CANCELLED)
        else:
            self._puller.hand.select(None)
            self._puller.said.emit(self._puller.tool.how)
        self._puller.draw()

    def remove(self) -> None:
        """Remove what is selected."""
        self._puller.display.arrows.end_drag()
        removed = self._puller.hand.remove()
        self._puller.said.emit(REMOVED if removed else NOTHING_SELECTED)

    def ask_for(self, tool: str) -> None:
        """The key of a tool."""
        self._puller.asked_for.emit(tool)

    def ask_for_size(self, factor: float) -> None:
        """The keys of the brush's size."""
        self._puller.asked_for_size.emit(factor)

    def undo(self) -> None:
        """Take back what was done last."""
        self._puller.steps.undo()

    def redo(self) -> None:
        """Do again what was taken back."""
        self._puller.steps.redo()

    def interrupt(self) -> bool:
        """A pair of which only one place was clicked is what was done last."""
        self._puller.display.arrows.end_drag()
        if self._puller.hand.pending is None:
            return False
        self.cancel()
        return True
