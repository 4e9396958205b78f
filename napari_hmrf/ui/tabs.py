"""Docks of ours lie behind each other as tabs, the newest in front, and cut nothing off."""

from __future__ import annotations

import math
import weakref
from typing import Any

from magicgui.widgets import Container
from qtpy.QtCore import QEvent, QObject
from qtpy.QtWidgets import QDockWidget, QMainWindow

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.ui.timers import single_shot

#: Qt's property by which a widget of ours is known.
_OURS = "napari_hmrf_dock"
#: Until the canvas has the size that a new dock leaves it, in milliseconds.
_LAID_OUT = 50
#: The middle of a view is the same if it is not further away, in pixels of the screen.
_NEAR = 20


class Tabs(QObject):
    """Has a widget, once it is docked, be a tab beside those of ours that are docked there.

    An image that was seen whole is seen whole beside the dock, too. It is a child of the widget,
    and ends with it.

    Parameters
    ----------
    widget : Container
        A dock widget of ours, not docked yet.
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, widget: Container, viewer: Any) -> None:
        super().__init__(widget.native)
        self._viewer = weakref.ref(viewer)
        widget.native.setProperty(_OURS, True)
        self._dock: Any = None
        self._behind = self._hidden = False
        self._raising = single_shot(self, 0, self._raise)
        self._fitting = single_shot(self, _LAID_OUT, self._fit)
        widget.native.installEventFilter(self)

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """See when the widget is put into a dock, and when that dock is hidden."""
        if watched is self.parent():
            if event.type() == QEvent.Type.ParentChange:
                self._take(watched.parent())
        elif event.type() == QEvent.Type.Hide and self._in_sight:
            # napari's menu hides a dock that it finds open, a tab behind others, too: but who
            # chooses what is not seen wants to see it.
            self._hidden = not self._behind
            if self._behind:
                self._raising.start()
        elif event.type() == QEvent.Type.Show and self._hidden:
            self._hidden = False
            self._raising.start()
        return False

    @property
    def _in_sight(self) -> bool:
        """Whether the window is there to be looked at: with it all docks are hidden and shown."""
        window = self._dock.parent() if self._dock is not None else None
        return isinstance(window, QMainWindow) and window.isVisible()

    def _take(self, dock: Any) -> None:
        if dock is self._dock:
            return
        self._dock = dock if isinstance(dock, QDockWidget) else None
        self._behind = False
        if self._dock is not None:
            # Tabs show this, and would cut the plugin's name off; the bar above has it in full.
            self._dock.setWindowTitle(self._dock.windowTitle().partition(" (")[0])
            self._dock.dockLocationChanged.connect(self._on_placed)
            self._dock.visibilityChanged.connect(self._on_seen)
            self._dock.installEventFilter(self)

    def _on_placed(self, area: Any) -> None:
        """The dock has its place, but nothing is drawn yet; later moves are the user's own."""
        dock = self._dock
        dock.dockLocationChanged.disconnect(self._on_placed)
        window = dock.parent()
        if not isinstance(window, QMainWindow):
            return
        others = [
            other
            for other in window.findChildren(QDockWidget)
            if other is not dock
            and other.widget() is not None
            and other.widget().property(_OURS)
            and not other.isHidden()
            and not other.isFloating()
            and window.dockWidgetArea(other) == area
        ]
        if others:
            window.tabifyDockWidget(others[-1], dock)
            self._raising.start()
        elif window.isVisible() and sees_all(self._viewer()):
            self._fitting.start()

    def _on_seen(self, seen: bool) -> None:
        """Qt tells of a tab, too, whether it is in front."""
        dock = self._dock
        self._behind = not seen and dock is not None and not dock.isHidden()

    def _fit(self) -> None:
        viewer = self._viewer()
        if viewer is not None and self._in_sight:
            viewer.reset_view()

    def _raise(self) -> None:
        dock = self._dock
        if dock is None or dock.widget() is not self.parent():
            return
        if self._in_sight:
            dock.show()
            dock.raise_()


def sees_all(viewer: Any) -> bool:
    """Whether a viewer shows its layers about as its home button does, in two dimensions."""
    if viewer is None or not viewer.layers or viewer.dims.ndisplay != 2:
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
