"""A table with one row for each label of a Labels layer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from qtpy.QtCore import Qt, Signal
from qtpy.QtGui import QColor, QIcon, QPixmap
from qtpy.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
)

#: Rows that are seen without scrolling.
_ROWS_SHOWN = 5
_ROW_HEIGHT = 26


class LabelTable(QTableWidget):
    """Rows by label, with its colour; what the other columns hold is up to subclasses.

    Signals
    -------
    edited : the user, or a script, changed what the table says
    picked : int, the label of a row that was clicked or added, to paint with
    refused : str, why something typed was not taken
    """

    edited = Signal()
    picked = Signal(int)
    refused = Signal(str)

    def __init__(self, headers: Sequence[tuple[str, str]], stretch: int) -> None:
        super().__init__(0, len(headers))
        for column, (title, tooltip) in enumerate(headers):
            item = QTableWidgetItem(title)
            item.setToolTip(tooltip)
            self.setHorizontalHeaderItem(column, item)
        self.verticalHeader().hide()
        self.verticalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        self.verticalHeader().setDefaultSectionSize(_ROW_HEIGHT)
        self.setWordWrap(False)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(stretch, QHeaderView.ResizeMode.Stretch)
        header.setMinimumSectionSize(30)
        self._rows: list[Any] = []
        self._colours: Mapping[int, Sequence[float]] = {}
        self._filling = False
        self._fit()
        self.itemChanged.connect(self._on_item)
        self.cellClicked.connect(self._on_picked)

    # What a subclass says

    def _default(self, label: int) -> Any:
        """The row of a label that was not there before."""
        raise NotImplementedError

    def _show(self, row: int, value: Any) -> None:
        """Fill the cells of a row beyond the first."""
        raise NotImplementedError

    def _parse(self, row: int, column: int, text: str, value: Any) -> Any:
        """The row's value after an edit; ValueError, saying why, puts the old text back."""
        raise NotImplementedError

    # What is in it

    @property
    def rows(self) -> tuple[Any, ...]:
        """The values, by label."""
        return tuple(self._rows)

    @rows.setter
    def rows(self, values: Iterable[Any]) -> None:
        self._rows = sorted(values, key=lambda value: int(value.label))
        self._refill()
        self.edited.emit()

    @property
    def labels(self) -> tuple[int, ...]:
        """The labels that have a row."""
        return tuple(int(value.label) for value in self._rows)

    def ensure(self, labels: Iterable[int]) -> bool:
        """Give each label a row; whether any was new."""
        new = sorted(set(labels) - set(self.labels))
        if new:
            self.rows = [*self._rows, *(self._default(label) for label in new)]
        return bool(new)

    def add(self, row: Callable[[int], Any] | None = None) -> int:
        """Add what `row` makes of the next free label; by default what a new label gets."""
        label = max([0, *self.labels]) + 1
        self.rows = [*self._rows, (row or self._default)(label)]
        self.highlight(label)
        self.picked.emit(label)
        return label

    def words(self, label: int) -> str:
        """What a label's row says, in words."""
        raise NotImplementedError

    def highlight(self, label: int | None) -> None:
        """Select the row of a label, or none; that alone does not ask to paint with it."""
        if label not in self.labels:
            self.setCurrentCell(-1, -1)
            self.clearSelection()
            return
        row = self.labels.index(label)
        if row != self.currentRow() or not self.selectedIndexes():
            self.setCurrentCell(row, max(1, self.currentColumn()))
            self.selectRow(row)

    def keyPressEvent(self, event: Any) -> None:
        """The arrow keys pick rows as the mouse does; Delete goes no further."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            # The window would give it to the active layer, which would lose its selected points.
            event.accept()
            return
        before = self.currentRow()
        super().keyPressEvent(event)
        if self.currentRow() != before:
            self._on_picked(self.currentRow())

    def set_colours(self, colours: Mapping[int, Sequence[float]]) -> None:
        """Show each label's colour, RGBA from 0 to 1."""
        if colours != self._colours:
            self._colours = colours
            self._filling = True
            for row, label in enumerate(self.labels):
                self._paint_swatch(self.item(row, 0), label)
            self._filling = False

    def _replace(self, row: int, value: Any) -> None:
        """Take over an edited row and tell."""
        self._rows[row] = value
        self._filling = True
        self._show(row, value)
        self._filling = False
        self.edited.emit()

    def _text(
        self, row: int, column: int, text: str, tooltip: str = "", number: bool = True
    ) -> Any:
        """Set a cell's text; it stays editable."""
        item = self.item(row, column)
        if item is None:
            item = QTableWidgetItem()
            self.setItem(row, column, item)
        item.setText(text)
        item.setToolTip(tooltip)
        if number:
            item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        return item

    def _refill(self) -> None:
        self._filling = True
        current = self.currentRow()
        self.setRowCount(0)
        self.setRowCount(len(self._rows))
        for row, value in enumerate(self._rows):
            item = QTableWidgetItem(str(value.label))
            item.setFlags(Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsSelectable)
            item.setToolTip("Click to paint with this label")
            self.setItem(row, 0, item)
            self._paint_swatch(item, int(value.label))
            self._show(row, value)
        if 0 <= current < len(self._rows):
            self.setCurrentCell(current, 1)
            self.selectRow(current)
        self._fit()
        self._filling = False

    def _paint_swatch(self, item: Any, label: int) -> None:
        pixels = QPixmap(14, 14)
        rgba = self._colours.get(label)
        colour = QColor(0, 0, 0, 0) if rgba is None else QColor.fromRgbF(*(float(v) for v in rgba))
        pixels.fill(colour)
        icon = QIcon(pixels)
        # Qt would tint the colour of the row that is selected.
        icon.addPixmap(pixels, QIcon.Mode.Selected)
        item.setIcon(icon)

    def _fit(self) -> None:
        """As high as a few rows: the dock is shared."""
        shown = min(max(2, len(self._rows)), _ROWS_SHOWN)
        header = self.horizontalHeader().sizeHint().height()
        self.setFixedHeight(header + shown * _ROW_HEIGHT + 2 * self.frameWidth() + 2)
        scroll = Qt.ScrollBarPolicy
        more = len(self._rows) > _ROWS_SHOWN
        self.setVerticalScrollBarPolicy(
            scroll.ScrollBarAsNeeded if more else scroll.ScrollBarAlwaysOff
        )

    def _on_item(self, item: Any) -> None:
        if self._filling or item.column() == 0:
            return
        row = item.row()
        try:
            value = self._parse(row, item.column(), item.text().strip(), self._rows[row])
        except ValueError as error:
            self._filling = True
            self._show(row, self._rows[row])
            self._filling = False
            self.refused.emit(f"{error}; kept {item.text()}.")
        else:
            self._replace(row, value)

    def _on_picked(self, row: int, *_: int) -> None:
        if 0 <= row < len(self._rows):
            self.picked.emit(int(self._rows[row].label))


def number(text: str) -> float:
    """A number as people type it, with a point or a comma; NaN for anything else."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan


def shown(value: float) -> str:
    """A number as a cell shows it."""
    return f"{value:g}"
