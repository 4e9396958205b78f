"""Edits of tables and of the curve as steps that can be undone."""

from __future__ import annotations

from typing import Any

from napari_hmrf.layers.background import Filling
from napari_hmrf.layers.metadata import Role
from napari_hmrf.layers.steps import BACKGROUND, CURVE, Slot, ViewerSteps
from napari_hmrf.layers.tables import Table, change
from napari_hmrf.widgets.curve.tissue import TissueCurve
from napari_hmrf.widgets.label_table import LabelTable
from napari_hmrf.widgets.painting import PaintedLabels


class TableSteps:
    """Keeps what is done to the table of a Labels layer, and puts back what is undone.

    Rows that come by themselves, for labels that were painted, are no steps.

    Parameters
    ----------
    role : "tissue" or "boundary"
    painted : PaintedLabels
    table : LabelTable
    steps : ViewerSteps
    """

    def __init__(
        self, role: Role, painted: PaintedLabels, table: LabelTable, steps: ViewerSteps
    ) -> None:
        self._role, self._painted, self._table = role, painted, table
        self._edits = steps.edits
        self._layer: Any = None
        painted.changed.connect(self._on_table)
        self._edits.changed.connect(self._on_undone)
        self._on_table()

    def _on_table(self) -> None:
        layer = self._painted.layer
        other, self._layer = layer is not self._layer, layer
        if layer is None:
            return
        slot, now = Slot(self._role, layer), Table.of(layer, self._role)
        before = self._edits.open(slot, now)
        if now == before:
            return
        if other or self._painted.by_itself:
            self._edits.amend(slot, now)
        else:
            self._edits.do(slot, now, change(before, now, layer.name))

    def _on_undone(self, slot: Any, value: Any) -> None:
        layer = self._painted.layer
        if layer is None or slot != Slot(self._role, layer):
            return
        if hasattr(self._table, "unit") and value.unit:
            self._table.unit = value.unit
        if self._table.rows != value.rows:
            self._table.rows = value.rows


class FillingSteps:
    """Keeps what was painted as no tissue by one press of a button, with its row, as one step.

    Parameters
    ----------
    painted : PaintedLabels
        Of the tissue.
    table : LabelTable
    steps : ViewerSteps
    """

    def __init__(self, painted: PaintedLabels, table: LabelTable, steps: ViewerSteps) -> None:
        self._painted, self._table, self._edits = painted, table, steps.edits
        # What is painted of each slot: the steps say what should be.
        self._there: dict[Slot, tuple[Filling, ...]] = {}
        painted.filled.connect(self._on_filled)
        self._edits.changed.connect(self._on_changed)

    def _on_filled(self, filling: Filling) -> None:
        slot = Slot(BACKGROUND, self._painted.layer, filling.place)
        fillings = (*self._edits.open(slot, ()), filling)
        self._there = {each: kept for each, kept in self._there.items() if each in self._edits}
        self._there[slot] = fillings
        self._edits.do(slot, fillings, f"made the background of '{slot.layer.name}' no tissue")

    def _on_changed(self, slot: Any, fillings: Any) -> None:
        if not isinstance(slot, Slot) or slot.what != BACKGROUND or slot not in self._there:
            return
        before, self._there[slot] = self._there[slot], fillings
        for filling in reversed(before[len(fillings) :]):
            filling.erase(slot.layer)
            self._have_row(slot.layer, filling, there=False)
        for filling in fillings[len(before) :]:
            self._have_row(slot.layer, filling, there=True)
            filling.paint(slot.layer)

    def _have_row(self, layer: Any, filling: Filling, there: bool) -> None:
        """Have the table say what the paint is, or no longer."""
        if not filling.new or self._painted.layer is not layer:
            return
        label, rows = filling.material.label, self._table.rows
        if there != (label in self._table.labels):
            with self._painted.by_nobody():
                kept = [row for row in rows if row.label != label]
                self._table.rows = (*rows, filling.material) if there else tuple(kept)


class CurveSteps:
    """Keeps what is done to the curve of a layer of stiffness, and puts back what is undone.

    Parameters
    ----------
    curve : TissueCurve
    choose : callable
        Has a layer be the tissue whose curve is shown.
    steps : ViewerSteps
    """

    def __init__(self, curve: TissueCurve, choose: Any, steps: ViewerSteps) -> None:
        self._curve, self._choose, self._edits = curve, choose, steps.edits
        self._undoing = False
        curve.changed.connect(self._on_changed)
        curve.settled.connect(self._on_settled)
        self._edits.changed.connect(self._on_undone)
        self.look()

    def look(self, *_: Any) -> None:
        """Another layer may be chosen: know its curve before it is edited."""
        layer = self._curve.layer
        if layer is not None:
            self._edits.open(Slot(CURVE, layer), self._curve.curve)

    def _on_changed(self, _: Any) -> None:
        self.look()

    def _on_settled(self, curve: Any) -> None:
        layer = self._curve.layer
        if layer is not None and not self._undoing:
            slot = Slot(CURVE, layer)
            self._edits.open(slot, curve)
            self._edits.do(slot, curve, f"changed the curve of '{layer.name}'")

    def _on_undone(self, slot: Any, value: Any) -> None:
        if not isinstance(slot, Slot) or slot.what != CURVE or self._undoing:
            return
        self._undoing = True
        try:
            if self._curve.layer is not slot.layer:
                self._choose(slot.layer)
            if self._curve.layer is slot.layer and self._curve.curve != value:
                self._curve.curve = value
        finally:
            self._undoing = False
