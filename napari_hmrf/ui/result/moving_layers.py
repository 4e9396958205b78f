"""The layers of the result that is looked at, at a moment of its deformation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.animation import Moment, Motion
from napari_hmrf.layers.image_result import Part, Result
from napari_hmrf.layers.overlay import Overlay
from napari_hmrf.layers.read import look_of
from napari_hmrf.layers.result_layers import Answer, picture_layer
from napari_hmrf.layers.result_lookup import picture_of
from napari_hmrf.study.study import Pictures
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.result.result_messages import FULL

#: Between drawing pictures and drawing lines, in milliseconds: napari paints meanwhile.
_TURN = 10


class LookedAt:
    """One result at a time, and its layers.

    Attributes
    ----------
    result : Answer, optional
    layers : Result, optional
        Which the viewer shows of it.
    overlay : Overlay, optional
        What lies over its image.
    source : napari.layers.Image, optional
        What is moved.
    percent : int
        How much of the deformation was chosen to be seen.
    """

    def __init__(self) -> None:
        self.result: Answer | None = None
        self.layers: Result | None = None
        self.overlay: Overlay | None = None
        self.source: Any = None
        self.percent = FULL

    def layer(self, part: Part) -> Any:
        """The layer of a part; None if it is gone, or the arrows are that hold the result."""
        if self.result is None or self.layers is None or self.layers.layer("arrows") is None:
            return None
        return self.layers.layer(part)


class MovingLayers:
    """Draws moments of the result that is looked at.

    How long its arrows are at 100 % is said by napari's own control of their layer.

    Parameters
    ----------
    native : QWidget
        The dock.
    shown : LookedAt
    refuse : callable
        Called with what is wrong with an image that cannot be read; the rest moves.
    """

    def __init__(self, native: Any, shown: LookedAt, refuse: Callable[[Exception], None]) -> None:
        self._shown, self._refuse = shown, refuse
        self._drawn: tuple[int, Moment] | None = None
        # Lines take napari as long as the image: each has a turn of its own.
        self._lines = single_shot(native, _TURN, self._draw_lines)
        # How long arrows are at 100 %; as they are drawn, and at how much of the deformation.
        self._length = self._drawn_length = 1.0
        self._drawn_percent = FULL

    @property
    def busy(self) -> bool:
        """Whether lines are still to be drawn."""
        return bool(self._lines.isActive())

    def motion(self) -> Motion | None:
        """Collect what moves: a copy of the image as it is now."""
        result, source = self._shown.result, self._shown.source
        if result is None:
            return None
        image = None
        try:
            image = None if source is None else picture_of(source, result)
        except HmrfError as error:
            self._refuse(error)
        return Motion(result.solution, image)

    def ready(self, motion: Motion) -> bool:
        """Have a layer that can be moved; whether there is one."""
        shown, result, layers = self._shown, self._shown.result, self._shown.layers
        if result is None or layers is None:
            return False
        if motion.image is not None:
            if shown.layer("image") is None:  # as it is before it moves
                pictures = Pictures(name=shown.source.name, look=look_of(shown.source))
                facts = {**result.facts, "percent": 0}
                run = result.solution.provenance.parameters
                made = picture_layer(result.frame, pictures, motion.image, run, facts)
                layers.put("image", made, shown.source)
            layers.want("image", True)
        return any(shown.layer(part) is not None for part in ("image", "overlay"))

    def draw(self, percent: int, moment: Moment) -> None:
        """Draw a moment: pictures now, lines in a turn of their own."""
        result, layers = self._shown.result, self._shown.layers
        if result is None or layers is None:
            return
        moved: dict[Part, Any] = {"image": moment.image, "overlay": moment.overlay}
        place = result.frame.put_image
        parts = {part: place(data) for part, data in moved.items() if data is not None}
        layers.show_part(percent, parts)
        self._drawn = percent, moment
        self._lines.start()

    def draw_whole(self) -> None:
        """Draw arrows of the whole deformation, and no lines of what was drawn before."""
        self._lines.stop()
        self._drawn = None
        self._draw_arrows(FULL)

    def _draw_lines(self) -> None:
        if self._drawn is not None:
            percent, moment = self._drawn
            self._draw_arrows(percent)
            result, layers, overlay = self._shown.result, self._shown.layers, self._shown.overlay
            if result is None or layers is None or overlay is None or moment.grid is None:
                return
            if overlay.name == "grid":  # another may have taken its place since
                layers.show_part(percent, {"overlay": result.frame.put_vectors(moment.grid)})

    def _draw_arrows(self, percent: int) -> None:
        """Let them end where the tissue is at so much of the deformation; their data stay."""
        arrows = self._shown.layer("arrows")
        if arrows is not None:
            # Somebody may have chosen another length.
            if self._drawn_percent and arrows.length != self._drawn_length:
                self._length = arrows.length * FULL / self._drawn_percent
            self._drawn_length = arrows.length = self._length * percent / FULL
        self._drawn_percent = percent
