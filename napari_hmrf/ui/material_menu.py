"""The menu of materials: published ones, those of other layers and of files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

from psygnal import Signal
from qtpy.QtWidgets import QFileDialog, QMenu, QPushButton

from napari_hmrf.io.material_tables import ENDING, load_materials, save_materials
from napari_hmrf.layers.metadata import TISSUE, Table, tissue_recorded
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.boundary_rules import default_rigid, stiffness_in_words
from napari_hmrf.tissue.material_presets import PRESETS, Preset, take_over
from napari_hmrf.ui.forms import add_entry, attempt, give_menu
from napari_hmrf.ui.tissue_tables import MaterialTable

_FILES = f"Materials (*{ENDING})"


def materials_of(layer: Any) -> Preset | None:
    """The table of a layer of tissue labels, or of a result, as a preset; None if it has none."""
    table = Table.of(layer, TISSUE)
    rows, unit = table[:2] if table.rows else tissue_recorded(layer)
    if not rows or not any(row.stiffness > 0 for row in rows):
        return None
    return Preset(str(layer.name), unit, f"the layer '{layer.name}'", rows)


class MaterialMenu(QPushButton):
    """A button with all there is to take materials from, and to keep them.

    Parameters
    ----------
    table : MaterialTable
    layers : callable
        The viewer's layers.

    Attributes
    ----------
    said : Signal(str)
        What was done, or why not.
    taken : Signal(str)
        What was put into the table, and what became of what it called otherwise.
    """

    said = Signal(str)
    taken = Signal(str)

    def __init__(self, table: MaterialTable, layers: Callable[[], list[Any]]) -> None:
        super().__init__("Materials")
        self._table, self._layers = table, layers
        self.setToolTip(
            "Published stiffnesses with their sources, and those of other layers and of files, in "
            "place of the table; or keep the table in a file, for other images"
        )
        give_menu(self, self.fill)

    def fill(self) -> None:
        """Fill the menu with what there is now."""
        menu = self.menu()
        menu.clear()
        _head(menu, "Published, each with its source")
        for preset in PRESETS:
            self._offer(menu, preset)
        _head(menu, "In addition")
        about = (
            "Adds a row to the table: what you paint with it moves and turns as one. The elastic "
            "model has that, the paper's has not"
        )
        add_entry(menu, "Bone or implant (rigid)", about, lambda: self._table.add(default_rigid))
        _head(menu, "Share and keep")
        taken = menu.addMenu("Take from layer")
        taken.setToolTipsVisible(True)
        for layer in self._layers():
            if layer is not self._table.layer and (found := materials_of(layer)):
                self._offer(taken, found)
        taken.setEnabled(bool(taken.actions()))
        about = "A file that was saved here, or written by hand"
        add_entry(menu, "Load from file ...", about, self._load)
        add_entry(menu, "Save to file ...", "For other images, and for other people", self._save)

    def take(self, materials: Preset | Any) -> None:
        """Put materials into the table: a preset, those of a layer, or those of a file.

        Raises
        ------
        LayerError
            If the layer has none.
        FileFormatError, OSError
            As `load_materials`.
        """
        preset: Preset | None = materials
        if isinstance(materials, str | Path):
            preset = load_materials(materials)
        elif not isinstance(materials, Preset):
            preset = materials_of(materials)
        if preset is None:
            raise LayerError(materials, "has no table of materials. Choose another layer.")
        rows, words = take_over(preset, self._table.rows)
        self._table.contents = Table(rows, preset.unit, preset.name, preset.source)
        self.taken.emit(f"Materials: {preset.name}. {words}".rstrip())

    def save(self, path: str | Path) -> Path:
        """Save the table to a file; as `save_materials`."""
        table = self._table.contents
        file = save_materials(path, Preset(table.preset, table.unit, table.whose, table.rows))
        self.said.emit(f"Saved {file.name}.")
        return file

    def _offer(self, menu: QMenu, preset: Preset) -> None:
        rows = "\n".join(
            f"{row.label}  {row.name}: {stiffness_in_words(row.stiffness, preset.unit)}"
            + (f", Poisson's ratio {row.poisson:g}" if row.is_deformable else "")
            for row in preset.materials
        )
        source = f"\nSource: {preset.source}" if preset.source else ""
        about = f"<p style='white-space:pre-wrap'>{escape(rows + source, quote=False)}</p>"
        title = f"{preset.name} {preset.unit if preset in PRESETS else ''}".strip()
        add_entry(menu, title, about, lambda _=False: self.take(preset))

    def _load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Load materials", "", _FILES)
        if path:
            attempt(partial(self.take, path), self.said.emit)

    def _save(self) -> None:
        path, _ = QFileDialog.getSaveFileName(self, "Save materials", f"materials{ENDING}", _FILES)
        if path:
            attempt(partial(self.save, path), self.said.emit)


def _head(menu: QMenu, title: str) -> None:
    """A line of words between entries; styles with colours of their own draw no section's."""
    menu.addSeparator()
    menu.addAction(title).setEnabled(False)
