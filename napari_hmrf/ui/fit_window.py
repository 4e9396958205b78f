"""Window that lists the properties of the tissues, to be fitted to the second image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from qtpy import QtWidgets
from qtpy.QtCore import Qt

from napari_hmrf.posterior.fit import Fit
from napari_hmrf.posterior.study_fit import value_in_words
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.ui.table_window import Cell, TableWindow

TITLE = "Fit to second image"
_ABOUT = (
    "Tick what is unknown, and press Fit. The values are then found with which the image moves to "
    "the second image, with intervals of 95 %. What is not ticked, held and pulled tissue, and "
    "forces, are used as they are."
)
_RATIOS = "Only ratios of stiffness have an effect: leave at least one tissue unticked"
#: Message if no property is ticked.
NOTHING = "Tick at least one property."
# Smallest width of the window, in pixels.
_WIDTH = 440


class FitColumn(NamedTuple):
    """Column of the window: a property of tissue.

    Attributes
    ----------
    name : {"growth", "stiffness", "poisson"}
        Attribute of `Material` and of `Fit`.
    title : str
    factor : float
        Factor from the value to the displayed number.
    tip : str
    """

    name: str
    title: str
    factor: float = 1.0
    tip: str = ""


COLUMNS = (
    FitColumn("growth", "grows (%)", 100.0, "Growth in length of free tissue"),
    FitColumn("stiffness", "stiffness", tip=_RATIOS),
    FitColumn("poisson", "Poisson's ratio"),
)


class FitWindow(TableWindow):
    """Window with a row for each tissue and a box for each property.

    Parameters
    ----------
    parent : QWidget
        Main window.
    start, cancel : callable
        Called when the user presses **Fit**, or **Cancel** during a fit. Otherwise, this button is
        **Close**.

    Attributes
    ----------
    start : callable
        The argument.
    """

    def __init__(
        self,
        parent: QtWidgets.QWidget,
        start: Callable[[], object],
        cancel: Callable[[], object],
    ) -> None:
        self.start, self._cancel = start, cancel
        self._rows: list[Material] = []
        self._fit, self._end = QtWidgets.QPushButton("Fit"), QtWidgets.QPushButton()
        self._fit.clicked.connect(lambda _: start())
        self._end.clicked.connect(self._on_end)
        self._outcome = QtWidgets.QLabel(wordWrap=True)
        about, below = QtWidgets.QLabel(_ABOUT, wordWrap=True), QtWidgets.QWidget()
        about.setMinimumWidth(_WIDTH)
        buttons = QtWidgets.QHBoxLayout(below)
        buttons.setContentsMargins(0, 0, 0, 0)
        buttons.addStretch()
        for button in (self._fit, self._end):
            button.setAutoDefault(False)
            buttons.addWidget(button)
        super().__init__(parent, TITLE, [about], [self._outcome, below], height=190)
        self.table.setAccessibleName("Properties to fit")
        self.show_busy(False)

    def show_rows(
        self, rows: Iterable[Material], ticked: Mapping[str, set[int]], found: Fit | None
    ) -> None:
        """Show tissues with their properties.

        Parameters
        ----------
        rows : iterable of Material
            Deformable tissues.
        ticked : mapping of str to set of int
            Labels whose boxes are ticked, by property.
        found : Fit or None
            Fit to which the values belong, for the intervals; None if there is none.
        """
        self._rows = [*rows]
        titles = ["tissue", *(each.title for each in COLUMNS)]
        cells = [
            [
                Cell(row.name or f"label {row.label}"),
                *(_cell(row, each, ticked, found) for each in COLUMNS),
            ]
            for row in self._rows
        ]
        self.show_cells(titles, cells)

    def tick(self, label: int, name: str) -> None:
        """Check the box of a property of a tissue."""
        (row,) = [number for number, each in enumerate(self._rows) if each.label == label]
        (column,) = [place for place, each in enumerate(COLUMNS, 1) if each.name == name]
        item = self.table.item(row, column)
        assert item is not None
        item.setCheckState(Qt.CheckState.Checked)

    @property
    def ticked(self) -> dict[str, set[int]]:
        """Labels whose boxes are ticked, by property."""
        found: dict[str, set[int]] = {column.name: set() for column in COLUMNS}
        for number, row in enumerate(self._rows):
            for place, column in enumerate(COLUMNS, 1):
                item = self.table.item(number, place)
                if item is not None and item.checkState() == Qt.CheckState.Checked:
                    found[column.name].add(row.label)
        return found

    def show_outcome(self, text: str) -> None:
        """Show the outcome of the last fit, or the reason why there is none."""
        self._outcome.setText(text)

    def show_busy(self, is_busy: bool) -> None:
        """Offer **Fit** and **Close**, or **Cancel** during a fit."""
        self._fit.setEnabled(not is_busy)
        self._end.setText("Cancel" if is_busy else "Close")

    def _on_end(self, *_: object) -> None:
        """Cancel the fit that is running, or close the window."""
        if self._fit.isEnabled():
            self.close()
        else:
            self._cancel()


def _cell(
    row: Material, column: FitColumn, ticked: Mapping[str, set[int]], found: Fit | None
) -> Cell:
    """Return a box with the value of a property, and its interval if it was fitted."""
    fitted: Mapping[int, Any] = {} if found is None else getattr(found, column.name)
    value = getattr(row, column.name)
    if row.label in fitted:
        text = value_in_words(fitted[row.label], column.factor)
    elif isinstance(value, tuple):
        text = " / ".join(f"{column.factor * part:.4g}" for part in value)
    else:
        text = f"{column.factor * value:.4g}"
    return Cell(text, column.tip, is_ticked=row.label in ticked.get(column.name, ()))
