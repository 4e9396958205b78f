"""Window with a table of records, such as measurements, landmarks or values to fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from qtpy import QtWidgets
from qtpy.QtCore import Qt

# Width of the window in addition to that of the columns, and height of a row, in pixels.
_MARGIN, _ROW = 40, 32
# napari draws empty boxes in the colour of the table.
_BOXES = "QTableView::indicator:unchecked { border: 1px solid gray; }"


class Cell(NamedTuple):
    """Cell of a table.

    Attributes
    ----------
    text, tip : str
        Text, and tooltip.
    is_edited : bool
        True if the user can type another text.
    is_ticked : bool or None
        State of the box in the cell; None if there is no box.
    """

    text: str
    tip: str = ""
    is_edited: bool = False
    is_ticked: bool | None = None

    def item(self) -> QtWidgets.QTableWidgetItem:
        """Return the item of the table."""
        item = QtWidgets.QTableWidgetItem(self.text)
        flags = Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsSelectable
        if self.is_edited:
            flags |= Qt.ItemFlag.ItemIsEditable
        if self.is_ticked is not None:
            flags |= Qt.ItemFlag.ItemIsUserCheckable
            state = Qt.CheckState
            item.setCheckState(state.Checked if self.is_ticked else state.Unchecked)
        item.setFlags(flags)
        item.setToolTip(self.tip)
        return item


class TableWindow(QtWidgets.QDialog):
    """Window with a table, which is as large as its first content.

    Parameters
    ----------
    parent : QWidget
        Main window.
    title : str
    above, below : sequence of QWidget
        Widgets above and below the table; buttons are on the right.
    height : int
        Height of the window in addition to that of the rows, in pixels.
    """

    def __init__(
        self,
        parent: QtWidgets.QWidget,
        title: str,
        above: Sequence[QtWidgets.QWidget] = (),
        below: Sequence[QtWidgets.QWidget] = (),
        height: int = 100,
    ) -> None:
        super().__init__(parent, windowTitle=title)
        self._height = height
        self.table = QtWidgets.QTableWidget()
        self.table.setObjectName("measurements")
        self.table.setAccessibleName(title)
        self.table.setTabKeyNavigation(False)  # the Tab key leaves the table
        self.table.verticalHeader().hide()
        self.table.setStyleSheet(_BOXES)
        layout = QtWidgets.QVBoxLayout(self)
        for each in (*above, self.table, *below):
            layout.addWidget(each)
            if isinstance(each, QtWidgets.QPushButton):
                layout.setAlignment(each, Qt.AlignmentFlag.AlignRight)

    def show_cells(
        self, titles: Sequence[str], rows: Iterable[Sequence[Cell]], tips: Sequence[str] = ()
    ) -> None:
        """Show a table.

        Parameters
        ----------
        titles, tips : sequence of str
            Title of each column, and its tooltip.
        rows : iterable of sequence of Cell
            Cells of each row.
        """
        table, cells = self.table, [*rows]
        is_first = not table.rowCount()
        table.blockSignals(True)
        table.setColumnCount(len(titles))
        table.setRowCount(len(cells))
        table.setHorizontalHeaderLabels(titles)
        for column, tip in enumerate(tips):
            table.horizontalHeaderItem(column).setToolTip(tip)
        for number, row in enumerate(cells):
            for column, cell in enumerate(row):
                table.setItem(number, column, cell.item())
        table.blockSignals(False)
        table.resizeColumnsToContents()
        if is_first:
            width = table.horizontalHeader().length() + _MARGIN
            width = max(width, self.layout().minimumSize().width())
            self.resize(width, self._height + _ROW * (len(cells) + 1))
