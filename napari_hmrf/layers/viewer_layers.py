"""Layers that come, change and go in the viewer while the user is at work with others."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import PLACE
from napari_hmrf.layers.result_layers import LayerData


def still_there(viewer: Any, layer: Any) -> Any:
    """A layer if it is in the viewer; None if somebody removed it, or there is none."""
    return layer if layer is not None and layer in viewer.layers else None


def update_layer(layer: Any, made: LayerData) -> None:
    """Give a layer other data and place; how the user had it drawn stays."""
    layer.data = made.data
    for name in PLACE:
        setattr(layer, name, made.attributes[name])
    layer.metadata = made.attributes["metadata"]


def overwrite(viewer: Any, layer: Any, data: npt.NDArray[Any]) -> bool:
    """Show other data in place of a layer's, whose array is written to.

    napari is told of new data as of any others: the viewer's axes are measured anew, a thumbnail is
    drawn, the list of layers is painted. Of a picture that is moved about none of that changes, and
    without it an update takes the window's thread a third of the time.

    The layer's `data` event is not emitted and its thumbnail stays: set its data when things have
    come to rest.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    layer : napari.layers.Layer
        Whose data are an array that nobody else holds.
    data : ndarray
        Copied.

    Returns
    -------
    bool
        Whether they fitted; if not, nothing was done.
    """
    shown = layer.data
    if (shown.shape, shown.dtype) != (data.shape, data.dtype) or not shown.flags.writeable:
        return False
    np.copyto(shown, data)
    # What the list of layers hears of a layer, it paints; nothing of what it shows is new.
    with viewer.layers.events.blocker_all():
        layer.refresh(thumbnail=False, highlight=False, extent=False)
    return True


@contextmanager
def same_selection(viewer: Any) -> Iterator[None]:
    """Add layers without taking the brush out of the user's hand."""
    layers = viewer.layers
    selected, active = set(layers.selection), layers.selection.active
    with layers.selection.events.active.blocker():
        yield
        layers.selection = {layer for layer in selected if layer in layers}
        if active in layers:
            layers.selection.active = active
    if layers.selection.active is not active:
        layers.selection.events.active(value=layers.selection.active)


_Shared = TypeVar("_Shared")
_shared: weakref.WeakKeyDictionary[Any, dict[Any, Any]] = weakref.WeakKeyDictionary()


def shared(viewer: Any, kind: Callable[[Any], _Shared]) -> _Shared:
    """The one object of a kind in a viewer, for a dock that is closed and for the next that comes.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    kind : type
        Made of the viewer; must not keep it alive.
    """
    known = _shared.setdefault(viewer, {})
    if kind not in known:
        known[kind] = kind(viewer)
    found: _Shared = known[kind]
    return found
