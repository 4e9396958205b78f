"""Menus for the layers of a viewer and for the extent of the deformation."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

from magicgui.widgets import ComboBox, PushButton
from napari.layers import Image, Points, Shapes
from psygnal import Signal
from qtpy.QtWidgets import QMenu

from napari_hmrf.layers.metadata import TISSUE, metadata_of, role_of
from napari_hmrf.layers.slice_view import layer_extents
from napari_hmrf.ui.forms import Form, add_entry, narrow


def is_picture(layer: Any) -> bool:
    """Return whether a layer is an image, but neither a result nor a stiffness image."""
    own = isinstance(layer, Image) and "kind" not in metadata_of(layer)
    return own and role_of(layer) != TISSUE


class LayerChoice(ComboBox):
    """Layer menu with an empty choice.

    magicgui's own layer menu requires a napari window, which a script may not have.

    Parameters
    ----------
    layers : callable
        Returns the layers of the viewer, lowest first.
    accept : callable
        Returns whether a layer can be chosen.
    label, tooltip : str
    more : callable, optional
        Returns further choices, as pairs of title and value.
    """

    #: Emitted after the layers that can be chosen were listed.
    listed = Signal()

    def __init__(
        self,
        layers: Callable[[], list[Any]],
        accept: Callable[[Any], bool],
        label: str,
        tooltip: str,
        more: Callable[[], list[tuple[str, Any]]] = list,
    ) -> None:
        self._layers, self._accept = layers, accept
        super().__init__(
            choices=lambda _: [*more(), *((layer.name, layer) for layer in self.offered)],
            nullable=True,
            label=label,
            tooltip=tooltip,
        )
        narrow(self)

    @property
    def offered(self) -> list[Any]:
        """Layers that can be chosen, lowest first."""
        return [layer for layer in self._layers() if self._accept(layer)]

    def reset_choices(self, *_: Any) -> None:
        """Update the menu; if the chosen layer was removed, clear the choice."""
        before: Any = self.get_value()
        with self.changed.blocked():
            super().reset_choices()
            after = before if before in self.choices else None
            self.set_value(after)
        self.listed.emit()
        if after is not before:
            self.changed.emit(after)


class LayerSubmenu:
    """Choice of a layer in a submenu, for a choice that few users need.

    Parameters
    ----------
    layers : callable
        Returns the layers of the viewer, lowest first.
    accept : callable
        Returns whether a layer can be chosen.
    title, about : str
        Title of the submenu, and tooltip of its entries.
    """

    #: Emitted with the chosen layer, or None.
    changed = Signal(object)

    def __init__(
        self,
        layers: Callable[[], list[Any]],
        accept: Callable[[Any], bool],
        title: str,
        about: str,
    ) -> None:
        self._layers, self._accept, self._title, self._about = layers, accept, title, about
        self._value: Any = None

    @property
    def value(self) -> Any:
        """Chosen layer, or None."""
        return self._value

    @value.setter
    def value(self, layer: Any) -> None:
        if layer is not self._value:
            self._value = layer
            self.changed.emit(layer)

    @property
    def offered(self) -> list[Any]:
        """Layers that can be chosen, lowest first."""
        return [layer for layer in self._layers() if self._accept(layer)]

    def reset_choices(self, *_: Any) -> None:
        """Clear the choice if the chosen layer was removed."""
        if self._value not in self.offered:
            self.value = None

    def add_to(self, menu: QMenu) -> None:
        """Add the submenu, with an entry for each layer, to a menu."""
        within, offered = menu.addMenu(self._title), self.offered
        within.setToolTipsVisible(True)
        within.setEnabled(bool(offered))
        choices = [("none", None), *((str(layer.name), layer) for layer in offered)]
        for title, layer in choices:
            entry = add_entry(within, title, self._about, partial(setattr, self, "value", layer))
            entry.setCheckable(True)
            entry.setChecked(layer is self._value)


class LandmarkChoice(Form):
    """Menus for landmarks and their targets.

    They are visible with the tool *Landmark* if there is a Points or Shapes layer.

    Parameters
    ----------
    layers : callable
        Returns the layers of the viewer.

    Attributes
    ----------
    sources, targets : LayerChoice
        Menus for two Points layers of equal length, or for one Shapes layer of lines.
    take_button : PushButton
        Button that adds the landmarks to the drawing again, after their layers have changed.
    """

    #: Emitted when a landmark layer was chosen, with its targets, except by `suggest`.
    chosen = Signal()

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self.sources = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Points | Shapes),
            "landmarks at",
            "Points layer with landmarks, or Shapes layer with lines from landmarks to targets",
        )
        self.targets = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Points) and layer is not self.sources.value,
            "should be at",
            "Points layer with targets, in the same order; a landmark at its target holds tissue",
        )
        self.take_button = PushButton(
            text="Use as landmarks",
            tooltip="Add these landmarks to the drawing, again if their layers have changed; "
            "landmarks added before are replaced",
        )
        self._is_for_tool = self._is_suggesting = False
        # Layers that were chosen automatically before; the user may have cleared the choice.
        self._suggested: weakref.WeakSet[Points] = weakref.WeakSet()
        super().__init__([self.sources, self.targets, self.take_button])
        self.sources.changed.connect(self._on_sources)
        self.targets.changed.connect(self._on_targets)
        self.refresh()

    @property
    def pair(self) -> tuple[Any, Any]:
        """Chosen landmark layer and target layer; each may be None."""
        return self.sources.value, self.targets.value

    def suggest(self) -> None:
        """Choose the two Points layers of the viewer, once, if they have equal numbers of points.

        The lower layer becomes the landmarks.
        """
        if self.pair != (None, None):
            return
        points = [layer for layer in self.sources.offered if isinstance(layer, Points)]
        counts = [len(layer.data) for layer in points]
        if len(points) == 2 and counts[0] == counts[1] > 0 and {*points} != {*self._suggested}:
            self._suggested = weakref.WeakSet(points)
            self._is_suggesting = True
            self.sources.value = points[0]
            self._is_suggesting = False

    def show_for(self, tool: str) -> None:
        """Show the menus with the tool *Landmark*, and hide them with other tools."""
        if (tool == "landmark") is not self._is_for_tool:
            self._is_for_tool = tool == "landmark"
            self.refresh()

    def refresh(self) -> None:
        """Update which widgets are visible and enabled."""
        self.visible = self._is_for_tool and bool(self.sources.offered)
        self.targets.visible = not isinstance(self.sources.value, Shapes)
        self.take_button.enabled = self.sources.value is not None

    def _on_sources(self, layer: Any) -> None:
        # A layer cannot have both roles, so the other of two Points layers becomes the target.
        self.targets.reset_choices()
        others = self.targets.offered
        if isinstance(layer, Points) and self.targets.value is None and len(others) == 1:
            self.targets.value = others[0]
        else:
            self._on_targets()
        self.refresh()

    def _on_targets(self, *_: Any) -> None:
        sources, targets = self.pair
        is_complete = isinstance(sources, Shapes) or None not in (sources, targets)
        if is_complete and not self._is_suggesting:
            self.chosen.emit()


class ExtentChoice(ComboBox):
    """Menu for the extent of the deformation, slice or volume; hidden if there are no slices."""

    has_slices = False

    def __init__(self) -> None:
        super().__init__(
            label="deform",
            choices=[("this slice", "slice"), ("the whole volume", "volume")],
            tooltip="this slice: only the visible slice is deformed, which is fast.\n"
            "the whole volume: tissue moves in all three directions.\n"
            "Each slice and the volume have marks and a saved study of their own.",
        )
        self.visible = False

    @property
    def is_volume(self) -> bool:
        """True if a whole volume is deformed."""
        return bool(self.value == "volume")

    def show_for(self, image: Any) -> None:
        """Show the menu if an image has slices, and select the extent that its metadata records."""
        self.has_slices = image is not None and layer_extents(image)[-3:-2] > (1,)
        self.visible = self.has_slices
        self.value = metadata_of(image).get("extent", "slice") if self.has_slices else "slice"
