"""Small work done on the compute thread, whose answers are given in the window's."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.ui.timers import repeating

#: How often the thread is asked whether it is done, in milliseconds.
_POLL = 8
# What those who wait for it are told.
_DOING = "what shows a result in 'Soft tissue', which takes a moment; closing that dock ends them"
_log = logging.getLogger("napari_hmrf")


class _Errand(NamedTuple):
    work: Callable[[], Any]
    answer: Callable[[Any], None]


class Errands:
    """One errand of a kind at a time; of those that wait, only the newest is ever run.

    Work must hold copies only, and nothing of Qt's: whoever sent it may be gone when it ends.

    Parameters
    ----------
    parent : QWidget
        With which this ends.
    refused : callable
        Given the error of work that raised one.
    """

    def __init__(self, parent: Any, refused: Callable[[Exception], None]) -> None:
        self._refused = refused
        self._waiting: dict[str, _Errand] = {}
        self._under_way: dict[str, tuple[Future[Any], Callable[[Any], None]]] = {}
        self._timer = repeating(parent, _POLL, self._on_timer)

    def send(self, kind: str, work: Callable[[], Any], answer: Callable[[Any], None]) -> None:
        """Have work done; `answer` is called with what it returns, unless newer work replaces it.

        What is being computed already is shown, too, so that something moves while one drags.
        """
        self._waiting[kind] = _Errand(work, answer)
        self._submit()
        self._timer.start()

    def busy(self, kind: str | None = None) -> bool:
        """Whether an errand of a kind, or any, is not answered yet."""
        if kind is None:
            return bool(self._waiting or self._under_way)
        return kind in self._waiting or kind in self._under_way

    def forget(self, kind: str | None = None) -> None:
        """Answer nothing of a kind, or of all, that was sent."""
        for each in [kind] if kind is not None else [*self._waiting, *self._under_way]:
            self._waiting.pop(each, None)
            if each in self._under_way:
                self._under_way.pop(each)[0].cancel()
        if not self.busy():
            self._timer.stop()

    def _submit(self) -> None:
        for kind in [kind for kind in self._waiting if kind not in self._under_way]:
            work, answer = self._waiting.pop(kind)
            self._under_way[kind] = (compute_thread.submit(work, _DOING), answer)

    def _on_timer(self) -> None:
        ready = [kind for kind, (future, _) in self._under_way.items() if future.done()]
        # One answer a turn: each may have napari draw, and the window is to breathe between two.
        for kind in ready[:1]:
            future, answer = self._under_way.pop(kind)
            try:
                found = future.result(timeout=0)
            except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
                _log.debug("%s failed", kind, exc_info=True)
                self._refused(error)
            else:
                answer(found)
        self._submit()
        if not self.busy():
            self._timer.stop()
