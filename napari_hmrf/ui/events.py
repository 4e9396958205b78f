"""Timers of the window, and connections to napari events."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from qtpy.QtCore import QObject, Qt, QTimer
from qtpy.QtGui import QGuiApplication


def single_shot(
    parent: QObject | None, milliseconds: int, callback: Callable[[], object]
) -> QTimer:
    """Create a timer that fires once, a fixed time after its last start.

    Parameters
    ----------
    parent : QObject, optional
        Owner of the timer; the timer is deleted with its owner.
    milliseconds : int
        Delay. With 0, the timer fires as soon as Qt has processed all pending events.
    callback : callable
        Called in the event loop of the thread that created the timer.

    Returns
    -------
    QTimer
        The timer, not started yet.
    """
    timer = repeating(parent, milliseconds, callback)
    timer.setSingleShot(True)
    return timer


def repeating(parent: QObject | None, milliseconds: int, callback: Callable[[], object]) -> QTimer:
    """Create a timer that fires at a fixed interval from its start until it is stopped.

    The parameters are the same as for `single_shot`.
    """
    timer = QTimer(parent)
    timer.setInterval(milliseconds)
    timer.timeout.connect(callback)
    return timer


class EventConnections:
    """Callbacks that are connected to events until `release` is called.

    Parameters
    ----------
    *connections : tuple of (event, callable)
        Events or signals, each with its callback.
    """

    def __init__(self, *connections: tuple[Any, Callable[..., object]]) -> None:
        self._connections = connections
        for event, callback in connections:
            event.connect(callback)

    def release(self) -> None:
        """Disconnect all callbacks."""
        for event, callback in self._connections:
            event.disconnect(callback)
        self._connections = ()


class Return:
    """Time at which the user last returned from another application.

    Windows of this application, such as a floating dock, do not count.
    """

    def __init__(self) -> None:
        self._app: Any = QGuiApplication.instance()
        self._has_been_active = self._is_active
        self._at = -math.inf
        self._app.applicationStateChanged.connect(self._on_state)

    @property
    def _is_active(self) -> bool:
        return bool(self._app.applicationState() == Qt.ApplicationState.ApplicationActive)

    def is_since(self, when: float) -> bool:
        """Return whether the user has returned since a time of `time.monotonic`."""
        return self._at >= when

    def release(self) -> None:
        """Disconnect from the application."""
        self._app.applicationStateChanged.disconnect(self._on_state)

    def _on_state(self, state: Any) -> None:
        if state == Qt.ApplicationState.ApplicationActive:
            if self._has_been_active:
                self._at = time.monotonic()
            self._has_been_active = True
