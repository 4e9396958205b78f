"""Whose result is seen where several docks have one: that of the dock that was used last."""

from __future__ import annotations

import weakref
from typing import Any, Literal

from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.outputs import LayerData

#: A dock whose layers show a result.
Maker = Literal["deform", "grab", "look"]
#: Layers that wait for the turn of their dock. Those that somebody hid by hand are not among them.
_waiting: weakref.WeakSet[Any] = weakref.WeakSet()


def sign(made: LayerData, maker: Maker) -> LayerData:
    """Write into a layer's metadata which dock makes it."""
    made.attributes["metadata"][METADATA]["by"] = maker
    return made


def take_turn(viewer: Any, maker: Maker, source: str = "", where: str | None = None) -> bool:
    """Have a dock's layers seen, and those of the others hidden until it is their turn.

    Tissue can have moved in one way only: of two results of the same image one would cover the
    other, and whoever works on the one below would see nothing happen.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    maker : {"deform", "grab", "look"}
        Who shows something.
    source : str
        The image's name, as in the layers' metadata; "": of whatever image.
    where : str, optional
        The slice, as in the layers' metadata; by default any.

    Returns
    -------
    bool
        Whether anything was hidden.
    """
    hidden = False
    for layer in list(viewer.layers):
        known = known_of(layer)
        by = known.get("by")
        if by is None or (where is not None and known.get("slice") != where):
            continue
        if source and known.get("source") and known["source"] != source:
            continue
        if by == maker:
            if layer in _waiting:
                layer.visible = True
        elif layer.visible:
            layer.visible, hidden = False, True
            _waiting.add(layer)
        if layer.visible:
            _waiting.discard(layer)
    return hidden
