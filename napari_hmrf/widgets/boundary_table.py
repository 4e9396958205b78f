"""The table of boundaries: what the tissue under each label does, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import QComboBox

from napari_hmrf.annotation import Action, BoundaryRule
from napari_hmrf.widgets.label_table import LabelTable, number, shown

_ACTIONS: dict[Action, str] = {
    "fixed": "fixed",
    "move": "moves by",
    "expand": "expands by",
}
_NAME, _DOES, _FIRST, _SECOND, _SURE_ROW, _SURE_COL = range(1, 7)


class BoundaryTable(LabelTable):
    """Label, name, action, amounts and confidences; `rows` are `BoundaryRule`s."""

    def __init__(self) -> None:
        super().__init__(
            [
                ("", "Label and colour; click a row to paint with it"),
                ("Boundary", "Any name"),
                ("Action", "Fixed: stays where it is.\nMoves by: (row, col).\nExpands by: outward"),
                ("", ""),
                ("", ""),
                ("conf.\nrow", "Confidence in the row component: 0 unknown, 1 certain"),
                ("conf.\ncol", "Confidence in the column component: 0 unknown, 1 certain"),
            ],
            stretch=_NAME,
        )
        self.unit = "px"

    @property
    def unit(self) -> str:
        """The unit of the amounts, from the image."""
        return self._unit

    @unit.setter
    def unit(self, unit: str) -> None:
        self._unit = unit
        header = self.horizontalHeaderItem(_FIRST)
        header.setText(f"row\n{unit}")
        header.setToolTip(
            f"Rows downward, in {unit}; or, for what expands, outward along the normal (negative: "
            "inward)"
        )
        header = self.horizontalHeaderItem(_SECOND)
        header.setText(f"col\n{unit}")
        header.setToolTip(f"Columns to the right, in {unit}")

    def _default(self, label: int) -> BoundaryRule:
        return BoundaryRule(label, "fixed", name=f"boundary {label}")

    def _show(self, row: int, value: Any) -> None:
        self._text(row, _NAME, value.name, number=False)
        box = self.cellWidget(row, _DOES)
        if box is None:
            box = QComboBox()
            for action, words in _ACTIONS.items():
                box.addItem(words, action)
            box.setToolTip(
                "Expanding regions must be closed rings or filled: they move along the outward "
                "normal of their outline"
            )
            box.currentIndexChanged.connect(lambda _, chosen=box: self._on_action(chosen))
            self.setCellWidget(row, _DOES, box)
        box.setCurrentIndex(list(_ACTIONS).index(value.action))
        amounts = {
            "fixed": ("", ""),
            "move": tuple(shown(part) for part in value.vector),
            "expand": (shown(value.amount), ""),
        }[value.action]
        for column, text in zip((_FIRST, _SECOND), amounts, strict=True):
            item = self._text(row, column, text, f"in {self._unit}")
            editable = Qt.ItemFlag.ItemIsEditable
            item.setFlags(item.flags() | editable if text else item.flags() & ~editable)
        self._text(row, _SURE_ROW, shown(value.confidence[0]))
        self._text(row, _SURE_COL, shown(value.confidence[1]))

    def _parse(self, row: int, column: int, text: str, value: Any) -> BoundaryRule:
        rule: BoundaryRule = value
        if column == _NAME:
            return replace(rule, name=text)
        amount = number(text)
        if not math.isfinite(amount):
            raise ValueError("not a number")
        if column in (_SURE_ROW, _SURE_COL):
            if not 0 <= amount <= 1:
                raise ValueError("a confidence is from 0 to 1")
            return replace(rule, confidence=_with(rule.confidence, column - _SURE_ROW, amount))
        if rule.action == "expand":
            return replace(rule, amount=amount)
        return replace(rule, vector=_with(rule.vector, column - _FIRST, amount))

    def _on_action(self, box: Any) -> None:
        if self._filling:
            return
        row = next(
            (row for row in range(self.rowCount()) if self.cellWidget(row, _DOES) is box), None
        )
        if row is not None:
            self._replace(row, replace(self._rows[row], action=box.currentData()))


def _with(pair: tuple[float, float], which: int, value: float) -> tuple[float, float]:
    return (value, pair[1]) if which == 0 else (pair[0], value)
