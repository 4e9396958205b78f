"""Docks of ours lie behind each other as tabs, the newest in front, and squeeze nothing."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import Container
from qtpy.QtCore import QEvent, QObject, QTimer
from qtpy.QtWidgets import QDockWidget, QMainWindow

#: Qt's property by which a widget of ours is known.
_OURS = "napari_hmrf_dock"


class Tabs(QObject):
    """Has a widget, once it is docked, be a tab beside those of ours that are docked there.

    It is a child of the widget, and ends with it.

    Parameters
    ----------
    widget : Container
        A dock widget of ours, not docked yet.
    """

    def __init__(self, widget: Container) -> None:
        super().__init__(widget.native)
        widget.native.setProperty(_OURS, True)
        self._dock: Any = None
        self._behind = self._hidden = False
        self._raising = QTimer(self)
        self._raising.setSingleShot(True)
        self._raising.timeout.connect(self._raise)
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
                self._raising.start(0)
        elif event.type() == QEvent.Type.Show and self._hidden:
            self._hidden = False
            self._raising.start(0)
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
            self._raising.start(0)

    def _on_seen(self, seen: bool) -> None:
        """Qt tells of a tab, too, whether it is in front."""
        dock = self._dock
        self._behind = not seen and dock is not None and not dock.isHidden()

    def _raise(self) -> None:
        dock = self._dock
        if dock is None or dock.widget() is not self.parent():
            return
        if self._in_sight:
            dock.show()
            dock.raise_()
