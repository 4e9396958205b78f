"""Tissue table and boundary table, with a row for each label.

A menu offers published materials and the materials of other layers and of files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from napari.layers import Layer
from psygnal import Signal
from qtpy.QtWidgets import QFileDialog, QMenu, QPushButton

from napari_hmrf.errors import LayerError
from napari_hmrf.field.directions import Directions
from napari_hmrf.io.segmentation_tables import ENDINGS, tissue_table
from napari_hmrf.io.tables import ENDING, write_preset
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, table_of, tissue_recorded
from napari_hmrf.notes import Note
from napari_hmrf.solver.model_advice import ABOUT_POISSON
from napari_hmrf.tissue.boundary_rules import (
    FORCES,
    NAMES_OF_ACTIONS,
    Action,
    BoundaryRule,
    Material,
    default_material,
    default_rule,
    stiffness_in_words,
)
from napari_hmrf.tissue.material_presets import PLAIN, PRESETS, Preset
from napari_hmrf.tissue.row_table import Row, RowTable
from napari_hmrf.tissue.tissue_names import NamedMaterials
from napari_hmrf.ui.forms import add_entry, attempt, give_menu, number_of
from napari_hmrf.ui.label_table import Column, LabelTable
from napari_hmrf.ui.messages import SAVED

#: Text in the table for each boundary action.
_ACTIONS: dict[Action, str] = {
    "fixed": "fixed",
    "move": "moves",
    "expand": "expands",
    "press": "pressed",
    "pull": "pulled",
    "slide": "slides",
    "remove": "removed",
}
#: Actions without a confidence.
_WITHOUT_CONFIDENCE: tuple[Action, ...] = *FORCES, "slide", "remove"
#: Texts of a choice in the table.
_YES, _NO = "yes", "no"
_BY_WORD = {word: action for action, word in _ACTIONS.items()}
_FILES = f"Materials (*{ENDING})"
_TABLES = f"Materials, names of labels ({' '.join(f'*{ending}' for ending in ENDINGS)})"


class MaterialTable(LabelTable[Material]):
    """Table of tissues with their stiffness, growth and sliding; `rows` are `Material`s."""

    role = TISSUE

    @property
    def columns(self) -> list[Column[Material]]:
        """Columns for stiffness (with its unit if known), Poisson's ratio, growth and sliding."""
        unit = self.contents.unit  # for display only: the motion depends on ratios of stiffness
        return [
            *super().columns,
            Column(
                _stiffness_title(unit, self.rows),
                "Young's modulus, in the same unit for all tissues.\n0: no tissue, such as air. "
                "'rigid': a rigid body, such as bone, in the elastic model.\n"
                "Label 0: all pixels that are not painted.",
                lambda row: stiffness_in_words(row.stiffness),
                _typed("stiffness"),
            ),
            Column(
                "Poisson's\nratio",
                f"{ABOUT_POISSON}\nThe paper's model does not use this ratio.",
                lambda row: f"{row.poisson:g}" if row.is_deformable else "",
                _typed("poisson"),
            ),
            Column(
                "grows\n%",
                "Growth in length of free tissue; a negative number shrinks the tissue. 26 % "
                "doubles the volume.\nTwo numbers, such as 20 / 0: growth along rows and along "
                "columns.\nThe paper's model has no growth.",
                lambda row: _joined(100 * np.atleast_1d(row.growth)) if row.is_deformable else "",
                _growth,
            ),
            Column(
                "slides",
                "yes: the tissue slides along all other tissue without friction, and stays "
                "together with it,\nlike the lung and the chest wall. In the elastic model.",
                lambda row: _YES if row.slides else _NO,
                lambda row, text: replace(row, slides=text == _YES),
                (_NO, _YES),
            ),
        ]

    def default(self, label: int) -> Material:
        """Return a material with the properties of the first row."""
        return default_material(label, self.rows)


def _stiffness_title(unit: str, rows: Iterable[Material]) -> str:
    """Return the title of the stiffness column; without a unit, normal tissue may be 1.

    Normal tissue is a tissue of this name, or else the first tissue that is not rigid.
    """
    soft = [row for row in rows if row.is_deformable]
    named = [row for row in soft if "normal" in row.name.lower()]
    is_ratio = any(row.stiffness == 1 for row in (named or soft)[:1])
    return f"Stiffness\n({unit or ('x normal' if is_ratio else 'relative')})"


def _typed(name: str) -> Callable[[Row, str], Row]:
    """Return a function that sets the value of a row from text, with a decimal point or comma."""

    def typed(row: Row, text: str) -> Row:
        value: dict[str, Any] = {name: text.replace(",", ".")}
        return replace(row, **value)

    return typed


