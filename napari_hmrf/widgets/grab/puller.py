"""What pulls tissue: the drawings of all slices, the hand that draws, and tissue that follows."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from psygnal import Signal

from napari_hmrf.drawing import Arrow, Drawing, History
from napari_hmrf.drawing.marks import Point
from napari_hmrf.drawing.pull import Grip, Pull
from napari_hmrf.layers.ground import Ground
from napari_hmrf.widgets.grab.arrows import ArrowsLayer
from napari_hmrf.widgets.grab.follow import Follower, Seen
from napari_hmrf.widgets.grab.live_layers import LiveLayers
from napari_hmrf.widgets.words import COMPILING, refusal

ON = "Drag tissue to pull it, or click it to hold it in place."
OFF = "Paused: press 'Grab and pull', or choose the layer 'Arrows', to go on."
NOTHING = "There is no tissue to take hold of there."
CANCELLED = "Cancelled; everything is as before."

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
    #: How the arrow that was taken hold of holds.
    taken = Signal(object)

    def __init__(self, viewer: Any, grip: Callable[[], Grip]) -> None:
        self._grip = grip
        self.history = History()
        self.pull = Pull(self.history)
        self.arrows = ArrowsLayer(viewer, self)
        self.follower = Follower(self._on_seen)
        self._shown = LiveLayers(viewer)
        self._image: Any = None
        self._seen: Seen | None = None
        self._busy_with_layers = self._working = self._warned = False
        self._histories: weakref.WeakKeyDictionary[Any, dict[Any, History]]
        self._histories = weakref.WeakKeyDictionary()

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
            self.pull = Pull(self.history)
        else:
            key = (ground.frame.plane, ground.frame.index)
            self.history = self._histories.setdefault(image, {}).setdefault(key, History())
            self.pull = Pull(self.history, ground.frame.spacing)
            self._seen = Seen.still(ground)
            with self._own_doing():
                self.arrows.place(ground.frame, ground.shape)
            self._working = False
        self.history.changed.connect(self._on_changed)
        self._on_changed(self.history.drawing)

    def take(self, radius: float) -> None:
        """Have the mouse pull tissue."""
        ground = self.ground
        if ground is None:
            return
        with self._own_doing():
            self.arrows.take(ground.frame, ground.shape, radius)
        self.draw()
        self.said.emit(COMPILING if self._working else ON)

    def complete(self) -> None:
        """The drawing rests: keep it, and have its displacement drawn."""
        self.arrows.keep(self.history.drawing)
        self.follower.complete()

    def draw(self) -> None:
        """Show the arrows as they are."""
        self.arrows.show(self.history.drawing, self.pull.selected)
        self.changed.emit()

    # What the mouse and the keys do

    def press(self, point: Point, reach: float) -> bool:
        """Take hold of tissue, or of an arrow."""
        if self._seen is None:
            return False
        taken = self.pull.press(point, reach, self._grip(), self._seen.came_from)
        mark = self.pull.arrow
        if mark is not None:
            components = mark.components if isinstance(mark, Arrow) else "both"
            self.taken.emit(Grip(mark.radius, mark.confidence, components))
        if not taken:
            self.said.emit(NOTHING)
        self.draw()
        return taken

    def move(self, point: Point) -> None:
        """Go on pulling."""
        self.pull.move(point)

    def release(self) -> None:
        """Let go."""
        self.arrows.end_drag()
        if self.pull.release():
            self.draw()

    def cancel(self) -> None:
        """Give up the drag that goes on; without one, select nothing."""
        self.arrows.end_drag()
        if self.pull.cancel():
            self.said.emit(CANCELLED)
        else:
            self.pull.select(None)
        self.draw()

    def remove(self) -> None:
        """Remove the arrow that is selected."""
        self.arrows.end_drag()
        if not self.pull.remove():
            self.said.emit("No arrow is selected: click the head or the base of one.")

    def undo(self) -> None:
        """Take back what was done last."""
        self.arrows.end_drag()
        word = self.history.undo()
        self.said.emit(f"Took back: {word}." if word else "There is nothing to take back.")

    def redo(self) -> None:
        """Do again what was taken back."""
        self.arrows.end_drag()
        word = self.history.redo()
        self.said.emit(f"Did again: {word}." if word else "There is nothing to do again.")

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
            self.said.emit(ON if self.active else OFF)
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
            self.said.emit(ON if self.active else OFF)

    @contextmanager
    def _own_doing(self) -> Iterator[None]:
        before, self._busy_with_layers = self._busy_with_layers, True
        try:
            yield
        finally:
            self._busy_with_layers = before
