"""What pulls tissue: the drawings of all slices, the hand that draws, and tissue that follows."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from psygnal import Signal

from napari_hmrf.layers.edit_history import ViewerSteps
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Drawing, History, Stroke
from napari_hmrf.tissue.drawing.brush import Paint
from napari_hmrf.tissue.drawing.pull import Grip
from napari_hmrf.tissue.drawing.tool import Hand
from napari_hmrf.ui.grab.display import Display
from napari_hmrf.ui.grab.grab_messages import LATER, OFF, OPEN, PREPARING
from napari_hmrf.ui.grab.histories import Histories
from napari_hmrf.ui.grab.keys import Listener
from napari_hmrf.ui.grab.live_tissue import Follower
from napari_hmrf.ui.grab.tissue_view import Seen
from napari_hmrf.ui.grab.tool_hands import Hands
from napari_hmrf.ui.grab.tools import BY_NAME, Tool
from napari_hmrf.ui.messages import in_short, progress
from napari_hmrf.ui.timers import single_shot

#: In a drag the arrows are drawn with the tissue that follows them, one painting rather than two;
#: if that takes longer than so many milliseconds, they go ahead.
_AHEAD = 150
#: After so many milliseconds without a first answer it is said why, and again.
_LONG = 1000
#: So few folded pixels are noise of the rounding, and nothing to warn of.
_HANDFUL = 5


class Puller:
    """Has the tissue of the slice that is shown follow its drawing; each slice has its own.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    how : callable
        How the tool in the hand draws.
    answers : callable
        Makes, of this, who answers the mouse and the keys: `Answers`.

    Attributes
    ----------
    answers : Listener
        What the mouse and the keys do.
    picked : bool
        Whether what is selected was picked up, and not just made.
    display : Display
        What is seen.
    """

    #: The drawing, what can be undone or what is selected is another.
    changed = Signal()
    #: What there is to say, in words.
    said = Signal(str)
    #: Something new is begun: what was said of what came before is over.
    begun = Signal()
    #: What is to be known of the tissue that is seen, in words; "" if nothing.
    warned = Signal(str)
    #: The state of the tissue that is seen from now on.
    seen = Signal(object)
    #: How the mark that was taken hold of is made.
    taken = Signal(object)
    #: Another tool is taken.
    taken_up = Signal(object)
    #: A key asks for a tool, or for a brush so many times larger.
    asked_for = Signal(str)
    asked_for_size = Signal(float)

    def __init__(
        self,
        viewer: Any,
        how: Callable[[], Grip | Paint],
        answers: Callable[[Puller], Listener],
    ) -> None:
        self.how = how
        self.history = History()
        self.tool: Tool = BY_NAME["pull"]
        self._hands = Hands(self.history)
        self.picked = False
        self.answers = answers(self)
        self.display = Display(viewer, self.answers)
        self.follower = Follower(self._on_seen)
        self._drawing_waits = single_shot(None, _AHEAD, self.draw)
        self._compiling = single_shot(None, _LONG, self._on_long)
        self._image: Any = None
        self._working = self._in_error = False
        self._histories = Histories(viewer)

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
        return self.ground is not None and self.display.arrows.active

    @property
    def preparing(self) -> bool:
        """Whether the mouse draws, and nothing follows yet: something is read, or compiled."""
        return self.active and not self._working

    @property
    def steps(self) -> ViewerSteps:
        """All that was edited in the viewer, in order."""
        return self._histories.steps

    @property
    def quiet(self) -> bool:
        """Whether layers come and go by our own doing."""
        return self.display.quiet

    def stand_on(
        self, ground: Ground | None, image: Any = None, tissues: dict[int, Any] | None = None
    ) -> None:
        """Go over to the drawing of another slice, or of the same with other tissue.

        Parameters
        ----------
        ground : Ground or None
            None: there is nothing to draw on.
        image : napari.layers.Image, optional
            What is pulled.
        tissues : dict of int to colour, optional
            Of the tissues that can be painted.
        """
        self.answers.release()
        self._warn_of(0)
        self.history.changed.disconnect(self._on_drawn, missing_ok=True)
        self.follower.stand_on(ground)
        self._image = image
        if ground is None:
            self.history = History()
            self._hands = Hands(self.history)
        else:
            self.history = self._histories.of(image, ground.study.grid.place)
            self._hands = Hands(self.history, ground.study.grid.spacing, ground.shape)
            self._working = False
        self.display.stand_on(ground, image, tissues or {})
        self.history.changed.connect(self._on_drawn)
        if self.active:
            self.display.come_forward()
        self._on_changed(self.history.drawing)

    def tool_for(self, number: int) -> Tool:
        """The tool a mark is made with."""
        return self._hands.tool_for(number)

    def take_up(self, tool: Tool) -> None:
        """Have another tool in the hand, which has nothing selected."""
        if tool is self.tool:
            return
        self.answers.release()
        self.hand.cancel()
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
        self.display.come_forward()
        with self.display.own_doing():
            self.display.arrows.take(ground.study.grid.place, ground.shape, radius)
        self.draw()
        self.said.emit(self.tool.how if self._working else PREPARING)
        if not self._working:
            self._compiling.start()

    def complete(self) -> None:
        """The drawing rests: keep it, and have its displacement drawn."""
        self.display.arrows.keep(self.history.drawing)
        self.follower.complete()

    def draw(self) -> None:
        """Show what is drawn as it is."""
        self._drawing_waits.stop()
        self.display.draw(self.history.drawing, self.hand)
        self.changed.emit()

    def forgive(self) -> None:
        """What was wrong was taken back, and somebody else says so."""
        self._in_error = False

    def set_drawing(self, drawing: Drawing, word: str) -> None:
        """Have another drawing, as one step."""
        self.answers.release()
        self.history.do(drawing, word)

    def leave(self) -> None:
        """Follow nothing more; take away the layers that nobody answers. What is drawn stays."""
        self.answers.release()
        self.history.changed.disconnect(self._on_drawn, missing_ok=True)
        self._compiling.stop()
        self._drawing_waits.stop()
        self.follower.stand_on(None)
        self.display.stand_on(None, None, {})
        self.display.leave()

    def end(self) -> None:
        """Pull nothing any more."""
        with suppress(RuntimeError):  # at the end of the process Qt's own are gone before us
            self._drawing_waits.stop()
            self._compiling.stop()
            self.display.release()
        self.display.arrows.release()
        self.follower.release()

    # What follows

    def _on_drawn(self, drawing: Drawing) -> None:
        self.display.come_forward()
        self._on_changed(drawing)

    def _on_changed(self, drawing: Drawing) -> None:
        self.follower.follow(drawing)
        if not self.hand.holding:
            self.draw()
        elif not self._drawing_waits.isActive():
            self._drawing_waits.start()

    def _on_seen(self, seen: Seen) -> None:
        if seen.ground is not self.ground or self._image is None:
            return
        if seen.error is not None:
            self._on_error(seen)
            return
        first, self._working = not self._working, True
        before = self.display.seen
        self.display.show(seen, self.hand)
        painted = seen.painted or (None if before is None else before.painted)
        if self._drawing_waits.isActive():
            self.draw()
        elif painted is not None:  # its marks are those of what is seen
            self.display.draw(self.history.drawing, self.hand)
        if first or self._in_error:
            self._in_error = False
            self.said.emit(self.tool.how if self.active else OFF)
        if seen.outputs is not None or not seen.drawing.marks:
            self._warn_of(0 if seen.outputs is None else seen.outputs.folds, seen.note)
        self.seen.emit(seen)

    def _on_long(self) -> None:
        if not self._working and self.ground is not None and self.follower.busy:
            self.said.emit(f"{progress(self.follower.monitor, _LONG / 1000)} {LATER}")
            self._compiling.start()

    def _on_error(self, seen: Seen) -> None:
        assert seen.error is not None
        self._in_error = True
        hand = self.hand
        if hand.holding and isinstance(hand.mark, Stroke):
            # A ring that is being painted is an open line until it is closed.
            self.said.emit(OPEN if hand.mark.action == "expand" else in_short(seen.error))
            return
        self.display.show_painted(seen, hand)
        self.said.emit(in_short(seen.error))

    def _warn_of(self, folds: int, note: str = "") -> None:
        """Say what is to be known of the tissue that is seen, as long as it is."""
        parts = []
        if folds > _HANDFUL:
            parts.append(
                f"Warning: at {folds} pixels the tissue is pushed through itself (it folds), "
                "which no tissue does. Move it less. Far from all that is held a larger patch "
                "helps, too; near it, a smaller one."
            )
        if note:
            parts.append(note)
        self.warned.emit(" ".join(parts))
