"""Current study of a dock, and the tissue that follows it."""

from __future__ import annotations

import logging
import math
import time
import weakref
from dataclasses import replace
from typing import Any

from napari.utils.notifications import show_error, show_warning
from psygnal import Signal

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.frame import SlicePlace
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.screen_directions import ways_of
from napari_hmrf.layers.slice_view import frame_of, plane_shown
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.coarse_grid import CoarseGrid, Glance
from napari_hmrf.study.ground import refuse_unknown
from napari_hmrf.study.study import Study
from napari_hmrf.study.study_model import Part, StudyModel
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve, first_curve
from napari_hmrf.ui import messages
from napari_hmrf.ui.curve.curve_layer import CurveLayer
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import repeating, single_shot
from napari_hmrf.ui.follower import Done, Follower, Seen
from napari_hmrf.ui.form_binding import FormBinding
from napari_hmrf.ui.motion.pointer import Pointer
from napari_hmrf.ui.warning_chip import WarningChip

_log = logging.getLogger("napari_hmrf")
#: Interval between updates of the progress of a solve, in milliseconds.
_POLL = 30
#: Time without a result after which progress is shown, in seconds.
_PATIENCE = 0.4
#: Time at rest after which all layers of a result are drawn, in milliseconds.
_REST = 200
#: Tolerance while dragging in the large-motion model, in pixels.
_NEAR = 0.1
#: Sites on which a volume, or an image in large motion, is solved during a drag: several pictures
#: a second. Images up to the second factor larger are solved at full resolution.
GLANCED, _FOLLOWED = 100_000, 4


