"""Edits of tables and of the curve as steps that can be undone."""

from __future__ import annotations

from typing import Any

from napari_hmrf.layers.background import Filling
from napari_hmrf.layers.edit_history import BACKGROUND, CURVE, Slot, ViewerSteps, steps_of
from napari_hmrf.layers.metadata import TISSUE, Role
from napari_hmrf.layers.table_state import Table, change
from napari_hmrf.ui.curve.tissue import TissueCurve
from napari_hmrf.ui.label_sync import PaintedLabels
from napari_hmrf.ui.label_table import LabelTable


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

    def show(self, slot: Any, value: Any) -> None:
        """Show what a slot holds, if it is the table that is shown."""
        layer = self._painted.layer
        if layer is None or slot != Slot(self._role, layer):
            return
        if hasattr(self._table, "unit") and value.unit:
            self._table.unit = value.unit
        if self._table.rows != value.rows:
            self._table.rows = value.rows


class FillingSteps:
    """Keeps what was painted as no tissue by one press of a button, with its row, as one step.

    Which dock did it, and what it shows now, makes no difference: the row is that of the layer.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
        Have one of them in a viewer, by `shared`.
    """

    def __init__(self, viewer: Any) -> None:
        self._edits = steps_of(viewer).edits
        self._edits.changed.connect(self._on_changed)

    def fill(self, layer: Any, filling: Filling) -> None:
        """Paint it in a layer of tissue labels, and have that undone in one step."""
        slot = Slot(BACKGROUND, layer, filling.place)
        fillings = (*self._edits.open(slot, ()), filling)
        self._edits.do(slot, fillings, f"made the background of '{layer.name}' no tissue")

    def _on_changed(self, slot: Any, fillings: Any, before: Any) -> None:
        if not isinstance(slot, Slot) or slot.what != BACKGROUND:
            return
        for filling in reversed(before[len(fillings) :]):
            filling.erase(slot.layer)
            label = filling.material.label
            # Whoever painted it elsewhere since goes on meaning no tissue by it.
            if filling.new and not (slot.layer.data == label).any():
                self._have_row(slot.layer, label)
        for filling in fillings[len(before) :]:
            self._have_row(slot.layer, filling.material.label, filling.material)
            filling.paint(slot.layer)

    def _have_row(self, layer: Any, label: int, *row: Any) -> None:
        """Have the table say what the paint is, or no longer; that is no step of its own."""
        slot, table = Slot(TISSUE, layer), Table.of(layer, TISSUE)
        rows = (*(each for each in table.rows if each.label != label), *row)
        self._edits.open(slot, table)
        by_label = tuple(sorted(rows, key=lambda each: int(each.label)))
        self._edits.amend(slot, table._replace(rows=by_label))


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
        self._left: tuple[Slot, Any] | None = None
        curve.changed.connect(self._on_changed)
        curve.settled.connect(self._on_settled)
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

    def leave(self) -> None:
        """Nobody will listen: know what should be shown now."""
        slot = Slot(CURVE, self._curve.layer)
        self._left = (slot, self._edits.get(slot)) if slot in self._edits else None

    def catch_up(self) -> None:
        """Show what was undone meanwhile."""
        left, self._left = self._left, None
        if left is not None and left[0] in self._edits:
            now = self._edits.get(left[0])
            if now != left[1]:
                self.show(left[0], now)

    def show(self, slot: Any, value: Any) -> None:
        """Show what a slot holds, if it is a curve, and the layer it is of."""
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