def _joined(parts: Iterable[float]) -> str:
    """Join numbers with slashes, in the format that the user types."""
    return " / ".join(f"{round(part, 9):g}" for part in parts)


def _growth(material: Material, text: str) -> Material:
    per_cent = (part if "%" in part else f"{part}%" for part in text.split("/"))
    return _typed("growth")(material, "/".join(per_cent))


class BoundaryTable(LabelTable[BoundaryRule]):
    """Table with label, name, action, distances and confidence; `rows` are `BoundaryRule`s.

    Attributes
    ----------
    largest : float
        Largest distance that can be typed: the longest side of the image.
    """

    role = BOUNDARY
    largest = math.inf
    _place = "px", Directions(), ""

    @property
    def columns(self) -> list[Column[BoundaryRule]]:
        """Columns for the action and its amounts, in patient or screen directions."""
        unit, ways, stiffness = self._place
        per_area = stiffness or "relative"
        return [
            *super().columns,
            Column(
                "Action",
                "fixed: stays in place.\nmoves: by a displacement along rows and columns.\n"
                "expands: outward, by a distance; the paint must be a closed ring or a patch.\n"
                "pressed, pulled: by a force per area, on the surface of tissue under the paint.\n"
                "slides: keeps its distance from a wall, and moves freely along its surface; erase "
                "the wall from the tissue (stiffness 0). In the elastic model.\n"
                "removed: the tissue is cut out; 'cavity' below is what then acts there.",
                lambda row: _ACTIONS[row.action],
                _action,
                tuple(_BY_WORD),
            ),
            *(_along(axis, unit, ways, "move", self.largest) for axis in (0, 1)),
            _amount(
                "out",
                "Distance outward; negative: inward. For a surface that slides, usually 0",
                unit,
                ("expand", "slide"),
                self.largest,
            ),
            Column(
                "confi-\ndence",
                "Confidence from 0 to 1.\nTwo numbers, such as 1 / 0.5: along rows and columns.",
                lambda row: _joined(
                    () if row.action in _WITHOUT_CONFIDENCE else dict.fromkeys(row.confidence)
                ),
                _confidence,
            ),
            _amount(
                "pressure",
                "Force per area; negative: suction",
                per_area,
                ("press",),
                math.inf,
            ),
            *(_along(axis, per_area, ways, "pull", math.inf) for axis in (0, 1)),
        ]

    def show_place(self, unit: str, ways: Directions, stiffness: str) -> None:
        """Show the units of amounts and forces, and the directions of rows and columns."""
        self._place = unit, ways, stiffness
        self._fill()

    def default(self, label: int) -> BoundaryRule:
        """Return a rule that holds the boundary in place."""
        return default_rule(label)


def _action(rule: BoundaryRule, text: str) -> BoundaryRule:
    """Return the rule with another action, and with its name unless the user has changed it.

    The amount is reset if its unit differs.
    """
    action = _BY_WORD[text]
    follows = rule.name == NAMES_OF_ACTIONS[rule.action]
    name = NAMES_OF_ACTIONS[action] if follows else rule.name
    changed_rule = replace(rule, action=action, name=name)
    same = (changed_rule.action in FORCES) == (rule.action in FORCES)
    if changed_rule.action == "slide":  # the distance of an expansion would usually be too large
        return replace(changed_rule, amount=0.0)
    return changed_rule if same else replace(changed_rule, vector=(0.0, 0.0), amount=0.0)


def _along(
    axis: int, unit: str, ways: Directions, action: Action, largest: float
) -> Column[BoundaryRule]:
    """Return the column for one component of a motion or a pull, along rows or columns."""

    def typed(rule: BoundaryRule, amount: float) -> BoundaryRule:
        *deep, down, along = ways.to_display(rule.vector)
        seen = (*deep, down, amount) if axis else (*deep, amount, along)
        return replace(rule, vector=ways.from_display(seen))

    def seen(rule: BoundaryRule) -> float | None:
        return ways.to_display(rule.vector)[axis - 2] if rule.action == action else None

    title = ways.label(axis) if action == "move" else f"pull {ways.label(axis)}"
    return _distance(title, ways.about(axis), unit, seen, typed, largest)


def _amount(
    title: str, about: str, unit: str, actions: tuple[Action, ...], largest: float
) -> Column[BoundaryRule]:
    """Return the column for an amount that applies to some actions only."""

    def shown(rule: BoundaryRule) -> float | None:
        return rule.amount if rule.action in actions else None

    return _distance(title, about, unit, shown, lambda row, far: replace(row, amount=far), largest)


