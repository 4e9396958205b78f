"""Handover of results from the compute thread to the GUI thread."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any, NamedTuple

from qtpy.QtCore import QCoreApplication, QEvent, QObject, Qt, Signal

from napari_hmrf.errors import in_words
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.ui.events import single_shot
from napari_hmrf.wording import in_words_of

_log = logging.getLogger("napari_hmrf")
_Answer = Callable[[Any], None]
# Description of an errand for other jobs' messages, after "waiting for".
_DOING = "a picture that is being drawn"


class Newest(QObject):
    """Mailbox that delivers only the latest value, on the GUI thread.

    Any thread may put a value; a replaced value is never delivered. The object has no parent,
    because a parent could delete it while another thread puts a value.

    Parameters
    ----------
    answer : callable
        Called with the value on the thread that created this object, by its event loop.
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
        """Replace the pending value, without waiting for its delivery."""
        with self._lock:
            if self._released:
                return
            self._waiting = [value]
            self._came.emit()

    @property
    def waits(self) -> bool:
        """True if a value is pending."""
        return bool(self._waiting)

    def forget(self) -> None:
        """Drop the pending value."""
        with self._lock:
            # A queued callback then finds no value.
            self._waiting = []

    def release(self) -> None:
        """Drop the pending value and every value that is put later."""
        with self._lock:
            self._released, self._waiting = True, []
        with suppress(RuntimeError):  # at exit Qt may have deleted the object already
            self.deleteLater()

    def _on_came(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []
        if waiting:
            self._answer(waiting[0])


class _Errand(NamedTuple):
    """Submitted background task."""

    kind: str
    answer: _Answer
    #: Set when the answer is no longer needed.
    forgotten: threading.Event


class Errands:
    """Background tasks on the compute thread; only the newest queued task of each kind runs.

    Tasks must hold copies only and no Qt objects: their sender may be gone when they end.

    Parameters
    ----------
    refuse : callable
        Called with the message of the error that a task raised.
    """

    def __init__(self, refuse: Callable[[str], object]) -> None:
        self._refuse = refuse
        self._sent: dict[Future[Any], _Errand] = {}
        self._ended = Newest(self._on_ended)

    def send(self, kind: str, work: Callable[[], Any], answer: _Answer) -> None:
        """Submit a task; `answer` is called with its return value, unless a newer task replaces it.

        A task that is running already is answered, too, so that the picture moves during a drag.
        """
        for future in self._of(kind):
            if future.cancel():
                del self._sent[future]
        errand = _Errand(kind, answer, threading.Event())

        def run() -> Any:
            with compute_thread.unless(errand.forgotten.is_set):
                return work()

        future = compute_thread.submit(run, _DOING)
        self._sent[future] = errand
        future.add_done_callback(self._ended.put)

    def busy(self, kind: str | None = None) -> bool:
        """Return whether a task of a kind, or any task, is not answered yet."""
        return bool(self._of(kind))

    def forget(self, kind: str | None = None) -> None:
        """Discard the tasks of a kind, or all; a running task stops at its next checkpoint."""
        for future in self._of(kind):
            self._sent.pop(future).forgotten.set()
            future.cancel()

    def release(self) -> None:
        """Discard all tasks, and answer none from now on."""
        self.forget()
        self._ended.release()

    def _of(self, kind: str | None) -> list[Future[Any]]:
        return [future for future, errand in self._sent.items() if kind in (None, errand.kind)]

    def _on_ended(self, _: Future[Any]) -> None:
        """Answer every task that has ended, as only the newest of several signals is delivered."""
        for future in self._of(None):
            if not future.done() or future not in self._sent:
                continue  # an earlier answer may have discarded this task
            kind, answer = self._sent.pop(future)[:2]
            try:
                found = future.result(timeout=0)
            except Exception as error:  # noqa: BLE001 - every error is reported to the user
                _log.debug("%s failed", kind, exc_info=True)
                self._refuse(in_words_of("window", in_words(error)))
            else:
                answer(found)


class Repainted(QObject):
    """Callback after the next painting of the window and the mouse events that follow it.

    Qt posts its request to paint with low priority, so that an event posted with a lower one comes
    after it. Pending mouse events are processed next, and then timers without a delay fire.

    Parameters
    ----------
    answer : callable
        Called on the thread that created this object, by its event loop.
    """

    _KIND = QEvent.Type(QEvent.registerEventType())
    _PRIORITY = int(getattr(Qt.EventPriority.LowEventPriority, "value", -1)) - 1

    def __init__(self, answer: Callable[[], None]) -> None:
        super().__init__()
        self._timer = single_shot(self, 0, answer)

    def ask(self) -> None:
        """Schedule the callback after the next painting."""
        QCoreApplication.postEvent(self, QEvent(self._KIND), self._PRIORITY)

    def event(self, event: QEvent | None) -> bool:
        """Start the timer of the callback, as the requested painting is done."""
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
