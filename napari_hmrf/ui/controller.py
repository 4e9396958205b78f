"""Controller of the dock: solves the study after each edit and shows the results."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

from napari.utils.notifications import show_error, show_warning
from psygnal import Signal
from qtpy.QtWidgets import QWidget

from napari_hmrf.errors import is_expected
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.read import NoImageError, StudyReader
from napari_hmrf.layers.result_layers import CompleteResult
from napari_hmrf.layers.slice_view import View, directions_of, plane_shown, view_of
from napari_hmrf.study.drag_preview import as_dragged, drag_preview
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.session import Session
from napari_hmrf.study.study import Study
from napari_hmrf.study.support import unfolds_quickly, unsupported
from napari_hmrf.ui import messages
from napari_hmrf.ui.curve.curve_layer import CurveLayer
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.form_binding import FormBinding
from napari_hmrf.ui.jobs import Jobs
from napari_hmrf.ui.motion.pointer import Pointer
from napari_hmrf.ui.solving import PacedEngine, SolveProgress

_log = logging.getLogger("napari_hmrf")
#: Time without edits after which all layers of the result are drawn, in milliseconds.
_REST = 200


class Controller:
    """Controller of the dock: solves the study after each edit and shows the results.

    After an edit to a form or a layer, `refresh` reads the whole study again; after an edit to the
    drawing, only the drawing is replaced. The study is then submitted to the engine. Each answer is
    shown immediately. After a pause in the edits, all layers of the complete result are drawn.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    form, binding, pointer, session : DockForm, FormBinding, Pointer, Session
        Views of the study, and the session, also available as attributes.

    Attributes
    ----------
    reader : StudyReader
    settling : bool
        True while a cold-start solve is in progress.
    curve_layer : CurveLayer
        Layer that shows the stiffness of the tissue if a curve defines it.
    jobs : Jobs
        Background jobs of the dock.
    engine : PacedEngine
    progress : SolveProgress
    """

    #: Emitted with a `Deformation` when the visible state of the tissue has changed.
    deformation_changed = Signal(object)
    #: Emitted with `Outputs` after all layers of the complete result have been drawn.
    result_drawn = Signal(object)
    #: Emitted after a cold-start solve with `Outputs`, or with None if it was cancelled or failed.
    finished = Signal(object)
    #: Emitted with a status message; "" clears the previous message.
    message = Signal(str)
    #: Emitted with the reason why a request cannot be carried out.
    refusal = Signal(str)
    #: Emitted when there is another latest result, or none.
    latest_changed = Signal()
    #: Emitted when the inputs cannot be solved, so that the result belongs to earlier inputs.
    outdated = Signal()
    #: Emitted with the study when the current slice or image has changed.
    slice_changed = Signal(Study)

    def __init__(
        self,
        native: QWidget,
        viewer: Any,
        form: DockForm,
        binding: FormBinding,
        pointer: Pointer,
        session: Session,
    ) -> None:
        self.viewer, self.form, self.binding, self.pointer = viewer, form, binding, pointer
        self.session = session
        self._is_released = False
        # True if the choices could not be read, so that the last study is not the current one.
        self._is_unread = False
        self.reader = StudyReader(viewer, session, binding.settle)
        self.settling = False
        self.jobs = Jobs()
        self.engine = PacedEngine(self.jobs, self._on_answer, self._on_complete)
        self._submitted: Study | None = None
        # Reason why the tissue is not updated, report on the last result, and last emitted message.
        self._failure = self._report = self._last_message = ""
        # Reason why large motion does not solve the current study, until the next report.
        self._taken_back = ""
        # True until a report says that large motion has taken the place of the elastic model.
        self._is_new_model = False
        self._refresh_timer = single_shot(native, 0, self.refresh)
        self._complete_timer = single_shot(native, _REST, self.complete)
        self.progress = SolveProgress(
            native, form.footer, self.jobs, self.engine, lambda: self._is_working
        )
        self.curve_layer = CurveLayer(viewer, form.tissue.editor)
        form.model.in_detail.live.changed.connect(self.schedule_refresh)
        pointer.drawn.connect(self._on_drawn)

    # State

    @property
    def view(self) -> View:
        """View of the visible slice, or of the volume if a volume is deformed."""
        return view_of(self.viewer, self.session)

    @property
    def busy(self) -> bool:
        """True if a requested change is not shown yet."""
        looking, shown = self._refresh_timer.isActive(), self.progress.active
        return looking or shown or self._is_working

    @property
    def _is_working(self) -> bool:
        """True from the submission of a study until the layers of its result have changed."""
        # During a drag, the layers of a complete result are not drawn.
        resting = self._complete_timer.isActive() and not self.pointer.tool.is_dragging
        return resting or self.engine.busy or self.jobs.busy("layers")

    # Actions

    def schedule_refresh(self, *_: Any) -> None:
        """Schedule a refresh on the next idle event."""
        if not self._is_released:
            self._refresh_timer.start()

    def refresh(self) -> bool:
        """Read the current choices and update the tissue; return whether reading succeeded."""
        if self._is_released:
            return False
        self._refresh_timer.stop()
        try:
            study = self._read_chosen()
        except Exception as error:  # noqa: BLE001 - a layer may raise anything
            _log_unexpected(error)
            self._is_unread, self._submitted = True, None
            self.curve_layer.show(None)
            self._report_failure(error)
            return False
        self._is_unread = False
        if self.session.display.live or self.pointer.active:
            self._follow(study)
        else:
            self._failure = ""
            self._emit_message()
        return True

    def solve_cold(self) -> None:
        """Solve from a cold start, and emit `finished` at the end."""
        self._refresh_timer.stop()
        self.reader.invalidate()  # a script may have changed an array in place
        try:
            study = self._read_chosen(unpainted=False)
        except Exception as error:  # noqa: BLE001 - a layer may raise anything
            _log_unexpected(error)
            self._refuse(error)
            return
        self._is_unread = False
        self.settling, self._submitted = True, study
        self._submit(study, cold_start=True)
        self.progress.start("Deforming", at_once=True)

    def cancel(self) -> None:
        """Cancel all work; the dock is idle immediately, even if a solve is still stopping."""
        settling, going_on = self.settling, self._is_working
        self.engine.cancel()
        self._submitted = None
        if settling or going_on:
            session = self.session
            study = session.study
            edited = session.result is not None or (study is not None and study.moves)
            self._stop()
            self._show_latest()
            is_behind = edited and not session.is_fresh
            self.message.emit(messages.BEHIND if is_behind else messages.CANCELLED)
        if settling:
            self.finished.emit(None)

    def complete(self, *_: Any) -> None:
        """Draw all layers of the latest result, once no drag or solve is in progress."""
        study = self.session.study
        if study is None:
            return
        if self.pointer.tool.is_dragging or self.engine.busy:
            self._complete_timer.start()
            return
        moved = self.pointer.display.moved
        if moved is not None and (moved.preview or moved.study.optimizer != study.optimizer):
            self._submitted = None  # solve at full accuracy after a drag
            self._follow(study)
        else:
            self._complete_timer.stop()
            self.pointer.display.arrows.keep(self.pointer.drawing)
            self.engine.complete()

    def follow_edit(self) -> None:
        """Read the study again and solve it, even if *Live* is off."""
        if self.refresh() and (study := self.session.study) is not None:
            self._follow(study)

    def refuse(self, error: Exception) -> None:
        """Report why a request cannot be carried out."""
        if isinstance(error, NoImageError):
            reason = messages.no_image(has_layers=bool(self.viewer.layers))
        else:
            reason = messages.in_short(error)
        self.refusal.emit(reason)
        # A warning disappears by itself; an error would remain beside the next valid result.
        show = show_warning if is_expected(error) else show_error
        show(reason)

    def show_again(self) -> None:
        """Show the latest result, or the undeformed image, in place of unfinished work."""
        if self.session.result_here is not None:
            self._show_latest()
        elif (study := self.session.study) is not None:
            still = Deformation(study, image=study.pictures.image)
            self.pointer.display.discard(still)

    def clear(self) -> None:
        """Clear the current study."""
        self._refresh_timer.stop()
        self._complete_timer.stop()
        self.engine.cancel()
        self.reader.invalidate()  # later changes to layers are not tracked
        self.progress.release()
        self.curve_layer.show(None)
        self.session.study = self._submitted = None
        self._failure, self._report, self._is_unread = "", "", False
        self.pointer.select_slice(None)
        self.latest_changed.emit()

    def release(self) -> None:
        """Stop responding to edits permanently."""
        self._is_released = True
        self.session.results.clear()
        self.engine.close()
        self.jobs.release()

    # Solving and showing

    def _read_chosen(self, unpainted: bool = True) -> Study:
        """Read the current choices as the current study.

        If `unpainted` is True, a boundary layer without paint is accepted. Large motion that has
        taken the place of the elastic model gives it back to inputs that it does not support.
        """
        request = self.reader.request()
        assert request.drawing is not None
        if not (unpainted or request.drawing.marks or request.boundary is None):
            request = replace(request, drawing=None)  # gives a specific error message
        study = self.reader.read(request)
        error = unsupported(study)
        if error is not None and self._has_taken_over(study):
            self._take_back(error)
            return self._read_chosen(unpainted)
        if error is not None:
            raise error
        self._select_slice(study, request.grid_layers[0])
        return replace(study, motion=replace(study.motion, drawing=self.session.drawing))

    def _select_slice(self, study: Study, source: Any) -> None:
        """Make a study current, and select the drawing of its slice."""
        session, place = self.session, study.grid
        is_other_image = source is not session.slice.layer
        # The display of this dock may be closed, although another dock has opened the slice.
        is_open = session.is_here(study) and self.pointer.display.moved is not None
        is_other = is_other_image or not is_open
        if is_other and self.settling:
            self.cancel()  # the result would belong to another slice or image
        self.pointer.tissue = self.form.tissue.layer
        session.study = study
        if is_other:
            if is_other_image:
                self._report = ""
            self._submitted = None
            self.pointer.select_slice(study, source)
            self.latest_changed.emit()
            self.engine.rehearse(study)
            self.slice_changed.emit(study)
        ways = directions_of(place.known_place, self.viewer)
        self.curve_layer.show(study, source)
        self.form.show_place(unit_symbol(place.unit), ways, study.tissue.unit)

    def _on_drawn(self) -> None:
        """Solve for the changed drawing without reading the layers again."""
        if self._refresh_timer.isActive() and (self.session.display.live or self.pointer.active):
            return  # the refresh reads the other changes of the same undo step, and the drawing
        if self._failure:  # the last study that was read has other settings than the form
            self.follow_edit()
            return
        study = self.session.study
        if study is not None:
            self._follow(study)

    def _follow(self, study: Study) -> None:
        before = self._submitted
        # Results are named after the image, which may have been renamed.
        has_same_name = before is not None and before.pictures.name == study.pictures.name
        if before is not None and has_same_name and before.same_as(study):
            return
        self._submitted = study
        self._complete_timer.stop()
        self.progress.start("Updating" if study.moves else "Getting ready")
        preview = None
        if self.pointer.tool.is_dragging:
            volume, place, view = (
                len(study.grid.shape) == 3,
                study.grid.known_place,
                self.view,
            )
            in_slices = volume and len(view.displayed) == 2
            plane = plane_shown(place, view) if in_slices else None
            cut = self.pointer.display.cut if volume and not in_slices else None
            study, preview = as_dragged(study), drag_preview(study, plane, cut)
        self._submit(study, preview=preview)

    def _submit(self, study: Study, **how: Any) -> None:
        counts = self.session.model.unfolds and unfolds_quickly(study)
        self.engine.submit(study, self.session.display.device, counts_folds=counts, **how)

    def unfold_latest(self) -> None:
        """Let large motion take over if the latest result folds, once it is prepared."""
        latest, study = self.session.result_here, self.session.study
        if latest is None or study is None or self.busy or not self.session.is_fresh:
            return
        is_elastic = self.session.model.name == "elastic" and self.session.model.unfolds
        folds = "folds" in messages.marks_of(latest.outputs)
        if is_elastic and folds and unfolds_quickly(study):
            self._unfold(is_settled=False)

    def _unfold(self, *, is_settled: bool) -> None:
        """Choose large motion, because elastic tissue folds, and solve again as before."""
        self.session.unfold()
        self._is_new_model = True
        if is_settled:
            self.solve_cold()
        else:
            self.follow_edit()

    def _has_taken_over(self, study: Study) -> bool:
        """Return whether large motion took the place of the elastic model for a study."""
        return self.session.model.has_unfolded and study.model_name == "large motion"

    def _take_back(self, error: Exception) -> None:
        """Choose the elastic model again, because large motion cannot solve the study."""
        self.session.take_back_unfolding(unfolds=False)
        self._taken_back = messages.ELASTIC_AGAIN.format(messages.in_short(error))

    def _on_answer(self, moved: Deformation) -> None:
        if not self.session.is_here(moved.study):
            return
        self.progress.restart()
        if moved.folds:
            self._unfold(is_settled=moved.settled)
            return
        if moved.error is not None and self._has_taken_over(moved.study):
            self._take_back(moved.error)
            self.follow_edit()
            return
        if moved.error is not None:
            self.outdated.emit()
        if moved.error is not None and moved.settled:
            self._refuse(moved.error)
            return
        self.pointer.show(moved)
        if moved.error is not None:
            self._submitted = None
            if not self.pointer.active:  # otherwise the pointer has reported the error
                self._report_failure(moved.error)
            self._end_settling()
            return
        self.deformation_changed.emit(moved)
        if moved.solution is None:
            if self._has_taken_over(moved.study):
                self.session.take_back_unfolding(unfolds=True)
            self._clear_result()
            self._end_settling()
        self._complete_timer.start(0 if moved.settled else _REST)

    def _on_complete(self, done: CompleteResult) -> None:
        # Read pending edits first: they may select another slice or image.
        if self._refresh_timer.isActive():
            self.refresh()
        if not self._is_unread:
            self._failure = ""
        if not self.session.is_here(done.moved.study):
            return
        self.session.results[self.session.slice.layer] = done
        solution = done.outputs.solution
        unfolded = self._is_new_model and self._has_taken_over(done.moved.study)
        self._is_new_model = False
        report = messages.report(done, unfolded=unfolded)
        is_special = bool(self._taken_back) or unfolded
        self._report, self._taken_back = f"{report} {self._taken_back}".rstrip(), ""
        self._show(done)
        self.progress.restart()
        self.latest_changed.emit()
        settled = self.settling
        if settled:
            self._stop()
        self._emit_message(always=not self.pointer.active)
        is_short = solution.reach is not None and solution.reach.where is not None
        if self.pointer.active and (settled or is_special or is_short):
            self.message.emit(self._report)
        self.result_drawn.emit(done.outputs)
        if settled:
            self.finished.emit(done.outputs)

    def _end_settling(self) -> None:
        """End a cold-start solve without a result, because a later edit has replaced its study."""
        if self.settling:
            self._stop()
            self.finished.emit(None)

    def _show(self, done: CompleteResult | None) -> None:
        """Show a complete result, or the undeformed image if `done` is None.

        The metadata of each layer records whether the result is up to date.
        """
        for made in () if done is None else done.outputs.layers.values():
            made.attributes["metadata"][METADATA]["inputs_changed"] = not self.session.is_fresh
        self.pointer.display.finish(done)

    def _show_latest(self) -> None:
        """Show the latest result again, in place of the partial result of a cancelled study."""
        moved = self.pointer.display.moved
        if moved is not None and moved.solution is not None:
            self._complete_timer.stop()
            self._show(self.session.result_here)
            self.pointer.draw()

    @property
    def _state(self) -> str:
        """Message about the current study, or ""."""
        session = self.session
        if self._failure:
            stays = "" if session.result is None else messages.STAYS
            return f"The tissue was not updated. {self._failure} {stays}".rstrip()
        if self.pointer.active:
            return ""
        is_idle = session.result is None or session.study is None
        if is_idle or session.display.live or session.is_fresh:
            return self._report
        return messages.CHANGED

    def _emit_message(self, always: bool = False) -> None:
        """Emit the message about the study if it has changed, or if `always` is True."""
        before, self._last_message = self._last_message, self._state
        if always or self._last_message != before:
            self.message.emit(self._last_message)

    def _report_failure(self, error: Exception) -> None:
        """Report why the tissue is not updated, and keep the last result."""
        lacks_image = isinstance(error, NoImageError)  # then there is no tissue to update
        self._failure = "" if lacks_image else messages.in_short(error)
        self.outdated.emit()
        self.latest_changed.emit()
        self._emit_message(always=lacks_image and not self.viewer.layers)

    def _clear_result(self) -> None:
        """Reset to the undeformed state, and discard the result."""
        before, self._failure = self.session.results.pop(self.session.slice.layer, None), ""
        self._report = self._report if before is None else messages.STILL
        self.latest_changed.emit()
        self._emit_message()

    def _refuse(self, error: Exception) -> None:
        self._stop()
        self.refuse(error)
        self.finished.emit(None)

    def _stop(self) -> None:
        """Show that no work is in progress."""
        self.settling = False
        self.progress.stop()


def _log_unexpected(error: Exception) -> None:
    """Log a read error that is not caused by the user's input."""
    if not is_expected(error):
        _log.error("the current choices could not be read", exc_info=error)
