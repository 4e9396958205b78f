"""Jobs on the compute thread, and calls on the GUI thread."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple, TypeVar

import psygnal
from qtpy.QtCore import QCoreApplication, QEvent, QObject, Qt, Signal

from napari_hmrf.errors import Cancelled, in_words, is_expected
from napari_hmrf.solver.latest_queue import LatestQueue, Turn
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.window_words import in_window_words

_log = logging.getLogger("napari_hmrf")
T = TypeVar("T")
#: Description of a job in the messages of other jobs that wait for it.
_DOING = "a picture that is being drawn"
#: Function that is called without arguments.
Call = Callable[[], object]
#: Function that reports an error.
Refuse = Callable[[Exception], object]


def reason_of(error: Exception) -> str:
    """Return the message of an error in the words of the window."""
    return in_window_words(in_words(error))


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


class Jobs:
    """Runner for all background jobs of a dock; a new job replaces a pending job of the same kind.

    A job calls `work` in the background, which must reference only copies of data, and no Qt
    objects, because the dock may be deleted before the job ends. Then `show` is called with the
    result, or `refuse` with the error, unless the job was cancelled. By default, the reason of an
    error is emitted as `refused`.

    All methods must be called on the GUI thread.

    Attributes
    ----------
    gui : GuiThread
        Queue of calls on the GUI thread, also for other threads.
    """

    #: Emitted with the reason why a job has failed.
    refused = psygnal.Signal(str)

    def __init__(self) -> None:
        self._pending: dict[str, _Pending] = {}
        self._monitors: dict[str, Monitor] = {}
        self.gui = GuiThread()

    def submit(
        self,
        kind: str,
        work: Callable[..., T],
        show: Callable[[T], object],
        refuse: Refuse | None = None,
        *,
        doing: str = _DOING,
        yields: bool = False,
    ) -> None:
        """Submit a job.

        The result of a running job is shown even if a newer job is pending, so that the picture
        is updated during a drag.

        Parameters
        ----------
        kind : str
        work, show, refuse : callable
            As described above.
        doing : str
            Description of the job and how to stop it, for work that waits for it.
        yields : bool
            If False, the job has the compute thread to itself. If True, it has a thread of its own,
            so that edits are solved between two of its solves; `work` is then called with
            `progress` and `cancel`, as `solve` is.
        """

        def run(turn: Turn, **how: Any) -> None:
            call: Call | None = None
            try:
                call = partial(show, work(**how))
            except Cancelled:
                pass
            except Exception as error:  # noqa: BLE001 - every error is reported to the user
                level = logging.DEBUG if is_expected(error) else logging.ERROR
                _log.log(level, "%s failed", kind, exc_info=True)
                call = partial(refuse or self._refuse, error)
            self.gui.submit(partial(self._finish, kind, turn, call))

        def start_thread(turn: Turn) -> None:
            how = {"progress": partial(self._report, kind, turn), "cancel": turn}
            threading.Thread(target=run, args=(turn,), kwargs=how, name=kind, daemon=True).start()

        pending = self._pending.get(kind)
        queue = LatestQueue(doing) if pending is None else pending.queue
        self._monitors[kind] = Monitor("starting", 0.0)
        self._pending[kind] = _Pending(queue, queue.submit(start_thread if yields else run))

    def busy(self, *kinds: str) -> bool:
        """Return whether any job, or any job of the given kinds, is unfinished."""
        return any(kind in self._pending for kind in kinds or self._pending)

    def monitor(self, kind: str) -> Monitor | None:
        """Return the progress that an unfinished job of its own thread has reported, or None."""
        return self._monitors[kind] if self.busy(kind) else None

    def cancel(self, *kinds: str) -> None:
        """Drop all jobs, or all jobs of the given kinds; a running job stops soon."""
        for kind in kinds or [*self._pending]:
            if kind in self._pending:
                self._pending.pop(kind).queue.close()

    def release(self) -> None:
        """Drop all jobs, and stop delivering results."""
        self.cancel()
        self.gui.release()

    def _report(self, kind: str, turn: Turn, monitor: Monitor) -> None:
        if not turn.dropped:
            self._monitors[kind] = monitor

    def _refuse(self, error: Exception) -> None:
        self.refused.emit(reason_of(error))

    def _finish(self, kind: str, turn: Turn, call: Call | None) -> None:
        if turn.dropped:
            return
        pending = self._pending.get(kind)
        if pending is not None and pending.turn is turn:
            del self._pending[kind]
        if call is not None:
            call()
