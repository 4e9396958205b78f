"""Rendering of an image and its deformed copy in napari's 3-D view, which must agree."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import Any

from napari.layers import Image

from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.viewer_layers import layers_of, still_there

#: Settings of an Image layer for the 3-D view.
_SETTINGS = ("rendering", "iso_threshold", "attenuation", "interpolation3d", "depiction")
#: Settings of the plane of an Image layer.
_PLANE = ("position", "normal", "thickness")


class VolumeLook:
    """Link between the rendering of a volume and of its deformed copy.

    In a slice view, the deformed copy covers the image. In the 3-D view, both would be visible at
    the same time, so the image is hidden while its deformed copy is visible, and so are slices of
    other studies, which would show through the volume.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer, self._layers = viewer, layers_of(viewer)
        self._source: Any = None
        self._picture: Any = None
        self._connections = ExitStack()
        self._is_copying = False
        # Layers that are hidden while the deformed copy covers them.
        self._hidden: list[Any] = []
        self._is_covering = False

    def link(self, source: Any, picture: Any) -> None:
        """Link the rendering of two layers, in place of the layers that were linked last.

        Parameters
        ----------
        source : napari.layers.Image or None
            Image before the motion.
        picture : napari.layers.Image or None
            Its deformed copy; None if no volume is deformed.
        """
        if source is self._source and picture is self._picture:
            return
        self.release()
        if source is None or picture is None or not hasattr(source, "depiction"):
            return
        self._source, self._picture = source, picture
        self._copy(source, picture)
        for layer, other in ((source, picture), (picture, source)):
            copy = partial(self._copy, layer, other)
            for name in _SETTINGS:
                self._connect(getattr(layer.events, name), copy)
            self._connect(layer.plane.events, copy)
            self._connect(layer.events.visible, self._update)
        self._connect(self._viewer.dims.events.ndisplay, self._update)
        self._update()

    def release(self) -> None:
        """Show the hidden layers again, and disconnect from both layers."""
        self._connections.close()
        self._show_hidden()
        self._source = self._picture = None

    def _connect(self, signal: Any, callback: Any) -> None:
        signal.connect(callback)
        self._connections.callback(signal.disconnect, callback)

    def _copy(self, layer: Any, other: Any, *_: Any) -> None:
        """Copy the settings of a layer to the other layer."""
        if self._is_copying:
            return
        self._is_copying = True
        try:
            for owner, to, names in ((layer, other, _SETTINGS), (layer.plane, other.plane, _PLANE)):
                for name in names:
                    value = getattr(owner, name)
                    if getattr(to, name) != value:
                        setattr(to, name, value)
        finally:
            self._is_copying = False

    def _update(self, *_: Any) -> None:
        """Hide the image and slices if the view is 3-D and the deformed copy is visible."""
        picture = still_there(self._viewer, self._picture)
        covers = picture is not None and picture.visible and self._viewer.dims.ndisplay == 3
        if not covers:
            self._show_hidden()
        elif not self._is_covering:
            self._is_covering = True
            slices = [layer for layer in self._viewer.layers if _is_slice(layer)]
            self._hidden = [self._source, *slices]
            self._layers.hide_while(self, self._hidden)
        elif self._source.visible and self._source in self._hidden:  # shown again by the user
            self._hidden.remove(self._source)
            self._layers.hide_while(self, self._hidden)

    def _show_hidden(self) -> None:
        self._is_covering, self._hidden = False, []
        self._layers.hide_while(self, [])


def _is_slice(layer: Any) -> bool:
    """Return whether a layer is a slice of a volume, or the result of a slice."""
    if metadata_of(layer).get("slice"):
        return True
    return isinstance(layer, Image) and layer.ndim >= 3 and 1 in layer.data.shape[-3:]
