"""Whose result is seen where several docks have one: that of the dock that was used last."""

from __future__ import annotations

import weakref
from typing import Any, Literal

from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.result_layers import LayerData

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
    for layer, by in _signed(viewer, source, where):
        if by == maker:
            if layer in _waiting:
                layer.visible = True
        elif layer.visible:
            layer.visible, hidden = False, True
            _waiting.add(layer)
        if layer.visible:
            _waiting.discard(layer)
    return hidden


def give_way(viewer: Any, maker: Maker, source: str = "", where: str | None = None) -> bool:
    """Have a dock's layers wait if it is another's turn; whether it is.

    Parameters
    ----------
    viewer, maker, source, where
        As of `take_turn`.
    """
    found = _signed(viewer, source, where)
    if not any(layer.visible for layer, by in found if by not in (maker, "look")):
        return False
    for layer, by in found:
        if by == maker and layer.visible:
            layer.visible = False
            _waiting.add(layer)
    return True


def has_turn(viewer: Any, maker: Maker, source: str = "", where: str | None = None) -> bool:
    """Whether a dock's layers are seen; parameters as of `take_turn`."""
    return any(layer.visible for layer, by in _signed(viewer, source, where) if by == maker)


def hide(layer: Any) -> None:
    """Hide a layer that nobody wants to see; its dock's turn does not bring it back."""
    layer.visible = False
    _waiting.discard(layer)


def _signed(viewer: Any, source: str, where: str | None) -> list[tuple[Any, Maker]]:
    """The layers of a slice that show a result, and who makes them."""
    found = []
    for layer in viewer.layers:
        known = known_of(layer)
        here = where is None or known.get("slice") == where
        same = not source or not known.get("source") or known["source"] == source
        if "by" in known and here and same:
            found.append((layer, known["by"]))
    return found
