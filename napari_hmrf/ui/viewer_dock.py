"""What a dock widget has to know: the viewer it is in, and whether it is there."""

from __future__ import annotations

import math
import weakref
from typing import Any

from magicgui.widgets import Container
from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QMainWindow

from napari_hmrf.layers.compat import CanvasContext, camera_of, clear_middle, unwrapped
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.ui.events import single_shot

#: Until the canvas has the size that a new dock leaves it, in milliseconds.
_LAID_OUT = 50
#: The middle of a view is the same if it is not further away, in pixels of the screen.
_NEAR = 20
#: Qt's signals keep no strong reference to those they call: this does, until the dock is over.
_living: set[_Life] = set()


class Dock(Container):
    """Knows its viewer; an image that was seen whole is seen whole beside it, too.

    A dock that was closed is over, as is one whose window is gone; the next one that is opened goes
    on with what is in the viewer.

    Parameters
    ----------
    napari_viewer : napari.Viewer
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(labels=False)
        self._viewer = unwrapped(napari_viewer)
        self._life = _Life(self)
        self._fitting = single_shot(self.native, _LAID_OUT, self._viewer.reset_view)
        self._arriving = single_shot(self.native, 0, self._on_arrived)
        clear_middle(self._viewer)
        shared(self._viewer, CanvasContext)

    @property
    def away(self) -> bool:
        """Whether the window is gone, or the dock was closed."""
        return self._life.over

    @property
    def docked(self) -> bool:
        """Whether there is a dock around this, in a window."""
        return not self.away and self.native.parent() is not None

    def on_docked(self) -> None:
        """See all of the image beside the dock, if all was seen before."""
        self._arriving.start()
        if sees_all(self._viewer):
            self._fitting.start()

    def on_window(self, window: QMainWindow) -> None:
        """The dock is in a window of napari's."""

    def _on_arrived(self) -> None:
        window = self.native
        while window is not None and not isinstance(window, QMainWindow):
            window = window.parent()  # a dock that floats has a window of its own, too
        if window is not None:
            self.on_window(window)

    def on_over(self, closed: bool) -> None:
        """The dock was closed, or the window is gone: listen to nothing any more."""
        if closed:
            for timer in self.native.findChildren(QTimer):
                timer.stop()


class _Life:
    """Ends with a dock widget; then nothing of Qt's is touched any more."""

    # A closure over the owner would be called by Qt even while Python is taking both apart.
    def __init__(self, owner: Dock) -> None:
        self.over = self._docked = False
        self._owner = weakref.ref(owner)
        _living.add(self)
        owner.native.destroyed.connect(self._on_destroyed)
        owner.native_parent_changed.connect(self._on_parent)

    def _on_destroyed(self, *_: Any) -> None:
        self.end(closed=False)

    def _on_parent(self, *_: Any) -> None:
        """Napari closes a dock by taking the widget out of it."""
        owner, docked = self._owner(), self._docked
        self._docked = not self.over and owner is not None and owner.native.parent() is not None
        if owner is not None and self._docked and not docked:
            owner.on_docked()
        elif docked and not self._docked:
            self.end(closed=True)

    def end(self, closed: bool) -> None:
        """The dock was closed, or its window is gone."""
        over, self.over = self.over, True
        _living.discard(self)
        if not over and (owner := self._owner()) is not None:
            owner.on_over(closed)


def sees_all(viewer: Any) -> bool:
    """Whether a viewer shows its layers about as its home button does, in two dimensions."""
    if not viewer.layers or viewer.dims.ndisplay != 2:
        return False
    camera = camera_of(viewer)
    center, zoom = camera.center, camera.zoom
    viewer.reset_view()
    # napari fits a first layer before it knows how wide the controls beside it are.
    same = math.isclose(zoom, camera.zoom, rel_tol=0.1)
    for one, other in zip(center[-2:], camera.center[-2:], strict=True):
        same = same and abs(one - other) * zoom < _NEAR
    if not same:
        camera.center, camera.zoom = center, zoom
    return same
