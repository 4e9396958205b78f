"""Dock section for the motion of tissue: tools, painted boundary and landmarks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from magicgui.widgets import CheckBox, Container, PushButton
from psygnal import Signal
from qtpy.QtCore import QSize, Qt
from qtpy.QtGui import QIcon
from qtpy.QtWidgets import QGridLayout, QSizePolicy, QToolButton

from napari_hmrf.layers.slice_view import View
from napari_hmrf.ui.forms import row
from napari_hmrf.ui.motion.tool import Tool
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.motion.tools import TOOLS
from napari_hmrf.ui.motion.weight_form import WeightForm
from napari_hmrf.ui.tissue_form import BoundarySection

#: Number of tool buttons in a row.
_ACROSS = 4
_ICON = QSize(20, 20)
#: Style of the buttons on light and dark themes; napari's own style does not show a pressed state.
_LOOK = """
QToolButton { background: rgba(128, 128, 128, 60); border-radius: 2px; padding: 3px 0px; }
QToolButton:hover { background: rgba(128, 128, 128, 110); }
QToolButton:disabled { color: gray; background: rgba(128, 128, 128, 25); }
QToolButton:checked { background: rgba(80, 105, 210, 220); }
"""


class MotionForm(Container):
    """Form with the tools and their fields, the outer edge, the boundary and the weight.

    Parameters
    ----------
    layers, view : callable
        Return the layers and the visible slice of the viewer.

    Attributes
    ----------
    tools : dict of str to QToolButton
        Buttons by tool name.
    fields : ToolFields
    edge : CheckBox
    weight : WeightForm
    boundary : BoundarySection
    remove, clear : PushButton

    picked : Signal(str)
        Emitted with the name of a tool when its button is pressed.
    """

    picked = Signal(str)

    def __init__(self, layers: Callable[[], list[Any]], view: Callable[[], View]) -> None:
        self.tools = {tool.name: _button(tool) for tool in TOOLS}
        self.fields = ToolFields()
        self.edge = CheckBox(
            text="Fix outer edge",
            value=True,
            tooltip="Fix the outline of the tissue, and tissue at the edge of the image, unless a "
            "mark or the boundary moves it; edges of holes in the tissue stay free",
        )
        self.weight = WeightForm()
        self.boundary = BoundarySection(layers, view)
        self.remove = PushButton(
            text="Remove", enabled=False, tooltip="Remove the selected mark (Delete)"
        )
        self.clear = PushButton(text="Remove all", enabled=False, tooltip="Remove all marks")
        drawn = row(self.remove, self.clear)
        parts = [self.fields, drawn, self.edge, self.boundary, self.weight]
        super().__init__(widgets=parts, labels=False)
        for container in (drawn, self.boundary):
            container.margins = (0, 0, 0, 0)
        grid = QGridLayout()
        grid.setSpacing(2)
        for number, (name, button) in enumerate(self.tools.items()):
            button.clicked.connect(partial(self.picked.emit, name))
            grid.addWidget(button, *divmod(number, _ACROSS))
        self.native.layout().insertLayout(0, grid)

    def show_tool(self, name: str) -> None:
        """Highlight the button of the tool in use; "" if the mouse does not draw."""
        for each, button in self.tools.items():
            button.setChecked(each == name)

    def show_obstacle(self, reason: str) -> None:
        """Disable the tools for a reason, which is shown in their tooltips; "" enables them."""
        for tool in TOOLS:
            button = self.tools[tool.name]
            button.setEnabled(not reason)
            button.setToolTip(reason or _tip(tool))


def _tip(tool: type[Tool]) -> str:
    return f"{tool.hint} ({tool.key})"


def _button(tool: type[Tool]) -> QToolButton:
    button = QToolButton(text=tool.title, toolTip=_tip(tool), checkable=True)
    button.setIcon(QIcon(str(Path(__file__).with_name(f"{tool.name}.svg"))))
    button.setIconSize(_ICON)
    button.setStyleSheet(_LOOK)
    button.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextUnderIcon)
    button.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return button
