"""Forms for the motion of tissue: tools with their fields; edge, boundary, weight and cavity."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from magicgui.widgets import CheckBox, Container, PushButton
from psygnal import Signal
from qtpy.QtCore import QSize, Qt
from qtpy.QtGui import QIcon
from qtpy.QtWidgets import QHBoxLayout, QSizePolicy, QToolButton, QVBoxLayout

from napari_hmrf.layers.slice_view import View
from napari_hmrf.study.session import ImageChoice
from napari_hmrf.study.study import SWITCHES
from napari_hmrf.ui.forms import row
from napari_hmrf.ui.motion.load_forms import CavityForm, WeightForm
from napari_hmrf.ui.motion.tool import Tool
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.motion.tools import TOOLS
from napari_hmrf.ui.tissue_form import BoundarySection

#: Number of tool buttons in each row; the buttons of the first row are larger.
_ROWS = 4, 3, 3
#: Sizes of the icons in the first row and in the other rows, in pixels.
_ICONS = QSize(20, 20), QSize(12, 12)
#: Style of the buttons on light and dark themes; napari's own style does not show a pressed state.
_LOOK = """
QToolButton { background: rgba(128, 128, 128, 60); border-radius: 2px; padding: 3px 0px; }
QToolButton:hover { background: rgba(128, 128, 128, 110); }
QToolButton:disabled { color: gray; background: rgba(128, 128, 128, 25); }
QToolButton:checked { background: rgba(80, 105, 210, 220); }
"""


class MotionForm(Container):
    """Form with the tools and their fields.

    Parameters
    ----------
    layers, view : callable
        Return the layers and the visible slice of the viewer.

    Attributes
    ----------
    tools : dict of str to QToolButton
        Buttons by tool name.
    fields : ToolFields
    remove, clear : PushButton
    edges : Container
        Section with the outer edge, the boundary, the weight and the cavity.
    switches : Container
        Check box for each condition that is True or False.
    boundary : BoundarySection
    weight : WeightForm
    cavity : CavityForm

    picked : Signal(str)
        Emitted with the name of a tool when its button is pressed.
    """

    picked = Signal(str)

    def __init__(self, layers: Callable[[], list[Any]], view: Callable[[], View]) -> None:
        self.tools = {
            tool.name: _button(tool, is_large=number < _ROWS[0])
            for number, tool in enumerate(TOOLS)
        }
        self.fields = ToolFields()
        self.switches = Container(
            widgets=[
                CheckBox(
                    name=each.name,
                    value=getattr(ImageChoice, each.name),
                    text=each.metadata["text"],
                    tooltip=each.metadata["tooltip"],
                )
                for each in SWITCHES
            ],
            labels=False,
        )
        self.weight, self.cavity = WeightForm(), CavityForm()
        self.boundary = BoundarySection(layers, view)
        self.remove = PushButton(
            text="Remove", enabled=False, tooltip="Remove the selected mark (Delete)"
        )
        self.clear = PushButton(text="Remove all", enabled=False, tooltip="Remove all marks")
        drawn = row(self.remove, self.clear)
        parts = [self.switches, self.boundary, self.weight, self.cavity]
        self.edges = Container(widgets=parts, labels=False)
        super().__init__(widgets=[self.fields, drawn], labels=False)
        for container in (drawn, self.boundary, self.switches):
            container.margins = (0, 0, 0, 0)
        for name, button in self.tools.items():
            button.clicked.connect(partial(self.picked.emit, name))
        buttons, rows = iter(self.tools.values()), QVBoxLayout()
        rows.setSpacing(2)
        for count in _ROWS:
            line = QHBoxLayout()
            rows.addLayout(line)
            for button in islice(buttons, count):
                line.addWidget(button, 1)
        self.native.layout().insertLayout(0, rows)

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
    return f"{tool.hint} {tool.flat_hint}".rstrip() + f" ({tool.key})"


def _button(tool: type[Tool], is_large: bool) -> QToolButton:
    button = QToolButton(text=tool.title, toolTip=_tip(tool), checkable=True)
    style, policy = Qt.ToolButtonStyle, QSizePolicy.Policy
    button.setIcon(QIcon(str(Path(__file__).with_name(f"{tool.name}.svg"))))
    button.setIconSize(_ICONS[not is_large])
    button.setStyleSheet(_LOOK)
    button.setToolButtonStyle(
        style.ToolButtonTextUnderIcon if is_large else style.ToolButtonTextBesideIcon
    )
    button.setSizePolicy(policy.Expanding, policy.Fixed)
    return button
