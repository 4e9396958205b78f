"""Rendering of an image and its deformed copy in napari's 3-D view: their surface."""

from __future__ import annotations

import weakref
from contextlib import ExitStack
from functools import partial
from typing import Any

from napari.layers import Image

from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.viewer_layers import layers_of, still_there
from napari_hmrf.tissue.surroundings import surface_value

#: Settings of an Image layer for the 3-D view.
_SETTINGS = ("rendering", "iso_threshold", "attenuation", "interpolation3d", "depiction")
#: Settings of the plane of an Image layer.
_PLANE = ("position", "normal", "thickness")
#: Rendering of napari for a new image, and rendering of a surface.
_USUAL, _SURFACE = "mip", "iso"
# Images whose rendering the user has chosen; it is not changed again.
_chosen: weakref.WeakSet[Any] = weakref.WeakSet()


class VolumeLook:
    """Link between the rendering of a volume and of its deformed copy.

    In a slice view, the deformed copy covers the image. In the 3-D view, both would be visible at
    the same time, so the image is hidden while its deformed copy is visible, and so are slices of
    other studies, which would show through the volume.

    If tissue is surrounded by air, the 3-D view shows its surface: a maximum projection of a head
    is a white disc. A rendering that the user has chosen is not changed.

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
        # True while a surface is shown that the user has not chosen, and while it is set.
        self._shows_surface = self._is_setting = False
        # True if the linked layers have been in a 3-D view.
        self._is_decided = False
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
            self._connect(layer.events.rendering, self._on_rendering)
            self._connect(layer.plane.events, copy)
            self._connect(layer.events.visible, self._update)
        self._connect(self._viewer.dims.events.ndisplay, self._update)
        self._update()

    def release(self) -> None:
        """Show the hidden layers and the usual rendering again, and disconnect from both layers."""
        self._connections.close()
        self._show_hidden()
        self._is_decided = False
        if self._shows_surface:
            self._shows_surface = False
            for layer in (self._source, self._picture):
                layer.rendering = _USUAL
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
        """Hide the image and slices if the view is 3-D and the deformed copy is visible.

        In the first 3-D view, show the surface of the tissue.
        """
        picture = still_there(self._viewer, self._picture)
        if picture is not None and self._viewer.dims.ndisplay == 3 and not self._is_decided:
            self._is_decided = True
            self._show_surface()
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

    def _show_surface(self) -> None:
        """Show the surface of the tissue if neither the user nor a script has chosen otherwise."""
        source, picture = self._source, self._picture
        is_usual = source.rendering == _USUAL and source not in _chosen
        if not is_usual or picture.rgb or picture.data.ndim != 3:
            return
        value = surface_value(picture.data)
        if value is not None:
            self._is_setting = True
            for layer in (source, picture):
                layer.iso_threshold, layer.rendering = value, _SURFACE
            self._is_setting, self._shows_surface = False, True

    def _on_rendering(self, _: Any) -> None:
        """Note that the user has chosen a rendering."""
        if not self._is_setting:
            _chosen.add(self._source)
            self._shows_surface = False

    def _show_hidden(self) -> None:
        self._is_covering, self._hidden = False, []
        self._layers.hide_while(self, [])


def _is_slice(layer: Any) -> bool:
    """Return whether a layer is a slice of a volume, or the result of a slice."""
    if metadata_of(layer).get("slice"):
        return True
    return isinstance(layer, Image) and layer.ndim >= 3 and 1 in layer.data.shape[-3:]
