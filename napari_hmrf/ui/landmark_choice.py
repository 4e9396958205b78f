"""The fields for landmarks: points or lines, and what goes with each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magicgui.widgets import Container
from napari.layers import Points, Shapes
from psygnal import Signal

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.landmarks import LandmarkLayers
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import unit_symbol
from napari_hmrf.tissue.usual_lengths import usual_radius
from napari_hmrf.ui.events import Pixels
from napari_hmrf.ui.forms import align_labels, confidence_slider, length
from napari_hmrf.ui.layer_choice import LayerChoice

_RADIUS = "radius"


def _any_of(*kinds: type[Any]) -> Callable[[Any], bool]:
    return lambda layer: isinstance(layer, kinds)


class LandmarkChoice(Container):
    """Where things are and where they should be; there only where there are points or lines.

    Parameters
    ----------
    layers : callable
        The viewer's layers.
    """

    #: Other landmarks, or other ones of the same layers.
    edited = Signal()

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self.where, self.should = (
            LayerChoice(
                layers,
                _any_of(*kinds),
                label,
                tip,
                lambda layer: layer.name + (" (lines)" if isinstance(layer, Shapes) else ""),
            )
            for label, kinds, tip in (
                (
                    "landmarks at",
                    (Points, Shapes),
                    (
                        "A Points layer: where things are; or a Shapes layer of lines, from there "
                        "to where they should be. They count on top of the boundary, and without "
                        "one"
                    ),
                ),
                (
                    "should be at",
                    (Points,),
                    (
                        "A Points layer: where the same things should be, in the same order. A "
                        "point in the same place in both holds the tissue there"
                    ),
                ),
            )
        )
        self.radius = length(
            _RADIUS,
            "Of the patch of tissue that goes with each landmark; smaller where landmarks are "
            "close to each other. 0: a sixteenth of the image",
            least=0.0,
            step=1.0,
        )
        self.confidence = confidence_slider(
            "How sure the landmarks are. Below 1 the tissue may pull them away from where they "
            "should be"
        )
        super().__init__(widgets=[self.where, self.should, self.radius, self.confidence])
        self._pixels = Pixels(self._on_points)
        self.where.changed.connect(self._on_where)
        self.should.changed.connect(self._on_choice)
        for field in (self.radius, self.confidence):
            field.changed.connect(self._on_points)
        self.look()

    @property
    def lines(self) -> bool:
        """Whether they are lines, which need no other layer."""
        return isinstance(self.where.value, Shapes)

    @property
    def complete(self) -> bool:
        """Whether there are pairs to be read."""
        return self.lines or len(self.layers) == 2

    @property
    def layers(self) -> tuple[Any, ...]:
        """The layers that are chosen."""
        chosen = (self.where.value, None if self.lines else self.should.value)
        return tuple(layer for layer in chosen if layer is not None)

    @property
    def chosen(self) -> LandmarkLayers | None:
        """The pair, or None.

        Raises
        ------
        HmrfError
            If only one of them is chosen.
        """
        where, should = self.where.value, self.should.value
        if where is None and should is None:
            return None
        if self.lines:
            should = None
        elif where is None or should is None:
            one, other = (where, "should be at") if should is None else (should, "landmarks at")
            raise HmrfError(
                f"Of the landmarks only '{one.name}' is chosen: choose another Points layer as "
                f"'{other}', or none of both."
            )
        return LandmarkLayers(where, should, self.radius.value or None, self.confidence.value)

    @chosen.setter
    def chosen(self, pair: LandmarkLayers | tuple[Any, ...] | None) -> None:
        if isinstance(pair, LandmarkLayers):
            self.radius.value, self.confidence.value = pair.radius or 0.0, pair.confidence
            pair = (pair.where, pair.should)
        self.where.value, self.should.value = (*(pair or ()), None, None)[:2]

    def look(self) -> None:
        """Show what there are layers for."""
        begun = bool(self.layers)
        self.visible = begun or bool(self.where.offered)
        for field in (self.should, self.radius, self.confidence):
            field.visible = begun and not (field is self.should and self.lines)
        align_labels(self)

    def show_place(self, frame: Frame, shape: tuple[int, int]) -> None:
        """Say in which unit the radius is, and which is the usual one."""
        label = f"{_RADIUS} ({unit_symbol(frame.unit)})"
        if self.radius.label != label:
            self.radius.label = label
        usual = f"{usual_radius(shape, frame.spacing):g} (usual)"
        # Qt writes the field anew whenever it is told, while somebody types in it, too.
        if self.radius.native.specialValueText() != usual:
            self.radius.native.setSpecialValueText(usual)

    def listen(self) -> None:
        """Listen to the layers that are chosen, again."""
        self._pixels.listen_to(self.layers)

    def release(self) -> None:
        """Stop listening to layers."""
        self._pixels.release()

    def _on_where(self, layer: Any) -> None:
        others = [each for each in self.should.offered if each is not layer]
        paired = layer is not None and not self.lines
        if paired and self.should.value is None and len(others) == 1:
            self.should.value = others[0]  # which tells of both
        else:
            self._on_choice()

    def _on_choice(self, *_: Any) -> None:
        self.listen()
        self.look()
        self.edited.emit()

    def _on_points(self, *_: Any) -> None:
        self.edited.emit()
