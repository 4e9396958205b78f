"""Dock widget *Soft tissue*: forms for the tissue, its motion, and the result."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from napari.layers import Labels
from napari.utils.notifications import show_warning
from qtpy.QtWidgets import QMessageBox

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.landmarks import SD_FEATURE, read_landmarks, with_spreads_of
from napari_hmrf.layers.viewer_layers import layers_of, put_brush_away, shared
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.session import BRIGHTNESS, Session
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui import messages
from napari_hmrf.ui.autosave import Autosave
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.dock_values import DockValues
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.fitting import Fitting
from napari_hmrf.ui.form_binding import FormBinding
from napari_hmrf.ui.forms import attempt
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.introduction import Introduction
from napari_hmrf.ui.keyboard_access import EnterKey, FocusRings, order_tabs
from napari_hmrf.ui.motion.carry_over import CarryOver
from napari_hmrf.ui.motion.pointer import Pointer
from napari_hmrf.ui.new_layers import add_missing
from napari_hmrf.ui.patient_sides import PatientSides
from napari_hmrf.ui.preparation import Preparation
from napari_hmrf.ui.registering import Registering
from napari_hmrf.ui.remembered_settings import remember
from napari_hmrf.ui.result.result_view import ResultView
from napari_hmrf.ui.second_image import SecondImage
from napari_hmrf.ui.study_files import StudyFiles
from napari_hmrf.ui.unsaved import Unsaved, guard_windows
from napari_hmrf.ui.viewer_watch import ViewerWatch


class SoftTissue(DockValues):
    """Dock widget that defines tissue and its motion, and shows the resulting deformation.

    A script can do everything that the user can do: choose layers (`image`, `tissue`, `boundary`,
    ...), fill the tables (`materials`, `rules`), and set `model`, `settings` and `drawing`. While
    `live` is True, every edit updates the result. `deform` solves from a cold start and emits
    `finished` with the result. `result`, `percent`, `overlay` and similar attributes control the
    display.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    session : Session
        Studies of the viewer with their undo steps. The window shows every edit.
    fields : ToolFields
        Settings of the tools.
    more : ResultMenu
        Menu with measurements of the result, export of its field and of a film, and deformation
        of other layers.
    deformation_changed : Signal(Deformation)
        Emitted for every new state of the tissue.
    result_drawn : Signal(Outputs)
        Emitted after all layers of a result have been drawn.
    finished : Signal(object)
        Emitted when `deform` ends, with the `Outputs`, or with None if it was cancelled or failed.
    saved : Signal(object)
        Emitted after pictures have been written, with a list of `Path`.
    at : callable
        Returns the deformation of the visible tissue at a point in world coordinates, as a
        `Probe`; None outside tissue.
    undo, redo : callable
        Undoes the last step; redoes the step that was undone last.
    remove, clear : callable
        Removes the selected mark; removes all marks of the visible slice.
    play, pause : callable
        Plays back and forth between 0 and 100 %; pauses at the displayed state.
    save_study : callable
        Saves `study` to a path, with its field if the field is up to date; see
        `napari_hmrf.write_study`. Returns the `Path` of the file.
    open_study : callable
        Adds the layers of a saved study, and restores its settings. Raises the same errors as
        `read_study`.
    save_materials : callable
        Saves the tissue table to a path; see `tables.write_preset`. Returns the `Path` of
        the file.
    take_materials : callable
        Copies a `Preset`, the table of another Labels layer, or a file into the table of the
        Labels layer chosen as tissue; see `MaterialMenu.copy_materials`.
    cancel : callable
        Cancels all work. The dock is idle immediately, even if a solve is still stopping.
    schedule_refresh : callable
        Updates the result after an edit that does not emit an event.
    show_message : callable
        Shows a message in the status text of the dock.
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        viewer, undo = self._viewer, undo_of(self._viewer)
        self.session: Session = undo.session
        self._added_landmarks: tuple[Landmark, ...] = ()
        self._form = form = DockForm(self, viewer)
        remember(form.model.in_detail.device)
        self._binding = FormBinding(viewer, form)
        self._pointer = Pointer(self.native, viewer, form.motion.fields, undo)
        inputs = form, self._binding, self._pointer, undo.session
        self._controller = controller = Controller(self.native, viewer, *inputs)
        self._results = results = shared(viewer, ResultLayers)
        self._view = ResultView(
            self.native, viewer, form.result, results, undo.session, controller.jobs
        )
        self._connections = EventConnections((undo.session.selected, self._view.select_image))
        self._guide = Guide(viewer, controller, undo)
        self._preparation = Preparation(self.native, controller)
        self._carry_over = CarryOver(
            form.carry_over,
            undo.session,
            self._pointer.set_drawing,
            partial(self._guide.show_message, why="step"),
        )
        controller.slice_changed.connect(self._carry_over.refresh)
        self._watch = ViewerWatch(self.native, viewer, controller, self._guide)
        self._introduction = Introduction(
            self.native, controller, self._guide, results, self._on_sample
        )
        self._second = SecondImage(viewer, self._view, controller, undo.session)
        self._registering = Registering(controller, undo.session)
        self._fitting = Fitting(controller, undo.session)
        for job in (self._registering, self._fitting):
            job.message.connect(partial(self._guide.show_message, why="step"))
        self._sides = PatientSides(viewer, undo.session)
        self._files = StudyFiles(self, viewer, controller, self._guide)
        work = controller, self._files
        self._autosave = Autosave(self, viewer, undo.session, *work, self._try)
        self._unsaved = Unsaved(self.native, viewer, *work, self._autosave, self._try)
        self.fields, self.more = form.motion.fields, self._view.more
        self.deformation_changed, self.result_drawn, self.finished = (
            controller.deformation_changed,
            controller.result_drawn,
            controller.finished,
        )
        self.saved = self._view.more.saved
        self.undo, self.redo = undo.undo, undo.redo
        self.remove, self.clear = self._pointer.remove, self._pointer.clear
        self.play, self.pause = self._view.play, self._view.player.stop
        self.at = self._view.cursor.at
        self.save_study, self.open_study = self._files.save, self._files.open
        self.take_materials, self.save_materials = (
            form.tissue.menu.copy_materials,
            form.tissue.menu.save,
        )
        self.cancel, self.schedule_refresh, self.show_message = (
            controller.cancel,
            controller.schedule_refresh,
            self._guide.show_message,
        )
        self._connect()
        order_tabs(self.native)
        FocusRings(self.native)
        EnterKey(self.native)
        self._binding.choose_first()

    # State

    @property
    def study(self) -> Study:
        """Current study: the choices, paint, drawing and settings.

        Raises
        ------
        HmrfError
            If neither an image nor tissue labels are chosen, or if a layer cannot be read.
        """
        return self._controller.reader.read(self._controller.reader.request())

    @property
    def solution(self) -> Solution | None:
        """Solution of the latest complete result, or None."""
        latest = self.session.result
        return None if latest is None else latest.outputs.solution

    @property
    def shown(self) -> Study | None:
        """Study of the latest result, or None."""
        latest = self.session.result
        return None if latest is None else latest.moved.study

    @property
    def details(self) -> str:
        """Method, duration and accuracy of the latest result; "" if there is no result."""
        return "" if self.solution is None else repr(self.solution)

    @property
    def idle(self) -> bool:
        """True if no cold-start solve is in progress."""
        return not self._controller.settling

    @property
    def busy(self) -> bool:
        """True if a requested change is not shown yet."""
        return self._controller.busy or self._controller.jobs.busy()

    @property
    def tool(self) -> str:
        """Current tool: "pull", "landmark", or the action of the `Stroke`s that it paints."""
        return self._pointer.tool.name

    @tool.setter
    def tool(self, name: str) -> None:
        self._pointer.select_tool(name)

    @property
    def drawing(self) -> Drawing:
        """Drawing of the visible slice."""
        return self._pointer.drawing

    @drawing.setter
    def drawing(self, drawing: Drawing) -> None:
        self._controller.refresh()
        word = "" if self._binding.automatic else "replaced the drawing"
        self._pointer.set_drawing(drawing, word)

    # Actions

    def start(self) -> bool:
        """Start drawing with the current tool; return whether the mouse draws now."""
        if self._guide.situation.obstacle or self.image is None:
            self._guide.invite()
        elif self._controller.refresh():
            self._pointer.start_drawing()
            self._watch.hide_paint()
            self.schedule_refresh()  # the drawing updates the result even if `live` is False
        self._watch.update_mouse_mode()
        return self.active

    def stop(self) -> None:
        """Stop drawing, so that the mouse moves the view again; the drawing is kept."""
        if self.active and self.image in self._viewer.layers:
            self._viewer.layers.selection = {self.image}

    def save_pictures(self, folder: str | Path) -> None:
        """Write pictures into an existing folder, then emit `saved`."""
        attempt(partial(self.more.save_pictures, folder), self.show_message)

    def _show_marks(self) -> None:
        """Start drawing if an opened study has marks, which are visible only then."""
        if self.drawing.marks:
            self.start()

    def deform(self) -> None:
        """Solve the study from a cold start.

        The layers are copied before this method returns. `finished` is emitted at the end of the
        solve.
        """
        if self.idle and not self.away:
            for table in self._form.tables:
                table.refresh()
            self._binding.begin()
            self._controller.solve_cold()

    def reset(self) -> None:
        """Remove the drawing and restore the default settings, as one undo step.

        The layers, their tables and the device are kept.
        """
        self._pointer.release()
        self.session.reset()
        self._guide.show_message(messages.WAS_RESET, "step")

    def make_layers(self) -> None:
        """Add a tissue and a boundary layer on the pixel grid of the image, and choose both.

        Layers that are already chosen are kept, as is tissue defined by the brightness of the
        image.

        Raises
        ------
        HmrfError
            If no image is chosen, or if the image has no pixels in the visible slice.
        """
        if self.image is None:
            raise HmrfError(messages.WELCOME)
        by_brightness = self.curve is not None
        chosen = (self.image if by_brightness else self.tissue, self.boundary)
        preset, drawing = self._form.motion.fields.preset.value, self.drawing
        made = add_missing(
            self._viewer, self.image, *chosen, self._controller.view, preset, drawing
        )
        with self._binding.automatically():  # undo would not remove the layers
            self.tissue, self.boundary = BRIGHTNESS if by_brightness else made[0], made[1]
        self._watch.hand_brush(self._viewer.layers.selection.active)
        painted = [layer for layer in made if isinstance(layer, Labels)]
        # The deformed image, which they do not move with, is hidden now.
        layers_of(self._viewer).want(*painted)
        names = " and ".join(f"'{layer.name}'" for layer in painted)
        self._guide.show_message(messages.PAINT.format(names), "step")

    def tissue_from_intensity(self, curve: StiffnessCurve | None = None) -> StiffnessCurve:
        """Define the stiffness of tissue from the intensity of the image, and return the curve.

        Parameters
        ----------
        curve : StiffnessCurve, optional
            By default, the existing curve of the image, or a first guess if there is no curve.

        Returns
        -------
        StiffnessCurve

        Raises
        ------
        HmrfError
            If no image is chosen, or if no curve can be created for the image.
        """
        if self.image is None:
            raise HmrfError(messages.WELCOME)
        curve = curve or self._form.tissue.brightness_curve or self._controller.reader.first_curve()
        self.curve = curve
        self._controller.refresh()
        layer = self._controller.curve_layer.layer
        if layer is not None and not self.active:  # a tool would be put away
            self._viewer.layers.selection.active = layer
        self.show_message(messages.CURVE)
        return curve

    def take_landmarks(self, where: Any, should: Any = None, **how: float) -> None:
        """Add the points of two layers, or the lines of a Shapes layer, as landmarks.

        The landmarks of an earlier call are removed from the drawing, except those that were moved.
        If no standard deviations are given, neither here nor in the layers, landmarks keep those of
        the landmarks with the same source in the drawing.

        Parameters
        ----------
        where : napari.layers.Points or Shapes
            Landmarks, or lines from each landmark to its target.
        should : napari.layers.Points, optional
            Targets, in the order of the landmarks.
        **how
            Further arguments of `read_landmarks`, such as `radius` and `confidence`.

        Raises
        ------
        HmrfError
            If no image is chosen, or if the layers cannot be read; see `read_landmarks`.
        """
        if self.image is None or not self._controller.refresh():
            raise HmrfError(messages.WELCOME if self.image is None else self.status)
        grid, view = self.study.grid, self._controller.view
        added = {(mark.source, mark.target) for mark in self._added_landmarks}
        others = [
            mark
            for mark in self.drawing.marks
            if not (isinstance(mark, Landmark) and (mark.source, mark.target) in added)
        ]
        marks = read_landmarks(where, should, grid.known_place, grid.shape, view, **how)
        if "sd" not in how and SD_FEATURE not in (where if should is None else should).features:
            marks = with_spreads_of(self.drawing, marks)
        self._added_landmarks = marks
        self._pointer.set_drawing(
            Drawing((*marks, *others)), f"added landmarks from '{where.name}'"
        )
        self.start()

    def hand_brush(self, layer: Any) -> None:
        """Prepare a layer for painting: make it visible and active, and select its brush."""
        if layer in self._viewer.layers:
            self._viewer.layers.selection.active = layer
            self._watch.hand_brush(layer)

    def _connect(self) -> None:
        form, pointer, controller = self._form, self._pointer, self._controller
        form.make.changed.connect(lambda _: self._try(self.make_layers))
        form.intensity.changed.connect(lambda _: self._try(self.tissue_from_intensity))
        form.tissue.editor.guess.changed.connect(
            lambda: self._try(lambda: self.tissue_from_intensity(controller.reader.first_curve()))
        )
        points = form.motion.landmarks
        for signal in (points.chosen, points.take_button.changed):
            signal.connect(self._on_landmarks, max_args=0)
        form.motion.picked.connect(self._on_tool)
        form.footer.remove.triggered.connect(lambda: self.remove())
        form.footer.remove_all.triggered.connect(lambda: self.clear())
        form.result.keep.changed.connect(lambda _: self._try(self._files.save_as))
        self._files.opened.connect(self._show_marks)
        form.footer.deform.changed.connect(lambda _: self.deform())
        form.footer.cancel.changed.connect(lambda _: self.cancel())
        form.footer.reset.triggered.connect(lambda: self._on_reset())
        self.more.precise_chosen.connect(lambda: form.footer.deform.changed.emit(True))
        for table in form.tables:
            table.picked.connect(self.hand_brush)
            table.changed.connect(self._on_table)
        pointer.changed.connect(self._show_tool)
        pointer.pulled.connect(self._view.show_pulled)
        form.footer.cancel.changed.connect(lambda _: self._view.show_pulled(""))
        form.footer.cancel.changed.connect(lambda _: self._view.cancel_estimate())
        self._view.working.connect(controller.progress.start)
        controller.result_drawn.connect(lambda _: self._view.show_pulled(""))
        controller.finished.connect(self._on_finished)
        controller.jobs.refused.connect(self.show_message)
        self._view.message.connect(self.show_message)
        self._watch.first_image_ready.connect(self._on_first)

    def _on_landmarks(self) -> None:
        """Add the landmarks of the chosen layers to the drawing."""
        motion = self._form.motion
        take = partial(self.take_landmarks, radius=motion.fields.patch_radius)
        self._try(lambda: take(*motion.landmarks.pair))

    def _on_reset(self) -> None:
        """Ask, and reset the study."""
        button = QMessageBox.StandardButton
        question = messages.RESET.format(getattr(self.image, "name", ""))
        offered = button.Reset | button.Cancel
        answer = QMessageBox.question(self.native, "Soft tissue", question, offered, button.Cancel)
        if answer == button.Reset:
            self.reset()

    def _show_tool(self) -> None:
        motion, pointer = self._form.motion, self._pointer
        if not pointer.tool.is_dragging:  # a drag does not change the widgets below
            motion.show_tool(pointer.tool.name if pointer.active else "")
            motion.landmarks.show_for(pointer.tool.name)
            pointer.report_tool()

    def _try(self, action: Callable[[], object]) -> None:
        attempt(action, self._refuse)

    def _refuse(self, message: str) -> None:
        self._guide.refuse(message)
        show_warning(message)

    # Buttons and events

    def _on_tool(self, name: str) -> None:
        """Switch to the tool of a button, and draw with it."""
        self.tool = name
        if not self.active:
            self.start()
        self._show_tool()

    def _on_table(self, is_automatic: bool) -> None:
        """Show the effect of a typed value, except while a painted layer is in use."""
        image = self.session.slice.layer
        if not is_automatic and image is not None:
            self._results.show_deformed(image, "comparison")

    def _on_finished(self, outputs: object) -> None:
        """Hide the paint, which would tint the requested result."""
        if outputs is not None and self.image is not None:
            put_brush_away(self._viewer)
            self._results.show_deformed(self.image)
            tissue = (self._form.tissue.layer, self._controller.curve_layer.layer)
            shown = [each for each in tissue if each is not None]
            layers_of(self._viewer).want(*shown, wanted=False)

    def on_window(self, window: Any) -> None:
        """Connect to the napari window that the dock was added to."""
        guard_windows()
        self._sides.begin(window)

    def on_over(self, closed: bool) -> None:
        """Release all parts after the dock was closed or its window was deleted."""
        if closed:
            self._autosave.keep_now()
            self._controller.cancel()
            self._controller.clear()
            self._pointer.leave()
            self._view.rest()
        parts = (
            self._connections,
            self._second,
            self._registering,
            self._fitting,
            self._sides,
            self._preparation,
            self._view,
            self._autosave,
            self._unsaved,
            self._watch,
            self._guide,
        )
        for part in (*parts, self._controller, self._binding, self._form):
            part.release()
        self._pointer.end()
        super().on_over(closed)

    def _on_first(self) -> None:
        if self.docked:
            self.start()

    def _on_sample(self) -> bool:
        """Start drawing on a sample, if the dock is in a window; return whether the mouse draws."""
        self._on_first()
        return self.docked and self.active
