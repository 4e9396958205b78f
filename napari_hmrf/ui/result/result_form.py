"""Forms for the display of the result, its comparison, and files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import CheckBox, ComboBox, Container, PushButton, Slider
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QProxyStyle, QPushButton, QSlider, QStyle, QVBoxLayout

from napari_hmrf.layers.field_layer import holds_field
from napari_hmrf.ui.forms import FixedText, Form, narrow, row
from napari_hmrf.ui.layer_choice import LayerChoice, LayerSubmenu, is_picture
from napari_hmrf.ui.registration_form import RegistrationForm
from napari_hmrf.ui.result.result_messages import NOTHING, OVERLAY_TIP, overlay_choices

#: Key that shows the undeformed image while it is pressed.
BEFORE_KEY = "Shift-B"
PLAY, PAUSE = "Play", "Pause"
#: Number of lines below the overlay, which the displacement shares with the landmarks.
_LINES = 2


class _JumpStyle(QProxyStyle):
    """Slider style that jumps to the clicked position instead of moving by a page."""

    def styleHint(self, hint: Any, option: Any = None, widget: Any = None, data: Any = None) -> int:
        if hint == QStyle.StyleHint.SH_Slider_AbsoluteSetButtons:
            left = Qt.MouseButton.LeftButton
            return int(getattr(left, "value", left))
        return int(super().styleHint(hint, option, widget, data))


class ResultForm(Container):
    """Form for the percentage of the deformation and its overlay, with a fixed height.

    Parameters
    ----------
    layers : callable
        Returns the layers of the viewer.
    image : LayerChoice
        Menu for the image to deform.

    Attributes
    ----------
    slider : Slider
    play, before : PushButton
    how_far, landmarks : FixedText
        Displacement of the tissue, and distances of the landmarks from their targets.
    overlay : ComboBox
    arrows : CheckBox
        True if the arrows of the result are shown.
    comparison : Container
        Section with the second image; hidden if there is none to choose.
    second : LayerChoice
        Second image.
    show_second : PushButton
        Button that shows the second image alone while it is pressed.
    in_colours : CheckBox
        Ticked if the second image is shown over the deformed image, both in colours.
    reference : LayerSubmenu
        Known field that the result is compared with, in the menu of `more`.
    registration : RegistrationForm
        Controls that register the image to the second image.
    files : Container
        Row of the buttons `keep` and `more`.
    """

    def __init__(self, layers: Callable[[], list[Any]], image: LayerChoice) -> None:
        # Arrow layer of the displayed result; a result cannot be its own reference.
        self._own_arrows: Any = None
        self.slider = Slider(
            value=100,
            max=100,
            readout=False,
            label="displayed percentage",  # not visible; the accessible name
            tooltip="Displayed fraction of the displacement: 0 % is the undeformed image, 100 % is "
            "the result",
        )
        self.slider.native.setToolTip(self.slider.tooltip)
        self._style = _JumpStyle()  # Qt does not keep a reference to it
        self.slider.native.findChild(QSlider).setStyle(self._style)
        self.play = PushButton(text=PLAY, tooltip="Play back and forth between 0 and 100 %")
        self.before = PushButton(
            text="Compare (press)",
            tooltip="Show the undeformed image while this button is pressed "
            f"(or {BEFORE_KEY} on the canvas)",
        )
        self.how_far, self.landmarks = FixedText(_LINES), FixedText()
        self.overlay = ComboBox(
            choices=overlay_choices("px"), value=NOTHING, label="overlay", tooltip=OVERLAY_TIP
        )
        narrow(self.overlay)
        self.arrows = CheckBox(
            text="arrows", tooltip="Show the displacement as arrows, which cover the image"
        )
        self.reference = LayerSubmenu(
            layers,
            lambda layer: layer is not self._own_arrows and holds_field(layer),
            "Compare with a known field",
            "Displacement field (File > Open) or another result; the dock reports its difference "
            "from this result, and 'overlay' offers a map of the difference",
        )
        self.second = LayerChoice(
            layers,
            lambda layer: is_picture(layer) and layer is not image.value,
            "second image",
            "Second image of the same tissue, such as a later scan",
        )
        self.show_second = PushButton(
            text="Show it (press)", tooltip="Show the second image while this button is pressed"
        )
        self.in_colours = CheckBox(
            text="both in colours",
            tooltip="Show the second image in green over the deformed image in magenta; where both "
            "images agree, the sum is grey",
        )
        self.keep = PushButton(
            text="Save study ...",
            tooltip="Save all choices, paint, marks and settings, and the result if there is one, "
            "in one file. To restore them, use File > Open.",
        )
        self.more = QPushButton("More")
        self.more.setToolTip(
            "Measurements, forces, landmarks, moved copies of other layers, fields for other "
            "tools, pictures, films, and a precise solve"
        )
        self.files = row(self.keep)
        self.files.native.layout().addWidget(self.more)
        self.registration = RegistrationForm()
        pair, views = Form([self.second]), row(self.show_second, self.in_colours)
        views.margins = (0, 0, 0, 0)
        self.comparison = Container(widgets=[pair, views, self.registration], labels=False)
        slider = Container(widgets=[self.slider], labels=False)
        top = row(self.play, slider, self.before)
        over = row(Form([self.overlay]), self.arrows)
        over.native.layout().setStretch(0, 1)  # the names of overlays are long
        super().__init__(widgets=[top, over], labels=False)
        for part in (slider, top, over):
            part.margins = (0, 0, 0, 0)
        texts, layout = QVBoxLayout(), self.native.layout()
        texts.setSpacing(0)
        layout.setSpacing(2)
        layout.addLayout(texts)
        for text in (self.how_far, self.landmarks):
            text.setContentsMargins(4, 0, 4, 0)
            texts.addWidget(text)
        self.show_landmarks("")

    def show_landmarks(self, text: str) -> None:
        """Show the distances of the landmarks in the last line; "" gives the line back."""
        self.landmarks.show_text(text)
        self.landmarks.setVisible(bool(text))
        self.how_far.limit(_LINES - bool(text))

    def offer(self, arrows: Any) -> None:
        """Enable the widgets that require a result; disable them if `arrows` is None."""
        self._own_arrows = arrows
        self.reference.reset_choices()
        for part in (self.slider, self.play, self.before, self.overlay, self.arrows):
            part.enabled = arrows is not None
