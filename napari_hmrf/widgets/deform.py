"""The dock widget *Deform tissue*: from painted layers to a deformed image, with one button."""

from __future__ import annotations

import logging
from typing import Any

from napari.utils.notifications import show_error
from psygnal import Signal
from qtpy.QtCore import QTimer

from napari_hmrf.errors import Cancelled, HmrfError, ProblemError
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.inputs import Request, read_layers
from napari_hmrf.layers.metadata import METADATA, role_of
from napari_hmrf.layers.outputs import Outputs
from napari_hmrf.layers.view import unit_symbol
from napari_hmrf.solution import Solution
from napari_hmrf.widgets.chooser import Chooser
from napari_hmrf.widgets.job import Job
from napari_hmrf.widgets.life import Life
from napari_hmrf.widgets.preview import BoundaryPreview
from napari_hmrf.widgets.results import ResultLayers
from napari_hmrf.widgets.words import report

#: How often a running job is asked how it is getting on, in milliseconds.
_POLL = 30
_WELCOME = "Choose an image and make layers to paint on, or open a sample (File > Open Sample)."
_READY = "Press Deform."
_PAINT = (
    "Paint tissues in 'Tissue' and what holds or moves in 'Boundary' (click a table row to choose "
    "the label), then press Deform."
)
_log = logging.getLogger("napari_hmrf")


