"""The compute thread: the one thread that every kernel runs on, whatever the backend.

An OpenGL context belongs to the thread that made it current; beside napari's own context no other
thread, least of all the GUI's, may touch it. Numba's threads must not be entered from two threads
at once either. So there is one such thread in a process, started by the first job, and jobs queue
up for it.
"""

from __future__ import annotations

import atexit
import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

T = TypeVar("T")
_log = logging.getLogger("napari_hmrf")
_Job = tuple[Callable[[], Any], "Future[Any]"]


class ComputeThread:
    """A worker thread with a queue in and futures out; never two at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._at_end: list[Callable[[], None]] = []

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Queue a job; its future holds the result, or the error it raised."""
        future: Future[T] = Future()
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._run, name="napari-hmrf compute", daemon=True
                )
                self._thread.start()
            self._jobs.put((job, future))
        return future

    def is_current(self) -> bool:
        """Whether the caller is on the compute thread itself."""
        return threading.current_thread() is self._thread

    def at_end(self, release: Callable[[], None]) -> None:
        """Have something released on the compute thread before it ends."""
        self._at_end.append(release)

    def stop(self, timeout: float = 2.0) -> bool:
        """End the thread after the jobs it has, releasing what was registered.

        Returns
        -------
        bool
            Whether it ended in time; if not, it ends when its job does. A job submitted meanwhile
            keeps it going; one submitted afterwards starts a new thread.
        """
        with self._lock:
            thread = self._thread
            if thread is None:
                return True
            self._jobs.put(None)
        thread.join(timeout)
        return not thread.is_alive()

    def _run(self) -> None:
        while True:
            item = self._jobs.get()
            if item is None:
                if self._ended():
                    return
                continue
            job, future = item
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(job())
                except BaseException as error:  # noqa: BLE001 - it belongs to the one who waits
                    future.set_exception(error)
            # Nothing of a job outlives it here: its arrays would stay until the next one.
            del item, job, future

    def _ended(self) -> bool:
        """Release everything and make way for another thread, unless there is more to do."""
        with self._lock:
            if not self._jobs.empty():
                return False
            while self._at_end:
                try:
                    self._at_end.pop()()
                except Exception:  # noqa: BLE001 - the others are released all the same
                    _log.exception("releasing a device failed")
            self._thread = None
            return True


#: The process's compute thread.
compute_thread = ComputeThread()
atexit.register(compute_thread.stop)
