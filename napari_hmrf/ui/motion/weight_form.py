"""Form for the weight of tissue: direction and magnitude of a body force."""

from __future__ import annotations

import math

from magicgui.widgets import ComboBox, Container, FloatSpinBox

from napari_hmrf.field.directions import Directions
from napari_hmrf.ui.forms import narrow

#: Weight of water per unit volume, in kPa / mm.
_WATER = 0.00981
#: Largest weight that can be typed; a study from a file may have a larger weight.
_LARGEST = 1000.0
Step = tuple[float, ...]


class WeightForm(Container):
    """Form for the direction and magnitude of a force per unit volume.

    Attributes
    ----------
    way : ComboBox
        Unit vector in the order of the image axes; () if tissue has no weight.
    amount : FloatSpinBox
        Force per unit volume, in units of stiffness per length.
    value : tuple of float
        Force per unit volume as a vector, in the order of the image axes; () if there is no force.
    """

    def __init__(self) -> None:
        self._ways = Directions()
        self._step: Step = ()
        self.way = ComboBox(
            name="way",
            choices=self._offered,
            label="gravity",
            tooltip="Direction of the weight of all tissue, as in an open skull; some tissue must "
            "be held in place",
        )
        narrow(self.way)
        tip = f"Weight per unit volume (density times acceleration); for water, {_WATER} kPa / mm. "
        tip += f"From 0 to {_LARGEST:g}."
        self.amount = FloatSpinBox(name="amount", max=_LARGEST, step=0.001, tooltip=tip)
        super().__init__(widgets=[self.way, self.amount])
        self.amount.native.setDecimals(5)
        self.amount.native.setKeyboardTracking(False)  # "0." is not a complete number
        self.amount.value = _WATER
        self.margins = (0, 0, 0, 0)
        self.way.changed.connect(self._show)
        self.show_place("px", self._ways, "")

    @property
    def value(self) -> Step:
        """Force per unit volume, in the order of the image axes; () if there is no force."""
        return tuple(self.amount.value * step for step in self.way.value)

    @value.setter
    def value(self, vector: Step) -> None:
        size = math.hypot(*vector)
        self._choose(tuple(part / size for part in vector) if size else ())
        self.amount.max = max(self.amount.max, size)
        self.amount.value = size or self.amount.value

    def show_place(self, unit: str, ways: Directions, stiffness: str) -> None:
        """Show the unit of the force, and the directions on the screen or in the patient.

        The direction relative to the tissue does not change if the image is turned.
        """
        self.amount.label = f"{stiffness or 'relative'} / {unit}"
        if ways != self._ways:
            self._ways, before = ways, self.way.value
            with self.way.changed.blocked():
                self._choose(before if len(before) == len(ways.order) else ())
        self._show()

    def _choose(self, step: Step) -> None:
        self._step = self._ways.nearest(step)
        self.way.reset_choices()
        self.way.value = self._step

    def _offered(self, _: ComboBox) -> list[tuple[str, Step]]:
        return [("off", ()), *self._ways.steps_with(self._step)]

    def _show(self, *_: object) -> None:
        self.amount.visible = bool(self.way.value)
