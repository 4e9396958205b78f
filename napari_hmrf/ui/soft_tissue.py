"""Dock widget *Soft tissue*: the tissue, its motion, and the result."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from napari.layers import Labels
from napari.utils.notifications import show_warning

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.comparison import Comparison
from napari_hmrf.field.tissue_point import Probe
from napari_hmrf.layers.edit_history import steps_of
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.screen_directions import Sides
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.solver.model_names import ModelName
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.models import SolverDetails
from napari_hmrf.study.study import Study
from napari_hmrf.study.study_model import History
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui import messages
from napari_hmrf.ui.choices import Choices
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.forms import Part, attempt
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.live_study import LiveStudy
from napari_hmrf.ui.motion.pointer import Pointer
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.new_layers import add_missing
from napari_hmrf.ui.patient_sides import PatientSides
from napari_hmrf.ui.remembered_settings import remember
from napari_hmrf.ui.result.result_menu import ResultMenu
from napari_hmrf.ui.result.result_view import ResultView
from napari_hmrf.ui.second_image import SecondImage
from napari_hmrf.ui.tissue_form import BRIGHTNESS
from napari_hmrf.ui.unsaved import Unsaved
from napari_hmrf.ui.viewer_dock import Dock
from napari_hmrf.ui.viewer_watch import ViewerWatch


class SoftTissue(Dock):
    """Dock widget that defines tissue and its motion, and shows all of the tissue follow.

    A script can do everything the user can: choose layers (`image`, `tissue`, `boundary`, ...),
    fill the tables (`materials`, `rules`), set `model`, `settings` and `drawing`. While `live` is
    True, the tissue follows every edit; `deform` solves from a cold start and emits `finished`
    with the result. `result`, `percent`, `overlay` and similar attributes control the display.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    image : napari.layers.Image or None
        Image to deform. If there is no image at all, only the motion of painted tissue is shown.
    extent : {"slice", "volume"}
        Deform the visible slice as if it had no neighbours, or the whole volume.
    tissue : napari.layers.Labels, Image, "brightness" or None
        Labels of tissues, an image of stiffness, or the image's brightness through its curve;
        None: the content of the image is tissue.
    boundary : napari.layers.Labels, Vectors or None
        Labels of held and moved regions, or observed displacements.
    confidence : napari.layers.Image, Labels, "edges" or None
        Confidence of the Vectors chosen as boundary; None: 1 everywhere.
    materials, rules : tuple of Material, tuple of BoundaryRule
        Stiffness of each tissue label, and effect of each boundary label.
    curve : StiffnessCurve or None
        Curve from intensity to stiffness, if the tissue is defined by one; can be set.
    hold_edge, without_border : bool
        Whether the outer edge of the tissue is held in place, and whether the dark, unpainted
        border of the image is excluded from the tissue.
    model, plane : str
        Model of the tissue: "elastic", "paper" or "paper, converged"; and, for elastic tissue,
        "stress" or "strain". The paper's model sets its own numbers in `settings`.
    poisson : float
        Poisson's ratio of elastic tissue given as an image of stiffness; labels have theirs in
        `materials`.
    settings : SolverDetails
        Solver settings: a value, as in `dock.settings = replace(dock.settings, sweeps=7)`.
    fields, history : ToolFields, History
        Settings of the tools; and the drawing of the visible slice, with its undo steps.
    active, playing : bool
        Whether the mouse draws, and whether the deformation is played back and forth.
    result : napari.layers.Vectors or None
        Arrows that hold the displayed result: the newest, or one whose arrows were selected
        since; can be set.
    percent, before : int, bool
        Displayed part of the deformation, from 0 to 100; and whether the undeformed image is
        shown, without its result.
    overlay : str
        Overlay on the image: "nothing"; moving with the tissue, a `Quantity`, "grid", "labels",
        "difference" (from the reference), "folds", "overlaps", "stiffness" or "confidence"; at the
        original position, "observed".
    reference, comparison : napari.layers.Vectors or None, Comparison or None
        A field or another result, and the difference of this one from it, once computed.
    more : ResultMenu
        Measures the result, saves its field and a film, and moves other layers along.
    live : bool
        Whether the tissue follows every edit; by default True unless the image is large.
    status, invitation, warning : str
        Sentence at the bottom, hint at the next step, and warning about the visible tissue.
    seen, followed : Signal(Deformation), Signal(Outputs)
        Emitted with every new state of the tissue, and when it is at rest and all layers are drawn.
    finished, saved : Signal(object)
        Emitted when `deform` ends: `Outputs`, or None if it was cancelled or failed; and when
        pictures were written: a list of `Path`.
    unsaved, ask : bool, callable
        Whether there is work that is in no file; and the function that answers "save", "discard"
        or "cancel" before a window with such work closes: by default a dialog.
    compare_with, residual : napari.layers.Image or None, str
        A second image over the deformed one, and the distance of landmarks from their targets.
    at : callable
        Given a point of the world, returns the deformation of the visible tissue there, a `Probe`;
        None outside tissue.
    undo, redo : callable
        Undo the last step, and redo the step undone last.
    remove, clear : callable
        Remove the selected mark, and all marks of the visible slice.
    play, pause : callable
        Play back and forth between 0 and 100 %, and pause at the displayed state.
    save_study, save_materials : callable
        Given a path, save all of `study`, and its field if that is up to date, as
        `napari_hmrf.write_study`; and the table of tissues, as `material_tables.write_preset`.
        Both return the `Path` of the file.
    take_materials : callable
        Fill the table of the Labels layer chosen as tissue, as `MaterialMenu.take`: given a
        `Preset`, another Labels layer, or a file's path.
    cancel : callable
        Cancel the work, with nothing changed; the dock is idle at once, even if the thread still
        runs.
    touch : callable
        Update the tissue after an edit that emits no event.
    say : callable
        Show a sentence at the bottom.
    sides : Sides
        Side of the patient at each edge of the canvas, such as "R", if an image records it.
    """

    image = Part[Any]("_form.image.value")
    extent = Part[str]("_form.extent.value")
    tissue = Part[Any]("_form.tissue.choice.value")
    boundary = Part[Any]("_form.motion.boundary.choice.value")
    confidence = Part[Any]("_form.motion.boundary.confidence.value")
    materials = Part[tuple[Material, ...]]("_form.tissue.table.rows")
    rules = Part[tuple[BoundaryRule, ...]]("_form.motion.boundary.table.rows")
    curve = Part[StiffnessCurve | None]("_choices.curve")
    hold_edge = Part[bool]("_form.motion.edge.value")
    weight = Part[tuple[float, ...]]("_form.motion.weight.value")
    without_border = Part[bool]("_form.tissue.border.value")
    fields = Part[ToolFields]("_form.motion.fields")
    model = Part[ModelName]("_form.model.model.value")
    plane = Part[Plane]("_form.model.plane.value")
    poisson = Part[float]("_form.model.poisson.value")
    settings = Part[SolverDetails]("_form.model.in_detail.details")
    history = Part[History]("_pointer.history")
    active = Part[bool]("_pointer.active")
    result = Part[Any]("_view.arrows")
    percent = Part[int]("_form.result.slider.value")
    before = Part[bool]("_view.before")
    playing = Part[bool]("_view.player.playing")
    reference = Part[Any]("_form.result.reference.value")
    comparison = Part[Comparison | None]("_view.comparison")
    more = Part[ResultMenu]("_view.more")
    overlay = Part[str]("_form.result.overlay.value")
    saved = Part[Any]("_view.more.saved")
    unsaved = Part[bool]("_unsaved.there")
    ask = Part[Any]("_unsaved.ask")
    compare_with = Part[Any]("_form.result.second.value")
    residual = Part[str]("_form.result.landmarks.value")
    sides = Part[Sides]("_sides.shown")
    live = Part[bool]("_form.footer.live.value")
    status = Part[str]("_guide.shown")
    invitation = Part[str]("_guide.invitation")
    warning = Part[str]("_form.footer.warning")
    seen = Part[Any]("_live_study.seen")
    followed = Part[Any]("_live_study.followed")
    finished = Part[Any]("_live_study.finished")
    at = Part[Callable[[Any], Probe | None]]("_view.cursor.at")
    undo = Part[Callable[[], None]]("_steps.undo")
    redo = Part[Callable[[], None]]("_steps.redo")
    remove = Part[Callable[[], None]]("_pointer.remove")
    clear = Part[Callable[[], None]]("_pointer.clear")
    play = Part[Callable[[], None]]("_view.play")
    pause = Part[Callable[[], None]]("_view.player.stop")
    save_study = Part[Callable[[str | Path], Path]]("_unsaved.save")
    take_materials = Part[Callable[[Preset | Any], None]]("_form.tissue.menu.take")
    save_materials = Part[Callable[[str | Path], Path]]("_form.tissue.menu.save")
    cancel = Part[Callable[[], None]]("_live_study.cancel")
    touch = Part[Callable[[], None]]("_live_study.touch")
    say = Part[Callable[[str], None]]("_guide.say")

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        viewer, steps = self._viewer, steps_of(self._viewer)
        self._steps = steps
        self._taken: tuple[Landmark, ...] = ()
        # True if a tool was activated automatically and has not been used yet.
        self._unused = False
        self._form = form = DockForm(self, viewer)
        remember(form.model.in_detail["device"])
        self._choices = Choices(viewer, form)
        self._pointer = Pointer(self.native, viewer, form.motion.fields, steps)
        self._live_study = LiveStudy(self.native, viewer, form, self._choices, self._pointer)
        results = shared(viewer, ResultLayers)
        self._view = ResultView(self.native, viewer, form.result, results)
        form.image.changed.connect(self._view.stand_on)
        self._guide = Guide(viewer, self._live_study, steps)
        self._watch = ViewerWatch(self.native, viewer, self._live_study, self._guide)
        self._second = SecondImage(viewer, self._view, self._live_study)
        self._sides = PatientSides(viewer, form.image)
        self._unsaved = Unsaved(self, viewer, self._live_study, self._try)
        self._connect()
        self._choices.choose_first()

    # State

    @property
    def study(self) -> Study:
        """Current study: the choices, paint, drawing and settings.

        Raises
        ------
        HmrfError
            If there is nothing to work on, or a layer cannot be read.
        """
        return self._live_study.read(self._live_study.request())

    @property
    def solution(self) -> Solution | None:
        """Solution of the latest result at rest, or None."""
        latest = self._live_study.latest
        return None if latest is None else latest.outputs.solution

    @property
    def shown(self) -> Study | None:
        """Study of the latest result, or None."""
        latest = self._live_study.latest
        return None if latest is None else latest.moved.study

    @property
    def details(self) -> str:
        """Method, duration and accuracy of the latest result; "" if there is none."""
        return "" if self.solution is None else repr(self.solution)

    @property
    def idle(self) -> bool:
        """True if no cold-start solve is in progress."""
        return not self._live_study.settling

    @property
    def busy(self) -> bool:
        """True if a requested change is not shown yet."""
        return self._live_study.busy or self._view.busy

    @property
    def tool(self) -> str:
        """Tool of the mouse: "pull", "landmark", or an action of a `Stroke` that it paints."""
        return self._pointer.tool.name

    @tool.setter
    def tool(self, name: str) -> None:
        self._pointer.take_up(name)

    @property
    def drawing(self) -> Drawing:
        """Drawing of the visible slice."""
        return self._pointer.drawing

    @drawing.setter
    def drawing(self, drawing: Drawing) -> None:
        self._live_study.look()
        by_itself = self._choices.by_itself
        self._pointer.set_drawing(drawing, "" if by_itself else "took over a drawing")

    # Actions

    def start(self) -> bool:
        """Start drawing with the current tool; return whether the mouse draws now."""
        if self._viewer.dims.ndisplay != 2 or self.image is None:
            self._guide.invite()
        elif self._live_study.look():
            self._pointer.take()
            self._watch.hide_paint()
            self.touch()  # tissue follows its drawing, live or not
        self._watch.look_at_mouse()
        return self.active

    def stop(self) -> None:
        """Stop drawing, so that the mouse moves the view again; the drawing stays."""
        if self.active and self.image in self._viewer.layers:
            self._viewer.layers.selection = {self.image}

    def save_pictures(self, folder: str | Path) -> None:
        """Write pictures into an existing folder; `saved` is emitted when they are written."""
        attempt(partial(self.more.save_pictures, folder), self.say)

    def open_study(self, path: str | Path) -> None:
        """Add the layers of a saved study, and restore its settings; errors as in `read_study`."""
        self._unsaved.open(path)
        if self.drawing.marks:
            self._unused = self.start()  # makes the marks visible

    def deform(self) -> None:
        """Solve from a cold start; the layers are copied now, `finished` is emitted at the end."""
        if self.idle and not self.away:
            for table in self._form.tables:
                table.look()
            self._choices.begin()
            self._live_study.settle()

    def make_layers(self) -> None:
        """Add a tissue and a boundary layer on the pixels of the image, and choose them.

        Layers that are chosen already are kept, as is tissue defined by the image's brightness.

        Raises
        ------
        HmrfError
            If no image is chosen, or the image is not in the visible slice.
        """
        if self.image is None:
            raise HmrfError(messages.WELCOME)
        by_itself = self.curve is not None
        chosen = (self.image if by_itself else self.tissue, self.boundary)
        made = add_missing(self._viewer, self.image, *chosen, self._form.view())
        with self._choices.nobody_chooses():  # undo would not remove the layers
            self.tissue, self.boundary = BRIGHTNESS if by_itself else made[0], made[1]
        painted = (f"'{layer.name}'" for layer in made if isinstance(layer, Labels))
        self.say(messages.PAINT.format(" and ".join(painted)))

    def tissue_from_intensity(self, curve: StiffnessCurve | None = None) -> StiffnessCurve:
        """Define the stiffness of tissue by the image's intensity; return the curve.

        The `curve` is by default the existing one of this image, or else a first guess. Raises
        `HmrfError` if no image is chosen, or no curve can be made for it.
        """
        if self.image is None:
            raise HmrfError(messages.WELCOME)
        curve = curve or self._form.tissue.known or self._live_study.first_curve()
        self.curve = curve
        self._live_study.look()
        if (layer := self._live_study.curve_layer.layer) is not None:
            self._viewer.layers.selection.active = layer
        self.say(messages.CURVE)
        return curve

    def take_landmarks(self, where: Any, should: Any = None, **how: float) -> None:
        """Take points of two layers, or lines of a Shapes layer, as landmarks of the drawing.

        Landmarks that were taken before are replaced. Arguments (`radius` and `confidence` among
        them) and errors are those of `read_landmarks`.
        """
        if self.image is None or not self._live_study.look():
            raise HmrfError(messages.WELCOME if self.image is None else self.status)
        grid, view = self.study.grid, self._form.view()
        others = [mark for mark in self.drawing.marks if mark not in self._taken]
        self._taken = marks = read_landmarks(
            where, should, grid.known_place, grid.shape, view, **how
        )
        self._pointer.set_drawing(Drawing((*marks, *others)), f"took landmarks from '{where.name}'")
        self.start()

    def hand_brush(self, layer: Any) -> None:
        """Prepare a layer for painting: make it visible and active, on the undeformed image."""
        if layer in self._viewer.layers:
            self._viewer.layers.selection.active = layer
            layer.visible = True
            layer.mode = "paint"
            self.say(messages.MEANWHILE if self.before else "")

    def _connect(self) -> None:
        form, pointer, live = self._form, self._pointer, self._live_study
        form.make.changed.connect(lambda _: self._try(self.make_layers))
        form.intensity.changed.connect(lambda _: self._try(self.tissue_from_intensity))
        form.tissue.editor.anew.changed.connect(
            lambda: self._try(lambda: self.tissue_from_intensity(live.first_curve()))
        )
        points = form.motion.boundary.landmarks
        points.take.changed.connect(lambda _: self._try(lambda: self.take_landmarks(*points.pair)))
        form.motion.picked.connect(self._on_tool)
        form.motion.remove.changed.connect(lambda _: self.remove())
        form.motion.clear.changed.connect(lambda _: self.clear())
        form.result.keep.changed.connect(lambda _: self._try(self._unsaved.save_as))
        form.footer.deform.changed.connect(lambda _: self.deform())
        form.footer.cancel.changed.connect(lambda _: self.cancel())
        for table in form.tables:
            table.picked.connect(self.hand_brush)
            # Show the effect of a typed value even while the brush is active.
            table.changed.connect(lambda by_itself: None if by_itself else live.show_before(False))
        pointer.changed.connect(self._show_tool)
        pointer.begun.connect(partial(setattr, self, "_unused", False))
        live.finished.connect(self._on_finished)
        self._view.said.connect(self.say)
        self._watch.first_came.connect(self._on_first)

    def _show_tool(self) -> None:
        motion, pointer = self._form.motion, self._pointer
        if not pointer.hand.holding:  # a drag changes none of these
            motion.show_tool(pointer.tool.name if pointer.active else "")
            motion.remove.enabled = pointer.hand.selected is not None
            motion.clear.enabled = bool(pointer.drawing.marks)
            pointer.say_tool()

    def _try(self, action: Callable[[], object]) -> None:
        attempt(action, self._refuse)

    def _refuse(self, why: str) -> None:
        self._guide.refuse(why)
        show_warning(why)

    # Buttons and events

    def _on_tool(self, name: str) -> None:
        """Switch to the tool of a button; a second press puts it down."""
        unused, self._unused = self._unused, False
        if self.active and self.tool == name and not unused:
            self.stop()
        else:
            self.tool = name
            if not self.active:
                self.start()
        self._show_tool()

    def _on_finished(self, outputs: object) -> None:
        """Show the requested result without the paint on it."""
        if outputs is not None and self.image is not None:
            self._live_study.show_before(False)
            for tissue in (self._form.tissue.layer, self._live_study.curve_layer.layer):
                if tissue is not None:
                    tissue.visible = False  # would tint the deformed image

    def on_window(self, window: Any) -> None:
        """Connect to the napari window that the dock was added to."""
        window.installEventFilter(self._unsaved)
        self._sides.begin(window)

    def on_over(self, closed: bool) -> None:
        """Release all parts, as the dock was closed or its window is gone."""
        if closed:
            self._live_study.cancel()
            self._live_study.forget()
            self._pointer.leave()
            self._view.rest()
        parts = (self._second, self._sides, self._view, self._unsaved, self._watch, self._guide)
        for part in (*parts, self._live_study, self._choices, self._form):
            part.release()
        self._pointer.end()
        super().on_over(closed)

    def _on_first(self) -> None:
        if self.docked:
            self._unused = self.start()