class DeformTissue(Chooser):
    """Paint tissue and boundary beside an image, and see how the tissue moves.

    Everything the user can do a script can do too: choose layers (`image`, `tissue`, `boundary`,
    `confidence`), fill the tables (`materials`, `rules`), set `settings` and `outputs`, then
    `deform()`, and wait for `finished`.

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
        self._life = Life(self.native, self._on_closed)
        self._docked = False
        self._request: Request | None = None
        self._bar: Any = None
        self._status = self._undrawn = ""
        self._solution: Solution | None = None
        self._results = ResultLayers(self._viewer)
        self._preview = BoundaryPreview(self._viewer)
        self._poll = QTimer(self.native)
        self._poll.setInterval(_POLL)
        self._poll.timeout.connect(self._on_poll)
        self._drawing = QTimer(self.native)
        self._drawing.setSingleShot(True)
        self._drawing.setInterval(0)
        self._drawing.timeout.connect(self._draw_preview)
        self._connect()
        self.reset_choices()
        self.choose_by_role(list(self._viewer.layers))
        self._set_idle(_READY if self.tissue and self.boundary else _WELCOME)

    # What there is to see

    @property
    def idle(self) -> bool:
        """Whether nothing is being computed for this widget."""
        return self._life.job is None

    @property
    def status(self) -> str:
        """The sentence at the bottom."""
        return self._status

    @property
    def solution(self) -> Solution | None:
        """Of the latest result."""
        return self._solution

    # What can be done

    def make_layers(self) -> None:
        """Add a tissue and a boundary layer to paint on, on the pixels of the image."""
        try:
            self.add_layers()
        except ProblemError as error:
            self._refuse(str(error))
        else:
            self._say(_PAINT)

    def deform(self) -> None:
        """Start; the layers are copied now, and the result appears when `finished` is emitted."""
        if not self.idle or self._away:
            return
        for painted in (self._face.tissue.painted, self._face.boundary.painted):
            painted.look()
        try:
            request = self.request()
            inputs = read_layers(request)
            job = Job(
                inputs,
                self.settings.prior,
                self.settings.optimizer,
                self.settings.backend,
                self.outputs,
            )
        except (HmrfError, ValueError) as error:
            self._refuse(str(error))
            self.finished.emit(None)
            return
        self._request, self._life.job = request, job
        self._bar = self._face.start()
        self._poll.start()

    def cancel(self, why: str = "Cancelled; nothing was changed.") -> None:
        """Stop; nothing is changed, and the widget is idle at once, whatever the thread does."""
        if self._life.job is None:
            return
        self._life.job.cancel()
        self._set_idle(why)
        self.finished.emit(None)

    def reset_choices(self, *_: Any) -> None:
        """Look again at which layers there are."""
        if not self._away:
            super().reset_choices()

    # Behind the face

    def _connect(self) -> None:
        face, events = self._face, self._viewer.layers.events
        face.make.changed.connect(self.make_layers)
        face.deform.changed.connect(self.deform)
        face.cancel.changed.connect(self._on_cancel)
        face.image.changed.connect(self._on_image)
        face.boundary.edited.connect(self._on_boundary)
        self.native_parent_changed.connect(self._on_parent)
        events.inserted.connect(self._on_inserted)
        events.removed.connect(self._on_removed)
        events.renamed.connect(self.reset_choices)
        self._viewer.dims.events.current_step.connect(self._on_boundary)
        self._viewer.dims.events.order.connect(self._on_boundary)

    def _on_cancel(self) -> None:
        self.cancel()

    @property
    def _away(self) -> bool:
        """Whether the window is gone, or the dock was closed."""
        return self._life.over or (self._docked and self.native.parent() is None)

    def _on_parent(self, *_: Any) -> None:
        """Napari closes a dock by taking the widget out of it."""
        if self._life.over:
            return
        if self.native.parent() is not None:
            self._docked = True
            self.reset_choices()
        elif self._docked:
            self.cancel()

    def _on_poll(self) -> None:
        job = self._life.job
        if job is None or self._away:
            self._poll.stop()
            return
        if not job.done:
            monitor = job.monitor
            self._face.progress(self._bar, monitor.fraction)
            self._say(f"{monitor.message[0].upper()}{monitor.message[1:]} ...")
            return
        try:
            self._show(job, job.result())
        except Cancelled:
            self._set_idle("Cancelled; nothing was changed.")
            self.finished.emit(None)
        except HmrfError as error:
            self._refuse(str(error))
            self.finished.emit(None)
        except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
            _log.exception("the deformation failed")
            self._refuse(f"The deformation failed: {type(error).__name__}: {error}")
            self.finished.emit(None)

    def _show(self, job: Job, outputs: Outputs) -> None:
        request = self._request
        assert request is not None
        changed = self._changed_since(job, request)
        self._solution = outputs.solution
        for made in outputs.layers.values():
            made.attributes["metadata"][METADATA]["inputs_changed"] = changed
        self._preview.hide()
        self._results.show(outputs, request.layers[0])
        self._face.draw_energy(outputs.solution, self._viewer)
        self._set_idle(report(outputs, job.inputs, changed))
        self.finished.emit(outputs)

    def _changed_since(self, job: Job, started: Request) -> bool:
        try:
            now = self.request()
            same_tables = (now.materials, now.rules) == (started.materials, started.rules)
            return not (same_tables and read_layers(started).same_as(job.inputs))
        except Exception:  # noqa: BLE001 - a layer may read anything; the result is there
            return True

    def _set_idle(self, status: str) -> None:
        self._poll.stop()
        self._life.job = self._request = None
        self._face.stop(self._bar)
        self._bar = None
        self._say(status)

    def _refuse(self, message: str) -> None:
        self._set_idle(message)
        show_error(message)

    def _say(self, status: str) -> None:
        self._status = status
        self._face.say(status)

    def _on_image(self, image: Any) -> None:
        self._face.make.enabled = image is not None
        self._on_boundary()

    def _on_boundary(self, *_: Any) -> None:
        if not self._away:
            self._drawing.start()

    def _draw_preview(self) -> None:
        boundary = self._face.boundary
        place = self.image if self.image is not None else self.tissue
        try:
            reference = None if place is None else Frame.of(place, self._view())
            if reference is not None:
                boundary.table.unit = unit_symbol(reference.unit)
            layer = boundary.painted.layer
            if layer is not None and boundary.preview.value:
                self._preview.update(layer, self.rules, self._view(), reference)
            else:
                self._preview.remove()
        except Exception as error:  # noqa: BLE001 - Qt calls this: nobody else would tell the user
            if not isinstance(error, ProblemError):
                _log.exception("the preview could not be drawn")
            self._undrawn = str(error)
            if self.idle:
                self._say(self._undrawn)
        else:
            if self._undrawn and self._undrawn == self.status:
                self._say("")
            self._undrawn = ""

    def _on_inserted(self, event: Any) -> None:
        if not self._away:
            self.reset_choices()
            self.choose_by_role([event.value])
            if role_of(event.value) and self.idle and self.tissue and self.boundary:
                self._say(_READY)

    def _on_removed(self, event: Any) -> None:
        if self._away:
            return
        if self._request is not None and event.value in self._request.layers:
            self.cancel(f"Cancelled: '{event.value.name}' was removed.")
        self.reset_choices()

    def _on_closed(self) -> None:
        """The dock or the viewer is gone: listen to nothing any more."""
        events = self._viewer.layers.events
        events.inserted.disconnect(self._on_inserted)
        events.removed.disconnect(self._on_removed)
        events.renamed.disconnect(self.reset_choices)
        self._viewer.dims.events.current_step.disconnect(self._on_boundary)
        self._viewer.dims.events.order.disconnect(self._on_boundary)
        self._face.release()
