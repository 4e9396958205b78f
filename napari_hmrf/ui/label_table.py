"""Tables with a row for each label of a Labels layer, in step with what is painted there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

from napari.layers import Labels
from qtpy.QtCore import QModelIndex, QSignalBlocker, Qt, Signal
from qtpy.QtGui import QColor, QIcon, QPixmap
from qtpy.QtWidgets import QComboBox, QHeaderView, QSizePolicy, QTableWidget, QTableWidgetItem

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.metadata import BOUNDARY, Role, store_table, table_of
from napari_hmrf.layers.pixel_copy import CHANGES
from napari_hmrf.layers.slice_view import View, copy_slice, frame_of
from napari_hmrf.tissue.boundary_rules import unlisted
from napari_hmrf.tissue.row_table import RowTable
from napari_hmrf.ui.events import Listening, single_shot
from napari_hmrf.ui.forms import CalmField

#: The columns that every table has.
LABEL, NAME = range(2)
#: How long after the last brush stroke the labels are looked at, in milliseconds.
_PAUSE = 150
#: The layer's events after which there may be new labels, or other colours.
_EVENTS = (*CHANGES, "colormap")
#: In pixels, for the dock is shared: about five rows are seen without scrolling.
_ROW_HEIGHT, _HIGHEST = 26, 172
_COMPACT = "QComboBox { padding: 1px 0px 1px 3px; } QComboBox::drop-down { width: 14px; }"


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
    choices : sequence of str
        What there is to choose from, if nothing is to be typed.
    """

    title: str
    about: str
    shown: Callable[[Any], str]
    typed: Callable[[Any, str], Any] = lambda row, text: row
    choices: Sequence[str] = ()


def _named(row: Any, text: str) -> Any:
    return replace(row, name=text)


