"""Tables with a row for each label of a Labels layer: what they say, and how that is seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from qtpy.QtCore import QAbstractTableModel, QModelIndex, QSize, Qt, Signal
from qtpy.QtGui import QColor, QIcon, QPixmap
from qtpy.QtWidgets import (
    QAbstractItemView,
    QComboBox,
    QHeaderView,
    QSizePolicy,
    QStyledItemDelegate,
    QTableView,
)

#: Rows that are seen without scrolling.
_ROWS_SHOWN = 5
_ROW_HEIGHT = 26
_LABEL, _NAME = range(2)
_ROLE = Qt.ItemDataRole


class Column(NamedTuple):
    """One column of a table.

    Attributes
    ----------
    title, about : str
        Its head, and what the mouse finds there.
    shown : callable
        What the cell of a row says; where that is "" there is nothing to be typed either.
    typed : callable
        The row after something was typed; ValueError says why that means nothing.
    tip : callable
        What the mouse finds in the cell of a row.
    choices : sequence of str
        What there is to choose from, if nothing is to be typed.
    """

    title: str
    about: str
    shown: Callable[[Any], str]
    typed: Callable[[Any, str], Any] = lambda row, text: row
    tip: Callable[[Any], str] = lambda row: ""
    choices: Sequence[str] = ()


class LabelTable(QAbstractTableModel):
    """Rows by label, with its colour and its name; what the other columns hold is up to subclasses.

    Parameters
    ----------
    title : str
        Of the column of names.
    columns : sequence of Column
        Those beyond label and name.
    about : callable
        What there is to say of a row beside its name.

    Signals
    -------
    edited : the user, or a script, changed what the table says
    picked : int, the label of a row that was clicked or added, to paint with
    marked : int or None, the label whose row is to be selected, without painting with it
    refused : str, why something typed was not taken
    """

    edited = Signal()
    picked = Signal(int)
    marked = Signal(object)
    refused = Signal(str)
    #: Of stiffness, in a table that has it.
    unit: str = ""

    def __init__(
        self,
        title: str,
        columns: Sequence[Column],
        about: Callable[[Any], str] = lambda row: "",
    ) -> None:
        super().__init__()
        self.columns = [
            Column(
                "",
                "Label and colour; click a row to paint with it",
                lambda row: str(row.label),
                tip=lambda row: "Click to paint with this label",
            ),
            Column(
                title,
                "Any name",
                lambda row: row.name,
                lambda row, text: replace(row, name=text),
                lambda row: about(row) or row.name,
            ),
            *columns,
        ]
        self._rows: list[Any] = []
        self._colours: Mapping[int, Sequence[float]] = {}

    # What a subclass says

    def _default(self, label: int) -> Any:
        """The row of a label that was not there before."""
        raise NotImplementedError

    def words(self, row: Any) -> str:
        """What a row says, in words."""
        raise NotImplementedError

    # What is in it

    @property
    def rows(self) -> tuple[Any, ...]:
        """The values, by label."""
        return tuple(self._rows)

    @rows.setter
    def rows(self, values: Iterable[Any]) -> None:
        rows = sorted(values, key=lambda value: int(value.label))
        if [row.label for row in rows] == [*self.labels]:
            self._rows = rows
            self._show_again()
        else:
            self.beginResetModel()
            self._rows = rows
            self.endResetModel()
        self.edited.emit()

    @property
    def labels(self) -> tuple[int, ...]:
        """The labels that have a row."""
        return tuple(int(value.label) for value in self._rows)

    def show(self, table: Any) -> None:
        """Show a table as a layer carries it, with `rows` and a `unit`."""
        self.unit = table.unit
        if self.rows != table.rows:
            self.rows = table.rows

    def ensure(self, labels: Iterable[int]) -> list[Any]:
        """Give each label a row; those that are new."""
        new = [self._default(label) for label in sorted(set(labels) - set(self.labels))]
        if new:
            self.rows = [*self._rows, *new]
        return new

    def add(self, row: Callable[[int], Any] | None = None) -> int:
        """Add what `row` makes of the next free label; by default what a new label gets."""
        label = max([0, *self.labels]) + 1
        self.rows = [*self._rows, (row or self._default)(label)]
        self.picked.emit(label)
        return label

    def set_colours(self, colours: Mapping[int, Sequence[float]]) -> None:
        """Show each label's colour, RGBA from 0 to 1."""
        if colours != self._colours:
            self._colours = colours
            self._show_again()

    def set_head(self, column: int, title: str, about: str) -> None:
        """Give a column another head."""
        head = self.columns[column]._replace(title=title, about=about)
        if head != self.columns[column]:  # Qt measures the columns anew
            self.columns[column] = head
            self.headerDataChanged.emit(Qt.Orientation.Horizontal, column, column)

    def _show_again(self) -> None:
        self.dataChanged.emit(
            self.index(0, 0), self.index(len(self._rows) - 1, len(self.columns) - 1)
        )

    # What Qt asks

    def rowCount(self, parent: Any = None) -> int:
        """How many rows there are."""
        return len(self._rows)

    def columnCount(self, parent: Any = None) -> int:
        """How many columns there are."""
        return len(self.columns)

    def headerData(self, section: int, orientation: Any, role: int = _ROLE.DisplayRole) -> Any:
        """What the head of a column says."""
        head = self.columns[section]
        return {_ROLE.DisplayRole: head.title, _ROLE.ToolTipRole: head.about}.get(role)

    def data(self, index: Any, role: int = _ROLE.DisplayRole) -> Any:
        """What a cell says, and how it looks."""
        row, column = self._rows[index.row()], self.columns[index.column()]
        if role in (_ROLE.DisplayRole, _ROLE.EditRole):
            return column.shown(row)
        if role == _ROLE.ToolTipRole:
            return column.tip(row)
        if role == _ROLE.TextAlignmentRole and index.column() > _NAME:
            return Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter
        if role == _ROLE.DecorationRole and index.column() == _LABEL:
            return _swatch(self._colours.get(int(row.label), (0, 0, 0, 0)))
        return None

    def flags(self, index: Any) -> Any:
        """Whether a cell can be typed in."""
        column, flags = index.column(), super().flags(index)
        typed = column == _NAME or (column > _NAME and self.data(index))
        return flags | Qt.ItemFlag.ItemIsEditable if typed else flags

    def setData(self, index: Any, value: Any, role: int = _ROLE.EditRole) -> bool:
        """Take over what was typed into a cell, or say why not."""
        row, column = self._rows[index.row()], self.columns[index.column()]
        try:
            after = column.typed(row, str(value).strip())
        except ValueError as error:
            self.refused.emit(f"{error}; kept {column.shown(row)}.")
            return False
        if after != row:
            self._rows[index.row()] = after
            self._show_again()
            self.edited.emit()
        return True


