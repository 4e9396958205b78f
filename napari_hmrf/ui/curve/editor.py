"""A curve's plot, and fields that say in numbers what it shows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy.typing as npt
from psygnal import Signal
from qtpy import QtWidgets

from napari_hmrf.tissue.stiffness_curve import Between, StiffnessCurve
from napari_hmrf.tissue.surroundings import void_threshold
from napari_hmrf.ui.curve.plot import CurvePlot
from napari_hmrf.ui.forms import menu

#: Spin boxes need ends.
_FAR = 1e12


class CurveEditor(QtWidgets.QWidget):
    """Edits a curve by mouse, keys or numbers.

    Parameters
    ----------
    curve : StiffnessCurve
        To begin with.

    Attributes
    ----------
    plot : CurvePlot
        Which tells of edits.
    refused : Signal(str)
        Why something typed was not taken.
    """

    refused = Signal(str)

    def __init__(self, curve: StiffnessCurve) -> None:
        super().__init__()
        self.plot = CurvePlot(curve)
        self.intensity = _Number(-_FAR, "Of the selected point, in the image's own unit")
        self.stiffness = _Number(
            0, "Of tissue of that intensity: how stiff beside the rest, or a Young's modulus"
        )
        tip = "The unit, such as kPa, where stiffnesses are measured ones; shown only"
        self.unit = QtWidgets.QLineEdit(placeholderText="unit", toolTip=tip)
        self.unit.setFixedWidth(30)  # the dock is narrow
        self.unit.setStyleSheet("padding: 0")
        tip = "Add a point, halfway to the next"
        self.add = QtWidgets.QPushButton("+", maximumWidth=28, toolTip=tip)
        tip = "Remove the selected point (Delete)"
        self.remove = QtWidgets.QPushButton("−", maximumWidth=28, toolTip=tip)
        tip = "What is darker than this, such as air, has stiffness 0"
        self.void = QtWidgets.QCheckBox("no tissue below", toolTip=tip)
        self.void_below = _Number(-_FAR, "Intensity, in the image's own unit")
        tip = "How the points are joined; the smooth line overshoots none"
        self.between = menu("joined", {each: each for each in get_args(Between)}, tip)
        tip = (
            "Of stiffness. Logarithmic: by equal factors, as tissues differ; linear: by equal "
            "amounts. It counts between the points, too"
        )
        self.scale = menu("axis", {True: "logarithmic", False: "linear"}, tip)
        tip = "The first guess again, from the slice that is shown: the brighter, the stiffer"
        self.anew = QtWidgets.QPushButton("Anew", toolTip=tip)
        self._showing = False
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
            air = void_threshold(values)
            self.void_below.show_value(self.curve.points[0][0] if air is None else air)

    def _assemble(self) -> None:
        layout, label = QtWidgets.QVBoxLayout(self), QtWidgets.QLabel
        layout.setContentsMargins(0, 0, 0, 0)
        layout.setSpacing(3)
        layout.addWidget(self.plot)
        wide = QtWidgets.QComboBox | QtWidgets.QDoubleSpinBox
        for row in (
            [label("intensity"), self.intensity, label("stiffness"), self.stiffness, self.unit],
            [self.void, self.void_below, self.add, self.remove, self.anew],
            [label("joined"), self.between.native, label("axis"), self.scale.native],
        ):
            line = QtWidgets.QHBoxLayout()
            for widget in row:
                # What has the longer words is the wider.
                line.addWidget(widget, widget.sizeHint().width() * isinstance(widget, wide))
                if isinstance(widget, wide):
                    policy = widget.sizePolicy().Policy
                    widget.setSizePolicy(policy.Ignored, policy.Fixed)
            layout.addLayout(line)

    def _connect(self) -> None:
        for told in (self.plot.edited, self.plot.picked):
            told.connect(self._show)
        for field in (self.intensity, self.stiffness):
            field.valueChanged.connect(self._on_point)
        for told in (self.void.toggled, self.void_below.valueChanged):
            told.connect(self._on_void)
        for box in (self.between, self.scale):
            box.changed.connect(self._on_choice)
        self.unit.editingFinished.connect(self._on_choice)
        self.add.clicked.connect(self._on_add)
        self.remove.clicked.connect(lambda: self.plot.remove())

    def _show(self, *_: Any) -> None:
        """Show in the fields what the plot shows."""
        curve, at, edge = self.plot.curve, self.plot.selected, self.plot.curve.void_below
        self._showing = True
        for part, field in enumerate((self.intensity, self.stiffness)):
            field.setEnabled(at is not None)
            field.show_value(None if at is None else curve.points[at][part])
        self.remove.setEnabled(at is not None and len(curve.points) > 2)
        self.void.setChecked(edge is not None)
        self.void_below.setEnabled(edge is not None)
        if edge is not None:
            self.void_below.show_value(edge)
        self.between.value, self.scale.value = curve.between, curve.logarithmic
        if not self.unit.hasFocus():
            self.unit.setText(curve.unit)
        self._showing = False

    def _on_point(self, *_: Any) -> None:
        if self.plot.selected is None or self._showing:
            return
        if (stiffness := self.stiffness.value()) > 0:
            self.plot.move((self.intensity.value(), stiffness))
        else:
            self.refused.emit(
                "Stiffness must be above 0; what is no tissue is said by 'no tissue below'."
            )
        self._show()

    def _on_add(self) -> None:
        """Halfway to the next point, on the curve: nothing changes until it is moved."""
        points = self.curve.points
        at = min(self.plot.selected or 0, len(points) - 2)
        middle = (points[at][0] + points[at + 1][0]) / 2
        whole = replace(self.curve, void_below=None)
        self.plot.add((middle, float(f"{float(whole(middle)):.3g}")))

    def _on_void(self, *_: Any) -> None:
        self._take(void_below=self.void_below.value() if self.void.isChecked() else None)

    def _on_choice(self, *_: Any) -> None:
        between, logarithmic = self.between.value, self.scale.value
        self._take(between=between, logarithmic=logarithmic, unit=self.unit.text().strip())

    def _take(self, **values: Any) -> None:
        if not self._showing:
            self.plot.take(replace(self.curve, **values))


class _Number(QtWidgets.QDoubleSpinBox):
    """A number without the zeros behind it."""

    def __init__(self, least: float, tooltip: str) -> None:
        super().__init__(keyboardTracking=False, toolTip=tooltip, decimals=12)
        self.setStyleSheet("min-width: 50px")  # napari's are wider, and the dock is narrow
        self.setRange(least, _FAR)
        self.setStepType(self.StepType.AdaptiveDecimalStepType)
        self.setButtonSymbols(self.ButtonSymbols.NoButtons)

    def textFromValue(self, value: float) -> str:
        return f"{value:.10g}"

    def show_value(self, value: float | None) -> None:
        """Show a number; None: nothing."""
        if value is None:
            self.clear()
        else:
            self.setValue(value)