class LiveStudy:
    """Reader of the dock's choices that keeps the tissue up to date and shows the results.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    form, binding, pointer : DockForm, FormBinding, Pointer
        Inputs to read; kept as attributes, for the other parts of the dock.
    model : StudyModel

    Attributes
    ----------
    source : napari.layers.Layer or None
        Layer that is deformed.
    settling : bool
        Whether a cold-start solve is in progress.
    curve_layer : CurveLayer
        Shows the stiffness curve of the tissue, if it has one.
    chip : WarningChip
        Warns of problems of the latest result.
    """

    #: The visible state of the tissue has changed: a `Deformation`.
    seen = Signal(object)
    #: The tissue is at rest, and all layers of the result are drawn: `Outputs`.
    followed = Signal(object)
    #: A cold-start solve has ended: `Outputs`, or None if it was cancelled or failed.
    finished = Signal(object)
    #: Status message; "" clears the one before.
    said = Signal(str)
    #: Reason why a request cannot be carried out.
    refused = Signal(str)
    #: Progress message, shown until the work ends; then "".
    doing = Signal(str)
    #: The current slice or image has changed.
    moved_on = Signal(Study)

    def __init__(
        self,
        native: Any,
        viewer: Any,
        form: DockForm,
        binding: FormBinding,
        pointer: Pointer,
        model: StudyModel,
    ) -> None:
        self._viewer, self.form, self.binding, self.pointer = viewer, form, binding, pointer
        self._model = model
        self._over = False
        # Study that was read last, without later changes of its drawing.
        self._read: Study | None = None
        self.source: Any = None
        self._done: weakref.WeakKeyDictionary[Any, Done] = weakref.WeakKeyDictionary()
        self.settling = False
        self._copies = shared(viewer, LayerCopies)
        self._follower = Follower(self._on_seen, self._on_done)
        self._asked: Study | None = None
        self._since = 0.0
        # Reason why the tissue cannot follow, report of the last result, and last message of both.
        self._failed = self._report = self._told = ""
        self._looking = single_shot(native, 0, self.look)
        self._resting = single_shot(native, _REST, self.complete)
        self._poll = repeating(native, _POLL, self._on_poll)
        self.curve_layer = CurveLayer(viewer, form.tissue.editor)
        form.footer.live.changed.connect(self.touch)
        pointer.drawn.connect(self._on_drawn)
        self.chip = WarningChip(viewer, form, lambda: self._latest_here)
        self.chip.said.connect(lambda sentence: self.said.emit(sentence))

    # State

    @property
    def study(self) -> Study | None:
        """Study that was read last, with the current drawing; None if it cannot be read."""
        read = self._read
        if read is None:
            return None
        return replace(read, motion=replace(read.motion, drawing=self._model.drawing))

    @property
    def latest(self) -> Done | None:
        """Latest result at rest of the deformed layer, or None."""
        return None if self.source is None else self._done.get(self.source)

    @property
    def _latest_here(self) -> Done | None:
        """Latest result, if it belongs to the current slice or volume; else None."""
        latest, study = self.latest, self.study
        here = latest is not None and study is not None and latest.moved.study.grid == study.grid
        return latest if here else None

    @property
    def loose(self) -> str:
        """Warning that nothing holds the tissue of the latest result; "" if it is held."""
        return "" if (done := self._latest_here) is None else messages.loose(done.notes)

    @property
    def busy(self) -> bool:
        """True if a requested change is not shown yet."""
        # The layers of a result at rest are not drawn before a drag ends.
        resting = self._resting.isActive() and not self.pointer.hand.holding
        words = self._poll.isActive()
        return self._looking.isActive() or resting or words or self._follower.at_work

    @property
    def fresh(self) -> bool:
        """True if the latest result belongs to the current study."""
        latest, study = self.latest, self.study
        return latest is not None and study is not None and latest.moved.study.same_as(study)

    def request(self) -> Request:
        """Return the current choices, with the visible slice and its drawing.

        Raises
        ------
        HmrfError
            If there is nothing to work on.
        """
        request = self.binding.request()
        layer = request.layers[0]
        place = SlicePlace.of(frame_of(layer, request.view))
        drawing = self._model.get(Part("drawing", layer, place), Drawing())
        return replace(request, drawing=drawing)

    def read(self, request: Request) -> Study:
        """Read the study of a request, with the chosen model and solver settings."""
        model = self._model.model
        study = study_from_layers(request, self._copies)
        return replace(study, prior=model.prior, optimizer=model.optimizer)

    def first_curve(self) -> StiffnessCurve:
        """Guess the curve from the brightness of the slice to stiffness.

        Raises
        ------
        HmrfError
            If the slice cannot be read, or has a single value.
        """
        image = self.form.image.value
        study = self.read(Request(image=image, view=self.form.view(), drawing=Drawing()))
        assert study.intensities is not None
        return first_curve(study.intensities)

    # Actions

    def touch(self, *_: Any) -> None:
        """Schedule a refresh on the next idle event."""
        if not self._over:
            self._looking.start()

    def look(self) -> bool:
        """Read the current choices and update the tissue; return whether they could be read."""
        if self._over:
            return False
        self._looking.stop()
        try:
            study = self._read_chosen()
        except Exception as error:  # noqa: BLE001 - a layer may raise anything
            if not isinstance(error, HmrfError | ValueError):
                _log.exception("the current choices could not be read")
            self._asked = None
            self.curve_layer.show(None)
            self._cannot(error)
            return False
        if self.form.footer.live.value or self.pointer.active:
            self._follow(study)
        else:
            self._failed = ""
            self._tell()
        return True

    def settle(self) -> None:
        """Solve from a cold start; `finished` is emitted at the end."""
        self._looking.stop()
        self.form.footer.show_work(True)
        self._copies.forget()  # a script may have changed an array in place
        try:
            study = self._read_chosen(unpainted=False)
        except (HmrfError, ValueError) as error:
            self._refuse(error)
            return
        self.settling, self._since, self._asked = True, time.monotonic(), study
        self._follower.settle(study, self._model.model.details.device)
        self._poll.start()

    def cancel(self) -> None:
        """Cancel the work, with nothing changed; idle at once, even if the thread still runs."""
        settling, going_on = self.settling, self._follower.busy
        self._follower.forget()
        self._asked = None
        if settling or going_on:
            edited = self.latest is not None or (self.study is not None and self.study.moves)
            self._stop()
            self._go_back()
            self.said.emit(messages.BEHIND if edited and not self.fresh else messages.CANCELLED)
        if settling:
            self.finished.emit(None)

    def complete(self, *_: Any) -> None:
        """Draw image and arrows of the latest result, once no drag or solve is in progress."""
        study = self.study
        if study is None:
            return
        if self.pointer.hand.holding or self._follower.busy:
            self._resting.start()
            return
        moved = self.pointer.display.moved
        if moved is not None and (moved.glance or moved.study.optimizer != study.optimizer):
            self._asked = None  # solve at full accuracy after a drag
            self._follow(study)
        else:
            self._resting.stop()
            self.pointer.display.arrows.keep(self.pointer.drawing)
            self._follower.complete()

    def show_before(self, before: bool) -> None:
        """Show the undeformed image, or the deformed one again."""
        result = self.pointer.display.result
        if result is not None:
            result.show_before(before)

    def forget(self) -> None:
        """Clear the current study."""
        self._looking.stop()
        self._resting.stop()
        self._follower.forget()
        self._copies.forget()  # changes of layers are no longer noticed
        self._poll.stop()
        self.curve_layer.show(None)
        self._read = self.source = self._asked = None
        self._failed = self._report = ""
        self.pointer.stand_on(None)
        self.chip.look()

    def release(self) -> None:
        """Stop following edits for good."""
        self._over = True
        self._follower.release()

    # Solving and showing

    def _read_chosen(self, unpainted: bool = True) -> Study:
        """Read the current choices as the current study.

        A boundary layer without paint is accepted if `unpainted`, as while the user draws.
        """
        request = self.request()
        assert request.drawing is not None
        if not (unpainted or request.drawing.marks or request.boundary is None):
            request = replace(request, drawing=None)  # refused with a message of its own
        study = self.read(request)
        refuse_unknown(study)
        self._stand_on(study, request.layers[0])
        return replace(study, motion=replace(study.motion, drawing=self._model.drawing))

    def _stand_on(self, study: Study, source: Any) -> None:
        """Make a study that was read the current one, and select the drawing of its slice."""
        before = self._read
        self.pointer.tissue = self.form.tissue.layer
        place, self._read = study.grid, study
        if before is None or source is not self.source or before.grid != place:
            if source is not self.source:
                self.source, self._report = source, ""
            self._asked = None
            self.pointer.stand_on(study, source)
            self.chip.look()
            self.form.footer.live.judge(math.prod(study.grid.shape[-2:]))
            self._follower.rehearse(study)
            self.moved_on.emit(study)
        ways = ways_of(place.known_place, self._viewer)
        self.curve_layer.show(study, source)
        self.form.show_place(unit_symbol(place.unit), ways, study.tissue.unit)

    def _on_drawn(self) -> None:
        """Follow a changed drawing, without reading the layers again."""
        study = self.study
        if study is not None:
            self._follow(study)

    def _follow(self, study: Study) -> None:
        if self._asked is not None and self._asked.same_as(study):
            return
        if not self._follower.busy:
            self._since = time.monotonic()
        self._asked = study
        self._resting.stop()
        study = self._as_followed(study)
        device = self._model.model.details.device
        self._follower.follow(study, device, self._glanced_at(study))
        if not self._poll.isActive():
            self._poll.start()

    def _glanced_at(self, study: Study) -> Glance | None:
        """Return the coarse grid to solve on during a drag; None: the full grid."""
        shape = study.grid.shape
        quick = study.model_name != "large motion" or math.prod(shape) <= _FOLLOWED * GLANCED
        if not self.pointer.hand.holding or (len(shape) == 2 and quick):
            return None
        seen = () if len(shape) == 2 else plane_shown(study.grid.known_place, self.form.view())
        return Glance(CoarseGrid.of_at_most(GLANCED, shape), *seen)

    def _as_followed(self, study: Study) -> Study:
        """Return the study to solve: during a drag only to a visible tolerance."""
        optimizer = study.optimizer
        near = _NEAR if study.model_name == "large motion" else TOLERANCE
        if not self.pointer.hand.holding or not isinstance(optimizer, Multigrid):
            return study
        return replace(study, optimizer=Multigrid(max(near, optimizer.tolerance)))

    def _on_seen(self, seen: Seen) -> None:
        study, moved = self.study, seen.moved
        if study is None or moved.study.grid != study.grid:
            return
        self._since = time.monotonic()
        if moved.error is not None and moved.settled:
            self._refuse(moved.error)
            return
        self.pointer.show(seen)
        if moved.error is not None:
            self._asked = None
            if not self.pointer.active:  # else the pointer has reported the error
                self._cannot(moved.error)
            return
        self.seen.emit(moved)
        if moved.solution is None:
            self._come_to_rest()
        self._resting.start(0 if moved.settled else _REST)

    def _on_done(self, done: Done) -> None:
        study = self.study
        if study is None or done.moved.study.grid != study.grid:
            return
        if self._looking.isActive():  # read pending edits first
            self.look()
        self._done[self.source], self._failed = done, ""
        self._report = messages.report(done)
        self._show(done)
        self.chip.look()
        settled = self.settling
        if settled:
            self._stop()
        self._tell(anew=not self.pointer.active)
        if settled and self.pointer.active:
            self.said.emit(self._report)
        self.followed.emit(done.outputs)
        if settled:
            self.finished.emit(done.outputs)

    def _show(self, done: Done | None) -> None:
        """Show a result at rest, or none; its layers record whether it is up to date."""
        for made in () if done is None else done.outputs.layers.values():
            made.attributes["metadata"][METADATA]["inputs_changed"] = not self.fresh
        self.pointer.display.finish(done)

    def _go_back(self) -> None:
        """Show the latest result again, in place of the partial result of a cancelled study."""
        moved = self.pointer.display.moved
        if moved is not None and moved.solution is not None:
            self._resting.stop()
            self._show(self._latest_here)
            self.pointer.draw()

    def _on_poll(self) -> None:
        footer, monitor = self.form.footer, self._follower.monitor
        self._follower.go_on()
        if not (self._follower.busy or self.settling):
            self._poll.stop()
            self._stop()
        elif self.settling or time.monotonic() - self._since > _PATIENCE:
            moves = self.study is not None and self.study.moves
            following = "Following the last edit" if moves else "Getting ready"
            what = "Deforming" if self.settling else following
            footer.cancel.enabled = True
            self.doing.emit(messages.progress(monitor, what))
            footer.explain(monitor.message)

    @property
    def _state(self) -> str:
        """Message about the current study; "" if there is none."""
        latest, study = self.latest, self.study
        if self._failed:
            stays = "" if latest is None else messages.STAYS
            return f"The tissue does not follow yet. {self._failed} {stays}".rstrip()
        if self.pointer.active:
            return ""
        if latest is None or study is None or self.form.footer.live.value or self.fresh:
            return self._report
        return messages.CHANGED

    def _tell(self, anew: bool = False) -> None:
        """Emit the message about the study if it has changed; with `anew` in any case."""
        before, self._told = self._told, self._state
        if anew or self._told != before:
            self.said.emit(self._told)

    def _cannot(self, error: Exception) -> None:
        """Report why the tissue does not follow; the last result stays."""
        sentence = messages.in_short(error)
        # Without a chosen image there is nothing that could fail to follow.
        self._failed = "" if sentence in (messages.WELCOME, messages.CHOOSE) else sentence
        self.chip.look()
        self._tell(anew=sentence == messages.WELCOME)

    def _come_to_rest(self) -> None:
        """Reset to the undeformed state, without a result or its report."""
        before, self._failed = self._done.pop(self.source, None), ""
        self._report = self._report if before is None else messages.STILL
        self.chip.look()
        self._tell()

    def _refuse(self, error: Exception) -> None:
        self._stop()
        self.refused.emit(messages.in_short(error))
        # A warning disappears by itself; an error would stay beside the next good result.
        show = show_warning if isinstance(error, HmrfError | ValueError) else show_error
        show(messages.in_short(error))
        self.finished.emit(None)

    def _stop(self) -> None:
        """Show that no work is in progress."""
        self.settling = False
        self.form.footer.show_work(False)
        self.doing.emit("")
