"""Calls on the GUI thread: from other threads, and after the window is painted."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

from qtpy.QtCore import QCoreApplication, QEvent, QObject, Qt, Signal

from napari_hmrf.ui.events import single_shot

#: Function that is called without arguments.
Call = Callable[[], object]


class GuiThread(QObject):
    """Queue of calls that run, in order, in the event loop of the thread that created the queue.

    The object has no parent, because a parent could delete it while another thread submits a call.
    """

    _submitted = Signal(object)

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._released = False
        self._submitted.connect(self._run, Qt.ConnectionType.QueuedConnection)

    def submit(self, call: Call) -> None:
        """Submit a call from any thread, and return immediately."""
        with self._lock:
            if not self._released:
                self._submitted.emit(call)

    def release(self) -> None:
        """Drop all pending and later calls."""
        with self._lock:
            self._released = True
        with suppress(RuntimeError):  # at exit Qt may have deleted the object already
            self.deleteLater()

    def _run(self, call: Call) -> None:
        if not self._released:
            call()


class Repainted(QObject):
    """Callback that runs once the window is repainted and pending mouse events are processed.

    Qt posts its paint request with low priority, so an event with an even lower priority is
    processed after the request. Pending mouse events are processed next, then zero-delay timers.

    Parameters
    ----------
    callback : callable
        Called in the event loop of the thread that created this object.
    """

    _KIND = QEvent.Type(QEvent.registerEventType())
    _PRIORITY = int(getattr(Qt.EventPriority.LowEventPriority, "value", -1)) - 1

    def __init__(self, callback: Callable[[], None]) -> None:
        super().__init__()
        self._timer = single_shot(self, 0, callback)

    def schedule(self) -> None:
        """Schedule the callback to run after the next painting."""
        QCoreApplication.postEvent(self, QEvent(self._KIND), self._PRIORITY)

    def event(self, event: QEvent | None) -> bool:
        """Start the timer of the callback when the posted event arrives, after the painting."""
        if event is not None and event.type() == self._KIND:
            self._timer.start()
            return True
        return bool(super().event(event))

    def release(self) -> None:
        """Cancel the callback, and delete this object."""
        with suppress(RuntimeError):  # at exit Qt may have deleted the object already
            QCoreApplication.removePostedEvents(self)
            self._timer.stop()
            self.deleteLater()
