"""The dock widget *Deform tissue*: from painted layers to a deformed image, with one button."""

from __future__ import annotations

import logging
from typing import Any

from magicgui.widgets import Container
from napari.layers import Image
from napari.utils.notifications import show_error
from psygnal import Signal
from qtpy.QtCore import QTimer

from napari_hmrf.annotation import BoundaryRule, Material
from napari_hmrf.errors import Cancelled, HmrfError, ProblemError
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.inputs import Request, read_layers
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, METADATA, TISSUE, role_of
from napari_hmrf.layers.outputs import Kind, Outputs
from napari_hmrf.layers.view import View
from napari_hmrf.solution import Solution
from napari_hmrf.widgets.face import Face
from napari_hmrf.widgets.job import Job
from napari_hmrf.widgets.new_layers import layers_to_paint_on
from napari_hmrf.widgets.preview import BoundaryPreview
from napari_hmrf.widgets.results import ResultLayers
from napari_hmrf.widgets.words import report, unit_symbol

#: How often a running job is asked how it is getting on, in milliseconds.
_POLL = 30
_log = logging.getLogger("napari_hmrf")


class DeformTissue(Container):
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
        super().__init__(labels=False)
        # napari hands plugins a proxy, whose layers are proxies too: other objects at every look.
        self._viewer = getattr(napari_viewer, "__wrapped__", napari_viewer)
        self._closed = False
        self._job: Job | None = None
        self._request: Request | None = None
        self._bar: Any = None
        self._solution: Solution | None = None
        self._face = Face(self, self._layers, self._view)
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
        self._choose_by_role(self._layers())
        self._set_idle("Choose an image, or open a sample (File > Open Sample).")

    # What is chosen

    @property
    def image(self) -> Any:
        """The image to deform, or None to see the motion alone."""
        return self._face.image.value

    @image.setter
    def image(self, layer: Any) -> None:
        self._face.image.choose(layer)

    @property
    def tissue(self) -> Any:
        """The Labels layer of tissues, or an image of stiffness."""
        return self._face.tissue.choice.value

    @tissue.setter
    def tissue(self, layer: Any) -> None:
        self._face.tissue.choice.choose(layer)

    @property
    def boundary(self) -> Any:
        """The Labels layer of boundaries, or observed displacements as Vectors."""
        return self._face.boundary.choice.value

    @boundary.setter
    def boundary(self, layer: Any) -> None:
        self._face.boundary.choice.choose(layer)

    @property
    def confidence(self) -> Any:
        """With Vectors as boundary: an image of confidence, or None for 1 everywhere."""
        return self._face.boundary.confidence.value

    @confidence.setter
    def confidence(self, layer: Any) -> None:
        self._face.boundary.confidence.choose(layer)

    @property
    def materials(self) -> tuple[Material, ...]:
        """How stiff each tissue label is."""
        return self._face.tissue.materials

    @materials.setter
    def materials(self, materials: tuple[Material, ...]) -> None:
        self._face.tissue.table.rows = materials

    @property
    def rules(self) -> tuple[BoundaryRule, ...]:
        """What each boundary label does."""
        return self._face.boundary.rules

    @rules.setter
    def rules(self, rules: tuple[BoundaryRule, ...]) -> None:
        self._face.boundary.table.rows = rules

    @property
    def outputs(self) -> tuple[Kind, ...]:
        """The layers a result makes."""
        return self._face.outputs

    @outputs.setter
    def outputs(self, kinds: tuple[Kind, ...]) -> None:
        self._face.outputs = kinds

    @property
    def settings(self) -> Any:
        """How to solve: a `SolverSettings`."""
        return self._face.settings

    # What there is to see

    @property
    def idle(self) -> bool:
        """Whether nothing is being computed for this widget."""
        return self._job is None

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
            if self.image is None:
                raise ProblemError("image", "is missing. Choose one to paint on.")
            tissue, boundary = layers_to_paint_on(self.image, self._view())
        except ProblemError as error:
            self._refuse(str(error))
            return
        self._viewer.add_layer(tissue)
        self._viewer.add_layer(boundary)
        self.tissue, self.boundary = tissue, boundary
        self._viewer.layers.selection = {tissue}
        tissue.selected_label, tissue.mode = 2, "paint"
        self._say(
            "Paint tissues in 'Tissue' and what holds or moves in 'Boundary' (click a table row "
            "to choose the label), then press Deform."
        )

    def deform(self) -> None:
        """Start; the layers are copied now, and the result appears when `finished` is emitted."""
        if not self.idle or self._closed:
            return
        for painted in (self._face.tissue.painted, self._face.boundary.painted):
            painted.look()
        try:
            request = self._current_request()
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
        self._request, self._job = request, job
        self._bar = self._face.start()
        self._poll.start()

    def cancel(self, why: str = "Cancelled; nothing was changed.") -> None:
        """Stop; nothing is changed, and the widget is idle at once, whatever the thread does."""
        if self._job is None:
            return
        self._job.cancel()
        self._set_idle(why)
        self.finished.emit(None)

    def reset_choices(self, *_: Any) -> None:
        """Look again at which layers there are."""
        if not self._closed:
            for choice in self._face.choices:
                choice.refresh()

    # Behind the face

    def _connect(self) -> None:
        face, events = self._face, self._viewer.layers.events
        face.make.changed.connect(self.make_layers)
        face.deform.changed.connect(self.deform)
        face.cancel.changed.connect(lambda: self.cancel())
        face.image.changed.connect(self._on_image)
        face.boundary.edited.connect(self._on_boundary)
        events.inserted.connect(self._on_inserted)
        events.removed.connect(self._on_removed)
        events.renamed.connect(self.reset_choices)
        self._viewer.dims.events.current_step.connect(self._on_boundary)
        self._viewer.dims.events.order.connect(self._on_boundary)
        self.native.destroyed.connect(lambda *_: self._on_destroyed())

    def _layers(self) -> list[Any]:
        return list(self._viewer.layers)

    def _view(self) -> View:
        return View.of(self._viewer.dims)

    def _current_request(self) -> Request:
        if self.tissue is None:
            raise ProblemError(
                "tissue", "no layer is chosen. Choose one, or press 'Make layers to paint on'."
            )
        if self.boundary is None:
            raise ProblemError(
                "boundary", "no layer is chosen. Choose one, or press 'Make layers to paint on'."
            )
        return Request(
            tissue=self.tissue,
            boundary=self.boundary,
            image=self.image,
            materials=self.materials,
            rules=self.rules,
            confidence=self.confidence if self._face.boundary.confidence.visible else None,
            view=self._view(),
        )

    def _on_poll(self) -> None:
        job = self._job
        if job is None or self._closed:
            self._poll.stop()
            return
        if not job.done:
            self._face.progress(self._bar, job.monitor)
            return
        try:
            outputs = job.result()
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
        else:
            self._show(job, outputs)

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
            now = self._current_request()
            same_tables = (now.materials, now.rules) == (started.materials, started.rules)
            return not (same_tables and read_layers(started).same_as(job.inputs))
        except HmrfError:
            return True

    def _set_idle(self, status: str) -> None:
        self._poll.stop()
        self._job = self._request = None
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
        if not self._closed:
            self._drawing.start()

    def _draw_preview(self) -> None:
        boundary = self._face.boundary
        place = self.image if self.image is not None else self.tissue
        try:
            if place is not None:
                unit = Frame.of(place, self._view()).unit
                boundary.table.unit = unit_symbol(unit)
            layer = boundary.painted.layer
            if layer is not None and boundary.preview.value:
                self._preview.update(layer, self.rules, self._view())
            else:
                self._preview.remove()
        except ProblemError as error:
            if self.idle:
                self._say(str(error))

    def _on_inserted(self, event: Any) -> None:
        if not self._closed:
            self.reset_choices()
            self._choose_by_role([event.value])

    def _choose_by_role(self, layers: list[Any]) -> None:
        """Choose a sample's layers as they come, and the first image there is."""
        for layer in layers:
            role = role_of(layer)
            if role == TISSUE:
                self.tissue = layer
            elif role == BOUNDARY:
                self.boundary = layer
            elif role == IMAGE:
                self.image = layer
        if self.image is None:
            images = [layer for layer in self._layers() if isinstance(layer, Image)]
            plain = [layer for layer in images if layer is not self.tissue]
            if plain:
                self.image = plain[0]

    def _on_removed(self, event: Any) -> None:
        if self._closed:
            return
        if self._request is not None and event.value in self._request.layers:
            self.cancel(f"Cancelled: '{event.value.name}' was removed.")
        self.reset_choices()

    def _on_destroyed(self) -> None:
        """The dock or the viewer was closed: stop, and touch nothing of Qt's any more."""
        self._closed = True
        if self._job is not None:
            self._job.cancel()
            self._job = None
        events = self._viewer.layers.events
        events.inserted.disconnect(self._on_inserted)
        events.removed.disconnect(self._on_removed)
        events.renamed.disconnect(self.reset_choices)
        self._viewer.dims.events.current_step.disconnect(self._on_boundary)
        self._viewer.dims.events.order.disconnect(self._on_boundary)
        self._face.release()
