"""Warning chip: reports problems with the visible tissue and offers a remedy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from psygnal import Signal

from napari_hmrf.field.animation import MARKS, Mark
from napari_hmrf.layers.complete_result import CompleteResult
from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.slice_view import plane_shown
from napari_hmrf.study.models import larger_budget
from napari_hmrf.ui import messages
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.result.result_messages import NOTHING


class WarningChip:
    """Chip that reports problems with a result, marks them, and offers a remedy.

    The remedy is a model without folds, or more work for a solve that used up its budget.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm
    latest : callable
        Returns the latest result of the current study, or None.
    """

    #: Emitted with a message for the user.
    message = Signal(str)

    def __init__(
        self, viewer: Any, form: DockForm, latest: Callable[[], CompleteResult | None]
    ) -> None:
        self._viewer, self._form, self._latest = viewer, form, latest
        form.footer.chip.clicked.connect(self._on_chip)
        form.footer.other.clicked.connect(self._take_offer)
        for signal in (form.result.overlay.changed, form.model.model.changed):
            signal.connect(self.refresh)
        self._events = EventConnections((viewer.layers.events, self._on_layers))

    def release(self) -> None:
        """Disconnect from the viewer."""
        self._events.release()

    def refresh(self, *_: Any) -> None:
        """Update the warnings of the latest result, and the offer of another model."""
        done, overlay = self._latest(), self._visible_overlay
        self._form.footer.warn(*(("",) if done is None else messages.warnings_of(done, overlay)))
        offer = messages.OFFER if self._can_unfold() else ""
        offer = messages.CONTINUE if self._can_continue() else offer
        self._form.footer.offer(offer, messages.ABOUT_OFFERS[offer])

    @property
    def _visible_overlay(self) -> str:
        """Chosen overlay, or `NOTHING` if its marks are not visible."""
        chosen: str = self._form.result.overlay.value
        if chosen not in MARKS:
            return chosen
        marks = (each for each in self._viewer.layers if metadata_of(each).get("kind") == chosen)
        return chosen if any(each.visible for each in marks) else NOTHING

    def _on_layers(self, event: Any) -> None:
        if event.type in ("inserted", "removed", "visible"):
            self.refresh()

    def _can_unfold(self) -> bool:
        """Return whether the large-motion model would avoid the folds of the latest result."""
        done, chosen = self._latest(), self._form.model.model.value
        return chosen != "large motion" and done is not None and messages.can_unfold(done)

    def _can_continue(self) -> bool:
        """Return whether the budget of the large-motion model ended the latest solve."""
        done, chosen = self._latest(), self._form.model.model.value
        return chosen == "large motion" and done is not None and messages.has_stopped(done)

    def _take_offer(self) -> None:
        if self._can_continue():
            details = self._form.model.in_detail
            details["budget"].value = larger_budget(details["budget"].value)
        elif self._can_unfold():
            self._form.model.model.value = "large motion"

    def _on_chip(self) -> None:
        """Emit the warning, and show the next mark: folds, then overlaps, then no mark."""
        overlay, latest, slice_message = self._form.result.overlay, self._latest(), ""
        shown = self._visible_overlay
        mark = None if latest is None else messages.next_mark(latest.outputs, shown)
        if latest is not None and mark is not None:
            if overlay.value == mark:  # the marks are hidden
                overlay.value = NOTHING
            overlay.value = mark
            slice_message = self._go_to_most(latest, mark)
        elif overlay.value in MARKS:
            overlay.value = NOTHING
        self.message.emit(f"{self._form.footer.warning} {slice_message}".rstrip())

    def _go_to_most(self, latest: CompleteResult, mark: Mark) -> str:
        """Show the slice of a volume with the most marked sites, and return a message."""
        dims, place, view = (
            self._viewer.dims,
            latest.moved.study.grid.known_place,
            self._form.view(),
        )
        if len(place.plane) == 2 or dims.ndisplay == 3:
            return ""
        across, _ = plane_shown(place, view)
        plane = place.plane_at(across, latest.outputs.fullest[mark][across])
        point = view.point_at(plane, plane.index)
        dims.set_point([*point], [*point.values()])
        return messages.MOST.format(plane.slice_seen)
