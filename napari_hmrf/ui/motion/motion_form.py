"""The part of the dock that says how tissue moves: tools, what is painted, and landmarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import CheckBox, Container, PushButton
from psygnal import Signal

from napari_hmrf.layers.slice_view import View
from napari_hmrf.ui.forms import row
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.motion.tools import TOOLS
from napari_hmrf.ui.tissue_form import BoundarySection

#: How many tools lie beside each other.
_ACROSS = 4


class MotionForm(Container):
    """Tools with the fields of the one in the hand, what is held at the edge, and the boundary.

    Parameters
    ----------
    layers, view : callable
        The viewer's layers, and which slice it shows.

    Attributes
    ----------
    tools : dict of str to PushButton
        By the name of the tool.
    fields : ToolFields
    edge : CheckBox
    boundary : BoundarySection
    remove, clear : PushButton

    Signals
    -------
    picked : the name of a tool whose button was pressed
    """

    picked = Signal(str)

    def __init__(self, layers: Callable[[], list[Any]], view: Callable[[], View | None]) -> None:
        self.tools: dict[str, PushButton] = {}
        for tool in TOOLS:
            about = f"{tool.how} {tool.more}".strip()
            button = PushButton(text=tool.title, tooltip=f"{about} ({tool.key})")
            button.native.setCheckable(True)
            button.native.clicked.connect(lambda _, name=tool.name: self.picked.emit(name))
            self.tools[tool.name] = button
        self.fields = ToolFields()
        self.edge = CheckBox(
            text="hold the edge of the tissue",
            value=True,
            tooltip="The outline of the tissue, and what lies at the edge of the image, stay where "
            "they are, unless they are moved themselves; holes in the tissue are free",
        )
        self.boundary = BoundarySection(layers, view)
        self.remove = PushButton(text="Remove", enabled=False, tooltip="What is selected (Delete)")
        self.clear = PushButton(text="Remove all", enabled=False, tooltip="All that is drawn")
        buttons = list(self.tools.values())
        rows = [row(*buttons[at : at + _ACROSS]) for at in range(0, len(buttons), _ACROSS)]
        drawn = row(self.remove, self.clear)
        super().__init__(
            widgets=[*rows, self.fields, drawn, self.edge, self.boundary], labels=False
        )
        for container in (*rows, drawn, self.boundary):
            container.margins = (0, 0, 0, 0)

    def show_tool(self, name: str) -> None:
        """Show which tool the mouse has; "" if none."""
        for each, button in self.tools.items():
            button.native.setChecked(each == name)
