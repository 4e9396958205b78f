"""The layers of a result at a moment of its deformation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy.typing as npt

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.animation import Moment, Motion
from napari_hmrf.layers.image_result import Part
from napari_hmrf.layers.read import look_of
from napari_hmrf.layers.result_layers import LayerData, picture_layer
from napari_hmrf.layers.result_lookup import FoundResult, picture_of
from napari_hmrf.study.study import Pictures
from napari_hmrf.ui.result.arrow_choices import ArrowChoices
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.result_messages import FULL
from napari_hmrf.ui.timers import single_shot

#: Between drawing pictures and drawing lines, in milliseconds: napari paints meanwhile.
_TURN = 10


class MovingLayers:
    """Draws moments of the result that is looked at.

    Parameters
    ----------
    native : QWidget
        The dock.
    shown : LookedAt
    arrows : ArrowChoices
    refuse : callable
        Called with what is wrong with an image that cannot be read; the rest moves.
    """

    def __init__(
        self,
        native: Any,
        shown: LookedAt,
        arrows: ArrowChoices,
        refuse: Callable[[Exception], None],
    ) -> None:
        self._shown, self._arrows, self._refuse = shown, arrows, refuse
        self._drawn: tuple[int, Moment] | None = None
        # Lines take napari as long as the image: each has a turn of its own.
        self._lines = single_shot(native, _TURN, self._draw_lines)

    @property
    def busy(self) -> bool:
        """Whether lines are still to be drawn."""
        return bool(self._lines.isActive())

    def motion(self) -> Motion | None:
        """Collect what moves: a copy of the image as it is now, and what lies over it."""
        result, source, overlay = self._shown.result, self._shown.source, self._shown.overlay
        if result is None:
            return None
        image = None
        try:
            image = None if source is None else picture_of(source, result)
        except HmrfError as error:
            self._refuse(error)
        if overlay is None:
            return Motion(result.solution, image)
        return Motion(result.solution, image, overlay.picture, overlay.name == "grid")

    def ready(self, motion: Motion | None) -> bool:
        """Have a layer that can be moved; whether there is one."""
        shown, result, layers = self._shown, self._shown.result, self._shown.layers
        if result is None or layers is None:
            return False
        if motion is not None and motion.image is not None:
            image = shown.layer("image")
            if image is None or (layers.is_added("image") and not image.visible):
                image = layers.put(
                    "image", _unmoved(result, shown.source, motion.image), shown.source
                )
            image.visible = True
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
        self._arrows.show(FULL)

    def _draw_lines(self) -> None:
        if self._drawn is not None:
            percent, moment = self._drawn
            self._arrows.show(percent)
            result, layers, overlay = self._shown.result, self._shown.layers, self._shown.overlay
            if result is None or layers is None or overlay is None or moment.grid is None:
                return
            if overlay.name == "grid":  # another may have taken its place since
                layers.show_part(percent, {"overlay": result.frame.put_vectors(moment.grid)})


def _unmoved(result: FoundResult, source: Any, image: npt.NDArray[Any]) -> LayerData:
    """A layer for the moving image, as the image is before it moves."""
    pictures = Pictures(name=source.name, look=look_of(source))
    facts = {**result.facts, "percent": 0}
    parameters = result.solution.provenance.parameters
    return picture_layer(result.frame, pictures, image, parameters, facts)
