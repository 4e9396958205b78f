"""A window with what happened to each tissue, in numbers."""

from __future__ import annotations

from collections.abc import Sequence

from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QDialog,
    QPushButton,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from napari_hmrf.field.measurement import Measurement

#: What is above each column, and what of a `Measurement` is in it.
_COLUMNS = {
    "tissue": "name",
    "label": "label",
    "area ({unit}²)": "area",
    "area change (%)": "area_change",
    "moved, mean ({unit})": "mean_displacement",
    "moved, most ({unit})": "largest_displacement",
    "strain, mean (%)": "mean_strain",
    "strain, most (%)": "largest_strain",
    "folds (px)": "folds",
}


class MeasurementTable(QDialog):
    """A table that stays as it was when it was opened.

    Parameters
    ----------
    parent : QWidget
    rows : sequence of Measurement
    unit : str
        Of lengths.

    Attributes
    ----------
    save : QPushButton
    """

    def __init__(self, parent: QWidget, rows: Sequence[Measurement], unit: str) -> None:
        super().__init__(parent)
        self.setWindowTitle("What happened to each tissue")
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        table = QTableWidget(len(rows), len(_COLUMNS))
        table.setObjectName("measurements")
        table.setHorizontalHeaderLabels([title.format(unit=unit) for title in _COLUMNS])
        table.verticalHeader().hide()
        table.setEditTriggers(table.EditTrigger.NoEditTriggers)
        for number, row in enumerate(rows):
            for column, name in enumerate(_COLUMNS.values()):
                value = getattr(row, name)
                table.setItem(number, column, QTableWidgetItem(_in_words(value)))
        table.resizeColumnsToContents()
        self.save = QPushButton("Save .csv ...")
        layout = QVBoxLayout(self)
        layout.addWidget(table)
        layout.addWidget(self.save, alignment=Qt.AlignmentFlag.AlignRight)
        self.resize(table.horizontalHeader().length() + 40, 100 + 32 * (len(rows) + 1))


def _in_words(value: float | int | str) -> str:
    """Four digits; of large areas all before the point."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value)
