"""Adding, updating and finding layers without disturbing the user's work in the viewer."""

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
    """Return a layer if it is in the viewer; None if it was removed, or is None."""
    return layer if layer is not None and layer in viewer.layers else None


def update_layer(layer: Any, made: LayerData) -> None:
    """Set the data and the place of a layer; the user's display settings stay."""
    layer.data = made.data
    for name in PLACE:
        # Each assignment makes napari update extents and redraw, even for an equal value.
        if not np.array_equal(getattr(layer, name), made.attributes[name]):
            setattr(layer, name, made.attributes[name])
    layer.metadata = made.attributes["metadata"]


def overwrite(viewer: Any, layer: Any, data: npt.NDArray[Any]) -> bool:
    """Write new data into the array of a layer, and refresh only the canvas.

    Setting the data of a layer makes napari also update the viewer's axes, the thumbnail and the
    layer list. During a drag none of these change, and without them an update takes a third of the
    time on the GUI thread.

    The layer's `data` event is not emitted, and its thumbnail is not updated: set the data of the
    layer after the last update.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    layer : napari.layers.Layer
        Layer whose data are an array that no other object uses.
    data : ndarray
        New data, which are copied.

    Returns
    -------
    bool
        False if shape or type differ, or the array is read-only; then nothing is changed.
    """
    shown = layer.data
    if (shown.shape, shown.dtype) != (data.shape, data.dtype) or not shown.flags.writeable:
        return False
    np.copyto(shown, data)
    # The layer list repaints after every event of a layer, although nothing in it changes here.
    with viewer.layers.events.blocker_all():
        layer.refresh(thumbnail=False, highlight=False, extent=False)
    return True


@contextmanager
def same_selection(viewer: Any) -> Iterator[None]:
    """Keep the selection and the active layer while layers are added or removed."""
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
    """Return the object of a class that belongs to a viewer; it is created on first use.

    The object is shared by all docks of the viewer, also after one is closed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    kind : type
        Class, called with the viewer; its objects must not hold a reference to the viewer.
    """
    objects = _shared.setdefault(viewer, {})
    if kind not in objects:
        objects[kind] = kind(viewer)
    shared_object: _Shared = objects[kind]
    return shared_object
