"""Form for the load on the cavity that remains where tissue is removed."""

from __future__ import annotations

from magicgui.widgets import Container, FloatSpinBox

from napari_hmrf.tissue.cavity import Cavity
from napari_hmrf.ui.forms import menu

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


class CavityForm(Container):
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
        self.pressure = FloatSpinBox(
            min=-_LARGEST,
            max=_LARGEST,
            step=0.01,
            value=0.1,
            tooltip="Force per area on the surface of the cavity; negative: suction",
        )
        self.fluid = FloatSpinBox(
            max=_LARGEST,
            step=0.001,
            tooltip=f"Weight of the fluid per unit volume; for water, {_WATER} kPa / mm",
        )
        self.level = FloatSpinBox(
            label="level %",
            max=_HIGHEST,
            step=5.0,
            value=_PER_CENT,
            tooltip="Level of the fluid, in per cent of the height of the cavity",
        )
        super().__init__(widgets=[self.contents, self.pressure, self.fluid, self.level])
        for amount, decimals in ((self.pressure, 4), (self.fluid, 5), (self.level, 1)):
            amount.native.setDecimals(decimals)
            amount.native.setKeyboardTracking(False)  # "0." is not a complete number
        self.fluid.value = _WATER
        self.margins = (0, 0, 0, 0)
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
            size = abs(cavity.pressure)
            self.pressure.min = min(self.pressure.min, -size)
            self.pressure.max = max(self.pressure.max, size)
            self.pressure.value = cavity.pressure
        if cavity.fluid:
            percent = _PER_CENT * cavity.level
            self.fluid.max = max(self.fluid.max, cavity.fluid)
            self.level.max = max(self.level.max, percent)
            self.fluid.value, self.level.value = cavity.fluid, percent

    def show_place(self, unit: str, stiffness: str) -> None:
        """Show the units of pressure and weight, given the units of length and stiffness."""
        self.pressure.label = f"pressure {stiffness or 'relative'}"
        self.fluid.label = f"fluid {stiffness or 'relative'} / {unit}"
        self._show()

    def _show(self, *_: object) -> None:
        is_pressed, is_filled = self.contents.value
        self.pressure.visible = is_pressed
        self.fluid.visible = self.level.visible = is_filled