class LabelTable(QTableWidget):
    """Rows by label, with its colour and its name; what the other columns hold is up to subclasses.

    A layer carries its table in its metadata, so that it goes where the layer goes. New labels that
    are painted get rows, and a row that is clicked, or gone to by the keys, is painted with.

    Parameters
    ----------
    view : callable
        Which slice is shown.

    Attributes
    ----------
    role : "tissue" or "boundary"
    title : str
        Of the column of names.

    Signals
    -------
    changed : bool, the paint or the table changed; whether by nobody's hand, as for new paint
    picked : the layer, a row of which is to be painted with
    found : str, what new labels were painted
    refused : str, why something typed was not taken
    """

    role: Role
    title: str
    changed = Signal(bool)
    picked = Signal(object)
    found = Signal(str)
    refused = Signal(str)

    def __init__(self, view: Callable[[], View]) -> None:
        super().__init__()
        self._view = view
        self._contents = RowTable(())
        self._layer: Any = None
        self._heard = Listening()
        self._timer = single_shot(self, _PAUSE, self.look)
        self._fill()
        self.verticalHeader().hide()
        self.verticalHeader().setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        self.verticalHeader().setDefaultSectionSize(_ROW_HEIGHT)
        self.setWordWrap(False)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setSizeAdjustPolicy(self.SizeAdjustPolicy.AdjustToContents)
        self.setMaximumHeight(_HIGHEST)
        self.setSelectionBehavior(self.SelectionBehavior.SelectRows)
        self.setSelectionMode(self.SelectionMode.SingleSelection)
        header = self.horizontalHeader()
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(NAME, QHeaderView.ResizeMode.Stretch)
        header.setMinimumSectionSize(30)
        header.setTextElideMode(Qt.TextElideMode.ElideRight)
        self.cellClicked.connect(self._on_click)
        self.itemChanged.connect(self._on_typed)

    # What a row says

    @property
    def columns(self) -> list[Column]:
        """What the columns are now; subclasses have more."""
        return [
            Column("", "Click a row to paint with its label", lambda row: str(row.label)),
            Column(self.title, "Double click: rename", lambda row: row.name, _named),
        ]

    def default(self, label: int) -> Any:
        """The row of a label that was not there before."""
        raise NotImplementedError

    # What is in it

    @property
    def contents(self) -> RowTable:
        """All that it says, as one value; to be set, too."""
        return self._contents

    @contents.setter
    def contents(self, contents: RowTable) -> None:
        if contents != self._contents:
            self._show(contents)
            self._timer.start()
            self._tell(by_itself=False)

    @property
    def rows(self) -> tuple[Any, ...]:
        """The values, by label; to be set, too."""
        return self._contents.rows

    @rows.setter
    def rows(self, values: Iterable[Any]) -> None:
        self.contents = self._contents.edited(values)

    @property
    def labels(self) -> tuple[int, ...]:
        """The labels that have a row."""
        return tuple(int(row.label) for row in self.rows)

    def add(self) -> int:
        """Add a row with the next free label."""
        label = max([0, *self.labels]) + 1
        self.rows = [*self.rows, self.default(label)]
        self.pick(label)
        return label

    # Its layer

    @property
    def layer(self) -> Any:
        """The Labels layer, or None."""
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
        self._heard = Listening(
            (layer.events.selected_label, self._mark),
            # Restarted at every stroke: looking at a large image takes longer than a stroke.
            *((getattr(layer.events, name), lambda _: self._timer.start()) for name in _EVENTS),
        )
        self._tell(by_itself=True)

    def release(self) -> None:
        """Stop listening to the layer."""
        with suppress(RuntimeError):  # at the end of the program Qt may have ended it already
            self._timer.stop()
        self._heard.release()
        self._layer = None

    def look(self) -> None:
        """Give new labels their rows and all rows their colours; now, not after a pause."""
        if self._layer is None:
            return
        self._timer.stop()
        new = self._list_painted()
        self._fill()
        self._tell(by_itself=True)
        if new:
            said = " and ".join(f"label {row.label}" for row in new[:3])
            self.found.emit(f"New in '{self._layer.name}': {said}. Change it in the table.")

    def pick(self, label: int) -> None:
        """Have a label be painted with."""
        if self._layer is not None:
            self._layer.selected_label = label
            self.picked.emit(self._layer)

    def _mark(self, *_: Any) -> None:
        """Highlight the row of the label that is selected in the layer."""
        label = int(self._layer.selected_label)
        if label not in self.labels:
            self.setCurrentIndex(QModelIndex())
            self.clearSelection()
        elif not self.selectionModel().isRowSelected(row := self.labels.index(label)):
            self.selectRow(row)

    def _list_painted(self) -> list[Any]:
        """Give each label of the slice a row; those that are new, none if it cannot be read."""
        try:
            picture = copy_slice(self._layer, frame_of(self._layer, self._view()))
        except ProblemError:
            return []
        labels = unlisted(picture, self.rows)
        new = [self.default(each) for each in labels if each > 0 or self.role != BOUNDARY]
        if new:
            self._show(self._contents._replace(rows=(*self.rows, *new)))
        return new

    def _show(self, contents: RowTable) -> None:
        rows = tuple(sorted(contents.rows, key=lambda row: int(row.label)))
        self._contents = contents._replace(rows=rows)
        self._fill()

    def _tell(self, by_itself: bool) -> None:
        """Have the layer carry the table, and say what changed."""
        if self._layer is not None:
            store_table(self._contents, self._layer, self.role)
            self.changed.emit(by_itself)

    # How it is seen

    def _fill(self) -> None:
        """Have the cells say what the rows do; columns are seen that say something of any row."""
        blocked, columns = QSignalBlocker(self), self.columns  # nobody has typed it
        self.setRowCount(len(self.rows))
        self.setColumnCount(len(columns))
        for column, about in enumerate(columns):
            head = QTableWidgetItem(about.title)
            head.setToolTip(about.about)
            self.setHorizontalHeaderItem(column, head)
            for row in range(len(self.rows)):
                self._write(row, column, about)
            said = any(about.shown(row) for row in self.rows)
            self.setColumnHidden(column, column > NAME and not said)  # the dock is narrow
        blocked.unblock()

    def _write(self, row: int, column: int, about: Column) -> None:
        """Have a cell say what its row does; one that is typed in is left alone."""
        value, item = self.rows[row], self.item(row, column)
        text = about.shown(value)
        if item is None:
            item = QTableWidgetItem()
            self.setItem(row, column, item)
            if column > NAME:
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            if about.choices:
                self.setCellWidget(row, column, self._box(item, about.choices))
        item.setText(text)
        item.setToolTip(text)  # the dock is narrow
        typing = Qt.ItemFlag.ItemIsEditable
        typed = column == NAME or (column > NAME and text)
        flags = item.flags() | typing if typed else item.flags() & ~typing
        if flags != item.flags():
            item.setFlags(flags)
        if column == LABEL:
            item.setIcon(self._swatch(int(value.label)))
        if about.choices:
            self.cellWidget(row, column).setCurrentText(text)

    def _box(self, item: QTableWidgetItem, choices: Sequence[str]) -> QComboBox:
        """What a cell is chosen by, rather than typed."""
        box = QComboBox()
        box.addItems(choices)
        box.setStyleSheet(_COMPACT)
        box.textActivated.connect(item.setText)
        box.activated.connect(self.clearFocus)  # the keys that come next are the canvas's
        CalmField(box).watch(box)
        return box

    def _swatch(self, label: int) -> QIcon:
        rgba = self._layer.get_color(label) if label and self._layer is not None else None
        pixels = QPixmap(14, 14)
        pixels.fill(QColor(0, 0, 0, 0) if rgba is None else QColor.fromRgbF(*map(float, rgba)))
        icon = QIcon(pixels)
        # Qt would tint the colour of the row that is selected.
        icon.addPixmap(pixels, QIcon.Mode.Selected)
        return icon

    # What is done with it

    def keyPressEvent(self, event: Any) -> None:
        """Arrow keys pick rows as the mouse does, letters are the canvas's, Delete is nobody's."""
        if event.key() in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            # The window would give it to the active layer, which would lose its selected points.
            event.accept()
            return
        if event.text() >= " " and self.currentColumn() <= NAME:
            event.ignore()  # the row was clicked to paint with; a name is typed by a double click
            return
        before = self.currentRow()
        super().keyPressEvent(event)
        if self.currentRow() not in (-1, before):
            self.pick(self.labels[self.currentRow()])

    def _on_click(self, row: int, column: int) -> None:
        if column <= NAME:  # in the others somebody may want to type
            self.pick(self.labels[row])
        elif self._layer is not None:
            self._layer.selected_label = self.labels[row]

    def _on_typed(self, item: QTableWidgetItem) -> None:
        """Take over what was typed into a cell, or say why not."""
        row, column = self.rows[item.row()], self.columns[item.column()]
        try:
            after = column.typed(row, item.text().strip())
        except ValueError as error:
            self.refused.emit(f"{error}; kept {column.shown(row)}.")
            after = row
        if after == row:
            self._fill()
        else:
            self.rows = [after if each is row else each for each in self.rows]
