"""How *Grab and pull* looks: what to pull, how to take hold of it, and what can be done."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import (
    CheckBox,
    ComboBox,
    Container,
    FloatSlider,
    FloatSpinBox,
    PushButton,
)
from napari.layers import Image, Labels

from napari_hmrf.drawing import History
from napari_hmrf.drawing.pull import Grip
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.widgets.forms import Prose
from napari_hmrf.widgets.layer_choice import LayerChoice

COMPONENTS = [
    ("both directions", "both"),
    ("up and down only (rows)", "row"),
    ("left and right only (columns)", "col"),
]
ABOUT = (
    "Tissue is elastic here: it follows best, as each picture is computed from the one before. "
    "Without a tissue layer all that is not dark background is tissue of one stiffness."
)
KEYS = (
    "Drag tissue: pull it. Click: hold it there. Drag an arrow's head or base: change it.\n"
    "Delete: remove the selected arrow. Esc: cancel a drag. Ctrl+Z, Ctrl+Shift+Z: undo, redo. "
    "Hold Space: move the view."
)


class GrabForm(Container):
    """The widgets of *Grab and pull*.

    Parameters
    ----------
    layers : callable
        The viewer's layers.
    """

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self.image = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Image) and "kind" not in known_of(layer),
            label="image",
            tooltip="The image whose tissue is pulled; of a stack, the slice that is shown",
        )
        self.tissue = LayerChoice(
            layers,
            lambda layer: (
                (isinstance(layer, Labels) or (isinstance(layer, Image) and not layer.rgb))
                and "kind" not in known_of(layer)
                and layer is not self.image.value
            ),
            label="tissue",
            tooltip="Labels with a table of stiffnesses (as Deform tissue makes them), or an image "
            "of stiffness; may be left out",
        )
        self.boundary = LayerChoice(
            layers,
            lambda layer: (
                isinstance(layer, Labels)
                and "kind" not in known_of(layer)
                and layer is not self.tissue.value
            ),
            label="boundary",
            tooltip="Labels with a table of what holds and what moves (as Deform tissue makes "
            "them); arrows come on top of it; may be left out",
        )
        self.edge = CheckBox(
            text="hold the edge of the tissue",
            value=True,
            tooltip="What lies beside no tissue, or at the edge of the image, stays where it is, "
            "unless it is pulled itself",
        )
        self.grab = PushButton(
            text="Grab and pull",
            tooltip="Makes the layer 'Arrows' the active one: while it is, the mouse pulls tissue",
        )
        self.grab.native.setCheckable(True)
        self.radius = FloatSpinBox(
            value=10.0,
            min=0.001,
            max=1e6,
            step=1.0,
            label="radius",
            tooltip="Of the patch that is taken hold of, in the unit of the image",
        )
        self.confidence = FloatSlider(
            value=1.0,
            min=0.05,
            max=1.0,
            step=0.05,
            tracking=False,
            label="confidence",
            tooltip="How sure the arrow is. 1: tissue is held exactly. Below, it slips where "
            "holding it would strain it by more than about that",
        )
        self.components = ComboBox(
            choices=COMPONENTS,
            value="both",
            label="moves",
            tooltip="In which directions an arrow says where tissue goes; in the other it is free",
        )
        self.undo = PushButton(text="Undo", enabled=False)
        self.redo = PushButton(text="Redo", enabled=False)
        self.remove = PushButton(
            text="Remove", enabled=False, tooltip="The selected arrow (Delete)"
        )
        self.clear = PushButton(text="Remove all", enabled=False)
        self.status = Prose(value="")
        about, keys = Prose(value=ABOUT), Prose(value=KEYS)
        buttons = [
            Container(widgets=pair, layout="horizontal", labels=False)
            for pair in ([self.undo, self.redo], [self.remove, self.clear])
        ]
        self._steps = ("", "")
        first = Container(widgets=[self.image, self.tissue, self.boundary])
        fields = Container(widgets=[self.radius, self.confidence, self.components])
        super().__init__(
            widgets=[first, self.edge, self.grab, fields, *buttons, self.status, keys, about],
            labels=False,
        )
        for container in (first, fields, *buttons):
            container.margins = (0, 0, 0, 0)
        for words in (about, keys):
            words.say(str(words.value))
        self.native.layout().addStretch()

    @property
    def choices(self) -> tuple[LayerChoice, ...]:
        """The menus of layers."""
        return self.image, self.tissue, self.boundary

    @property
    def grip(self) -> Grip:
        """How a new arrow takes hold."""
        return Grip(self.radius.value, self.confidence.value, self.components.value)

    def show_grip(self, grip: Grip) -> None:
        """Show how the selected arrow holds, without changing it."""
        for field, value in (
            (self.radius, grip.radius),
            (self.confidence, max(grip.confidence, 0.05)),
            (self.components, grip.components),
        ):
            if field.value != value:
                with field.changed.blocked():
                    field.value = value

    def show_steps(self, history: History, selected: bool) -> None:
        """Show what can be taken back, done again and removed."""
        self.remove.enabled, self.clear.enabled = selected, bool(history.drawing.marks)
        undo, redo = steps = history.undo_word, history.redo_word
        if steps == self._steps:
            return
        self._steps = steps
        self.undo.enabled, self.redo.enabled = bool(undo), bool(redo)
        self.undo.tooltip = f"Take back: {undo} (Ctrl+Z)" if undo else "Ctrl+Z"
        self.redo.tooltip = f"Do again: {redo} (Ctrl+Shift+Z)" if redo else "Ctrl+Shift+Z"

    def show_toggle(self, on: bool) -> None:
        """Show whether the mouse pulls."""
        self.grab.native.setChecked(on)
        self.grab.text = "Grab and pull: on" if on else "Grab and pull"
