"""Table of the landmarks: distances from their targets, and editable standard deviations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from qtpy import QtWidgets
from qtpy.QtCore import Qt

from napari_hmrf.tissue.drawing import Landmark
from napari_hmrf.ui.forms import number_of
from napari_hmrf.ui.table_window import Cell, TableWindow

TITLE = "Distance of each landmark from its target"
_COLUMN = 3
_SD_TIP = (
    "Standard deviation of the landmark. 0: exact, for a patch of tissue. Above 0: only the tissue "
    "at the point is moved, and it may miss the target by about this distance, for the elastic "
    "model and large motion. Double-click to change it."
)
_BAR_TIP = (
    "Uncertainty of the result: standard deviation of the displacement of the tissue around the "
    "landmark, along its motion."
)
_NOT_DRAWN = "This pair is not a landmark of the drawing. Press 'Use as landmarks' first."
#: Message for a standard deviation that is not a length, or is larger than the image.
INVALID = (
    "A standard deviation (±) must be from 0 (exact) to {:g} {}, the diagonal of the image; it was "
    "not changed."
)


class LandmarkRow(NamedTuple):
    """Row of the table.

    Attributes
    ----------
    number : int
        Number of the landmark in its layer or in the drawing.
    before, now : float
        Distance from the target before and after the motion.
    mark : Landmark or None
        Landmark in the drawing; None if a pair of a layer is not in the drawing.
    bar : float or None
        Standard deviation of the displacement of the tissue around the landmark, along its motion;
        None if the uncertainty is not estimated.
    """

    number: int
    before: float
    now: float
    mark: Landmark | None
    bar: float | None = None


class LandmarkRows(NamedTuple):
    """Content of the table; all lengths are in `unit`.

    Attributes
    ----------
    rows : list of LandmarkRow
    unit : str
    largest : float
        Largest standard deviation.
    is_outdated : bool
        True if the distances belong to earlier inputs, because the current inputs were refused.
    """

    rows: list[LandmarkRow]
    unit: str
    largest: float = math.inf
    is_outdated: bool = False


class LandmarkTable(TableWindow):
    """Window with the landmarks of the displayed result, updated with each result.

    Parameters
    ----------
    parent : QWidget
        Main window.
    set_sd : callable
        Sets the standard deviation of a landmark.
    refuse : callable
        Called with a message if a typed value is not a length or is too large.
    """

    def __init__(
        self,
        parent: QtWidgets.QWidget,
        set_sd: Callable[[Landmark, float], None],
        refuse: Callable[[str], None],
    ) -> None:
        super().__init__(parent, TITLE)
        self._set_sd, self._refuse = set_sd, refuse
        self._content = LandmarkRows([], "")
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.table.itemChanged.connect(self._on_item)

    def show_rows(self, content: LandmarkRows | None) -> None:
        """Show the landmarks of a result; None shows an empty table."""
        self._content = content = LandmarkRows([], "") if content is None else content
        unit, now = content.unit, "last result" if content.is_outdated else "now"
        titles = ["landmark", f"before ({unit})", f"{now} ({unit})", f"± ({unit})"]
        tips = ["", "", "", _SD_TIP, _BAR_TIP]
        rows = [_cells(row) for row in content.rows]
        self.show_cells([*titles, f"tissue ± ({unit})"], rows, tips)
        self.table.setColumnHidden(_COLUMN + 1, all(row.bar is None for row in content.rows))

    def _on_item(self, item: Any) -> None:
        """Set the typed standard deviation, or restore the previous value if it is invalid."""
        row = self._content.rows[item.row()]
        if item.column() != _COLUMN or row.mark is None:
            return
        value = number_of(item.text().strip().removeprefix("±"))
        largest = self._content.largest
        if 0 <= value <= largest and math.isfinite(value):
            self._set_sd(row.mark, value)
        else:
            self._refuse(INVALID.format(largest, self._content.unit))
            self.show_rows(self._content)


def _cells(row: LandmarkRow) -> list[Cell]:
    spread = Cell("", _NOT_DRAWN)
    if row.mark is not None:
        spread = Cell(f"{row.mark.sd:g}", _SD_TIP, is_edited=True)
    bar = "" if row.bar is None else f"{row.bar:.2g}"
    number, before, now = f"{row.number}", f"{row.before:.3g}", f"{row.now:.3g}"
    return [Cell(number), Cell(before), Cell(now), spread, Cell(bar)]