class LabelTableView(QTableView):
    """A table as it is seen; a row that is clicked, or gone to by the keys, is picked.

    Parameters
    ----------
    table : LabelTable
    """

    def __init__(self, table: LabelTable) -> None:
        super().__init__()
        self.setModel(table)
        self._boxes = _Boxes()
        self.setItemDelegate(self._boxes)
        self.verticalHeader().hide()
        self.verticalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        self.verticalHeader().setDefaultSectionSize(_ROW_HEIGHT)
        self.setWordWrap(False)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(_NAME, QHeaderView.ResizeMode.Stretch)
        header.setMinimumSectionSize(30)
        header.geometriesChanged.connect(self.updateGeometry)
        self.clicked.connect(self._pick)
        table.modelReset.connect(self._on_rows)
        table.marked.connect(self._mark)

    def keyPressEvent(self, event: Any) -> None:
        """The arrow keys pick rows as the mouse does; Delete goes no further."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            # The window would give it to the active layer, which would lose its selected points.
            event.accept()
            return
        before = self.currentIndex().row()
        super().keyPressEvent(event)
        if self.currentIndex().row() != before:
            self._pick(self.currentIndex())

    def sizeHint(self) -> QSize:
        """As high as a few rows: the dock is shared."""
        rows = min(max(2, self.model().rowCount()), _ROWS_SHOWN)
        height = self.horizontalHeader().sizeHint().height() + rows * _ROW_HEIGHT
        return QSize(super().sizeHint().width(), height + 2 * self.frameWidth() + 2)

    def _mark(self, label: int | None) -> None:
        labels = self.model().labels
        if label not in labels:
            self.setCurrentIndex(QModelIndex())
            self.clearSelection()
        elif not self.selectionModel().isRowSelected(row := labels.index(label)):
            self.selectRow(row)

    def _pick(self, index: Any) -> None:
        if index.isValid():
            self.model().picked.emit(self.model().labels[index.row()])

    def _on_rows(self) -> None:
        table = self.model()
        for column, about in enumerate(table.columns):
            for row in range(table.rowCount() if about.choices else 0):
                self.openPersistentEditor(table.index(row, column))
        self.updateGeometry()


class _Boxes(QStyledItemDelegate):
    """Has a cell chosen rather than typed, where its column says from what."""

    def createEditor(self, parent: Any, option: Any, index: Any) -> Any:
        choices = index.model().columns[index.column()].choices
        if not choices:
            return super().createEditor(parent, option, index)
        box = QComboBox(parent)
        box.addItems(choices)
        box.activated.connect(lambda _: self.commitData.emit(box))
        return box


def _swatch(rgba: Sequence[float]) -> QIcon:
    pixels = QPixmap(14, 14)
    pixels.fill(QColor.fromRgbF(*(float(part) for part in rgba)))
    icon = QIcon(pixels)
    # Qt would tint the colour of the row that is selected.
    icon.addPixmap(pixels, QIcon.Mode.Selected)
    return icon


def number(text: str) -> float:
    """A number as people type it, with a point or a comma; NaN for anything else."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan
