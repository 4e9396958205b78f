"""Knowing when the window has painted what it was given."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from qtpy.QtCore import QCoreApplication, QEvent, QObject, Qt

from napari_hmrf.ui.timers import single_shot


class Repainted(QObject):
    """Tells, once asked, when the window has painted and has heard of the mouse since.

    Qt posts itself a request to paint, of low priority: what is posted with a lower one comes after
    it. What the mouse has done meanwhile is heard next, and then timers without a delay ring.

    Parameters
    ----------
    answer : callable
        Called on the thread this was made on, by its event loop.
    """

    _KIND = QEvent.Type(QEvent.registerEventType())
    _PRIORITY = int(getattr(Qt.EventPriority.LowEventPriority, "value", -1)) - 1

    def __init__(self, answer: Callable[[], None]) -> None:
        super().__init__()
        self._timer = single_shot(self, 0, answer)
        self._released = False

    def ask(self) -> None:
        """Have the answer called after the next painting."""
        QCoreApplication.postEvent(self, QEvent(self._KIND), self._PRIORITY)

    def event(self, event: QEvent | None) -> bool:
        """What was asked for has been painted."""
        if event is not None and event.type() == self._KIND:
            if not self._released:
                self._timer.start()
            return True
        return bool(super().event(event))

    def release(self) -> None:
        """Tell nothing any more."""
        self._released = True
        with suppress(RuntimeError):  # at the end of the program Qt may have ended it already
            self._timer.stop()
            self.deleteLater()
