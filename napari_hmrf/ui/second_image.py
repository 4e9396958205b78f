"""A second image over the one that moves, and how far landmarks are from where they belong."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.layers.landmarks import landmark_pairs
from napari_hmrf.layers.slice_view import View
from napari_hmrf.tissue.drawing import Landmark
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.landmark_choice import LandmarkChoice
from napari_hmrf.ui.live_study import LiveStudy
from napari_hmrf.ui.result.result_view import ResultView
from napari_hmrf.ui.second_image_form import SecondImageForm

#: Where both images are alike they make grey.
_MOVED = {"colormap": "magenta"}
_OTHER = {"colormap": "green", "blending": "additive", "opacity": 1.0, "visible": True}


class SecondImage:
    """Has two images be seen at once, and measures landmarks whenever tissue has come to rest.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm
        Its landmark layers say where things are and should be; without, those of the drawing do.
    view : ResultView
        Of the result that is looked at.
    live : LiveStudy
    """

    def __init__(self, viewer: Any, form: Any, view: ResultView, live: LiveStudy) -> None:
        self._viewer, self._view, self._live = viewer, view, live
        self._form: SecondImageForm = form.second
        self._pair: LandmarkChoice = form.motion.boundary.landmarks
        self._before: list[tuple[Any, dict[str, Any]]] = []
        self._other: Any = None
        changes = (
            self._form.other.changed,
            live.followed,
            self._pair.where.changed,
            self._pair.should.changed,
        )
        self._heard = Listening(*((change, self.look) for change in changes))

    def release(self) -> None:
        """The dock is closed, or its window is gone."""
        self._heard.release()
        self._restore()

    def look(self, *_: Any) -> None:
        """Show the second image over the first, and say how far landmarks are apart."""
        other, shown = self._form.other.value, self._view.shown
        if other is not self._other:
            self._restore()
            self._other = other
        if other is not None:
            self._draw(other, _OTHER)
            layers = self._viewer.layers
            for layer in (self._live.source, None if shown is None else shown.layer("image")):
                self._draw(layer, _MOVED)
                if layer in layers and layers.index(layer) > layers.index(other):
                    layers.move(layers.index(other), layers.index(layer) + 1)
        self._form.line.say(self._measured())

    def _draw(self, layer: Any, look: dict[str, Any]) -> None:
        """Draw a layer in another way until nothing is compared any more."""
        if layer is None or any(each is layer for each, _ in self._before):
            return
        looks = {name: value for name, value in look.items() if name != "colormap" or not layer.rgb}
        self._before.append((layer, {name: getattr(layer, name) for name in looks}))
        _set(layer, looks)

    def _restore(self) -> None:
        for layer, look in self._before:
            _set(layer, look)
        self._before = []

    def _measured(self) -> str:
        """How far landmarks were and are apart; each pair's goes to the features of its layer."""
        shown, where = self._view.shown, self._pair.where.value
        if shown is None:
            return ""
        answer = shown.answer
        spacing, d = answer.solution.spacing, answer.solution.displacement
        if where is not None:
            view = View.of(self._viewer.dims)
            try:
                pairs = landmark_pairs(
                    where, self._pair.should.value, answer.frame, answer.shape, view
                )
            except HmrfError:
                return ""  # said when they are taken
            numbers, at, to = pairs.numbers, pairs.at, pairs.to
        else:
            drawing = self._live.study.motion.drawing if self._live.study is not None else None
            marks = () if drawing is None else drawing.marks
            both = [(mark.source, mark.target) for mark in marks if isinstance(mark, Landmark)]
            if not both:
                return ""
            at, to = np.array(both, dtype=float).swapaxes(0, 1)
        apart = np.linalg.norm((to - at) * spacing, axis=1)
        left = np.linalg.norm((to - moved_points(at, d, spacing=spacing)) * spacing, axis=1)
        if where is not None:
            column = np.full(len(where.data), np.nan)
            column[numbers] = left
            where.features = where.features.assign(**{f"residual ({answer.unit})": column})
        before, now = (float(np.sqrt((lengths**2).mean())) for lengths in (apart, left))
        return (
            f"Landmarks: {before:.3g} {answer.unit} apart before, {now:.3g} now (RMS of {len(at)})"
        )


def _set(layer: Any, look: dict[str, Any]) -> None:
    for name, value in look.items():
        setattr(layer, name, value)
