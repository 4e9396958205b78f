"""How errors name a layer: by what the user called it first, by what it is after that."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from napari_hmrf.errors import ProblemError


@dataclass(frozen=True)
class Named:
    """What is kept of a layer to name it by when it may be gone.

    Attributes
    ----------
    name : str
        The user's.
    details : str
        Such as "Labels layer, uint8, 300 x 300".
    """

    name: str
    details: str

    @classmethod
    def of(cls, layer: Any) -> Named:
        """Of a layer, or of what was already kept of one."""
        if isinstance(layer, Named):
            return layer
        kind = layer.__class__.__name__  # not type(): napari hands plugins proxies
        if kind in ("Vectors", "Points", "Shapes"):
            details = f"{len(layer.data)} {kind.lower()}, {layer.ndim}-D"
        else:
            data = full_resolution(layer)
            details = f"{data.dtype}, {' x '.join(str(extent) for extent in data.shape)}"
        return cls(str(layer.name), f"{kind} layer, {details}")


class LayerError(ProblemError):
    """What is wrong with a layer: a sentence for people, then what the layer is.

    Parameters
    ----------
    layer : napari.layers.Layer or Named
    message : str
        What is wrong and what to do, as it goes on after the layer's name.
    sentence : str, optional
        The same as a sentence of its own, where the name does not come first.

    Attributes
    ----------
    sentence : str
        Without the technical details.
    """

    def __init__(self, layer: Any, message: str, sentence: str = "") -> None:
        named = Named.of(layer)
        super().__init__(named.name, message)
        self.sentence = sentence or f"'{named.name}' {message}"
        self.args = (f"{self.sentence} ({named.details})",)


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
