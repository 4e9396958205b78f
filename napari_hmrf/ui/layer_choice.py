"""A menu of the viewer's layers that stays true while layers come and go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import ComboBox, Container, PushButton
from napari.layers import Image, Points, Shapes

from napari_hmrf.layers.metadata import TISSUE, known_of, role_of
from napari_hmrf.layers.slice_view import layer_extents
from napari_hmrf.ui.forms import align_labels, narrow


def is_picture(layer: Any) -> bool:
    """Whether a layer is an image of something, and neither a result nor how stiff tissue is."""
    own = isinstance(layer, Image) and "kind" not in known_of(layer)
    return own and role_of(layer) != TISSUE


class LayerChoice(ComboBox):
    """Choose a layer, or none.

    magicgui's own menu of layers asks the window for them, which a script may not have.

    Parameters
    ----------
    layers : callable
        The layers there are, lowest first.
    accept : callable
        Whether a layer can be chosen.
    label, tooltip : str
    more : callable, optional
        What else can be chosen now: pairs of a title and a value.
    if_any : bool
        Whether it is seen only where there is a layer to choose.
    """

    def __init__(
        self,
        layers: Callable[[], list[Any]],
        accept: Callable[[Any], bool],
        label: str,
        tooltip: str,
        more: Callable[[], list[tuple[str, Any]]] = list,
        if_any: bool = False,
    ) -> None:
        self._layers, self._accept, self._if_any = layers, accept, if_any
        super().__init__(
            choices=lambda _: [*more(), *((layer.name, layer) for layer in self.offered)],
            nullable=True,
            label=label,
            tooltip=tooltip,
        )
        narrow(self)

    @property
    def offered(self) -> list[Any]:
        """The layers that can be chosen, lowest first."""
        return [layer for layer in self._layers() if self._accept(layer)]

    def reset_choices(self, *_: Any) -> None:
        """Look again at what layers there are; a choice that is gone becomes none."""
        before: Any = self.get_value()
        with self.changed.blocked():
            super().reset_choices()
            after = before if before in self.choices else None
            self.set_value(after)
        if self._if_any:
            self.visible = bool(self.offered)
        if after is not before:
            self.changed.emit(after)


class LandmarkChoice(Container):
    """Where things are and where they should be; there only where there are points or lines.

    Parameters
    ----------
    layers : callable
        Returns the layers there are.

    Attributes
    ----------
    where, should : LayerChoice
        A layer of points, and another one of as many; or a Shapes layer of lines alone.
    take : PushButton
        Has them become landmarks of the drawing.
    """

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self.where = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Points | Shapes),
            "landmarks at",
            "Points: where things are; or Shapes: lines from there to where they should be",
        )
        self.should = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Points) and layer is not self.where.value,
            "should be at",
            "Points: where these should be, in the same order; where both agree, tissue is held",
        )
        self.take = PushButton(
            text="Take as landmarks",
            tooltip="Adds them to what is drawn, in place of those that were taken before",
        )
        super().__init__(widgets=[self.where, self.should, self.take])
        self.where.changed.connect(self._on_where)
        self.look()

    @property
    def pair(self) -> tuple[Any, Any]:
        """The layers that are chosen, or None."""
        return self.where.value, self.should.value

    def look(self) -> None:
        """Show what there are layers for."""
        self.visible = bool(self.where.offered)
        self.should.visible = not isinstance(self.where.value, Shapes)
        self.take.enabled = self.where.value is not None
        align_labels(self)

    def _on_where(self, layer: Any) -> None:
        self.should.reset_choices()  # no layer is both: where there are two, they change places
        others = self.should.offered
        if isinstance(layer, Points) and self.should.value is None and len(others) == 1:
            self.should.value = others[0]
        self.look()


class ExtentChoice(ComboBox):
    """How much of an image is deformed; there is a choice for images that have slices."""

    has_slices = False

    def __init__(self) -> None:
        super().__init__(
            label="deform",
            choices=[("this slice", "slice"), ("the whole volume", "volume")],
            tooltip="This slice: as if it had no neighbours, which is quick.\n"
            "The whole volume: tissue moves in all three directions.",
        )
        self.visible = False

    @property
    def is_volume(self) -> bool:
        """Whether all of a volume is deformed."""
        return bool(self.value == "volume")

    def look_at(self, image: Any) -> None:
        """Offer what there is of an image, and choose what it is meant for."""
        self.has_slices = image is not None and layer_extents(image)[-3:-2] > (1,)
        self.visible = self.has_slices
        self.value = known_of(image).get("extent", "slice") if self.has_slices else "slice"
