"""Warning chip: shows where the visible tissue has problems, and takes the offered remedy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from psygnal import Signal

from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.result_layers import CompleteResult
from napari_hmrf.layers.slice_view import plane_shown, view_of
from napari_hmrf.results.animation import FOLD_MARKS
from napari_hmrf.study.models import larger_budget
from napari_hmrf.study.session import Session
from napari_hmrf.ui import messages
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.result.result_messages import NOTHING


class WarningChip:
    """Clicks on the warning about a result, which show its marks, and on the offer of a remedy.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm
    session : Session
        Session with the overlay and the latest result.
    """

    #: Emitted with a message for the user.
    message = Signal(str)

    def __init__(self, viewer: Any, form: DockForm, session: Session) -> None:
        self._viewer, self._form, self._session = viewer, form, session
        form.footer.chip.clicked.connect(self._on_chip)
        form.footer.other.clicked.connect(self._take_offer)

    @property
    def overlay(self) -> str:
        """Chosen overlay, or `NOTHING` if its marks are not visible."""
        chosen = self._session.display.overlay
        if chosen != FOLD_MARKS:
            return chosen
        marks = (each for each in self._viewer.layers if metadata_of(each).get("kind") == chosen)
        return chosen if any(each.visible for each in marks) else NOTHING

    def _take_offer(self) -> None:
        model = self._form.model
        offer = messages.offer_of(self._session.result_here, self._session.model)
        if offer == messages.CONTINUE:
            details = model.in_detail
            details["budget"].value = larger_budget(details["budget"].value)
        elif offer == messages.OFFER:
            self._session.choose_model(replace(self._session.model, name="large motion"))
        elif offer == messages.BACK:
            self._session.use_elastic()

    def _on_chip(self) -> None:
        """Emit the warning, and show or hide the marks of folds and overlaps."""
        latest, slice_message = self._session.result_here, ""
        is_shown = self.overlay == FOLD_MARKS
        if self._session.display.overlay == FOLD_MARKS:  # the marks may be hidden
            self._session.choose_display(overlay=NOTHING)
        if latest is not None and messages.marks_of(latest.outputs) and not is_shown:
            self._session.choose_display(overlay=FOLD_MARKS)
            slice_message = self._go_to_most(latest)
        self.message.emit(f"{self._form.footer.warning} {slice_message}".rstrip())

    def _go_to_most(self, latest: CompleteResult) -> str:
        """Show the slice of a volume with the most marked sites, and return a message."""
        dims, place, view = (
            self._viewer.dims,
            latest.moved.study.grid.known_place,
            view_of(self._viewer, self._session),
        )
        if len(place.plane) == 2 or dims.ndisplay == 3:
            return ""
        across, _ = plane_shown(place, view)
        plane = place.plane_at(across, latest.outputs.fullest[across])
        point = view.point_at(plane, plane.index)
        dims.set_point([*point], [*point.values()])
        return messages.MOST.format(plane.slice_seen)
