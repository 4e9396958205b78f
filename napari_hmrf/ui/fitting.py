"""Fit of the tissues of the image to the second image, in the window."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from napari_hmrf.posterior.fit import Fit
from napari_hmrf.posterior.study_fit import StudyFit, fit_study
from napari_hmrf.study.session import Part, Session
from napari_hmrf.study.support import supports
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.fit_window import NOTHING, FitWindow
from napari_hmrf.ui.pair_job import REMOVED, PairJob

_INVALID = "Nothing was fitted, because the study is invalid; the dock shows the reason."


class Fitting(PairJob):
    """Fit of properties in the tissue table to the second image, as one undo step."""

    name, doing = "fit", "Fitting"
    failed = "Nothing was fitted."

    def __init__(self, controller: Controller, session: Session) -> None:
        self._window: FitWindow | None = None
        self._ticked: dict[str, set[int]] = {}
        # Latest fit, and the tissue table that it made.
        self._found: tuple[Fit, object] | None = None
        super().__init__(controller, session)
        self._form.fit.changed.connect(self.open)
        self.message.connect(self._show_outcome)

    def open(self, *_: Any) -> None:
        """Open the window in which the user ticks the unknown properties."""
        if self._window is None:
            self._window = FitWindow(self._form.native.window(), self.start, self.cancel)
            self._ticked = {"growth": {row.label for row in self._rows if row.grows}}
        self._window.show_outcome("")
        if not self._window.isVisible():
            self._show_window(self._window, self._ticked)
        self._window.show()
        self._window.raise_()

    def start(self) -> None:
        """Fit the ticked properties in the background."""
        window = self._window
        if window is None or self.busy:
            return
        self._ticked = window.ticked
        if not any(self._ticked.values()):
            window.show_outcome(NOTHING)
            return
        pair = self._read_pair()
        if pair is None:
            window.show_outcome(_INVALID)
            return
        labels: dict[str, Any] = {name: sorted(each) for name, each in self._ticked.items()}
        work = partial(fit_study, *pair, progress=self._controller.engine.report, **labels)
        self._run(work, partial(self._store, self._part, self._session.measured_part))
        window.show_outcome("Fitting ...")

    def release(self) -> None:
        """Close the window, and disconnect from all events."""
        super().release()
        if self._window is not None:
            self._window.close()

    @property
    def _part(self) -> Part:
        """Key of the tissue table of the image."""
        return Part("tissue", self._session.choice.tissue_layer)

    @property
    def _rows(self) -> list[Material]:
        """Deformable tissues of the tissue table; empty if there is no table."""
        table = self._session.get(self._part)
        return [] if table is None else [row for row in table.rows if row.is_deformable]

    def _store(self, part: Part, measured: Part, found: StudyFit) -> None:
        """Write the fitted values into the tissue table, as one step."""
        table = self._session.get(part)
        if table is None:  # the layer was removed
            self._show_outcome("")
            return
        fitted = {row.label: row for row in found.study.tissue.materials}
        rows = []
        for row in table.rows:
            names = [name for name in self._ticked if row.label in getattr(found.fit, name)]
            changes: dict[str, Any] = {name: getattr(fitted[row.label], name) for name in names}
            rows.append(replace(row, **changes))
        changed = table.edited(rows)
        values: dict[Part, Any] = {part: changed}
        word = "fitted the tissue to the second image"
        self._found = found.fit, changed
        if was_registered := self._session.get(measured) is not None:
            self._session.unregister(measured, word, values)
        else:
            self._session.do_all(values, word)
        parts = [f"Fitted, with intervals of 95 %: {'; '.join(found.described())}."]
        if found.agreement:
            parts.append(f"Agreement of the images: {found.agreement}.")
        if was_registered:
            parts.append(REMOVED)
        self._controller.follow_edit()
        self.message.emit(" ".join(parts))

    def _show_outcome(self, text: str) -> None:
        if self._window is not None:
            self._window.show_outcome(text)

    def _on_changed(self, part: Part, *_: Any) -> None:
        """Refresh after an edit that a fit depends on; a drag changes only the drawing."""
        if part.kind in ("tissue", "choice", "model"):
            self._refresh()

    def _refresh(self, *_: Any) -> None:
        """Enable the button, and show the current tissues in the window if it is open."""
        rows = self._rows
        self._form.show_fit(
            has_second=self._second.value is not None,
            has_tissues=bool(rows),
            is_elastic=supports(self._session.model.name, "fit"),
        )
        if self._window is not None and self._window.isVisible():
            self._show_window(self._window, self._window.ticked)

    def _show_window(self, window: FitWindow, ticked: dict[str, set[int]]) -> None:
        """Show the current tissues in the window, and whether a fit is running."""
        window.show_busy(self.busy)
        is_fitted = self._found is not None and self._found[1] == self._session.get(self._part)
        window.show_rows(self._rows, ticked, self._found[0] if self._found and is_fitted else None)
