"""Landmarks from layers: points or lines that become landmarks of the drawing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import Container, PushButton
from napari.layers import Points, Shapes

from napari_hmrf.ui.forms import align_labels
from napari_hmrf.ui.layer_choice import LayerChoice


class LandmarkChoice(Container):
    """Where things are and where they should be; there only where there are points or lines.

    Parameters
    ----------
    layers : callable
        Returns the layers there are.

    Attributes
    ----------
    where, should : LayerChoice
        A layer of points, and one of as many; or a Shapes layer of lines alone.
    take : PushButton
        Has them become landmarks of the drawing.
    """

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self.where = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Points | Shapes),
            "landmarks at",
            "A Points layer: where things are; or a Shapes layer of lines, from there to where "
            "they should be",
        )
        self.should = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Points),
            "should be at",
            "A Points layer: where the same things should be, in the same order. A point in the "
            "same place in both holds the tissue there",
        )
        self.take = PushButton(
            text="Take as landmarks",
            tooltip="They come beside what is drawn, and are changed, removed and undone as what "
            "is clicked; taken again they replace those that were taken before",
        )
        super().__init__(widgets=[self.where, self.should, self.take])
        self.where.changed.connect(self._on_where)
        self.look()

    def look(self) -> None:
        """Show what there are layers for."""
        lines = isinstance(self.where.value, Shapes)
        self.visible = bool(self.where.offered)
        self.should.visible = not lines
        self.take.enabled = self.where.value is not None
        align_labels(self)

    def _on_where(self, layer: Any) -> None:
        others = [each for each in self.should.offered if each is not layer]
        if isinstance(layer, Points) and self.should.value is None and len(others) == 1:
            self.should.value = others[0]
        self.look()
