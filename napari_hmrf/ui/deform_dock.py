"""The dock widget *Deform tissue*: from painted layers to a deformed image, with one button."""

from __future__ import annotations

import logging
import time
from typing import Any

from napari.utils.notifications import show_error, show_warning
from psygnal import Signal

from napari_hmrf.errors import Cancelled, HmrfError
from napari_hmrf.layers.edit_history import steps_of
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.study.refusals import refuse_rigid
from napari_hmrf.ui.deform_events import Watch
from napari_hmrf.ui.dock_steps import DockSteps
from napari_hmrf.ui.job import Done, Job, Work, deforming, drawing
from napari_hmrf.ui.live_mode import LiveMode
from napari_hmrf.ui.messages import (
    AIR,
    CANCELLED,
    CHOOSE,
    CURVE,
    MAKE,
    PAINT,
    PAINT_BOUNDARY,
    READY,
    WELCOME,
    in_short,
    painting,
)
from napari_hmrf.ui.messages import progress as progress_of
from napari_hmrf.ui.point_steps import PointSteps
from napari_hmrf.ui.result_dock import ResultDock
from napari_hmrf.ui.step_buttons import StepKeys
from napari_hmrf.ui.timers import repeating

#: How often a running job is asked how it is getting on, in milliseconds.
_POLL = 30
_log = logging.getLogger("napari_hmrf")


