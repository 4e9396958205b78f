"""How errors name a layer: by what the user called it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from napari_hmrf.errors import ProblemError


class LayerError(ProblemError):
    """What is wrong with a layer, in a sentence for people.

    Parameters
    ----------
    layer : napari.layers.Layer or str
        Or its name.
    message : str
        What is wrong and what to do, as it goes on after the layer's name.
    """

    def __init__(self, layer: Any, message: str) -> None:
        name = layer if isinstance(layer, str) else str(layer.name)
        super().__init__(name, message)
        self.args = (f"'{name}' {message}",)


def full_resolution(layer: Any) -> Any:
    """The data of an Image or Labels layer, the finest level of a multiscale one."""
    return layer.data[0] if getattr(layer, "multiscale", False) else layer.data


@contextmanager
def naming(**layers: Any) -> Iterator[None]:
    """Let errors about an input of the problem name the layer these came from."""
    try:
        yield
    except LayerError:
        raise
    except ProblemError as error:
        layer = layers.get(error.field)
        if layer is None:
            raise
        raise LayerError(layer, error.message) from error
