"""Forms for the motion of tissue: tools with their fields; edge, boundary, weight and cavity."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from magicgui.widgets import CheckBox, Container
from psygnal import Signal
from qtpy.QtCore import QSize, Qt
from qtpy.QtGui import QIcon
from qtpy.QtWidgets import QHBoxLayout, QSizePolicy, QToolButton, QVBoxLayout, QWidget

from napari_hmrf.layers.slice_view import View
from napari_hmrf.study.session import ImageChoice
from napari_hmrf.study.study import SWITCHES
from napari_hmrf.ui.forms import Section
from napari_hmrf.ui.layer_choice import LandmarkChoice
from napari_hmrf.ui.motion.load_forms import CavityForm, WeightForm
from napari_hmrf.ui.motion.tool import Tool
from napari_hmrf.ui.motion.tool_fields import ToolFields
from napari_hmrf.ui.motion.tools import TOOLS
from napari_hmrf.ui.remembered_settings import remember_open
from napari_hmrf.ui.tissue_form import BoundarySection

#: Number of tool buttons in each row; the first row is larger, the others are in a section.
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
    more : Section
        Section with the tools that are needed less often.
    fields : ToolFields
    landmarks : LandmarkChoice
        Menus for landmark layers, visible with the tool *Landmark*.
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
        self.more = Section("More tools")
        self.more.toggleButton().setToolTip(
            "Brushes to free, push and remove tissue, to let it slide, and to change its kind "
            "and its confidence; and further settings of the tools"
        )
        self.fields, self.landmarks = ToolFields(), LandmarkChoice(layers)
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
        parts = [self.switches, self.boundary, self.weight, self.cavity]
        self.edges = Container(widgets=parts, labels=False)
        super().__init__(widgets=[self.fields, self.landmarks], labels=False)
        for container in (self.boundary, self.switches):
            container.margins = (0, 0, 0, 0)
        for name, button in self.tools.items():
            button.clicked.connect(partial(self.picked.emit, name))
        buttons, page, rows = iter(self.tools.values()), QWidget(), QVBoxLayout()
        for inside in (page, self.more):
            layout = QVBoxLayout(page) if inside is page else self.more.layout()
            layout.setSpacing(2)
            layout.setContentsMargins(0, 0, 0, 0)
        self.more.content().layout().setContentsMargins(0, 0, 0, 0)
        rows.setSpacing(2)
        for number, count in enumerate(_ROWS):
            line = QHBoxLayout()
            (page.layout() if number else rows).addLayout(line)
            for button in islice(buttons, count):
                line.addWidget(button, 1)
        self.more.addWidget(page)
        rows.addWidget(self.more)
        self.native.layout().insertLayout(0, rows)
        remember_open(self.more, "tools")
        self.fields.show_further(self.more.isExpanded())
        self.more.toggled.connect(self.fields.show_further)

    def show_tool(self, name: str) -> None:
        """Highlight the button of the tool in use; "" if the mouse does not draw."""
        for number, (each, button) in enumerate(self.tools.items()):
            button.setChecked(each == name)
            if each == name and number >= _ROWS[0] and not self.more.isExpanded():
                self.more.expand(animate=False)

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
