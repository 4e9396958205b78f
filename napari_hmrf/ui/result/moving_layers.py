"""The layers of a result at a moment of its deformation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from napari.layers import Labels

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.animation import Moment, Motion
from napari_hmrf.layers.image_result import Part
from napari_hmrf.layers.result_lookup import picture_of, tissue_of
from napari_hmrf.ui.result.arrow_choices import ArrowChoices
from napari_hmrf.ui.result.cursor import UnderCursor
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.result_messages import FULL
from napari_hmrf.ui.result.result_work import unmoved
from napari_hmrf.ui.timers import single_shot

#: What takes the pixels of a moment.
_MOVING: tuple[Part, ...] = ("image", "labels", "colours")
#: Between drawing pictures and drawing lines, in milliseconds: napari paints meanwhile.
_TURN = 10


class MovingLayers:
    """Draws moments of the result that is looked at.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    shown : LookedAt
    cursor : UnderCursor
        Knows what colours show; told which tissue layer says how stiff what is.
    arrows : ArrowChoices
    refuse : callable
        Called with what is wrong with a layer that cannot be read; the others move.
    """

    def __init__(
        self,
        native: Any,
        viewer: Any,
        shown: LookedAt,
        cursor: UnderCursor,
        arrows: ArrowChoices,
        refuse: Callable[[Exception], None],
    ) -> None:
        self._viewer, self._shown, self._cursor, self._arrows = viewer, shown, cursor, arrows
        self._refuse = refuse
        self._drawn: tuple[int, Moment] | None = None
        # Lines take napari as long as the image: each has a turn of its own.
        self._lines = single_shot(native, _TURN, self._draw_lines)

    @property
    def busy(self) -> bool:
        """Whether lines are still to be drawn."""
        return bool(self._lines.isActive())

    def motion(self, grid: bool) -> Motion | None:
        """Collect what moves: copies of what is there now.

        Parameters
        ----------
        grid : bool
            Whether a grid moves, too.
        """
        result, shown = self._shown.result, self._shown
        if result is None:
            return None
        image = labels = None
        tissue = tissue_of(self._viewer.layers, result)
        self._cursor.stiffness_from(tissue, result)
        try:
            if shown.source is not None:
                image = picture_of(shown.source, result)
            if isinstance(tissue, Labels) and shown.layer("labels") is not None:
                labels = picture_of(tissue, result)
        except HmrfError as error:
            self._refuse(error)
        seen = self._cursor.coloured
        colours = None if seen is None else seen[1]
        return Motion(result.solution, image, labels, colours, grid)

    def ready(self, motion: Motion | None) -> bool:
        """Have a layer that can be moved; whether there is one."""
        shown, result, layers = self._shown, self._shown.result, self._shown.layers
        if result is None or layers is None:
            return False
        if motion is not None and motion.image is not None:
            image = shown.layer("image")
            if image is None or (layers.is_added("image") and not image.visible):
                made = unmoved(result, shown.source, motion.image)
                image = layers.put("image", made, shown.source)
            image.visible = True
        return any(shown.layer(part) is not None for part in (*_MOVING, "grid"))

    def draw(self, percent: int, moment: Moment) -> None:
        """Draw a moment: pictures now, lines in a turn of their own."""
        result, layers = self._shown.result, self._shown.layers
        if result is None or layers is None:
            return
        moved = {part: getattr(moment, part) for part in _MOVING}
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
            result, layers = self._shown.result, self._shown.layers
            if result is not None and layers is not None and moment.grid is not None:
                layers.show_part(percent, {"grid": result.frame.put_vectors(moment.grid)})
