"""Editor for a stiffness curve: a plot, and fields with the same curve as text."""

from __future__ import annotations

from typing import get_args

import numpy as np
from magicgui.widgets import LineEdit, PushButton
from psygnal import Signal

from napari_hmrf.tissue.stiffness_curve import Between, Point, StiffnessCurve
from napari_hmrf.ui.curve.plot import CurvePlot
from napari_hmrf.ui.forms import Form, attempt, menu, number_of, show_quietly

_JOINED = {
    (between, scale == "logarithmic"): f"{between}, {scale}"
    for scale in ("logarithmic", "linear")
    for between in get_args(Between)
}


class CurveEditor(Form):
    """Editor for a stiffness curve; the user drags or types the points.

    Parameters
    ----------
    curve : StiffnessCurve
        Initial curve.

    Attributes
    ----------
    plot : CurvePlot
        Plot of the curve; emits its signals for all edits, including typed edits.
    points, void_below, unit : LineEdit
    joined : ComboBox
    guess : PushButton
        Button that replaces the curve with a first guess; the owner sets the callback.
    refusal : Signal(str)
        Reason why typed text was refused.
    """

    refusal = Signal(str)

    def __init__(self, curve: StiffnessCurve) -> None:
        self.plot = CurvePlot(curve)
        tip = (
            "Pairs of intensity (in the unit of the image) and stiffness (relative, or a Young's "
            "modulus), such as 10: 1; 50: 2"
        )
        self.points = LineEdit(label="points", tooltip=tip)
        tip = "Darker pixels, such as air, have stiffness 0; if empty, all pixels are tissue"
        self.void_below = LineEdit(label="no tissue below", tooltip=tip)
        tip = (
            "Interpolation between the points: straight, or smooth without overshoot, on a "
            "logarithmic or linear stiffness scale"
        )
        self.joined = menu("interpolation", _JOINED, tip)
        tip = "Unit of measured stiffness, such as kPa; for display only"
        self.unit = LineEdit(label="unit", tooltip=tip)
        tip = "Replace the curve with a first guess from the visible slice: brighter is stiffer"
        self.guess = PushButton(text="First guess", tooltip=tip)
        super().__init__([self.points, self.void_below, self.joined, self.unit, self.guess])
        self.native.layout().insertWidget(0, self.plot)
        self.plot.edited.connect(self._show)
        for field in (self.points, self.void_below, self.unit):
            field.native.editingFinished.connect(self._on_field)
        self.joined.changed.connect(self._on_field, max_args=0)
        self._show()

    @property
    def curve(self) -> StiffnessCurve:
        """Displayed curve; setting it does not emit the signals of the plot."""
        return self.plot.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve) -> None:
        self.plot.curve = curve
        self._show()

    def _show(self) -> None:
        """Show the plot's curve in the fields."""
        curve, below = self.curve, self.curve.void_below
        pairs = [f"{_digits(at)}: {_digits(stiffness)}" for at, stiffness in curve.points]
        self.points.value = "; ".join(pairs)
        self.void_below.value = "" if below is None else _digits(below)
        self.unit.value = curve.unit
        show_quietly(self.joined, (curve.between, curve.logarithmic))

    def _on_field(self) -> None:
        attempt(self._read_fields, self.refusal.emit)
        self._show()

    def _read_fields(self) -> None:
        """Set the curve from the text of the fields."""
        points = sorted(map(_point, self.points.value.split(";")))
        below, (between, logarithmic) = self.void_below.value.strip(), self.joined.value
        self.plot.apply_edit(
            StiffnessCurve(
                tuple(points),
                void_below=number_of(below) if below else None,
                between=between,
                logarithmic=logarithmic,
                unit=self.unit.value.strip(),
            )
        )


def _point(text: str) -> Point:
    intensity, _, stiffness = text.partition(":")
    return number_of(intensity), number_of(stiffness)


def _digits(number: float) -> str:
    """Format a number with the fewest digits that parse back to the same number."""
    return np.format_float_positional(number, trim="-")
