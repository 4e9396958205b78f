"""Forms for loads: the weight of tissue, and what presses on the surface of a cavity."""

from __future__ import annotations

import math

from magicgui.widgets import ComboBox

from napari_hmrf.field.directions import Directions
from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.ui.forms import Form, menu, narrow, number, show_value

#: Weight of water per unit volume, in kPa / mm.
_WATER = 0.00981
#: Largest pressure or weight that can be typed; a study from a file may have a larger value.
_LARGEST = 1000.0
#: Largest level that can be typed, in per cent of the height of the cavity.
_HIGHEST = 1000.0
_PER_CENT = 100.0
#: Contents of the cavity: whether there is a pressure, and whether there is a fluid.
_CONTENTS = {
    (False, False): "nothing",
    (False, True): "fluid",
    (True, False): "pressure",
    (True, True): "fluid and pressure",
}
Step = tuple[float, ...]


class WeightForm(Form):
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
        self.amount = number(
            "",
            f"Weight per unit volume (density times acceleration); for water, {_WATER} kPa / mm. "
            f"From 0 to {_LARGEST:g}.",
            decimals=5,
            max=_LARGEST,
            step=0.001,
            value=_WATER,
        )
        super().__init__([self.way, self.amount])
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
        show_value(self.amount, size or self.amount.value)

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


class CavityForm(Form):
    """Form for the pressure and the fluid in a cavity.

    Attributes
    ----------
    contents : ComboBox
        Contents of the cavity: (True if there is a pressure, True if there is a fluid).
    pressure : FloatSpinBox
        Pressure in the unit of stiffness; negative values are suction.
    fluid : FloatSpinBox
        Weight of the fluid per volume, in units of stiffness per length.
    level : FloatSpinBox
        Level of the fluid, in per cent of the height of the cavity.
    value : Cavity
        Load on the surface of the cavity.
    """

    def __init__(self) -> None:
        self.contents = menu(
            "cavity",
            dict(_CONTENTS),
            "Contents of the cavity where tissue is removed ('Resect', or the action 'removed'), "
            "which press on its surface; a fluid requires the direction of gravity",
        )
        self.pressure = number(
            "",
            "Force per area on the surface of the cavity; negative: suction",
            decimals=4,
            min=-_LARGEST,
            max=_LARGEST,
            step=0.01,
            value=0.1,
        )
        self.fluid = number(
            "",
            f"Weight of the fluid per unit volume; for water, {_WATER} kPa / mm",
            decimals=5,
            max=_LARGEST,
            step=0.001,
            value=_WATER,
        )
        self.level = number(
            "level %",
            "Level of the fluid, in per cent of the height of the cavity",
            decimals=1,
            max=_HIGHEST,
            step=5.0,
            value=_PER_CENT,
        )
        super().__init__([self.contents, self.pressure, self.fluid, self.level])
        self.contents.changed.connect(self._show)
        self.show_place("px", "")

    @property
    def value(self) -> Cavity:
        """Load on the surface of the cavity."""
        is_pressed, is_filled = self.contents.value
        return Cavity(
            pressure=self.pressure.value if is_pressed else 0.0,
            fluid=self.fluid.value if is_filled else 0.0,
            level=self.level.value / _PER_CENT if is_filled else Cavity.level,
        )

    @value.setter
    def value(self, cavity: Cavity) -> None:
        self.contents.value = (bool(cavity.pressure), bool(cavity.fluid))
        if cavity.pressure:
            show_value(self.pressure, cavity.pressure)
        if cavity.fluid:
            show_value(self.fluid, cavity.fluid)
            show_value(self.level, _PER_CENT * cavity.level)

    def show_place(self, unit: str, stiffness: str) -> None:
        """Show the units of pressure and weight, given the units of length and stiffness."""
        self.pressure.label = f"pressure {stiffness or 'relative'}"
        self.fluid.label = f"fluid {stiffness or 'relative'} / {unit}"
        self._show()

    def _show(self, *_: object) -> None:
        is_pressed, is_filled = self.contents.value
        self.pressure.visible = is_pressed
        self.fluid.visible = self.level.visible = is_filled
