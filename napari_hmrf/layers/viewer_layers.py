"""The one writer of the layers in a viewer: their visibility, data and order."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from napari.layers import Labels

from napari_hmrf.field.frame import PLACE
from napari_hmrf.layers.compat import without_stray_windows
from napari_hmrf.layers.field_layer import MOVED
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, metadata_of, role_of
from napari_hmrf.layers.result_layers import LayerData

#: Modes for painting in Labels layers, with the mode that picks a label from the image.
BRUSHES = ("paint", "erase", "fill", "polygon", "pick")


def still_there(viewer: Any, layer: Any) -> Any:
    """Return a layer if it is in the viewer, and None otherwise."""
    return layer if layer is not None and layer in viewer.layers else None


@dataclass
class _Visibility:
    #: True if neither the user nor `ViewerLayers.want` has hidden the layer.
    wanted: bool
    #: Visibility that was written last; if the layer's differs, the user has changed it.
    written: bool


class ViewerLayers:
    """Writer of the visibility, data and order of the layers in a viewer.

    A layer is visible if it is wanted and nothing hides it. `want`, or a click on the eye of the
    layer, changes whether it is wanted; `hide_while` gives the layers that something hides.
    `layers_of` returns the instance of a viewer.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    viewer : weak proxy of the viewer
    """

    def __init__(self, viewer: Any) -> None:
        self.viewer = weakref.proxy(viewer)
        self._states: weakref.WeakKeyDictionary[Any, _Visibility] = weakref.WeakKeyDictionary()
        # Layers that each owner hides, as an ordered set.
        self._hidden: weakref.WeakKeyDictionary[Any, weakref.WeakKeyDictionary[Any, None]] = (
            weakref.WeakKeyDictionary()
        )

    # Visibility

    def is_wanted(self, layer: Any) -> bool:
        """Return whether a layer has not been hidden by the user or by `want`."""
        return self._state(layer).wanted

    def want(self, *layers: Any, wanted: bool = True) -> None:
        """Show layers as soon as nothing hides them, or hide them until they are wanted again."""
        for layer in layers:
            self._state(layer).wanted = wanted
            self._write(layer)

    def hide_while(self, owner: object, layers: Iterable[Any]) -> None:
        """Hide layers on behalf of an owner, and no longer those that it has hidden before."""
        before, now = self._hidden.get(owner, ()), weakref.WeakKeyDictionary(dict.fromkeys(layers))
        self._hidden[owner] = now
        for layer in dict.fromkeys((*before, *now)):
            self._write(layer)

    def hide_still_paint(self) -> list[Any]:
        """Hide painted layers if a deformed image is visible, and return the hidden layers.

        Over a deformed image, the paint would look like an error of the deformation. It stays
        hidden until the user shows it. A layer in which a brush is selected stays visible.
        """
        if not is_deformed(self.viewer):
            return []
        shown = [each for each in self.viewer.layers if lies_still(each) and each.visible]
        hidden = [each for each in shown if not is_painted(self.viewer, each)]
        self.want(*hidden, wanted=False)
        return hidden

    def _state(self, layer: Any) -> _Visibility:
        state = self._states.setdefault(layer, _Visibility(layer.visible, layer.visible))
        if layer.visible != state.written:
            state.wanted = state.written = layer.visible
        return state

    def _write(self, layer: Any) -> None:
        state = self._state(layer)
        state.written = state.wanted and not any(layer in each for each in self._hidden.values())
        if layer.visible != state.written:  # an assignment ends the mode of a layer
            layer.visible = state.written

    # Data

    def update(self, layer: Any, made: LayerData) -> None:
        """Set the data, transform and metadata of a layer; display settings are unchanged."""
        layer.data = made.data
        for name in PLACE:
            # Assign only changed values: napari updates extents and redraws at each assignment.
            if not np.array_equal(getattr(layer, name), made.attributes[name]):
                setattr(layer, name, made.attributes[name])
        layer.metadata = made.attributes["metadata"]

    def set_data(self, layer: Any, data: npt.NDArray[Any]) -> None:
        """Set the data of a layer."""
        layer.data = data

    def overwrite(self, layer: Any, data: npt.NDArray[Any]) -> bool:
        """Copy new data to the array of a layer, and refresh only the canvas.

        When the data of a layer are set, napari also updates the axes of the viewer, the thumbnail
        and the layer list. These updates are not necessary during a drag; without them, an update
        takes a third of the time on the GUI thread.

        The `data` event of the layer is not emitted, and its thumbnail is not updated. Therefore,
        set the data of the layer after the last update.

        Parameters
        ----------
        layer : napari.layers.Layer
            Layer with an array that no other object uses.
        data : ndarray
            New data.

        Returns
        -------
        bool
            True on success; False, without any change, if the shape or type differs or the array
            is read-only.
        """
        shown = layer.data
        if (shown.shape, shown.dtype) != (data.shape, data.dtype) or not shown.flags.writeable:
            return False
        np.copyto(shown, data)
        # Block events, because the layer list would be repainted although it has not changed.
        with self.viewer.layers.events.blocker_all():
            layer.refresh(thumbnail=False, highlight=False, extent=False)
        return True

    # Order

    def add(self, layer: Any, at: int | None = None, *, select: bool = False) -> None:
        """Add a layer below the layer with index `at`, or on top; keep the selection by default."""
        layers, dims = self.viewer.layers, self.viewer.dims
        # napari 0.7.0 cannot add a hidden layer to a 3-D view.
        hides = not layer.visible and dims.ndisplay == 3 and layer.ndim > 2
        if hides:
            layer.visible = True
        at = len(layers) if at is None else at
        with nullcontext() if select else self.same_selection(), without_stray_windows():
            layers.insert(at, layer)
        if hides:
            self.want(layer, wanted=False)

    def move(self, layer: Any, at: int) -> None:
        """Move a layer below the layer with index `at`."""
        self.viewer.layers.move(self.viewer.layers.index(layer), at)

    def remove(self, layer: Any) -> None:
        """Remove a layer from the viewer."""
        self.viewer.layers.remove(layer)

    def above(self, *below: Any) -> int:
        """Return the lowest index above all given layers."""
        layers = self.viewer.layers
        return max((layers.index(each) + 1 for each in below if each in layers), default=0)

    @contextmanager
    def same_selection(self) -> Iterator[None]:
        """Return a context manager that restores the selection after layers change."""
        layers = self.viewer.layers
        selected, active = set(layers.selection), layers.selection.active
        with layers.selection.events.active.blocker():
            yield
            layers.selection = {layer for layer in selected if layer in layers}
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


def layers_of(viewer: Any) -> ViewerLayers:
    """Return the `ViewerLayers` of a viewer."""
    return shared(viewer, ViewerLayers)


def lies_still(layer: Any) -> bool:
    """Return whether a layer shows tissue or boundaries at their undeformed positions."""
    return role_of(layer) in (TISSUE, BOUNDARY) and metadata_of(layer).get("kind") != MOVED


def is_painted(viewer: Any, layer: Any) -> bool:
    """Return whether a brush of napari is selected in a layer."""
    is_active = isinstance(layer, Labels) and layer is viewer.layers.selection.active
    return is_active and layer.mode in BRUSHES


def layer_painted(viewer: Any) -> Any:
    """Return the tissue or boundary layer in which a brush of napari is selected, or None."""
    active = viewer.layers.selection.active
    return active if is_painted(viewer, active) and lies_still(active) else None


def put_brush_away(viewer: Any) -> None:
    """Let the mouse move the view again if a brush is selected in a tissue or boundary layer."""
    if (layer := layer_painted(viewer)) is not None:
        layer.mode = "pan_zoom"


def is_deformed(viewer: Any) -> bool:
    """Return whether a deformed image is visible."""
    return any(each.visible and metadata_of(each).get("kind") == "image" for each in viewer.layers)
