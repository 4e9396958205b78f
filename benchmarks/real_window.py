"""Napari window with the dock, whose canvas receives simulated mouse events.

This module imports no module of the package, so that a benchmark can measure its first import.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import napari
from qtpy.QtCore import QEvent, QEventLoop, QObject, QPoint, QPointF, Qt, QTimer
from qtpy.QtGui import QMouseEvent
from qtpy.QtWidgets import QApplication

from benchmarks.clock import now, since

_LEFT = Qt.MouseButton.LeftButton


class Window:
    """Window with the dock and an image of tissue, in which a drag is simulated."""

    _dock: Any

    def __init__(self) -> None:
        self.viewer = napari.Viewer(show=False)
        self._canvas: Any = self.viewer.window._qt_viewer.canvas
        self._native = self._canvas.native
        self._shown: list[float] = []
        self._native.frameSwapped.connect(lambda: self._on_frame(now().wall))

    def add_dock(self) -> Any:
        """Add the dock of the package, show the window, and return the dock."""
        _, dock = self.viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
        self.viewer.show()
        return dock

    def settle(self) -> None:
        """Wait until there are no pending results."""
        self.wait(0.3)
        while self._dock.busy:
            self.wait(0.1)

    def wait(self, seconds: float) -> None:
        """Run the event loop of the window for a number of seconds."""
        loop = QEventLoop()
        QTimer.singleShot(round(1000 * seconds), loop.quit)
        loop.exec()

    def resize(self, width: int, height: int) -> None:
        """Give the window a size; docks request space when they are added, so wait for them."""
        self.wait(1.0)
        self.viewer.window.resize(width, height)
        self.wait(1.0)
        self.viewer.reset_view()
        self.wait(0.5)

    def place_of(self, *pixel: float) -> QPointF:
        """Return the position on the canvas of a pixel, or of a voxel in the 3-D view."""
        view = self._canvas.view
        x, y, _, w = (view.transform * view.scene.transform).map(pixel[::-1])
        return QPointF(QPoint(round(x / w), round(y / w)))

    def send(self, kind: QEvent.Type, place: QPointF) -> None:
        """Send an event of the left button at a position on the canvas."""
        none = Qt.MouseButton.NoButton
        pressed = none if kind == QEvent.Type.MouseButtonRelease else _LEFT
        changed = none if kind == QEvent.Type.MouseMove else _LEFT
        there = QPointF(self._native.mapToGlobal(place.toPoint()))
        modifiers = Qt.KeyboardModifier.NoModifier
        QApplication.sendEvent(
            self._native, QMouseEvent(kind, place, there, changed, pressed, modifiers)
        )

    def _on_frame(self, at: float) -> None:
        """Note that the canvas has been shown on the screen."""
        self._shown.append(at)


class Poster(QObject):
    """Object that posts events to the GUI thread at a constant rate, from a separate thread.

    Parameters
    ----------
    answer : callable
        Function called on the GUI thread with the time of the post.
    pause : float
        Interval between posts, in seconds.
    compress : bool
        True if a pending post is replaced by the next post; False if all posts are answered.
    """

    _KIND = QEvent.Type(QEvent.registerEventType())

    def __init__(
        self, answer: Callable[[float], None], pause: float, compress: bool = False
    ) -> None:
        super().__init__()
        self._answer, self._pause, self._compress = answer, pause, compress
        self._lock = threading.Lock()
        self._pending: list[float] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.waits: list[float] = []

    def start(self) -> None:
        """Start posting."""
        self._thread.start()

    def stop(self) -> None:
        """Stop posting."""
        self._over.set()
        self._thread.join()

    def customEvent(self, event: QEvent) -> None:
        """Answer the pending posts."""
        with self._lock:
            pending, self._pending = self._pending, []
        if pending:
            answered = now().wall
            self.waits += [answered - posted for posted in pending]
            self._answer(pending[-1])

    def _run(self) -> None:
        began, count = now(), 0
        while not self._over.wait(max(0.0, (count + 1) * self._pause - since(began).wall)):
            count += 1
            with self._lock:
                is_posted = bool(self._pending)
                posted = now().wall
                self._pending = [posted] if self._compress else [*self._pending, posted]
            if not is_posted:
                QApplication.postEvent(self, QEvent(self._KIND))