def _distance(
    title: str,
    about: str,
    unit: str,
    amount: Callable[[BoundaryRule], float | None],
    changed: Callable[[BoundaryRule, float], BoundaryRule],
    largest: float,
) -> Column[BoundaryRule]:
    """Return a column of numbers with a unit; a cell is empty if `amount` returns None."""

    def shown(rule: BoundaryRule) -> str:
        value = amount(rule)
        return "" if value is None else f"{round(value, 9) + 0.0:g}"

    def typed(rule: BoundaryRule, text: str) -> BoundaryRule:
        if not abs(far := number_of(text)) <= largest or math.isinf(far):
            known = "in" if math.isinf(largest) else f"from {-largest:g} to {largest:g}"
            raise ValueError(f"The value must be a number {known} {unit}")
        return changed(rule, far)

    words = title.replace("along ", "along\n")  # saves width in the narrow dock
    return Column(f"{words}\n{unit}", f"{about}, in {unit}", shown, typed)


def _confidence(rule: BoundaryRule, text: str) -> BoundaryRule:
    parts: Any = text.replace(",", ".").split("/")
    return replace(rule, confidence=parts if len(parts) > 1 else parts * 2)


def materials_of(layer: Any) -> Preset | None:
    """Return the tissue table of a Labels layer or a result as a preset; None without a table."""
    table = table_of(layer, TISSUE)
    rows, unit = table[:2] if table.rows else tissue_recorded(layer)
    if not rows or not any(row.stiffness > 0 for row in rows):
        return None
    return Preset(str(layer.name), unit, f"the layer '{layer.name}'", rows)


class MaterialMenu(QPushButton):
    """Button with a menu to load materials from presets, layers and files, and to save the table.

    Parameters
    ----------
    table : MaterialTable
    layers : callable
        Returns the layers of the viewer.

    Attributes
    ----------
    message : Signal(str)
        Message about a change to the table and its effect on existing rows, or about an error.
    """

    message = Signal(str)

    def __init__(self, table: MaterialTable, layers: Callable[[], list[Any]]) -> None:
        super().__init__("Materials")
        self._table, self._layers = table, layers
        self.setToolTip(
            "Load stiffnesses from a publication, a layer or a file, or save the table to a file"
        )
        give_menu(self, self.fill)

    def fill(self) -> None:
        """Fill the menu with the current presets and layers."""
        menu = self.menu()
        menu.clear()
        for preset in (*PRESETS, PLAIN):
            self._offer(menu, preset)
        menu.addSeparator()
        taken = menu.addMenu("Load from layer")
        taken.setToolTipsVisible(True)
        for layer in self._layers():
            if layer is not self._table.layer and (materials := materials_of(layer)):
                self._offer(taken, materials)
        taken.setEnabled(bool(taken.actions()))
        about = "File that was saved here or written by hand, or label names of a segmentation"
        add_entry(menu, "Load from file ...", about, self._load)
        add_entry(menu, "Save to file ...", "For other images, or to share the table", self._save)

    def copy_materials(self, materials: Preset | Layer | str | Path) -> None:
        """Copy the materials of a preset, a layer or a file into the table.

        Raises
        ------
        LayerError
            If the layer has no table of materials.
        FileFormatError, OSError
            If the file cannot be read; see `tissue_table`.
        """
        preset: Preset | NamedMaterials | None
        if isinstance(materials, Preset):
            preset = materials
        elif isinstance(materials, str | Path):
            preset = tissue_table(materials)
        else:
            preset = materials_of(materials)
        if preset is None:
            raise LayerError(materials, "has no table of materials. Choose another layer.")
        rows, words = preset.replace_materials(self._table.rows)
        self._table.contents = RowTable(rows, preset.unit, preset.name, preset.source)
        self.message.emit(f"Materials: {preset.name}. {words}".rstrip())

    def save(self, path: str | Path) -> Path:
        """Save the table to a file (see `write_preset`), and return the path of the file."""
        table = self._table.contents
        file = write_preset(path, Preset(table.preset, table.unit, table.source, table.rows))
        self.message.emit(Note(f"Saved {file.name}.", kind=SAVED))
        return file

    def _offer(self, menu: QMenu, preset: Preset) -> None:
        about = f"<p>{escape(preset.source, quote=False)}</p>"  # Qt wraps rich text only
        title = f"{preset.name} {preset.unit if preset in PRESETS else ''}".strip()
        add_entry(menu, title, about, lambda: self.copy_materials(preset))

    def _load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Load materials", "", _TABLES)
        if path:
            attempt(partial(self.copy_materials, path), self.message.emit)

    def _save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Save materials", f"materials{ENDING}", _FILES)
        if path:
            attempt(partial(self.save, path), self.message.emit)
