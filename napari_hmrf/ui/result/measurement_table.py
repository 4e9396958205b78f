"""A window with what happened to each tissue, in numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QDialog,
    QLabel,
    QPushButton,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from napari_hmrf.field.measurement import Measurement
from napari_hmrf.field.units import as_seen
from napari_hmrf.ui.messages import HANDFUL

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
_FEW_FOLDS = f"Up to {HANDFUL} folds in all are taken for rounding, of which nothing warns."


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
                table.setItem(number, column, QTableWidgetItem(_in_words(row, name)))
        table.resizeColumnsToContents()
        self.save = QPushButton("Save .csv ...")
        layout = QVBoxLayout(self)
        layout.addWidget(table)
        if 0 < sum(row.folds for row in rows) <= HANDFUL:
            layout.addWidget(QLabel(_FEW_FOLDS))
        layout.addWidget(self.save, alignment=Qt.AlignmentFlag.AlignRight)
        self.resize(table.horizontalHeader().length() + 40, 100 + 32 * (len(rows) + 1))


def _in_words(row: Measurement, name: str) -> str:
    """Four digits; of large areas all before the point, and nothing of what nobody sees."""
    value = getattr(row, name)
    if not isinstance(value, float):
        return str(value)
    if name != "area":
        pixel = math.sqrt(row.area / row.pixels)
        value = as_seen(value, [pixel if name.endswith("displacement") else 1.0])
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
