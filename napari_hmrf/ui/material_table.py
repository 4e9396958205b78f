"""The table of tissues: how stiff each label is, and how much it bulges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from psygnal import Signal
from qtpy.QtCore import Qt

from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import (
    LARGEST_STIFFNESS,
    RIGID,
    Material,
    read_stiffness,
    stiffness_in_words,
)
from napari_hmrf.tissue.label_defaults import default_material
from napari_hmrf.tissue.material_presets import Preset, take_over
from napari_hmrf.ui.label_table import LabelTable, number, shown
from napari_hmrf.ui.messages import ABOUT_POISSON

_NAME, _STIFFNESS, _POISSON = range(1, 4)
_RIGID_TIP = "Moves and turns as one, such as bone or an implant, without changing its shape"


class MaterialTable(LabelTable):
    """Label, name, stiffness and Poisson's ratio; `rows` are `Material`s.

    Attributes
    ----------
    changed : Signal(Preset)
        Emitted with all that the table says whenever that is another, once for each edit.
    """

    changed = Signal(Preset)

    def __init__(self) -> None:
        super().__init__(
            [
                ("", "Label and colour; click a row to paint with it"),
                ("Tissue", "Any name"),
                ("Stiffness", ""),
                ("Poisson's\nratio", ABOUT_POISSON),
            ],
            stretch=_NAME,
        )
        self.unit = ""
        self.poisson_shown = False
        self._said = self.contents
        self.edited.connect(self._on_edited)

    @property
    def unit(self) -> str:
        """The unit of stiffness, shown only: ratios are what matters."""
        return self._unit

    @unit.setter
    def unit(self, unit: str) -> None:
        self._unit = unit
        header = self.horizontalHeaderItem(_STIFFNESS)
        header.setText(f"Stiffness ({unit})" if unit else "Stiffness")
        header.setToolTip(
            "Young's modulus, in any unit as long as it is the same for all tissues: only ratios "
            "matter.\n0 is no tissue, such as air. 'rigid' moves as one, such as bone or an "
            "implant; the elastic model has that, the paper's has not."
        )

    @property
    def contents(self) -> Preset:
        """All that the table says, as one value that does not change; to be put back, too."""
        return Preset("", self.unit, "", self.rows)

    @contents.setter
    def contents(self, contents: Preset) -> None:
        self.unit = contents.unit
        self.rows = contents.materials

    @property
    def poisson_shown(self) -> bool:
        """Whether there is a column of Poisson's ratios: only elastic tissue has them."""
        return not self.isColumnHidden(_POISSON)

    @poisson_shown.setter
    def poisson_shown(self, is_shown: bool) -> None:
        self.setColumnHidden(_POISSON, not is_shown)
        self._fit()

    def apply_preset(self, preset: Preset) -> str:
        """Take over a preset's tissues; what became of others, in words, as of `take_over`."""
        materials, words = take_over(preset, self._rows)
        self.contents = Preset("", preset.unit, "", materials)
        return words

    def add_rigid(self) -> int:
        """Add a row for bone or an implant, which moves as one, to paint with; its label."""
        return self.add(lambda label: Material(label, "bone or implant", RIGID))

    def _on_edited(self) -> None:
        if self.contents != self._said:
            self._said = self.contents
            self.changed.emit(self._said)

    def _default(self, label: int) -> Material:
        return default_material(label, self._rows)

    def words(self, label: int) -> str:
        """What a label's row says, in words."""
        material: Material = self._rows[self.labels.index(label)]
        amount = stiffness_in_words(material.stiffness)
        return amount if material.is_rigid else f"stiffness {amount}"

    def _show(self, row: int, value: Any) -> None:
        about = (
            "Every pixel you do not paint has this stiffness; with 0 it is no tissue"
            if value.label == 0
            else ""
        )
        self._text(row, _NAME, value.name, about or value.name, number=False)
        tip = about
        if not value.is_deformable:
            tip = _RIGID_TIP if value.is_rigid else "No tissue, such as air"
        self._text(row, _STIFFNESS, stiffness_in_words(value.stiffness), tip)
        bulges = value.is_deformable
        item = self._text(row, _POISSON, shown(value.poisson) if bulges else "", tip)
        editable = Qt.ItemFlag.ItemIsEditable
        item.setFlags(item.flags() | editable if bulges else item.flags() & ~editable)

    def _parse(self, row: int, column: int, text: str, value: Any) -> Material:
        material: Material = value
        if column == _NAME:
            return replace(material, name=text)
        if column == _POISSON:
            poisson, (low, high) = number(text), POISSON_RANGE
            if not low <= poisson <= high:
                raise ValueError(f"Poisson's ratio must be a number from {low:g} to {high:g}")
            return replace(material, poisson=poisson)
        if text.casefold() == "inf" or read_stiffness(text) == RIGID:
            return replace(material, stiffness=RIGID)
        stiffness = number(text)
        if not 0 <= stiffness <= LARGEST_STIFFNESS:
            raise ValueError("Stiffness must be a number, 0 or more, or 'rigid'")
        return replace(material, stiffness=stiffness)
