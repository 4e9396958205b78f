"""A curve's plot, and fields that say in numbers what it shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, get_args

import numpy.typing as npt
from psygnal import Signal
from qtpy.QtCore import QSignalBlocker
from qtpy.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QHBoxLayout,
    QLabel,
    QLineEdit,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.stiffness_curve import Between, StiffnessCurve
from napari_hmrf.tissue.surroundings import between_air_and_tissue
from napari_hmrf.ui.curve.plot import CurvePlot

#: Spin boxes need ends.
_FAR = 1e12


class CurveEditor(QWidget):
    """Edits a curve by mouse, keys or numbers.

    Parameters
    ----------
    curve : StiffnessCurve
        To begin with.

    Attributes
    ----------
    plot : CurvePlot
    changed : Signal(StiffnessCurve)
        Emitted with every curve that the user makes, while dragging, too.
    settled : Signal(StiffnessCurve)
        Emitted with the curve when an edit is at its end.
    refused : Signal(str)
        Why something typed was not taken.
    """

    changed = Signal(StiffnessCurve)
    settled = Signal(StiffnessCurve)
    refused = Signal(str)

    def __init__(self, curve: StiffnessCurve) -> None:
        super().__init__()
        self.plot = CurvePlot(curve)
        self.intensity = _number("Of the selected point, in the image's own unit", -_FAR)
        self.stiffness = _number(
            "Young's modulus of tissue of that intensity; any unit, for only ratios matter", 0
        )
        self.unit = QLineEdit()
        self.unit.setPlaceholderText("unit")
        self.unit.setMaximumWidth(52)
        self.unit.setToolTip("The unit of stiffness, such as kPa; shown only")
        self.add = _button("+", "Add a point, halfway to the next")
        self.remove = _button("−", "Remove the selected point (Delete)")
        for button in (self.add, self.remove):
            button.setFixedWidth(28)
        self.void = QCheckBox("no tissue below")
        self.void.setToolTip("What is darker than this, such as air, has stiffness 0")
        self.void_below = _number("Intensity, in the image's own unit", -_FAR)
        self.between = _choice(
            {between: between for between in get_args(Between)},
            "How the points are joined; the smooth line overshoots none",
        )
        self.scale = _choice(
            {True: "logarithmic", False: "linear"},
            "Of stiffness. Logarithmic: by equal factors, as tissues differ; linear: by equal "
            "amounts. It counts between the points, too",
        )
        self.anew = _button(
            "Start anew",
            "The first guess again, from the slice that is shown: the brighter, the stiffer",
        )
        self._assemble()
        self._connect()
        self._show()

    @property
    def curve(self) -> StiffnessCurve:
        """The curve shown; to set it is no edit of the user's."""
        return self.plot.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve) -> None:
        self.plot.curve = curve
        self._show()

    def show_intensities(self, values: npt.NDArray[Any]) -> None:
        """Draw the histogram of an image, shape (H, W), behind the curve."""
        self.plot.show_intensities(values)
        if self.curve.void_below is None:
            # What a first tick says: it is likely, and the dark end of the curve if nothing is.
            air = between_air_and_tissue(values)
            with QSignalBlocker(self.void_below):
                _set(self.void_below, self.curve.points[0][0] if air is None else air)

    def _assemble(self) -> None:
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(3)
        layout.addWidget(self.plot)
        for row in (
            [QLabel("intensity"), self.intensity, QLabel("stiffness"), self.stiffness, self.unit],
            [self.void, self.void_below, self.add, self.remove, self.anew],
            [QLabel("between points"), self.between, QLabel("axis"), self.scale],
        ):
            line = QHBoxLayout()
            for widget in row:
                line.addWidget(widget, int(isinstance(widget, QComboBox | QDoubleSpinBox)))
            layout.addLayout(line)

    def _connect(self) -> None:
        self.plot.edited.connect(self._on_plot)
        self.plot.settled.connect(self.settled.emit)
        self.plot.picked.connect(self._show)
        self.intensity.valueChanged.connect(self._on_point)
        self.stiffness.valueChanged.connect(self._on_point)
        self.add.clicked.connect(self._on_add)
        self.remove.clicked.connect(lambda: self.plot.remove())
        self.void.toggled.connect(self._on_void)
        self.void_below.valueChanged.connect(self._on_void)
        self.between.currentIndexChanged.connect(self._on_choice)
        self.scale.currentIndexChanged.connect(self._on_choice)
        self.unit.editingFinished.connect(self._on_choice)

    def _show(self, *_: Any) -> None:
        """Show in the fields what the plot shows."""
        curve, selected = self.plot.curve, self.plot.selected
        numbers, choices = (self.intensity, self.stiffness), (self.between, self.scale)
        fields = (*numbers, self.void, self.void_below, *choices, self.unit)
        blocked = [QSignalBlocker(field) for field in fields]
        for part, field in enumerate(numbers):
            field.setEnabled(selected is not None)
            if selected is None:
                field.clear()
            else:
                _set(field, curve.points[selected][part])
        self.remove.setEnabled(selected is not None and len(curve.points) > 2)
        self.void.setChecked(curve.void_below is not None)
        self.void_below.setEnabled(curve.void_below is not None)
        if curve.void_below is not None:
            _set(self.void_below, curve.void_below)
        self.between.setCurrentIndex(self.between.findData(curve.between))
        self.scale.setCurrentIndex(self.scale.findData(curve.logarithmic))
        if not self.unit.hasFocus():
            self.unit.setText(curve.unit)
        for blocker in blocked:
            blocker.unblock()

    def _on_plot(self, curve: StiffnessCurve) -> None:
        self._show()
        self.changed.emit(curve)

    def _on_point(self, *_: Any) -> None:
        if self.plot.selected is None:
            return
        stiffness = self.stiffness.value()
        if stiffness <= 0:
            self.refused.emit(
                "Stiffness must be above 0; what is no tissue is said by 'no tissue below'."
            )
        else:
            self.plot.move((self.intensity.value(), stiffness))
        self._show()

    def _on_add(self) -> None:
        """Halfway to the next point, on the curve: nothing changes until it is moved."""
        points, at = self.plot.curve.points, self.plot.selected or 0
        at = min(at, len(points) - 2)
        middle = (points[at][0] + points[at + 1][0]) / 2
        whole = replace(self.plot.curve, void_below=None)
        self.plot.add((middle, float(f"{float(whole(middle)):.3g}")))

    def _on_void(self, *_: Any) -> None:
        below = self.void_below.value() if self.void.isChecked() else None
        self._take(void_below=below)

    def _on_choice(self, *_: Any) -> None:
        self._take(
            between=self.between.currentData(),
            logarithmic=bool(self.scale.currentData()),
            unit=self.unit.text().strip(),
        )

    def _take(self, **values: Any) -> None:
        try:
            curve = replace(self.plot.curve, **values)
        except ProblemError as error:
            self.refused.emit(str(error))
            self._show()
            return
        if curve != self.plot.curve:
            self.curve = curve
            self.changed.emit(curve)
            self.settled.emit(curve)


class _PlainNumber(QDoubleSpinBox):
    """A number without the zeros behind it."""

    def textFromValue(self, value: float) -> str:
        return f"{value:.10g}"


def _number(tooltip: str, least: float) -> QDoubleSpinBox:
    field = _PlainNumber()
    field.setRange(least, _FAR)
    field.setKeyboardTracking(False)
    field.setToolTip(tooltip)
    field.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
    field.setMinimumWidth(50)
    field.setButtonSymbols(QDoubleSpinBox.ButtonSymbols.NoButtons)
    return field


def _button(text: str, tooltip: str) -> QPushButton:
    button = QPushButton(text)
    button.setToolTip(tooltip)
    return button


def _choice(words: Mapping[Any, str], tooltip: str) -> QComboBox:
    box = QComboBox()
    for value, said in words.items():
        box.addItem(said, value)
    box.setToolTip(tooltip)
    box.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
    return box


def _set(field: QDoubleSpinBox, value: float) -> None:
    """Show a number to as many digits as it has."""
    size = 0 if value == 0 else math.floor(math.log10(abs(value)))
    field.setDecimals(min(12, max(0, 4 - size)))
    field.setSingleStep(10.0 ** (size - 1))
    field.setValue(value)
