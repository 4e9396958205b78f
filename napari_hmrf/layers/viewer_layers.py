"""Adding, updating and finding layers without affecting the user's selection and settings."""

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
    """Return a layer if it is in the viewer, and None otherwise."""
    return layer if layer is not None and layer in viewer.layers else None


def update_layer(layer: Any, made: LayerData) -> None:
    """Set the data, transform and metadata of a layer; display settings are unchanged."""
    layer.data = made.data
    for name in PLACE:
        # Assign only changed values: napari updates extents and redraws after each assignment.
        if not np.array_equal(getattr(layer, name), made.attributes[name]):
            setattr(layer, name, made.attributes[name])
    layer.metadata = made.attributes["metadata"]


def overwrite(viewer: Any, layer: Any, data: npt.NDArray[Any]) -> bool:
    """Copy new data to the array of a layer, and refresh only the canvas.

    When the data of a layer are set, napari also updates the axes of the viewer, the thumbnail and
    the layer list. These updates are not necessary during a drag; without them, an update takes a
    third of the time on the GUI thread.

    The `data` event of the layer is not emitted, and its thumbnail is not updated. Therefore, set
    the data of the layer after the last update.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    layer : napari.layers.Layer
        Layer with an array that no other object uses.
    data : ndarray
        New data.

    Returns
    -------
    bool
        True on success; False, without any change, if the shape or type differs or the array is
        read-only.
    """
    shown = layer.data
    if (shown.shape, shown.dtype) != (data.shape, data.dtype) or not shown.flags.writeable:
        return False
    np.copyto(shown, data)
    # Block events, because the layer list would be repainted although it has not changed.
    with viewer.layers.events.blocker_all():
        layer.refresh(thumbnail=False, highlight=False, extent=False)
    return True


@contextmanager
def same_selection(viewer: Any) -> Iterator[None]:
    """Return a context manager that restores the selection after layers are added or removed."""
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
    """Return the instance of a class for a viewer, creating it on first use.

    The instance is shared by all docks of the viewer, and continues to exist when docks are closed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    kind : type
        Class, called with the viewer; its instances must not have strong references to the viewer.
    """
    objects = _shared.setdefault(viewer, {})
    if kind not in objects:
        objects[kind] = kind(viewer)
    shared_object: _Shared = objects[kind]
    return shared_object
