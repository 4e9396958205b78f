"""The menu of materials: published ones, one's own, those of other layers and of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from psygnal import Signal
from qtpy.QtCore import QStandardPaths
from qtpy.QtWidgets import QFileDialog, QInputDialog, QMenu, QPushButton

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.metadata import TISSUE, known_of, rows_of, tissue_recorded
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.boundary_rules import stiffness_in_words
from napari_hmrf.tissue.material_presets import PRESETS, Preset
from napari_hmrf.tissue.material_tables import (
    ENDING,
    MaterialLibrary,
    load_materials,
    save_materials,
)
from napari_hmrf.ui.material_table import MaterialTable

_FILES = f"Materials (*{ENDING})"


def own_library() -> MaterialLibrary:
    """The user's presets, kept where programs keep their settings."""
    place = QStandardPaths.writableLocation(QStandardPaths.StandardLocation.GenericConfigLocation)
    return MaterialLibrary(Path(place) / "napari-hmrf" / "materials")


def materials_of(layer: Any) -> Preset | None:
    """The table of a layer of tissue labels, or of a result, as a preset; None if it has none."""
    rows, unit = rows_of(layer, TISSUE), str(known_of(layer).get("unit", ""))
    if rows is None:
        rows, unit = tissue_recorded(layer)
    if not rows or not any(row.stiffness > 0 for row in rows):
        return None
    return Preset(str(layer.name), unit, f"the layer '{layer.name}'", rows)


def preset_of(materials: Preset | Any) -> Preset:
    """A preset, the table of a layer, or that of a file, as a preset.

    Raises
    ------
    LayerError
        If the layer has none.
    """
    if isinstance(materials, str | Path):
        return load_materials(materials)
    found = materials if isinstance(materials, Preset) else materials_of(materials)
    if found is None:
        raise LayerError(materials, "has no table of materials. Choose another layer.")
    return found


class MaterialMenu(QPushButton):
    """A button with all there is to take materials from, and to keep them.

    Parameters
    ----------
    table : MaterialTable
    layers : callable
        The viewer's layers.
    layer : callable
        The one whose table is shown.

    Attributes
    ----------
    said : Signal(str)
        What was done, or why not.
    taken : Signal(str)
        What was put into the table, and what became of what it called otherwise.
    """

    said = Signal(str)
    taken = Signal(str)

    def __init__(
        self, table: MaterialTable, layers: Callable[[], list[Any]], layer: Callable[[], Any]
    ) -> None:
        super().__init__("Materials")
        self._table, self._layers, self._layer = table, layers, layer
        self.setToolTip(
            "Published stiffnesses with their sources, your own, and those of other layers and of "
            "files, in place of the table; or keep the table for other images"
        )
        menu = QMenu(self)
        menu.setToolTipsVisible(True)
        menu.aboutToShow.connect(self.fill)
        self.setMenu(menu)

    def fill(self) -> None:
        """Fill the menu with what there is now."""
        menu, library = self.menu(), own_library()
        menu.clear()
        _head(menu, "Published, each with its source")
        for preset in PRESETS:
            self._offer(menu, preset)
        _head(menu, "In addition")
        about = (
            "Adds a row to the table: what you paint with it moves and turns as one. The elastic "
            "model has that, the paper's has not"
        )
        _act(menu, "Bone or implant (rigid)", about, lambda: self._table.add_rigid())
        own = library.presets
        if own:
            _head(menu, "Your own")
        for preset in own:
            self._offer(menu, preset)
        _head(menu, "Share and keep")
        here = self._layer()
        others = [layer for layer in self._layers() if layer is not here and materials_of(layer)]
        taken = self._submenu(menu, "Take from layer", others)
        for layer in others:
            found = materials_of(layer)
            assert found is not None
            self._offer(taken, found)
        _act(
            menu, "Load from file ...", "A file that was saved here, or written by hand", self._load
        )
        _act(menu, "Save to file ...", "For other images, and for other people", self._save)
        about = "Here in this menu, in every session; replaces those of the same name"
        _act(menu, "Remember as your own ...", about, self._remember)
        forgotten = self._submenu(menu, "Forget", own)
        for preset in own:
            _act(forgotten, preset.name, "", lambda _=False, name=preset.name: self._forget(name))
        for sentence in library.refused:
            _act(menu, sentence, str(library.folder), lambda: None).setEnabled(False)

    def take(self, preset: Preset) -> None:
        """Put a preset into the table."""
        words = self._table.apply_preset(preset)
        self.taken.emit(f"Materials: {preset.name}. {words}".rstrip())

    def _offer(self, menu: QMenu, preset: Preset) -> None:
        rows = "\n".join(
            f"{row.label}  {row.name}: {stiffness_in_words(row.stiffness, preset.unit)}"
            + (f", Poisson's ratio {row.poisson:g}" if row.is_deformable else "")
            for row in preset.materials
        )
        source = f"\nSource: {preset.source}" if preset.source else ""
        about = f"<p style='white-space:pre-wrap'>{_plain(rows + source)}</p>"
        title = f"{preset.name} {preset.unit if preset in PRESETS else ''}".strip()
        _act(menu, title, about, lambda _=False: self.take(preset))

    def _submenu(self, menu: QMenu, title: str, content: Any) -> QMenu:
        submenu: QMenu = menu.addMenu(title)
        submenu.setToolTipsVisible(True)
        submenu.setEnabled(bool(content))
        return submenu

    def _load(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self, "Load materials", "", _FILES)
        if path:
            self._try(lambda: self.take(load_materials(path)))

    def _save(self) -> None:
        contents = self._table.contents
        path, _ = QFileDialog.getSaveFileName(self, "Save materials", f"materials{ENDING}", _FILES)
        if path:
            self._try(lambda: save_materials(path, contents), f"Saved {Path(path).name}.")

    def _remember(self) -> None:
        name, taken = QInputDialog.getText(self, "Remember materials", "Name:")
        if taken and name.strip():
            contents = self._table.contents
            kept = Preset(name.strip(), contents.unit, contents.source, contents.materials)
            self._try(lambda: own_library().remember(kept), f"Remembered '{kept.name}'.")

    def _forget(self, name: str) -> None:
        self._try(lambda: own_library().forget(name), f"Forgot '{name}'.")

    def _try(self, action: Callable[[], Any], success: str = "") -> None:
        try:
            action()
        except (HmrfError, OSError) as error:
            self.said.emit(str(error))
        else:
            if success:
                self.said.emit(success)


def _act(menu: QMenu, title: str, about: str, answer: Callable[..., Any]) -> Any:
    action = menu.addAction(title.replace("&", "&&"))
    action.setToolTip(about)
    action.triggered.connect(answer)
    return action


def _head(menu: QMenu, title: str) -> None:
    """A line of words between entries; styles with colours of their own draw no section's."""
    menu.addSeparator()
    menu.addAction(title).setEnabled(False)


def _plain(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
