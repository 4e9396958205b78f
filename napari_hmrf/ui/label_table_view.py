"""How a table of labels is seen, and picked from."""

from __future__ import annotations

from typing import Any

from qtpy.QtCore import QModelIndex, QSize, Qt
from qtpy.QtWidgets import (
    QAbstractItemView,
    QComboBox,
    QHeaderView,
    QSizePolicy,
    QStyledItemDelegate,
    QTableView,
)

from napari_hmrf.ui.forms import WholeEntries
from napari_hmrf.ui.label_table import NAME, LabelTable

#: Rows that are seen without scrolling.
_ROWS_SHOWN = 5
_ROW_HEIGHT = 26


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
        header.setSectionResizeMode(NAME, QHeaderView.ResizeMode.Stretch)
        header.setMinimumSectionSize(30)
        header.geometriesChanged.connect(self.updateGeometry)
        self.clicked.connect(self._on_click)
        table.modelReset.connect(self._on_rows)
        table.dataChanged.connect(self._show_columns)
        table.headerDataChanged.connect(self._show_columns)
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

    def _on_click(self, index: Any) -> None:
        if index.column() <= NAME:  # in the others somebody may want to type
            self._pick(index)

    def _pick(self, index: Any) -> None:
        if index.isValid():
            self.model().pick(self.model().labels[index.row()])

    def _on_rows(self) -> None:
        table = self.model()
        for column, about in enumerate(table.columns):
            for row in range(table.rowCount() if about.choices else 0):
                self.openPersistentEditor(table.index(row, column))
        self._show_columns()
        self.updateGeometry()

    def _show_columns(self) -> None:
        """Show the columns that say something of any row: the dock is narrow."""
        table = self.model()
        for column, about in enumerate(table.columns[NAME + 1 :], start=NAME + 1):
            said = about.applies and any(about.shown(row) for row in table.rows)
            self.setColumnHidden(column, not said)


class _Boxes(QStyledItemDelegate):
    """Has a cell chosen rather than typed, where its column says from what."""

    def createEditor(self, parent: Any, option: Any, index: Any) -> Any:
        choices = index.model().columns[index.column()].choices
        if not choices:
            return super().createEditor(parent, option, index)
        box = QComboBox(parent)
        box.addItems(choices)
        box.installEventFilter(WholeEntries(box))
        box.activated.connect(lambda _: self.commitData.emit(box))
        return box
