"""What pulls tissue: the drawings of all slices, the hand that draws, and tissue that follows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from psygnal import Signal

from napari_hmrf.drawing import Drawing, History
from napari_hmrf.drawing.brush import Paint
from napari_hmrf.drawing.hand import Hand
from napari_hmrf.drawing.marks import Point
from napari_hmrf.drawing.pull import Grip
from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.ground import Ground
from napari_hmrf.widgets.grab.arrows import ArrowsLayer
from napari_hmrf.widgets.grab.follow import Follower, Seen
from napari_hmrf.widgets.grab.hands import Hands
from napari_hmrf.widgets.grab.histories import Histories
from napari_hmrf.widgets.grab.live_layers import LiveLayers
from napari_hmrf.widgets.grab.tools import BY_NAME, Tool
from napari_hmrf.widgets.grab.words import (
    CANCELLED,
    HALF,
    NOTHING,
    NOTHING_DRAWN,
    NOTHING_SELECTED,
    OFF,
    OUTSIDE,
    PICKED,
)
from napari_hmrf.widgets.words import COMPILING, refusal

#: So few folded pixels are noise of the rounding, and nothing to warn of.
_HANDFUL = 5


class Puller:
    """Answers the mouse and the keys of the layer *Arrows*; each slice has its own drawing.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    grip : callable
        How new arrows take hold.
    """

    #: The drawing, what can be undone or what is selected is another.
    changed = Signal()
    #: What there is to say, in words.
    said = Signal(str)
    #: The state of the tissue that is seen from now on.
    seen = Signal(object)
    #: How the mark that was taken hold of is made.
    taken = Signal(object)
    #: Another tool is taken.
    taken_up = Signal(object)
    #: A key asks for a tool, or for a brush so many times larger.
    asked_for = Signal(str)
    asked_for_size = Signal(float)

    def __init__(self, viewer: Any, how: Callable[[], Grip | Paint]) -> None:
        self._how = how
        self.history = History()
        self.tool: Tool = BY_NAME["pull"]
        self._hands = Hands(self.history)
        self.arrows = ArrowsLayer(viewer, self)
        self.follower = Follower(self._on_seen)
        self._shown = LiveLayers(viewer)
        self._image: Any = None
        self._seen: Seen | None = None
        self._busy_with_layers = self._working = self._warned = False
        self._histories = Histories()

    @property
    def hand(self) -> Hand:
        """What holds the tool."""
        return self._hands.of(self.tool)

    @property
    def ground(self) -> Ground | None:
        """What is drawn on."""
        return self.follower.ground

    @property
    def active(self) -> bool:
        """Whether the mouse pulls tissue."""
        return self.arrows.active

    @property
    def quiet(self) -> bool:
        """Whether layers come and go by our own doing."""
        return self._busy_with_layers

    def stand_on(self, ground: Ground | None, image: Any = None) -> None:
        """Go over to the drawing of another slice, or of the same with other tissue.

        Parameters
        ----------
        ground : Ground or None
            None: there is nothing to draw on.
        image : napari.layers.Image, optional
            What is pulled.
        """
        self.release()
        self.history.changed.disconnect(self._on_changed, missing_ok=True)
        self.follower.stand_on(ground)
        self._image = image
        if ground is None:
            self._seen, self.history = None, History()
            self._hands = Hands(self.history)
        else:
            self.history = self._histories.of(image, ground.frame)
            self._hands = Hands(self.history, ground.frame.spacing, ground.shape)
            self._seen = Seen.still(ground)
            with self._own_doing():
                self.arrows.place(ground.frame, ground.shape)
            self._working = False
        self.history.changed.connect(self._on_changed)
        self._on_changed(self.history.drawing)

    def take_up(self, tool: Tool) -> None:
        """Have another tool in the hand, which has nothing selected."""
        if tool is self.tool:
            return
        self.release()
        self.hand.cancel()
        self.hand.select(None)
        self.tool = tool
        self.hand.select(None)
        self.draw()
        self.taken_up.emit(tool)
        if self.active:
            self.said.emit(tool.how)

    def take(self, radius: float) -> None:
        """Have the mouse draw."""
        ground = self.ground
        if ground is None:
            return
        with self._own_doing():
            self.arrows.take(ground.frame, ground.shape, radius)
        self.draw()
        self.said.emit(COMPILING if self._working else self.tool.how)

    def complete(self) -> None:
        """The drawing rests: keep it, and have its displacement drawn."""
        self.arrows.keep(self.history.drawing)
        self.follower.complete()

    def draw(self) -> None:
        """Show the arrows as they are."""
        hand = self.hand
        self.arrows.show(self.history.drawing, hand.selected, hand.pending)
        self.changed.emit()

    # What the mouse and the keys do

    def press(self, point: Point, reach: float) -> bool:
        """Take hold of tissue, or of an arrow, or put the brush down."""
        if self._seen is None:
            return False
        if self.tool.is_brush and not self._seen.is_inside(point):
            self.said.emit(OUTSIDE)
            return False
        how = self._how()
        taken = self.hand.press(point, reach, how, self._seen.came_from)
        self._show_how()
        if not taken:
            self.said.emit(NOTHING)
        elif self.hand.pending is not None:
            self.said.emit(HALF)
        self.draw()
        return taken

    def pick(self, point: Point, reach: float) -> None:
        """Select what is drawn at a place, and take the tool it was made with."""
        if self._seen is None:
            return
        drawing, spacing = self.history.drawing, self._seen.ground.frame.spacing
        hit = drawing.at(point, reach, spacing)
        if hit is not None:
            number: int | None = hit.number
        else:
            number = drawing.painted_at(self._seen.came_from(point) or point, spacing)
        if number is not None:
            self.take_up(self._hands.tool_for(number))
        self.hand.select(number)
        self._show_how()
        self.said.emit(PICKED if number is not None else NOTHING_DRAWN)
        self.draw()

    def _show_how(self) -> None:
        how = self.hand.how
        if how is not None:
            self.taken.emit(how)

    def move(self, point: Point) -> None:
        """Go on pulling or painting."""
        self.hand.move(point)

    def release(self) -> None:
        """Let go."""
        self.arrows.end_drag()
        try:
            done = self.hand.release()
        except HmrfError as error:
            self.said.emit(refusal(error))
            self.draw()
            return
        if done:
            self.said.emit(self.tool.how)
            self.draw()

    def cancel(self) -> None:
        """Give up the drag or the pair that goes on; without one, select nothing."""
        self.arrows.end_drag()
        if self.hand.cancel():
            self.said.emit(CANCELLED)
        else:
            self.hand.select(None)
        self.draw()

    def remove(self) -> None:
        """Remove what is selected."""
        self.arrows.end_drag()
        if not self.hand.remove():
            self.said.emit(NOTHING_SELECTED)

    def ask_for(self, tool: str) -> None:
        """The key of a tool."""
        self.asked_for.emit(tool)

    def ask_for_size(self, factor: float) -> None:
        """The keys of the brush's size."""
        self.asked_for_size.emit(factor)

    def undo(self) -> None:
        """Take back what was done last."""
        if self._give_up_half():
            return
        word = self.history.undo()
        self.said.emit(f"Took back: {word}." if word else "There is nothing to take back.")

    def redo(self) -> None:
        """Do again what was taken back."""
        if self._give_up_half():
            return
        word = self.history.redo()
        self.said.emit(f"Did again: {word}." if word else "There is nothing to do again.")

    def _give_up_half(self) -> bool:
        """A pair of which only one place was clicked is what was done last."""
        self.arrows.end_drag()
        if self.hand.pending is None:
            return False
        self.cancel()
        return True

    def set_drawing(self, drawing: Drawing, word: str) -> None:
        """Have another drawing, as one step."""
        self.release()
        self.history.do(drawing, word)

    def leave(self) -> None:
        """Take the layer of arrows away, as nobody answers it; what is drawn is kept."""
        self.release()
        self.arrows.unbind_viewer()
        with self._own_doing():
            self.arrows.remove()

    def end(self) -> None:
        """Pull nothing any more."""
        self.arrows.release()
        self.follower.release()

    # What follows

    def _on_changed(self, drawing: Drawing) -> None:
        self.follower.follow(drawing)
        self.draw()

    def _on_seen(self, seen: Seen) -> None:
        if seen.ground is not self.ground or self._image is None:
            return
        if seen.error is not None:
            self.said.emit(refusal(seen.error))
            return
        first, self._working = not self._working, True
        self._seen = seen
        if seen.solution is not None or self._shown.picture is not None:
            with self._own_doing():
                self._shown.show(seen, self._image)
        if first:
            self.said.emit(self.tool.how if self.active else OFF)
        if seen.outputs is not None:
            self._warn_of(seen.outputs.folds)
        self.seen.emit(seen)

    def _warn_of(self, folds: int) -> None:
        before, self._warned = self._warned, folds > _HANDFUL
        if self._warned:
            self.said.emit(
                f"Warning: at {folds} pixels the tissue is pushed through itself (it folds), "
                "which no tissue does. Pull less, or a larger patch."
            )
        elif before:
            self.said.emit(self.tool.how if self.active else OFF)

    @contextmanager
    def _own_doing(self) -> Iterator[None]:
        before, self._busy_with_layers = self._busy_with_layers, True
        try:
            yield
        finally:
            self._busy_with_layers = before
