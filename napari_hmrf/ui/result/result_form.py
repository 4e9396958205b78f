"""Form for the display of the result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import ComboBox, Container, PushButton, Slider
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QProxyStyle, QPushButton, QSlider, QStyle

from napari_hmrf.layers.field_layer import holds_field
from napari_hmrf.ui.forms import Prose, narrow, row
from napari_hmrf.ui.layer_choice import LayerChoice, is_picture
from napari_hmrf.ui.result.result_messages import NOTHING, OVERLAY_TIP, overlay_choices

#: Key that shows the undeformed image while it is held.
BEFORE_KEY = "Shift-B"
PLAY, PAUSE = "Play", "Pause"


class _JumpStyle(QProxyStyle):
    """Style of sliders that jump to the clicked place instead of moving by a page."""

    def styleHint(self, hint: Any, option: Any = None, widget: Any = None, data: Any = None) -> int:
        if hint == QStyle.StyleHint.SH_Slider_AbsoluteSetButtons:
            left = Qt.MouseButton.LeftButton
            return int(getattr(left, "value", left))
        return int(super().styleHint(hint, option, widget, data))


class ResultForm(Container):
    """Form for the percentage of the deformation, its overlay, and comparisons.

    Parameters
    ----------
    layers : callable
        Returns the layers of the viewer.
    image : LayerChoice
        Menu of the image to deform.
    """

    def __init__(self, layers: Callable[[], list[Any]], image: LayerChoice) -> None:
        # Arrows of the displayed result, which cannot be its own reference.
        self._own_arrows: Any = None
        self.slider = Slider(
            value=100,
            max=100,
            readout=False,
            tooltip="Displayed part of the displacement: 0 % is the image as it was, 100 % the "
            "result",
        )
        self._style = _JumpStyle()  # Qt keeps no reference to it
        self.slider.native.findChild(QSlider).setStyle(self._style)
        self.play = PushButton(text=PLAY, tooltip="Go back and forth between 0 and 100 %")
        self.before = PushButton(
            text="Hold: before",
            tooltip=f"The image as it was, as long as this is held (or {BEFORE_KEY} on the canvas)",
        )
        self.how_far = Prose()
        self.overlay = ComboBox(
            choices=overlay_choices("px"), value=NOTHING, label="show", tooltip=OVERLAY_TIP
        )
        narrow(self.overlay)
        self.reference = LayerChoice(
            layers,
            lambda layer: layer is not self._own_arrows and holds_field(layer),
            "reference",
            "A displacement field, by File > Open, or another result: how far this one is from it "
            "is said here, and 'show' has a map of it",
            if_any=True,
        )
        self.second = LayerChoice(
            layers,
            lambda layer: is_picture(layer) and layer is not image.value,
            "compare with",
            "A second image of the same tissue, such as a later scan: it is seen in green over the "
            "one that moves, in magenta. Where they agree they make grey",
            if_any=True,
        )
        image.changed.connect(self.second.reset_choices)
        self.landmarks = Prose()
        self.save = PushButton(
            text="Save pictures ...",
            tooltip="PNG files, in a new folder: figures of displacement, before and after, grid, "
            "Jacobian, strain and energy. What the canvas shows, at any percent, is saved by "
            "File > Save Screenshot",
        )
        self.keep = PushButton(
            text="Save study ...",
            tooltip="One file with all that is chosen, painted, drawn and set so far, and the "
            "result if there is one; File > Open has it all back",
        )
        self.more = QPushButton("More")
        self.more.setToolTip(
            "Measurements, other layers moved along, fields for other tools, films"
        )
        buttons = row(self.save, self.keep)
        buttons.native.layout().addWidget(self.more)
        super().__init__(
            widgets=[
                Container(widgets=[self.slider], labels=False),
                self.how_far,
                row(self.play, self.before),
                Container(widgets=[self.overlay, self.reference, self.second]),
                buttons,
                self.landmarks,
            ],
            labels=False,
        )
        for part in self:
            if isinstance(part, Container):
                part.margins = (0, 0, 0, 0)

    def offer(self, arrows: Any) -> None:
        """Enable the widgets that need a result; `arrows` are those of the result, or None."""
        self._own_arrows = arrows
        self.reference.reset_choices()
        for part in (self.slider, self.play, self.before, self.overlay, self.save):
            part.enabled = arrows is not None
