"""The chip that warns: what is to be known of the tissue that is seen, and what helps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from psygnal import Signal

from napari_hmrf.field.animation import MARKS, Mark
from napari_hmrf.layers.slice_view import plane_shown
from napari_hmrf.solver.model_names import ModelName
from napari_hmrf.ui import messages
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.follower import Done
from napari_hmrf.ui.result.result_messages import NOTHING


class WarningChip:
    """Warns of a result, shows where, and offers the model that would mend it.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm
    latest : callable
        The latest result of what is worked on, or None.
    """

    #: What there is to say.
    said = Signal(str)

    def __init__(self, viewer: Any, form: DockForm, latest: Callable[[], Done | None]) -> None:
        self._viewer, self._form, self._latest = viewer, form, latest
        form.footer.chip.clicked.connect(self._on_chip)
        form.footer.other.clicked.connect(self._take_other)
        for told in (form.result.overlay.changed, form.model.model.changed):
            told.connect(self.look)

    def look(self, *_: Any) -> None:
        """Say of the latest result what is to be known, and offer what helps."""
        done, seen, other = self._latest(), self._form.result.overlay.value, self._other
        self._form.footer.warn(*(("",) if done is None else messages.warnings_of(done, seen)))
        self._form.footer.offer(messages.OFFERS[other] if other else "")

    @property
    def _other(self) -> ModelName | None:
        """The model that would mend what is wrong with the one there is."""
        done, chosen = self._latest(), self._form.model.model.value
        if chosen == "large motion":
            return "elastic" if self._form.extent.is_volume else None
        return "large motion" if done is not None and messages.can_unfold(done) else None

    def _take_other(self) -> None:
        self._form.model.model.value = self._other or self._form.model.model.value

    def _on_chip(self) -> None:
        """Say what there is to know, and mark folds, then overlaps, then neither."""
        overlay, latest, went = self._form.result.overlay, self._latest(), ""
        mark = None if latest is None else messages.next_mark(latest.outputs, overlay.value)
        if latest is not None and mark is not None:
            overlay.value = mark
            went = self._go_to_most(latest, mark)
        elif overlay.value in MARKS:
            overlay.value = NOTHING
        self.said.emit(f"{self._form.footer.warning} {went}".rstrip())

    def _go_to_most(self, latest: Done, mark: Mark) -> str:
        """Show the slice of a volume in which most sites are marked, and say which that is."""
        dims, place, view = (
            self._viewer.dims,
            latest.moved.study.grid.known_place,
            self._form.view(),
        )
        if len(place.plane) == 2 or dims.ndisplay == 3:
            return ""
        across, _ = plane_shown(place, view)
        plane = place.plane_at(across, latest.outputs.fullest[mark][across])
        there = view.point_at(plane, plane.index)
        dims.set_point([*there], [*there.values()])
        return messages.MOST.format(plane.slice_seen)
