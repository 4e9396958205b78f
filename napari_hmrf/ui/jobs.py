"""Jobs on the compute thread, and calls on the GUI thread."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import NamedTuple, TypeVar

from qtpy.QtCore import QCoreApplication, QEvent, QObject, Qt, Signal

from napari_hmrf.errors import Cancelled, in_words
from napari_hmrf.solver.latest_queue import LatestQueue, Turn
from napari_hmrf.ui.events import single_shot
from napari_hmrf.wording import in_words_of

_log = logging.getLogger("napari_hmrf")
T = TypeVar("T")
# Description of these jobs in the messages of other jobs that wait for them.
_DOING = "a picture that is being drawn"
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


class _Pending(NamedTuple):
    """Queue for one kind of job, and the turn of the latest job."""

    queue: LatestQueue
    turn: Turn


class BackgroundJobs:
    """Runner for jobs on the compute thread; a new job replaces a pending job of the same kind.

    Jobs must reference only copies of data, and no Qt objects, because the caller may be deleted
    before a job ends. All methods must be called on the GUI thread.

    Parameters
    ----------
    refuse : callable
        Called with the error message if a job raises an error.
    """

    def __init__(self, refuse: Callable[[str], object]) -> None:
        self._refuse = refuse
        self._pending: dict[str, _Pending] = {}
        self._gui = GuiThread()

    def submit(self, kind: str, work: Callable[[], T], show: Callable[[T], object]) -> None:
        """Submit a job; `show` is called with the result unless a newer job replaces this job.

        The result of a running job is shown even if a newer job is pending, so that the picture
        is updated during a drag.
        """
        pending = self._pending.get(kind)
        queue = LatestQueue(_DOING) if pending is None else pending.queue

        def job(turn: Turn) -> None:
            try:
                result = work()
            except Cancelled:
                raise
            except Exception as error:  # noqa: BLE001 - every error is reported to the user
                _log.debug("%s failed", kind, exc_info=True)
                call = partial(self._refuse, in_words_of("window", in_words(error)))
            else:
                call = partial(show, result)
            self._gui.submit(partial(self._finish, kind, turn, call))

        self._pending[kind] = _Pending(queue, queue.submit(job))

    def busy(self, kind: str | None = None) -> bool:
        """Return whether any job, or any job of the given kind, is unfinished."""
        return bool(self._pending) if kind is None else kind in self._pending

    def cancel(self, kind: str | None = None) -> None:
        """Drop all jobs, or all jobs of a kind; a running job stops at its next checkpoint."""
        for each in [*self._pending] if kind is None else [kind]:
            if each in self._pending:
                self._pending.pop(each).queue.close()

    def release(self) -> None:
        """Drop all jobs, and stop delivering results."""
        self.cancel()
        self._gui.release()

    def _finish(self, kind: str, turn: Turn, call: Callable[[], object]) -> None:
        if turn.dropped:
            return
        pending = self._pending.get(kind)
        if pending is not None and pending.turn is turn:
            del self._pending[kind]
        call()
