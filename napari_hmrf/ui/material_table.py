"""The table of tissues: how stiff each label is, and how much it bulges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import (
    LARGEST_STIFFNESS,
    RIGID,
    Material,
    default_material,
    read_stiffness,
    stiffness_in_words,
)
from napari_hmrf.tissue.material_presets import Preset, take_over
from napari_hmrf.ui.label_table import Column, LabelTable, number
from napari_hmrf.ui.messages import ABOUT_POISSON

_STIFFNESS, POISSON = range(2, 4)


class MaterialTable(LabelTable):
    """Label, name, stiffness and Poisson's ratio; `rows` are `Material`s."""

    def __init__(self) -> None:
        super().__init__(
            "Tissue",
            [
                Column("", "", lambda row: stiffness_in_words(row.stiffness), _stiffness, _about),
                Column(
                    "Poisson's\nratio",
                    ABOUT_POISSON,
                    lambda row: f"{row.poisson:g}" if row.is_deformable else "",
                    _poisson,
                    _about,
                ),
            ],
            about=_of_unpainted,
        )
        self.unit = ""

    @property
    def unit(self) -> str:
        """The unit of stiffness, shown only: ratios are what matters."""
        return self._unit

    @unit.setter
    def unit(self, unit: str) -> None:
        self._unit = unit
        self.set_head(
            _STIFFNESS,
            f"Stiffness ({unit})" if unit else "Stiffness",
            "Young's modulus, in any unit as long as it is the same for all tissues: only ratios "
            "matter.\n0 is no tissue, such as air. 'rigid' moves as one, such as bone or an "
            "implant; the elastic model has that, the paper's has not.",
        )

    @property
    def contents(self) -> Preset:
        """All that the table says, as one value that does not change; to be put back, too."""
        return Preset("", self.unit, "", self.rows)

    @contents.setter
    def contents(self, contents: Preset) -> None:
        self.unit = contents.unit
        self.rows = contents.materials

    def show(self, table: Any) -> None:
        """Show a table as a layer carries it, with its unit."""
        self.unit = table.unit or self.unit
        super().show(table)

    def apply_preset(self, preset: Preset) -> str:
        """Take over a preset's tissues; what became of others, in words, as of `take_over`."""
        materials, words = take_over(preset, self.rows)
        self.contents = replace(preset, materials=materials)
        return words

    def add_rigid(self) -> int:
        """Add a row for bone or an implant, which moves as one, to paint with; its label."""
        return self.add(lambda label: Material(label, "bone or implant", RIGID))

    def _default(self, label: int) -> Material:
        return default_material(label, self.rows)

    def words(self, label: int) -> str:
        """What a label's row says, in words."""
        material: Material = self.rows[self.labels.index(label)]
        amount = stiffness_in_words(material.stiffness)
        return amount if material.is_rigid else f"stiffness {amount}"


def _stiffness(material: Material, text: str) -> Material:
    if text.casefold() == "inf" or read_stiffness(text) == RIGID:
        return replace(material, stiffness=RIGID)
    stiffness = number(text)
    if not 0 <= stiffness <= LARGEST_STIFFNESS:
        raise ValueError("Stiffness must be a number, 0 or more, or 'rigid'")
    return replace(material, stiffness=stiffness)


def _poisson(material: Material, text: str) -> Material:
    poisson, (low, high) = number(text), POISSON_RANGE
    if not low <= poisson <= high:
        raise ValueError(f"Poisson's ratio must be a number from {low:g} to {high:g}")
    return replace(material, poisson=poisson)


def _of_unpainted(material: Material) -> str:
    unpainted = "Every pixel you do not paint has this stiffness; with 0 it is no tissue"
    return unpainted if material.label == 0 else ""


def _about(material: Material) -> str:
    if material.is_rigid:
        return "Moves and turns as one, such as bone or an implant, without changing its shape"
    return _of_unpainted(material) if material.is_deformable else "No tissue, such as air"