class DeformTissue(ResultDock):
    """Paint tissue and boundary beside an image, and see how the tissue moves.

    Everything the user can do a script can do too: choose layers (`image`, `tissue`, `boundary`,
    `confidence`), fill the tables (`materials`, `rules`), set `model`, `settings` and `outputs`,
    then `deform()`, and wait for `finished`.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    finished : Signal(object)
        Emitted when a deformation ends: `Outputs`, or None if it was cancelled or failed.
    """

    finished = Signal(object)

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._request: Request | None = None
        self._stage = ("", 0.0)
        self._objection = ""
        face = self._face
        self._live = LiveMode(self, face.footer.live)
        self._watch = Watch(
            self,
            self._viewer,
            face,
            edited=self._live.choose,
            rested=self.check,
            removed=self._on_layer_removed,
        )
        points = shared(self._viewer, PointSteps)
        self._steps = DockSteps(face, steps_of(self._viewer), points, self._life, self.say)
        StepKeys(self.native, self._steps.steps)
        self._poll = repeating(self.native, _POLL, self._on_poll)
        face.make.changed.connect(self.make_layers)
        face.intensity.changed.connect(self.make_from_intensity)
        face.tissue.painted.picked.connect(self.hand_brush)
        face.boundary.painted.picked.connect(self.hand_brush)
        face.tissue.background.clicked.connect(self.mark_background)
        face.footer.deform.changed.connect(self.deform)
        face.footer.cancel.changed.connect(self._on_cancel)
        self.reset_choices()
        self.choose_by_role(list(self._viewer.layers))
        self._say(self.invitation)
        if (source := self._take_over()) is not None and (shown := self.shown) is not None:
            self._live.result_shown(shown, source)

    @property
    def live(self) -> bool:
        """Whether the result follows every edit, once there is one; to set it true begins at once.

        By default it does unless the image is large.
        """
        return self._live.on

    @live.setter
    def live(self, on: bool) -> None:
        self._live.turn(on)

    @property
    def following(self) -> bool:
        """Whether an edit is being followed that is not shown yet."""
        return self._live.busy

    # What can be done

    def undo(self) -> None:
        """Take back what was done last, in this dock or another of ours."""
        self._steps.steps.undo()

    def redo(self) -> None:
        """Do again what was taken back."""
        self._steps.steps.redo()

    def make_layers(self) -> None:
        """Add a tissue and a boundary layer to paint on, on the pixels of the image."""
        self._try(self._add_layers, PAINT if self.curve is None else PAINT_BOUNDARY)

    def make_from_intensity(self) -> None:
        """Add a layer of stiffness made from the image's intensity, by a curve to be edited."""
        self._try(self.tissue_from_intensity, CURVE)

    def mark_background(self) -> None:
        """Paint the dark surroundings of the image as no tissue, where nothing is painted yet."""
        self._try(self.fill_background, AIR)

    def deform(self) -> None:
        """Start; the layers are copied now, and the result appears when `finished` is emitted."""
        if not self.idle or self.away:
            return
        self._face.footer.start("Reading layers ...")
        self._status = "Reading layers ..."
        for painted in (self._face.tissue.painted, self._face.boundary.painted):
            painted.look()
        try:
            request = self.request()
            self._copies.forget()
            study = self.read(request)
            refuse_rigid(study)
            work = deforming(study, self.backend, self.outputs)
        except (HmrfError, ValueError) as error:
            self._refuse(error)
            self.finished.emit(None)
            return
        self._latest.note = ""
        self._start(request, work)

    def cancel(self, why: str = CANCELLED) -> None:
        """Stop; nothing is changed, and the widget is idle at once, whatever the thread does."""
        if self._life.job is None:
            self._live.cancel()
            return
        self._life.job.cancel()
        self._set_idle(why)
        self._watch.settle()
        self.finished.emit(None)

    def reset_choices(self, *_: Any) -> None:
        """Look again at which layers there are."""
        if not self.away:
            super().reset_choices()

    def hand_brush(self, layer: Any) -> None:
        """Have a layer painted on next: seen, active, on the image as it was before it moved."""
        if layer not in self._viewer.layers:
            return
        begun = self._live.begun
        hidden = self._results.set_aside("deform" if begun else None)
        self._viewer.layers.selection.active = layer
        layer.visible = True
        layer.mode = "paint"
        note = " What was deformed is hidden meanwhile." if hidden else ""
        if begun:
            note = " The tissue follows; paint lies where it was before it moved."
        self.say_painting(painting(layer) + note, layer)

    # How it goes on

    def check(self) -> None:
        """Say whether the latest result is still that of the layers, and draw what was ticked."""
        if not self.idle or self.away:
            return
        if not self._viewer.layers:
            self._latest.forget()
            self._face.energy.show_solution(None)
            self._say(WELCOME)
        before, self._objection = self._objection, self.model.objection
        if self._latest.done is None:
            if self._status in (WELCOME, CHOOSE, MAKE, READY) or before != self._objection:
                self._say(self.invitation)
            return
        news = self._latest.compare(self.request, self.read)
        if self._latest.fresh and self._latest.lacks(self.outputs):
            self._face.footer.start("Drawing the result ...")
            self._start(self.request(), drawing(self._latest.done, self.outputs))
        elif self._objection != before and self._objection:
            self._say(self._objection)
        elif (
            news and (self._latest.fresh or not self._live.begun)
        ) or self._status == before != "":
            self._say(*self._latest.words)

    def _start(self, request: Request, work: Work) -> None:
        self._request, self._life.job = request, Job(work)
        self._poll.start()

    def _on_poll(self) -> None:
        job = self._life.job
        if job is None or self.away:
            self._poll.stop()
            return
        if not job.done:
            monitor = job.monitor
            if monitor.message != self._stage[0]:
                self._stage = (monitor.message, time.monotonic())
            self._face.footer.progress(monitor.fraction)
            # Qt may have answered whatever waited, a removal or Cancel among it.
            if self._life.job is job:
                self._say(progress_of(monitor, time.monotonic() - self._stage[1]))
            return
        try:
            self._show(job.result())
        except Cancelled:
            self._set_idle(CANCELLED)
            self.finished.emit(None)
        except HmrfError as error:
            self._refuse(error)
            self.finished.emit(None)
        except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
            _log.exception("the deformation failed")
            self._refuse(error)
            self.finished.emit(None)

    def _show(self, done: Done) -> None:
        request, outputs = self._request, done.outputs
        assert request is not None
        self._latest.done = done
        self._latest.compare(self.request, self.read)
        self._put(done, request.layers[0])
        if request.image is not None and {"image", "labels"} & set(outputs.layers):
            request.tissue.visible = False  # it would tint what was deformed
        self._set_idle("")
        self._say(*self._latest.words)
        self._live.result_shown(done.study, request.layers[0])
        self.finished.emit(outputs)

    def _set_idle(self, status: str) -> None:
        self._poll.stop()
        self._life.job = self._request = None
        self._face.footer.stop()
        self._say(status)

    def _refuse(self, error: Exception) -> None:
        self._set_idle(in_short(error))
        self._latest.outdate()
        self._watch.settle()
        # A warning goes by itself; an error would still be there beside the next good result.
        show = show_warning if isinstance(error, HmrfError | ValueError) else show_error
        show(in_short(error))

    def _try(self, action: Any, success: str) -> None:
        try:
            action()
        except HmrfError as error:
            if self.idle:
                self._refuse(error)
        else:
            self.say(success)

    def _add_layers(self) -> None:
        self.add_layers()
        self._results.set_aside()

    # What Qt and napari tell

    def _on_cancel(self) -> None:
        self.cancel()

    def _on_layer_removed(self, layer: Any) -> None:
        """What was to be computed from it is gone, too."""
        self._live.layer_removed(layer)
        if self._request is not None and layer in self._request.layers:
            self.cancel(f"Cancelled: '{layer.name}' was removed.")

    def _hide_preview(self) -> None:
        self._watch.hide_previews()

    def _on_opened(self) -> None:
        self._steps.come()
        self.reset_choices()
        self._face.listen()

    def _on_closed(self) -> None:
        self.cancel()
        self._live.leave()
        self._watch.leave()
        self._steps.leave()
        self._face.release()

    def _on_end(self) -> None:
        self._watch.release()
        self._live.release()
        self._steps.leave()
        self._face.release()
