"""How *Grab and pull* looks: what to pull, how to take hold of it, and what can be done."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import CheckBox, Container, PushButton
from napari.layers import Image, Labels, Points

from napari_hmrf.layers.edit_history import ViewerSteps
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.ui.forms import Prose, row
from napari_hmrf.ui.grab.fields import ToolFields
from napari_hmrf.ui.grab.tools import BY_NAME, TOOLS, Tool
from napari_hmrf.ui.layer_choice import LayerChoice, is_picture
from napari_hmrf.ui.step_buttons import StepButtons

ABOUT = (
    "Tissue is elastic here: it follows best, as each picture is computed from the one before. "
    "Without a tissue layer all that is not dark background is tissue of one stiffness."
)
KEYS = (
    "Drag tissue: pull it. Click: hold it there. Drag an arrow's head or base: change it.\n"
    "Tools: "
    + ", ".join(f"{tool.key} {tool.title.split()[0].lower()}" for tool in TOOLS)
    + ". [ and ]: size.\n"
    "Shift+click: select what was drawn. Delete: remove it. Esc: cancel. "
    "Ctrl+Z, Ctrl+Y: undo, redo. Hold Space: move the view."
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
            is_picture,
            "image",
            "The image whose tissue is pulled; of a stack, the slice that is shown",
        )
        self.tissue = LayerChoice(
            layers,
            lambda layer: (
                (isinstance(layer, Labels) or (isinstance(layer, Image) and not layer.rgb))
                and "kind" not in known_of(layer)
                and layer is not self.image.value
            ),
            "tissue",
            "Labels with a table of stiffnesses (as Deform tissue makes them), or an image "
            "of stiffness; may be left out",
        )
        self.boundary = LayerChoice(
            layers,
            lambda layer: (
                isinstance(layer, Labels)
                and "kind" not in known_of(layer)
                and layer is not self.tissue.value
            ),
            "boundary",
            "Labels with a table of what holds and what moves (as Deform tissue makes "
            "them); arrows come on top of it; may be left out",
        )
        self.edge = CheckBox(
            text="hold the edge of the tissue",
            value=True,
            tooltip="The outline of the tissue, and what lies at the edge of the image, stay where "
            "they are, unless they are pulled themselves; holes in the tissue are free",
        )
        self.grab = PushButton(
            text="Grab and pull",
            tooltip="Makes the layer 'Arrows' the active one: while it is, the mouse pulls tissue",
        )
        self.grab.native.setCheckable(True)
        self.tools = {"pull": self.grab}
        for tool in TOOLS[1:]:
            button = PushButton(text=tool.title, tooltip=f"{tool.what} ({tool.key})")
            button.native.setCheckable(True)
            self.tools[tool.name] = button
        self.fields = ToolFields()
        self.radius = self.fields.radius
        self.confidence = self.fields.confidence
        self.components = self.fields.components
        self.where, self.should = (
            LayerChoice(layers, lambda layer: isinstance(layer, Points), label, tip)
            for label, tip in (
                ("is at", "A Points layer: where things are"),
                ("should be at", "A Points layer: where the same things should be, in this order"),
            )
        )
        self.take = PushButton(text="Take points as landmarks", enabled=False)
        self.points = Container(widgets=[self.where, self.should])
        self._steps = StepButtons()
        self.undo, self.redo = self._steps.undo, self._steps.redo
        self.remove = PushButton(text="Remove", enabled=False, tooltip="What is selected (Delete)")
        self.clear = PushButton(text="Remove all", enabled=False)
        #: What is wrong with the tissue that is seen, apart from what was done last.
        self.warning, self.status = Prose(value=""), Prose(value="")
        about, keys = Prose(value=ABOUT), Prose(value=KEYS)
        buttons = [row(self.undo, self.redo), row(self.remove, self.clear)]
        first = Container(widgets=[self.image, self.tissue, self.boundary])
        others = list(self.tools.values())[1:]
        rows = [row(*others[:4]), row(*others[4:])]
        super().__init__(
            widgets=[
                first, self.edge, self.grab, *rows, self.fields, self.points, self.take,
                *buttons, self.warning, self.status, keys, about,
            ],
            labels=False,
        )  # fmt: skip
        for container in (first, self.points, *rows, *buttons):
            container.margins = (0, 0, 0, 0)
        for words in (about, keys):
            words.say(str(words.value))
        self.native.layout().addStretch()
        self.show_for(BY_NAME["pull"])
        self.warn("")

    @property
    def choices(self) -> tuple[LayerChoice, ...]:
        """The menus of layers."""
        return self.image, self.tissue, self.boundary, self.where, self.should

    def show_for(self, tool: Tool) -> None:
        """Show what a tool needs, and nothing else."""
        self.fields.show_for(tool)
        for part in (self.points, self.take):
            part.visible = tool.name == "landmark" and len(self.where.offered) > 1
        offered = self.where.offered
        if (
            tool.name == "landmark"
            and len(offered) == 2
            and not (self.where.value or self.should.value)
        ):
            self.where.value, self.should.value = offered  # the lower one is where things are
        self.take.enabled = self.where.value is not None and self.should.value is not None

    def show_steps(self, steps: ViewerSteps, marks: int, selected: bool) -> None:
        """Show what can be taken back, done again and removed."""
        self.remove.enabled, self.clear.enabled = selected, bool(marks)
        self._steps.show(steps)

    def warn(self, sentence: str) -> None:
        """Show what is wrong with what is seen; "" if nothing."""
        self.warning.visible = bool(sentence)
        self.warning.say(sentence)

    def show_toggle(self, on: str) -> None:
        """Show which tool the mouse has; "" if none."""
        for name, button in self.tools.items():
            button.native.setChecked(name == on)
        self.grab.text = "Grab and pull: on" if on == "pull" else "Grab and pull"
