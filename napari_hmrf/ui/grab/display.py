"""What of *Grab and pull* is seen in the viewer: arrows, paint, and the tissue itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from napari_hmrf.layers.arrow_layer import Lines
from napari_hmrf.layers.image_choice import image_covering_at
from napari_hmrf.layers.image_result import Result
from napari_hmrf.layers.paint_layer import outline_of
from napari_hmrf.layers.result_layers import Kind, picture_layer
from napari_hmrf.layers.viewer_layers import still_there
from napari_hmrf.layers.viewer_results import ResultLayers
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.drawing.marks import Point
from napari_hmrf.tissue.drawing.tool import Hand
from napari_hmrf.ui.grab.arrows import ArrowsLayer
from napari_hmrf.ui.grab.keys import Listener
from napari_hmrf.ui.grab.paint import PaintedLayer
from napari_hmrf.ui.grab.tissue_view import Seen
from napari_hmrf.ui.timers import single_shot

#: Touches of the brush are shown with the tissue that follows them, one painting rather than two;
#: if that takes longer than so many milliseconds, they go ahead.
_AHEAD = 80


#: So many arrows would hide what is drawn.
_UNASKED: tuple[Kind, ...] = ("arrows",)


class Display:
    """The layers that show a drawing and what comes of it.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    told : Listener
        Who is told what the mouse and the keys do.

    Attributes
    ----------
    arrows : ArrowsLayer
    painted : PaintedLayer
    seen : Seen or None
        The tissue as it is seen.
    tissues : dict of int to colour
        Of the tissues that can be painted.
    """

    def __init__(self, viewer: Any, told: Listener) -> None:
        self.arrows = ArrowsLayer(viewer, told)
        self.painted = PaintedLayer(viewer)
        self.seen: Seen | None = None
        self.tissues: dict[int, Any] = {}
        self._viewer = viewer
        self._results = shared(viewer, ResultLayers)
        self._results.changed.connect(self._on_result)
        self._result: Result | None = None
        self._image: Any = None
        #: Whether it is this result that is seen, and the layers that were hidden when it was not.
        self._here = False
        #: Whether nothing has moved that is shown.
        self._unmoved = False
        self._hidden: list[Any] = []
        self._busy = False
        # Where the brush was last, and of how many places its stroke was then.
        self._last: Point = (0.0, 0.0)
        self._places = 0
        self._touches_wait = single_shot(None, _AHEAD, self._show_touches)

    @property
    def quiet(self) -> bool:
        """Whether layers come and go by our own doing."""
        return self._busy

    def stand_on(self, ground: Ground | None, image: Any, tissues: dict[int, Any]) -> None:
        """Go over to another slice, or to none."""
        self._touches_wait.stop()
        self._image, self.tissues = image, tissues
        self.seen = None if ground is None else Seen.still(ground)
        before, self._result = self._result, None
        if ground is not None:
            self._result = self._results.at(image, ground.study.grid.place.slice_name)
        other, unmoved = self._result is not before, self._unmoved
        self._here, self._unmoved = self._here and not other, False
        with self.own_doing():
            if other and before is not None and unmoved and before.maker == "grab":
                before.remove()
            self.painted.forget()
            if ground is not None:
                self.arrows.place(ground.study.grid.place, ground.shape)

    @property
    def covering(self) -> Any:
        """The image of somebody else's that hides the place the mouse is at; else None."""
        image, result = still_there(self._viewer, self._image), self._result
        picture = None if result is None else result.layer("image")
        lowest = picture if picture is not None and picture.visible else image
        if lowest is None:
            return None
        return image_covering_at(self._viewer, lowest, self._viewer.cursor.position)

    def come_forward(self) -> None:
        """Have this seen, and no result of another dock."""
        seen = self.seen
        if seen is None or self._here:
            return
        self._here = True
        with self.own_doing():
            self._results.claim(self._image, seen.ground.study.grid.place, "grab")
            for layer in self._hidden:
                layer.visible = True
            self._hidden = []
            if seen.solution is not None:
                self._show_tissue(seen)

    def show(self, seen: Seen, hand: Hand) -> None:
        """Show another state of the tissue."""
        self.seen = seen
        with self.own_doing():
            maker = None if self._result is None else self._result.maker
            # What has not moved yet is shown, too, so that the first movement finds its layer.
            first = maker is None and seen.solution is not None
            self._unmoved = seen.is_still
            if not self._unmoved or first or maker == "grab":
                self._show_tissue(seen)
            self.show_painted(seen, hand)

    def _show_tissue(self, seen: Seen) -> None:
        study, solution = seen.ground.study, seen.solution
        place = study.grid.place
        if seen.outputs is not None:
            layers = seen.outputs.layers
        else:
            model = {"prior": study.prior.parameters, "optimizer": study.optimizer.parameters}
            layers = {"image": picture_layer(place, study.pictures, seen.picture, model)}
        self._results.show(
            self._image,
            place,
            layers,
            "grab",
            asked=self._here,
            moving=seen.outputs is None and solution is not None,
            unasked=_UNASKED,
        )

    def _on_result(self, result: Result) -> None:
        """Another result is seen: what is drawn belongs to none that is."""
        if result is self._result and not self._busy:
            self._here = False
            drawn = [layer for layer in (self.arrows.layer, self.painted.layer) if layer]
            self._hidden += [layer for layer in drawn if layer.visible]
            for layer in drawn:
                layer.visible = False

    def show_painted(self, seen: Seen, hand: Hand) -> None:
        """Show what is painted; what is being painted stays where it is, until it is known."""
        self._touches_wait.stop()
        stroke = hand.mark if hand.holding else None
        if not isinstance(stroke, Stroke):
            stroke = None
        picture = None if seen.painted is None else seen.painted.picture
        with self.own_doing():
            self.painted.show(seen.ground, picture, seen.drawing, stroke, self.tissues)

    def touch(self, hand: Hand, point: Point, first: bool) -> None:
        """Show where the brush is: at once if it was put down, else as soon as that is worth it."""
        stroke = hand.mark
        if self.seen is None or not isinstance(stroke, Stroke):
            return
        places = sum(map(len, stroke.lines))
        if places == self._places and not first:
            return
        self._places = places
        begin, self._last = point if first else self._last, point
        self.painted.touch(stroke, begin, point)
        if first:
            self._show_touches()
        elif not self._touches_wait.isActive():
            self._touches_wait.start()

    def _show_touches(self) -> None:
        self._touches_wait.stop()
        if self.seen is not None:
            with self.own_doing():
                self.painted.show_touches(self.seen.ground, self.tissues)

    def draw(self, drawing: Drawing, hand: Hand) -> None:
        """Show arrows, landmarks, and the marks of what is painted."""
        parts: list[Lines] = []
        seen, stroke = self.seen, hand.mark
        if seen is not None and seen.painted is not None:
            parts.append((seen.painted.lines, seen.painted.colours))
        if seen is not None and isinstance(stroke, Stroke) and not hand.holding:
            parts.append(outline_of(stroke, seen.ground.base, seen.goes_to))
        more = None
        if parts:
            lines, colours = zip(*parts, strict=True)
            more = np.concatenate(lines), np.concatenate(colours)
        self.arrows.show(drawing, hand.selected, hand.pending, more, quick=hand.holding)

    def leave(self) -> None:
        """Take away what nobody answers any more."""
        self.release()
        with self.own_doing():
            self.arrows.remove()
            self.painted.remove()

    def release(self) -> None:
        """Show nothing later on."""
        self._touches_wait.stop()

    @contextmanager
    def own_doing(self) -> Iterator[None]:
        """Layers that come and go meanwhile do so by our own doing."""
        before, self._busy = self._busy, True
        try:
            yield
        finally:
            self._busy = before
