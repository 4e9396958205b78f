"""The table of boundaries: what the tissue under each label does, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from qtpy.QtCore import Qt
from qtpy.QtWidgets import QComboBox

from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.tissue.boundary_rules import Action, BoundaryRule
from napari_hmrf.tissue.label_defaults import default_rule
from napari_hmrf.ui.label_table import LabelTable, number, shown

_ACTIONS: dict[Action, str] = {"fixed": "fixed", "move": "moves", "expand": "expands"}
_NAME, _DOES, _ROWS, _COLS, _OUTWARD, _SURE = range(1, 7)


class BoundaryTable(LabelTable):
    """Label, name, action, distances and confidence; `rows` are `BoundaryRule`s."""

    def __init__(self) -> None:
        super().__init__(
            [
                ("", "Label and colour; click a row to paint with it"),
                ("Boundary", "Any name"),
                (
                    "Action",
                    (
                        "Fixed: stays where it is.\nMoves: so far along the rows and the columns.\n"
                        "Expands: so far outward, along the normal of its outline"
                    ),
                ),
                ("", ""),
                ("", ""),
                ("", ""),
                (
                    "confi-\ndence",
                    (
                        "How sure this is: from 0, unknown, to 1, certain.\nTwo numbers, such as "
                        "1 / 0.5, for rows and columns apart"
                    ),
                ),
            ],
            stretch=_NAME,
        )
        self._unit, self._ways = "px", Directions()
        self._show_heads()

    @property
    def unit(self) -> str:
        """The unit of the amounts, from the image."""
        return self._unit

    @unit.setter
    def unit(self, unit: str) -> None:
        self._unit = unit
        self._show_heads()

    def show_ways(self, ways: Directions) -> None:
        """Say which way rows and columns run on the screen; what the numbers mean stays."""
        if ways != self._ways:
            self._ways = ways
            self._show_heads()

    def _show_heads(self) -> None:
        unit, ways = self._unit, self._ways
        for column, title, tooltip in (
            (_ROWS, ways.header(0), ways.about(0)),
            (_COLS, ways.header(1), ways.about(1)),
            (_OUTWARD, "out", "How far outward; negative: inward"),
        ):
            header = self.horizontalHeaderItem(column)
            header.setText(f"{title}\n{unit}")
            header.setToolTip(f"{tooltip}, in {unit}")

    def _default(self, label: int) -> BoundaryRule:
        return default_rule(label)

    def words(self, label: int) -> str:
        """What a label's row says, in words."""
        return _ACTIONS[self._rows[self.labels.index(label)].action]

    def _show(self, row: int, value: Any) -> None:
        self._text(row, _NAME, value.name, value.name, number=False)
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
            "fixed": ("", "", ""),
            "move": (*(shown(part) for part in value.vector), ""),
            "expand": ("", "", shown(value.amount)),
        }[value.action]
        for column, text in zip((_ROWS, _COLS, _OUTWARD), amounts, strict=True):
            item = self._text(row, column, text, f"in {self._unit}" if text else "")
            editable = Qt.ItemFlag.ItemIsEditable
            item.setFlags(item.flags() | editable if text else item.flags() & ~editable)
        self._text(row, _SURE, " / ".join(shown(part) for part in _apart(value.confidence)))

    def _parse(self, row: int, column: int, text: str, value: Any) -> BoundaryRule:
        rule: BoundaryRule = value
        if column == _NAME:
            return replace(rule, name=text)
        if column == _SURE:
            parts = [number(part) for part in text.split("/")]
            if len(parts) > 2 or not all(0 <= part <= 1 for part in parts):
                raise ValueError("Confidence must be a number from 0 to 1, or two: 1 / 0.5")
            return replace(rule, confidence=(parts[0], parts[-1]))
        amount = number(text)
        if not math.isfinite(amount):
            raise ValueError(f"A distance must be a number, in {self._unit}")
        if column == _OUTWARD:
            return replace(rule, amount=amount)
        rows, cols = rule.vector
        return replace(rule, vector=(amount, cols) if column == _ROWS else (rows, amount))

    def _on_action(self, box: Any) -> None:
        if self._filling:
            return
        row = next(
            (row for row in range(self.rowCount()) if self.cellWidget(row, _DOES) is box), None
        )
        if row is not None:
            self._replace(row, replace(self._rows[row], action=box.currentData()))


def _apart(confidence: tuple[float, float]) -> tuple[float, ...]:
    """Once, if rows and columns are equally sure."""
    return confidence[:1] if confidence[0] == confidence[1] else confidence
