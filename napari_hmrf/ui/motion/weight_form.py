"""The weight of tissue: which way all of it is pulled, and how strongly."""

from __future__ import annotations

from magicgui.widgets import ComboBox, Container, FloatSpinBox

from napari_hmrf.field.directions import Directions
from napari_hmrf.ui.forms import narrow

#: Water's, in kPa / mm.
_WATER = 0.00981
_NOWHERE = ("nowhere", ())


class WeightForm(Container):
    """A direction, and a force per volume along it.

    Attributes
    ----------
    way : ComboBox
        A step in the order of the axes of the image; () where tissue has no weight.
    amount : FloatSpinBox
        In the unit of stiffness per length.
    """

    def __init__(self) -> None:
        self.way = ComboBox(
            name="way",
            choices=[_NOWHERE],
            label="weight pulls",
            tooltip="All tissue by its weight, as in an open skull; it has to be held somewhere",
        )
        narrow(self.way)
        self.amount = FloatSpinBox(
            name="amount",
            max=1e6,
            step=0.001,
            tooltip=f"Density times acceleration. That of water is {_WATER} kPa / mm",
        )
        super().__init__(widgets=[self.way, self.amount])
        self.amount.native.setDecimals(5)
        self.amount.value = _WATER
        self.amount.native.setKeyboardTracking(False)  # "0." is no weight yet
        self.margins = (0, 0, 0, 0)
        self.way.changed.connect(self._show)
        self.show_place("px", Directions(), "")

    @property
    def vector(self) -> tuple[float, ...]:
        """What pulls at each part of tissue, in the order of the axes; () if nothing does."""
        return tuple(self.amount.value * step for step in self.way.value)

    @vector.setter
    def vector(self, vector: tuple[float, ...]) -> None:
        size = float(sum(part * part for part in vector)) ** 0.5
        step = tuple(part / size for part in vector) if size else ()
        if step not in self.way.choices:
            self.way.choices = [*self.way.choices, step]
        self.way.value, self.amount.value = step, size or self.amount.value

    def show_place(self, unit: str, ways: Directions, stiffness: str) -> None:
        """Offer the ways of the screen or the patient, and say in which unit it is."""
        before = self.way.value
        with self.way.changed.blocked():
            self.way.choices = [_NOWHERE, *ways.steps]
            self.way.value = before if before in self.way.choices else ()
        self.amount.label = f"{stiffness or 'stiffness'} / {unit}"
        self._show()

    def _show(self, *_: object) -> None:
        self.amount.visible = bool(self.way.value)
