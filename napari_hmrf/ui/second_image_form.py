"""The fields for a second image, and the line about landmarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import Container

from napari_hmrf.ui.forms import Prose
from napari_hmrf.ui.layer_choice import LayerChoice, is_picture


class SecondImageForm(Container):
    """Which image lies over the one that moves; there only where there are two.

    Parameters
    ----------
    layers : callable
        The layers there are.
    image : LayerChoice
        What is deformed.

    Attributes
    ----------
    other : LayerChoice
    line : Prose
        How far landmarks are from where they should be.
    """

    def __init__(self, layers: Callable[[], list[Any]], image: LayerChoice) -> None:
        self.other = LayerChoice(
            layers,
            lambda layer: is_picture(layer) and layer is not image.value,
            "compare with",
            "A second image of the same tissue, such as a later scan: it is seen in green over the "
            "one that moves, in magenta. Where they agree they make grey",
        )
        self.line = Prose()
        super().__init__(widgets=[Container(widgets=[self.other]), self.line], labels=False)
        self.margins = self[0].margins = (0, 0, 0, 0)
        image.changed.connect(self.look)
        self.look()

    def look(self, *_: Any) -> None:
        """Offer what there is."""
        self.other.reset_choices()
        self[0].visible = bool(self.other.offered)
