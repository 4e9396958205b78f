"""Base class of dock widgets, with callbacks for docking and closing."""

from __future__ import annotations

import math
import weakref
from typing import Any

from magicgui.widgets import Container
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QMainWindow

from napari_hmrf.layers.compat import (
    CanvasContext,
    camera_of,
    clear_middle,
    hide_circle_in_corner,
    unwrapped,
)
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.ui.events import single_shot

#: Time after which the canvas has its final size beside a new dock, in milliseconds.
_LAYOUT_TIME = 50
#: Distance below which two view centres are considered equal, in screen pixels.
_SAME_CENTRE = 20
#: Lifetimes of all open docks, stored here because Qt's signals do not reference callbacks.
_lifetimes: set[_Lifetime] = set()


class Dock(Container):
    """Dock widget of a viewer.

    An image that was fully visible before docking remains fully visible beside the dock. The
    lifetime of a dock ends when the dock is closed or its window is deleted. The next dock that is
    opened continues with the state of the viewer.

    Parameters
    ----------
    napari_viewer : napari.Viewer
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(labels=False)
        self._viewer = unwrapped(napari_viewer)
        self._lifetime = _Lifetime(self)
        self._fit_timer = single_shot(self.native, _LAYOUT_TIME, self._viewer.reset_view)
        self._arrival_timer = single_shot(self.native, 0, self._on_arrived)
        clear_middle(self._viewer)
        hide_circle_in_corner(self._viewer)
        shared(self._viewer, CanvasContext)

    @property
    def away(self) -> bool:
        """True if the window was deleted or the dock was closed."""
        return self._lifetime.has_ended

    @property
    def docked(self) -> bool:
        """True if this widget is docked in a window."""
        return not self.away and self.native.parent() is not None

    def on_docked(self) -> None:
        """Fit the image into the remaining canvas, if the whole image was visible before."""
        self._arrival_timer.start()
        if sees_all(self._viewer):
            self.fit_view()

    def fit_view(self) -> None:
        """Fit all layers into the canvas, once the canvas has its final size."""
        self._fit_timer.start()

    def on_window(self, window: QMainWindow) -> None:
        """Respond to docking in a napari window."""

    def _on_arrived(self) -> None:
        window = self.native
        while window is not None and not isinstance(window, QMainWindow):
            window = window.parent()  # a floating dock has its own window
        if window is not None:
            self.on_window(window)

    def on_over(self, closed: bool) -> None:
        """Stop all timers if the dock was closed; with a deleted window, Qt deletes the timers."""
        if closed:
            for timer in self.native.findChildren(QTimer):
                timer.stop()


class _Lifetime:
    """Lifetime of a dock widget, after which no Qt object is used."""

    # The reference is weak: Qt would call a closure over the owner even while deleting the owner.
    def __init__(self, owner: Dock) -> None:
        self.has_ended = self._docked = False
        self._owner = weakref.ref(owner)
        _lifetimes.add(self)
        owner.native.destroyed.connect(self._on_destroyed)
        owner.native_parent_changed.connect(self._on_parent)

    def _on_destroyed(self, *_: Any) -> None:
        self.end(closed=False)

    def _on_parent(self, *_: Any) -> None:
        """Detect docking and closing: napari closes a dock by removing the widget from it."""
        owner, docked = self._owner(), self._docked
        self._docked = (
            not self.has_ended and owner is not None and owner.native.parent() is not None
        )
        if owner is not None and self._docked and not docked:
            owner.on_docked()
        elif docked and not self._docked:
            self.end(closed=True)

    def end(self, closed: bool) -> None:
        """End the lifetime after the dock was closed or its window was deleted."""
        over, self.has_ended = self.has_ended, True
        _lifetimes.discard(self)
        if not over and (owner := self._owner()) is not None:
            owner.on_over(closed)


def sees_all(viewer: Any) -> bool:
    """Return whether the 2D view of a viewer is close to napari's home view."""
    if not viewer.layers or viewer.dims.ndisplay != 2:
        return False
    camera = camera_of(viewer)
    center, zoom = camera.center, camera.zoom
    viewer.reset_view()
    # napari fits a first layer before the controls beside the canvas have their final width.
    same = math.isclose(zoom, camera.zoom, rel_tol=0.1)
    for one, other in zip(center[-2:], camera.center[-2:], strict=True):
        same = same and abs(one - other) * zoom < _SAME_CENTRE
    if not same:
        camera.center, camera.zoom = center, zoom
    return same
