"""Tables with a row for each label of a Labels layer, updated when labels are painted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Generic, NamedTuple

from napari.layers import Labels
from qtpy.QtCore import QEvent, QModelIndex, QSignalBlocker, QSize, Qt, Signal
from qtpy.QtGui import QColor, QIcon, QPixmap
from qtpy.QtWidgets import QComboBox, QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.metadata import BOUNDARY, Role, store_table, table_of
from napari_hmrf.layers.pixel_copy import CHANGES
from napari_hmrf.layers.slice_view import View, copy_slice, frame_of
from napari_hmrf.tissue.boundary_rules import unlisted
from napari_hmrf.tissue.row_table import Row, RowTable
from napari_hmrf.ui.events import EventConnections, single_shot
from napari_hmrf.ui.forms import CalmField

#: Columns that every table has.
LABEL, NAME = range(2)
#: Time from the last brush stroke to the update of the labels, in milliseconds.
_PAUSE = 150
#: Layer events that can change the labels or their colours.
_EVENTS = (*CHANGES, "colormap")
#: Minimum height of a row, and space above and below its text, in pixels.
_ROW_HEIGHT, _ROW_SPACE = 26, 10
#: Largest height of a table, in rows; about five rows fit without scrolling.
_HIGHEST = 6.6
#: Width of a box in a cell beside its text, in pixels.
_BESIDE = 28
_COMPACT = "QComboBox { padding: 1px 0px 1px 3px; } QComboBox::drop-down { width: 14px; }"


class Column(NamedTuple, Generic[Row]):
    """Column of a table.

    Attributes
    ----------
    title, about : str
        Header of the column, and tooltip of the header.
    shown : callable
        Returns the text of a row's cell. An empty cell cannot be edited, except in the name column.
    typed : callable
        Returns the row with a typed text applied; raises ValueError if the text is invalid.
    choices : sequence of str
        Texts to choose from in a column that does not accept typed text.
    """

    title: str
    about: str
    shown: Callable[[Row], str]
    typed: Callable[[Row, str], Row] = lambda row, text: row
    choices: Sequence[str] = ()


def _named(row: Row, text: str) -> Row:
    return replace(row, name=text)


class LabelTable(QTableWidget, Generic[Row]):
    """Table of labels, with their colours and names; subclasses add further columns.

    The table is stored in the metadata of its layer. A row is added for each newly painted label.
    To select a label for painting, the user clicks its row or moves to the row with the arrow keys.

    Parameters
    ----------
    view : callable
        Returns the visible slice.

    Attributes
    ----------
    role : "tissue" or "boundary"

    Signals
    -------
    changed : bool, True if the paint or the layer changed, False if the rows were edited
    picked : layer in which a label was selected for painting
    message : str, message about newly painted labels
    refusal : str, reason why typed text was refused
    """

    role: Role
    changed = Signal(bool)
    picked = Signal(object)
    message = Signal(str)
    refusal = Signal(str)

    def __init__(self, view: Callable[[], View]) -> None:
        super().__init__()
        self._view = view
        self._contents: RowTable[Row] = RowTable(())
        self._layer: Any = None
        # True if the layer was painted since the last refresh.
        self._is_painted = False
        self._connections = EventConnections()
        self._timer = single_shot(self, _PAUSE, self.refresh)
        self.setAccessibleName(f"{self.role} table")
        self._fill()
        self.verticalHeader().hide()
        self.verticalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        self.setWordWrap(False)
        self.setTabKeyNavigation(False)  # the Tab key leaves the table; arrow keys select a cell
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setSizeAdjustPolicy(self.SizeAdjustPolicy.AdjustToContents)
        self._fit_rows()
        self.setSelectionBehavior(self.SelectionBehavior.SelectRows)
        self.setSelectionMode(self.SelectionMode.SingleSelection)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(NAME, QHeaderView.ResizeMode.Stretch)
        header.setMinimumSectionSize(30)
        header.setTextElideMode(Qt.TextElideMode.ElideNone)  # Qt elides two lines as one
        self.cellClicked.connect(self._on_click)
        self.itemChanged.connect(self._on_typed)

    # Columns and rows

    @property
    def columns(self) -> list[Column[Row]]:
        """Columns of the table; subclasses add further columns."""
        return [
            Column("", "Click a row to paint with its label", lambda row: str(row.label)),
            # The title is short, because the dock is narrow.
            Column("Name", "Double-click a name to change it", lambda row: row.name, _named),
        ]

    def default(self, label: int) -> Row:
        """Return the row for a new label."""
        raise NotImplementedError

    # Contents

    @property
    def contents(self) -> RowTable[Row]:
        """Contents of the table as a single value; can be set."""
        return self._contents

    @contents.setter
    def contents(self, contents: RowTable[Row]) -> None:
        if contents != self._contents:
            self._show(contents)
            self._timer.start()
            self._store(automatic=False)

    @property
    def rows(self) -> tuple[Row, ...]:
        """Rows in the order of their labels; can be set."""
        return self._contents.rows

    @rows.setter
    def rows(self, values: Iterable[Row]) -> None:
        self.contents = self._contents.edited(values)

    @property
    def labels(self) -> tuple[int, ...]:
        """Labels that have a row."""
        return tuple(int(row.label) for row in self.rows)

    def add(self) -> int:
        """Add a row with the next free label, and return the label."""
        label = max([0, *self.labels]) + 1
        self.rows = [*self.rows, self.default(label)]
        self.pick(label)
        return label

    # Layer

    @property
    def layer(self) -> Any:
        """Labels layer of the table, or None."""
        return self._layer

    @layer.setter
    def layer(self, layer: Any) -> None:
        if layer is self._layer:
            return
        self.release()
        if not isinstance(layer, Labels):
            return
        self._layer = layer
        self._show(table_of(layer, self.role))
        self._list_painted()
        self._mark()
        self._connections = EventConnections(
            (layer.events.selected_label, self._mark),
            # Debounced: reading the labels of a large image takes longer than a stroke.
            *((getattr(layer.events, name), self._on_paint) for name in _EVENTS),
        )
        self._store(automatic=True)

    def release(self) -> None:
        """Disconnect the table from its layer."""
        with suppress(RuntimeError):  # Qt may have deleted the timer at exit
            self._timer.stop()
        self._connections.release()
        self._layer = None

    def refresh(self) -> None:
        """Add rows for new labels and update the colours immediately."""
        if self._layer is None:
            return
        self._timer.stop()
        new = self._list_painted()
        self._fill()
        if new or self._is_painted:  # else only the table was edited, which is stored
            self._store(automatic=True)
        self._is_painted = False
        if new:
            names = " and ".join(f"label {row.label}" for row in new[:3])
            self.message.emit(f"New in '{self._layer.name}': {names}. Set values in the table.")

    def pick(self, label: int) -> None:
        """Select a label for painting."""
        if self._layer is not None:
            self._layer.selected_label = label
            self.picked.emit(self._layer)

    def _on_paint(self, *_: Any) -> None:
        self._is_painted = True
        self._timer.start()

    def _mark(self, *_: Any) -> None:
        """Highlight the row of the label that is selected in the layer."""
        label = int(self._layer.selected_label)
        if label not in self.labels:
            self.setCurrentIndex(QModelIndex())
            self.clearSelection()
        elif not self.selectionModel().isRowSelected(row := self.labels.index(label)):
            self.selectRow(row)

    def _list_painted(self) -> list[Row]:
        """Add rows for new labels of the slice and return them; [] if the slice cannot be read."""
        try:
            picture = copy_slice(self._layer, frame_of(self._layer, self._view()))
        except ProblemError:
            return []
        labels = unlisted(picture, self.rows)
        new = [self.default(each) for each in labels if each > 0 or self.role != BOUNDARY]
        if new:
            self._show(self._contents._replace(rows=(*self.rows, *new)))
        return new

    def _show(self, contents: RowTable[Row]) -> None:
        rows = tuple(sorted(contents.rows, key=lambda row: int(row.label)))
        self._contents = contents._replace(rows=rows)
        self._fill()

    def _store(self, automatic: bool) -> None:
        """Store the table in the layer, and emit `changed`."""
        if self._layer is not None:
            store_table(self._contents, self._layer, self.role)
            self.changed.emit(automatic)

    def changeEvent(self, event: Any) -> None:
        """Fit the rows to a new font."""
        super().changeEvent(event)
        if event.type() == QEvent.Type.FontChange:
            self._fit_rows()

    def _fit_rows(self) -> None:
        height = max(_ROW_HEIGHT, self.fontMetrics().height() + _ROW_SPACE)
        self.verticalHeader().setDefaultSectionSize(height)
        self.setMaximumHeight(round(_HIGHEST * height))

    # Cells

    def _fill(self) -> None:
        """Write the rows to the cells, and hide columns that are empty in every row."""
        # The changes below are not made by the user.
        blocked, columns = QSignalBlocker(self), self.columns
        self.setRowCount(len(self.rows))
        self.setColumnCount(len(columns))
        for column, about in enumerate(columns):
            head = QTableWidgetItem(about.title)
            head.setToolTip(about.about)
            self.setHorizontalHeaderItem(column, head)
            for row in range(len(self.rows)):
                self._write(row, column, about)
            is_shown = any(about.shown(row) for row in self.rows)
            self.setColumnHidden(column, column > NAME and not is_shown)  # the dock is narrow
        blocked.unblock()

    def _write(self, row: int, column: int, about: Column[Row]) -> None:
        """Write the value of a row to a cell, without closing an open editor."""
        value, item = self.rows[row], self.item(row, column)
        text = about.shown(value)
        if item is None:
            item = QTableWidgetItem()
            self.setItem(row, column, item)
            if column > NAME:
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            if about.choices:
                self.setCellWidget(row, column, self._box(item, about.choices))
                self._order_tabs(row, column)
        item.setText(text)
        item.setToolTip(text)  # the narrow dock may elide the text
        typing = Qt.ItemFlag.ItemIsEditable
        typed = column == NAME or (column > NAME and text)
        flags = item.flags() | typing if typed else item.flags() & ~typing
        if flags != item.flags():
            item.setFlags(flags)
        if column == LABEL:
            item.setIcon(self._swatch(int(value.label)))
        if about.choices:
            box = self.cellWidget(row, column)
            box.setCurrentText(text)
            width = box.fontMetrics().horizontalAdvance(text) + _BESIDE
            item.setSizeHint(QSize(width, item.sizeHint().height()))
            box.setAccessibleName(f"{about.title} of {value.name or f'label {value.label}'}")

    def _order_tabs(self, row: int, column: int) -> None:
        """Make the Tab key visit a new box after the table and the boxes before it."""
        columns = self.columnCount()
        cells = (divmod(number, columns) for number in range(row * columns + column))
        boxes = [box for cell in cells if (box := self.cellWidget(*cell)) is not None]
        self.setTabOrder([self, *boxes][-1], self.cellWidget(row, column))

    def _box(self, item: QTableWidgetItem, choices: Sequence[str]) -> QComboBox:
        """Create the menu for a cell with a fixed set of values."""
        box = QComboBox()
        box.addItems(choices)
        box.setStyleSheet(_COMPACT)
        box.textActivated.connect(item.setText)
        box.activated.connect(self.clearFocus)  # so that the canvas receives the next key presses
        CalmField(box).watch(box)
        return box

    def _swatch(self, label: int) -> QIcon:
        rgba = self._layer.get_color(label) if label and self._layer is not None else None
        pixels = QPixmap(14, 14)
        pixels.fill(QColor(0, 0, 0, 0) if rgba is None else QColor.fromRgbF(*map(float, rgba)))
        icon = QIcon(pixels)
        # Otherwise Qt tints the colour of the selected row.
        icon.addPixmap(pixels, QIcon.Mode.Selected)
        return icon

    # Mouse and keys

    def keyPressEvent(self, event: Any) -> None:
        """Select rows with the arrow keys, pass letters to the canvas, and block Delete."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            # Otherwise the active layer would receive the key and delete its selected points.
            event.accept()
            return
        if event.text() >= " " and self.currentColumn() <= NAME:
            event.ignore()  # a click selects a label; only a double click edits a name
            return
        before = self.currentRow()
        super().keyPressEvent(event)
        if self.currentRow() not in (-1, before):
            self.pick(self.labels[self.currentRow()])

    def _on_click(self, row: int, column: int) -> None:
        if column <= NAME:  # a click on another column may begin an edit
            self.pick(self.labels[row])
        elif self._layer is not None:
            self._layer.selected_label = self.labels[row]

    def _on_typed(self, item: QTableWidgetItem) -> None:
        """Apply the text typed into a cell, or report why the text was refused."""
        row, column = self.rows[item.row()], self.columns[item.column()]
        try:
            after = column.typed(row, item.text().strip())
        except ValueError as error:
            reason = str(error)
            self.refusal.emit(
                f"{reason[0].upper()}{reason[1:]}. The value is still {column.shown(row)}."
            )
            after = row
        if after == row:
            self._fill()
        else:
            self.rows = [after if each is row else each for each in self.rows]
