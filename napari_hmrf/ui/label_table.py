"""Tables with a row for each label of a Labels layer, in step with what is painted there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

from napari.layers import Labels
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

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.metadata import BOUNDARY, Role, Table
from napari_hmrf.layers.pixel_copy import CHANGES, copy_slice
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.tissue.boundary_rules import unlisted
from napari_hmrf.ui.events import Listening, single_shot
from napari_hmrf.ui.forms import WholeEntries

#: The columns that every table has.
LABEL, NAME = range(2)
#: How long after the last brush stroke the labels are looked at, in milliseconds.
_PAUSE = 150
#: The layer's events after which there may be new labels, or other colours.
_EVENTS = (*CHANGES, "colormap")
_ROLE = Qt.ItemDataRole
#: Rows that are seen without scrolling.
_ROWS_SHOWN = 5
_ROW_HEIGHT = 26


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
    applies : bool
        Whether it is of any consequence; else it is not seen.
    """

    title: str
    about: str
    shown: Callable[[Any], str]
    typed: Callable[[Any, str], Any] = lambda row, text: row
    tip: Callable[[Any], str] = lambda row: ""
    choices: Sequence[str] = ()
    applies: bool = True


class LabelTable(QAbstractTableModel):
    """Rows by label, with its colour and its name; what the other columns hold is up to subclasses.

    A layer carries its table in its metadata, so that it goes where the layer goes. New labels that
    are painted get rows, and a row that is picked is painted with.

    Parameters
    ----------
    role : "tissue" or "boundary"
    view : callable
        Which slice is shown.
    title : str
        Of the column of names.
    columns : sequence of Column
        Those beyond label and name.
    default : callable
        The row of a label that was not there before.
    words : callable
        What a row says, in words.
    about : callable
        What there is to say of a row beside its name.

    Signals
    -------
    changed : bool, the paint or the table changed; whether by nobody's hand, as for new paint
    picked : the layer, a row of which is to be painted with
    marked : int or None, the label whose row is to be selected, without painting with it
    found : str, what new labels were painted
    refused : str, why something typed was not taken
    """

    changed = Signal(bool)
    picked = Signal(object)
    marked = Signal(object)
    found = Signal(str)
    refused = Signal(str)

    def __init__(
        self,
        role: Role,
        view: Callable[[], View | None],
        title: str,
        columns: Sequence[Column],
        default: Callable[[int], Any],
        words: Callable[[Any], str],
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
        self.role, self._view = role, view
        self._default, self._words = default, words
        self._contents = Table(())
        self._layer: Any = None
        self._active = False
        self._heard = Listening()
        self._timer = single_shot(self, _PAUSE, self.look)

    # What is in it

    @property
    def contents(self) -> Table:
        """All that it says, as one value; to be set, too."""
        return self._contents

    @contents.setter
    def contents(self, contents: Table) -> None:
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

    def add(self, row: Callable[[int], Any] | None = None) -> int:
        """Add what `row` makes of the next free label; by default what a new label gets."""
        label = max([0, *self.labels]) + 1
        self.rows = [*self.rows, (row or self._default)(label)]
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
        self._show(Table.of(layer, self.role))
        self._list_painted()
        self._heard = Listening(
            (layer.events.selected_label, self._mark),
            *((getattr(layer.events, name), self._on_painted) for name in _EVENTS),
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
        if new := self._list_painted():
            said = " and ".join(f"label {row.label} ({self._words(row)})" for row in new[:3])
            self.found.emit(f"New in '{self._layer.name}': {said}. Change it in the table.")
        self.dataChanged.emit(self.index(0, LABEL), self.index(len(self.rows) - 1, LABEL))
        self._tell(by_itself=True)

    def pick(self, label: int) -> None:
        """Have a label be painted with."""
        if self._layer is not None:
            self._layer.selected_label = label
            self.picked.emit(self._layer)

    def mark(self, active: Any) -> None:
        """Highlight the row that is painted with, if the layer is the active one; else none."""
        self._active = self._layer is not None and active is self._layer
        self._mark()

    def _mark(self, *_: Any) -> None:
        self.marked.emit(int(self._layer.selected_label) if self._active else None)

    def _list_painted(self) -> list[Any]:
        """Give each label of the slice a row; those that are new, none if it cannot be read."""
        try:
            picture = copy_slice(self._layer, frame_of(self._layer, self._view()))
        except ProblemError:
            return []
        labels = unlisted(picture, self.rows)
        new = [self._default(each) for each in labels if each > 0 or self.role != BOUNDARY]
        if new:
            self._show(self._contents._replace(rows=(*self.rows, *new)))
        return new

    def _show(self, contents: Table) -> None:
        rows = tuple(sorted(contents.rows, key=lambda row: int(row.label)))
        others = tuple(row.label for row in rows) != self.labels
        if others:
            self.beginResetModel()
        self._contents = contents._replace(rows=rows)
        if others:
            self.endResetModel()
        else:
            self.dataChanged.emit(
                self.index(0, 0), self.index(len(rows) - 1, len(self.columns) - 1)
            )

    def _tell(self, by_itself: bool) -> None:
        """Have the layer carry the table, and say what changed."""
        if self._layer is not None:
            self._contents.give_to(self._layer, self.role)
            self.changed.emit(by_itself)

    def _on_painted(self, *_: Any) -> None:
        # Restarted at every stroke: looking at a large image takes longer than a stroke.
        self._timer.start()

    # What Qt asks

    def set_column(self, column: int, **parts: Any) -> None:
        """Give a column another head, or say whether it applies."""
        head = self.columns[column]._replace(**parts)
        if head != self.columns[column]:  # Qt measures the columns anew
            self.columns[column] = head
            self.headerDataChanged.emit(Qt.Orientation.Horizontal, column, column)

    def rowCount(self, parent: Any = None) -> int:
        """How many rows there are."""
        return len(self.rows)

    def columnCount(self, parent: Any = None) -> int:
        """How many columns there are."""
        return len(self.columns)

    def headerData(self, section: int, orientation: Any, role: int = _ROLE.DisplayRole) -> Any:
        """What the head of a column says."""
        head = self.columns[section]
        return {_ROLE.DisplayRole: head.title, _ROLE.ToolTipRole: head.about}.get(role)

    def data(self, index: Any, role: int = _ROLE.DisplayRole) -> Any:
        """What a cell says, and how it looks."""
        row, column = self.rows[index.row()], self.columns[index.column()]
        if role in (_ROLE.DisplayRole, _ROLE.EditRole):
            return column.shown(row)
        if role == _ROLE.ToolTipRole:
            return column.tip(row)
        if role == _ROLE.TextAlignmentRole and index.column() > NAME:
            return Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter
        if role == _ROLE.DecorationRole and index.column() == LABEL:
            return self._swatch(int(row.label))
        return None

    def flags(self, index: Any) -> Any:
        """Whether a cell can be typed in."""
        column, flags = index.column(), super().flags(index)
        typed = column == NAME or (column > NAME and self.data(index))
        return flags | Qt.ItemFlag.ItemIsEditable if typed else flags

    def setData(self, index: Any, value: Any, role: int = _ROLE.EditRole) -> bool:
        """Take over what was typed into a cell, or say why not."""
        row, column = self.rows[index.row()], self.columns[index.column()]
        try:
            after = column.typed(row, str(value).strip())
        except ValueError as error:
            self.refused.emit(f"{error}; kept {column.shown(row)}.")
            return False
        if after != row:
            self.rows = [after if each is row else each for each in self.rows]
        return True

    def _swatch(self, label: int) -> QIcon:
        rgba = self._layer.get_color(label) if label and self._layer is not None else None
        pixels = QPixmap(14, 14)
        pixels.fill(QColor(0, 0, 0, 0) if rgba is None else QColor.fromRgbF(*map(float, rgba)))
        icon = QIcon(pixels)
        # Qt would tint the colour of the row that is selected.
        icon.addPixmap(pixels, QIcon.Mode.Selected)
        return icon


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
