"""Which image a layer of stiffness comes from."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from napari.layers import Image, Layer

from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.stiffness_layers import curve_of, source_name, stiffness_layer
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve


class StiffnessSources:
    """Knows the images of layers of stiffness, whatever they are called by now.

    Parameters
    ----------
    layers : callable
        The viewer's layers.
    """

    def __init__(self, layers: Callable[[], list[Any]]) -> None:
        self._layers = layers
        self._known: weakref.WeakKeyDictionary[Any, weakref.ref[Any]] = weakref.WeakKeyDictionary()

    def image_of(self, layer: Any) -> Any:
        """The image that a layer comes from, or None if that is not open."""
        known = self._known.get(layer)
        image = None if known is None else known()
        if image is not None and image in self._layers():
            return image
        # A project was opened again, and all that is known is how the image was called.
        for other in self._layers():
            plain = isinstance(other, Image) and not known_of(other).get("kind")
            if plain and other is not layer and other.name == source_name(layer):
                self._known[layer] = weakref.ref(other)
                return other
        return None

    def open_image_of(self, layer: Any) -> Any:
        """The image that a layer comes from.

        Raises
        ------
        LayerError
            If it is not open.
        """
        image = self.image_of(layer)
        if image is None:
            raise LayerError(
                layer,
                f"comes from the image '{source_name(layer)}', which is not open. Open it, or give "
                "another that name.",
            )
        return image

    def made(self, image: Any) -> Any:
        """The layer of stiffness of an image that there is already, or None."""
        for layer in self._layers():
            known = self._known.get(layer)
            if known is not None and known() is image and curve_of(layer) is not None:
                return layer
        return None

    def make(self, image: Any, curve: StiffnessCurve) -> Any:
        """Make a layer of stiffness from an image, to be added to the viewer.

        Raises
        ------
        ProblemError
            If the image cannot be read.
        """
        layer = Layer.create(*stiffness_layer(image, curve))
        self._known[layer] = weakref.ref(image)
        return layer
