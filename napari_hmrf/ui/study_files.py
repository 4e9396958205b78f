"""Study files of the dock: studies that are saved and opened."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from napari.layers import Layer
from psygnal import Signal
from qtpy.QtWidgets import QFileDialog

from napari_hmrf.errors import HmrfError
from napari_hmrf.io.study_file import SUFFIX, read_saved, write_study
from napari_hmrf.layers.image_choice import is_same_image
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.missing_layer import missing_layer
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.read import study_layers
from napari_hmrf.layers.second_picture import second_picture
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.layers.viewer_layers import layers_of, shared
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.registration.study_registration import SecondPicture
from napari_hmrf.study.session import Part
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing.drawing import ends_of
from napari_hmrf.ui import messages
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.viewer_dock import Dock

#: Characters that some systems do not allow in file names.
_NO_FILE_NAME = re.compile(r'[\\/:*?"<>|]')


class StudyFiles:
    """Study files of the dock: studies that are saved and opened.

    Parameters
    ----------
    dock : Dock
    viewer : napari.Viewer or ViewerModel
    controller : Controller
    guide : Guide

    Attributes
    ----------
    opened : Signal()
        Emitted after a study was opened.
    stored : Signal(Part)
        Emitted with the drawing of a slice that now has a file with its work.
    """

    opened = Signal()
    stored = Signal(Part)

    def __init__(self, dock: Dock, viewer: Any, controller: Controller, guide: Guide) -> None:
        self._dock, self._viewer, self._controller, self._guide = dock, viewer, controller, guide
        self._session = undo_of(viewer).session

    def writer(self, study: Study) -> tuple[Callable[..., Path], str]:
        """Return `write_study` with the current display and second image of a study as arguments.

        An overlay that needs a layer which is not in the file is omitted, and so is a second image
        that cannot be read; the second value is the reason, or "".
        """
        display, second = self._session.display, self._session.choice.compare_with
        overlay = "" if display.overlay in ("difference", "uncertainty") else display.overlay
        picture, reason = None, ""
        if second is not None:
            try:
                picture = self._second_picture(second, study)
            except Exception as error:  # noqa: BLE001 - a layer may raise anything
                reason = messages.in_short(error)
        write = partial(write_study, overlay=overlay, second=picture, arrows=display.arrows)
        return write, reason

    def _second_picture(self, layer: Any, study: Study) -> SecondPicture:
        """Return the second image on the grid of a study; the same object while nothing changes."""
        place, shape, view = study.grid.known_place, study.grid.shape, self._controller.view
        copies, own = shared(self._viewer, LayerCopies), frame_of(layer, view)
        inputs = (copies.of(layer, own), own, place, shape, layer.name)
        return copies.derive(layer, inputs, lambda: second_picture(layer, place, shape, view))

    # Saving

    def save(self, path: str | Path) -> Path:
        """Save the current study, with the displayed field if it belongs to the study.

        The field of a solve that is still being continued is saved, too.
        """
        controller, session = self._controller, self._session
        work = session.unsaved
        study = controller.reader.read(controller.reader.request())
        latest = session.result if session.shows(study) else None
        solution = None if latest is None else latest.outputs.solution
        write, lacking = self.writer(study)
        written, here = write(path, study, solution), session.slice
        place = study.grid.known_place.slice_seen
        has_slices = controller.form.extent.has_slices
        saved = f"the study of {_extent(place)} as {written.name}" if has_slices else written.name
        fieldless = f" without a field: press {messages.BUTTON} to get one"
        sentences = [f"Saved {saved}{fieldless if solution is None else ''}."]
        if pairs := self._landmarks_apart(study):
            sentences.append(f"It lacks the landmarks of '{pairs}': press 'Use as landmarks'.")
        if lacking:
            sentences.append(f"It lacks the second image: {lacking}")
        others = [
            _extent(part.slice_name)
            for part in work.slices
            if part.layer is here.layer and part != here and part.plane
        ]
        if others:
            sentences.append(f"Not saved yet: {', '.join(others)}. Each has a file of its own.")
        self._guide.show_message(" ".join(sentences))
        self._set_stored(here, written)
        return written

    def save_as(self) -> None:
        """Prompt for a file name, and save the study.

        The name ends in .study, because napari opens no other file as a study.
        """
        here = self._session.slice
        name = "study" if here.layer is None else _NO_FILE_NAME.sub("-", here.title)
        known = self._session.unsaved.paths.get(here, Path(name + SUFFIX))
        chosen, _ = QFileDialog.getSaveFileName(
            self._dock.native, "Save the study", str(known), f"Studies (*{SUFFIX})"
        )
        if not chosen:
            return
        path = Path(chosen)
        if path.suffix.lower() != SUFFIX:
            path = path.with_name(path.name + SUFFIX)
            if path.exists():
                raise HmrfError(f"{path.name} exists. To replace it, choose this name.")
        self.save(path)

    def _set_stored(self, here: Part, path: Path) -> None:
        work = self._session.unsaved
        work.save(here)
        work.paths[here] = path
        self.stored.emit(here)

    def _landmarks_apart(self, study: Study) -> str:
        """Return the name of the landmark layer if any of its pairs was not added, else ""."""
        form, grid = self._controller.form, study.grid
        where, should = form.motion.landmarks.pair
        taken = [ends_of(mark, grid.spacing) for mark in study.motion.drawing.marks]
        if where is None:
            return ""
        try:
            chosen = read_landmarks(
                where, should, grid.known_place, grid.shape, self._controller.view
            )
        except HmrfError:  # reported when the landmarks are added
            return ""
        return where.name if any((mark.target, mark.source) not in taken for mark in chosen) else ""

    # Opening

    def open(self, path: str | Path) -> None:
        """Add the layers of a saved study, and keep the drawings on other layers."""
        self.add(path)
        self._controller.binding.begin()  # images opened later do not replace that of the study
        self._set_stored(self._session.slice, Path(path))
        self.opened.emit()

    def add(self, path: str | Path, reuse: bool = False) -> None:
        """Add the content of a file to the viewer, without undo steps for its layers.

        If `reuse` is True, an open image without a drawing is used instead of an equal image of
        the file.
        """
        saved, controller = read_saved(path), self._controller
        study, solution = saved.study, saved.solution
        if solution is not None:
            controller.engine.start_from(solution)
        layers = study_layers(study, saved.second)
        for name in ("image", "second"):
            if reuse and name in layers:
                layers[name] = self._undrawn_image(layers[name]) or layers[name]
        written = layers_of(self._viewer)
        with controller.binding.automatically():
            for name, layer in layers.items():
                if layer not in self._viewer.layers:
                    written.add(layer, select=name != "second")
                elif name != "second":
                    written.want(layer)
            if (frame := study.grid.place) is not None:
                first = next(iter(layers.values()))
                part = Part("drawing", first, frame.plane, (0,) * first.ndim)
                undo_of(self._viewer).go_to(part, turn=True)
            self._session.restore(study, layers)
            drawing, measured = study.motion.drawing, study.motion.measured
            if measured is not None or drawing.marks:
                is_read = controller.refresh()  # selects the slice
                if drawing.marks and not is_read:
                    reason = self._guide.scene.status
                    raise HmrfError(f"{Path(path).name} cannot be shown here: {reason}")
            if solution is not None:  # known before the motion starts a solve
                shown = controller.reader.read(controller.reader.request())
                motion = replace(shown.motion, drawing=drawing, measured=measured)
                controller.engine.deliver_again(replace(shown, motion=motion), solution)
            if measured is not None:
                self._session.set_measured(measured)
                if measured.missing is not None:
                    place, name = study.grid.known_place, layers["image"].name
                    made = Layer.create(*missing_layer(measured.missing, place, name))
                    written.add(made, select=False)
            controller.refresh()
            controller.pointer.set_drawing(drawing, "")
        if (brightness := controller.curve_layer.layer) is not None and study.moves:
            written.want(brightness, wanted=False)  # would tint the deformed image
        if saved.overlay in controller.form.result.overlay.choices:
            self._session.choose_display(overlay=saved.overlay)
        if saved.arrows is not None:
            self._session.choose_display(arrows=saved.arrows)
        self._dock.fit_view()

    def _undrawn_image(self, image: Any) -> Any:
        """Return an open image that equals a layer and has no drawing, or None."""
        parts = [each for each in self._session.parts if each.kind == "drawing"]
        drawn = {each.layer for each in parts if self._session.get(each).marks}
        for layer in self._viewer.layers:
            if layer not in drawn and is_same_image(layer, image):
                return layer
        return None


def _extent(slice_name: str) -> str:
    """Return the name of a slice, such as "z = 12", or of the volume ("") in a sentence."""
    if not slice_name:
        return "the whole volume"
    return slice_name if slice_name.startswith("slice") else f"the slice {slice_name}"
