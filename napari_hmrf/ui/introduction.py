"""Introduction of a sample: undeformed, with the tool *Pull* active and a hint on the canvas."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from napari.layers import Layer

from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.study import Study
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.motion import motion_messages

#: Name of this plugin in the source of a sample layer.
_PLUGIN = "napari-hmrf"


class Introduction:
    """Listener that shows a new sample undeformed until the first action of the user.

    The tissue and boundary of most samples move the tissue. If the result were shown at once, it
    could be mistaken for a registration error.

    Parameters
    ----------
    native : QWidget
        The dock.
    controller : Controller
    guide : Guide
    results : ResultLayers
    start : callable
        Starts drawing, if the dock is in a window; returns whether the mouse draws.
    """

    def __init__(
        self,
        native: Any,
        controller: Controller,
        guide: Guide,
        results: ResultLayers,
        start: Callable[[], bool],
    ) -> None:
        self._controller, self._guide, self._start = controller, guide, start
        self._session, self._results = controller.session, results
        # Samples that were introduced before.
        self._known: weakref.WeakSet[Layer] = weakref.WeakSet()
        # Sample that is being introduced, and its first study: another study ends the introduction.
        self._sample: Any = None
        self._study: Study | None = None
        self._start_timer = single_shot(native, 0, self._on_start)
        controller.slice_changed.connect(self._on_slice)
        controller.deformation_changed.connect(self._on_moved)
        form = controller.form
        result = form.result
        used = (result.slider, result.play, result.overlay, form.footer.deform)
        for signal in (controller.pointer.action_started, *(field.changed for field in used)):
            signal.connect(self.end, max_args=0)
        result.before.native.released.connect(self.end)

    def end(self) -> None:
        """Show the result, because the user has begun."""
        sample, self._sample = self._sample, None
        if sample is not None:
            self._guide.introduction = ""
            self._results.show_deformed(sample, "introduction")

    def _on_slice(self, study: Study) -> None:
        image = self._session.slice.layer
        self.end()
        if image is None or image in self._known or _plugin_of(image) != _PLUGIN:
            return
        self._known.add(image)
        if not study.motion.drawing.marks:
            self._start_timer.start()

    def _on_start(self) -> None:
        study, self._sample = self._session.study, self._session.slice.layer
        if study is None or self._sample is None:
            return
        self._study = None if study.moves else study  # the first study is solved only if it moves
        hint = motion_messages.HERE_OR_PLAY if study.moves else motion_messages.HERE
        self._guide.introduction = hint
        self._results.show_undeformed(self._sample, "introduction")
        if not self._start():
            self.end()

    def _on_moved(self, moved: Deformation) -> None:
        if self._sample is None:
            return
        self._study = self._study or moved.study
        if not moved.study.same_as(self._study):
            self.end()


def _plugin_of(layer: Layer) -> str:
    """Return the plugin of the sample that a layer belongs to, or ""."""
    source = layer.source.sample
    return "" if source is None else str(source[0])
