"""Handing results over to the window's thread, the newest only."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from qtpy.QtCore import QObject, Qt, Signal


class Newest(QObject):
    """What is put here from any thread is answered on the window's, and what is replaced never.

    It has no parent, as that would end it while another thread puts something in.

    Parameters
    ----------
    answer : callable
        Called on the thread this was made on, by its event loop.
    """

    _came = Signal()

    def __init__(self, answer: Callable[[Any], None]) -> None:
        super().__init__()
        self._answer = answer
        self._lock = threading.Lock()
        self._waiting: list[Any] = []
        self._released = False
        self._came.connect(self._on_came, Qt.ConnectionType.QueuedConnection)

    def put(self, value: Any) -> None:
        """Have this answered instead of what waits; returns at once."""
        with self._lock:
            if self._released:
                return
            told = bool(self._waiting)
            self._waiting = [value]
            if not told:
                self._came.emit()

    @property
    def waits(self) -> bool:
        """Whether something is not answered yet."""
        return bool(self._waiting)

    def forget(self) -> None:
        """Drop what waits."""
        with self._lock:
            # Whoever was told finds nothing.
            self._waiting = []

    def release(self) -> None:
        """Answer nothing any more; what is put from now on is dropped."""
        with self._lock:
            self._released, self._waiting = True, []
        with suppress(RuntimeError):  # at the end of the program Qt may have ended it already
            self.deleteLater()

    def _on_came(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []
        if waiting and not self._released:
            self._answer(waiting[0])
