"""What the compute thread finds, handed over to the window's thread."""

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
# What those who wait for an errand are told.
_DOING = "a picture that is being drawn"


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
            self._waiting = [value]
            self._came.emit()

    @property
    def waits(self) -> bool:
        """Whether something is not answered yet."""
        return bool(self._waiting)

    def forget(self) -> None:
        """Drop what waits."""
        with self._lock:
            # Who was told finds nothing.
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
        if waiting:
            self._answer(waiting[0])


class _Errand(NamedTuple):
    """What was sent."""

    kind: str
    answer: _Answer
    #: Set when nobody wants its answer any more.
    forgotten: threading.Event


class Errands:
    """Small work on the compute thread; of those of a kind that wait, only the newest is ever run.

    Work must hold copies only, and nothing of Qt's: whoever sent it may be gone when it ends.

    Parameters
    ----------
    refuse : callable
        Given what was wrong, in words, with work that raised an error.
    """

    def __init__(self, refuse: Callable[[str], object]) -> None:
        self._refuse = refuse
        self._sent: dict[Future[Any], _Errand] = {}
        self._ended = Newest(self._on_ended)

    def send(self, kind: str, work: Callable[[], Any], answer: _Answer) -> None:
        """Have work done; `answer` is called with what it returns, unless newer work replaces it.

        What is being computed already is shown, too, so that something moves while one drags.
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
        """Whether an errand of a kind, or any, is not answered yet."""
        return bool(self._of(kind))

    def forget(self, kind: str | None = None) -> None:
        """Answer nothing of a kind, or of all, that was sent; what runs stops at its next look."""
        for future in self._of(kind):
            self._sent.pop(future).forgotten.set()
            future.cancel()

    def release(self) -> None:
        """Answer nothing any more."""
        self.forget()
        self._ended.release()

    def _of(self, kind: str | None) -> list[Future[Any]]:
        return [future for future, errand in self._sent.items() if kind in (None, errand.kind)]

    def _on_ended(self, _: Future[Any]) -> None:
        """Answer all that has ended: of what was put meanwhile only the newest is told."""
        for future in self._of(None):
            if not future.done() or future not in self._sent:
                continue  # an answer may have had others forgotten
            kind, answer = self._sent.pop(future)[:2]
            try:
                found = future.result(timeout=0)
            except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
                _log.debug("%s failed", kind, exc_info=True)
                self._refuse(in_words_of("window", in_words(error)))
            else:
                answer(found)


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

    def ask(self) -> None:
        """Have the answer called after the next painting."""
        QCoreApplication.postEvent(self, QEvent(self._KIND), self._PRIORITY)

    def event(self, event: QEvent | None) -> bool:
        """What was asked for has been painted."""
        if event is not None and event.type() == self._KIND:
            self._timer.start()
            return True
        return bool(super().event(event))

    def release(self) -> None:
        """Tell nothing any more."""
        with suppress(RuntimeError):  # at the end of the program Qt may have ended it already
            QCoreApplication.removePostedEvents(self)
            self._timer.stop()
            self.deleteLater()
