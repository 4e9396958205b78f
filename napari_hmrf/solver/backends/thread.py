"""The compute thread: the one thread that every kernel runs on, whatever the backend.

An OpenGL context belongs to the thread that made it current; beside napari's own context no other
thread, least of all the GUI's, may touch it. Numba's threads must not be entered from two threads
at once either. So there is one such thread in a process, started by the first job, and jobs queue
up for it. The child of a fork, in which only the thread that forked goes on, starts its own.
"""

from __future__ import annotations

import atexit
import logging
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import Any, TypeVar

from napari_hmrf.errors import BackendError, Cancelled

T = TypeVar("T")
_log = logging.getLogger("napari_hmrf")
#: Present work in words, and how to stop it; a callable is read when it is needed.
Doing = str | Callable[[], str]
_Job = tuple[Callable[[], Any], "Future[Any]", Doing]

#: Description of cancelled work, for callers that wait.
STOPPED = "what was cancelled to come to its end, which happens by itself"
# Longest time until a caller that waits for a job sees Ctrl-C, in seconds.
_TICK = 0.1
_SOMETHING = "a computation that a script or another plugin asked for, which only that can stop"


class ComputeThread:
    """A worker thread with a queue in and futures out; never two at once."""

    def __init__(self) -> None:
        self._forked = self._torn = False
        self._begin()

    def _begin(self) -> None:
        self._lock = threading.Lock()
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._at_end: list[Callable[[], None]] = []
        self._working = False
        self._doing: Doing = ""
        #: Progress of the running job, in words, if it reports any.
        self.stage = ""
        # Each says whether the job that runs is to stop.
        self._stops: list[Callable[[], bool]] = []

    def submit(self, job: Callable[[], T], doing: Doing = _SOMETHING) -> Future[T]:
        """Queue a job; its future holds the result, or the error it raised.

        Parameters
        ----------
        job : callable
        doing : str or callable
            Description for callers that wait: the work, and how to stop it. A clause that goes
            on from "waiting for".

        Raises
        ------
        BackendError
            In the child of a fork that came in the middle of another thread's job.
        """
        if self._torn:
            raise BackendError(
                "this process was forked while its parent was computing, and what the compiler was "
                'doing then cannot be trusted. Start it by "spawn" '
                '(multiprocessing.get_context("spawn")), or between two solves.'
            )
        future: Future[T] = Future()
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._run, name="napari-hmrf compute", daemon=True
                )
                self._thread.start()
            self._jobs.put((job, future, doing))
        return future

    def result_of(self, job: Callable[[], T], doing: Doing = _SOMETHING) -> T:
        """Run a job, as `submit` does, and wait for it; at once if this is the thread itself.

        A caller that stops waiting, as after Ctrl-C, stops the job at its next `look`.
        """
        if self.is_current():
            return job()
        left = threading.Event()

        def run() -> T:
            with self.unless(left.is_set):
                return job()

        future: Future[T] | None = None
        try:
            future = self.submit(run, doing)
            while not wait([future], _TICK).done:
                pass  # a lock alone may keep Ctrl-C waiting: on Windows always
            return future.result()
        except BaseException:
            left.set()
            if future is not None:
                future.cancel()
            raise

    @contextmanager
    def unless(self, stop: Callable[[], bool]) -> Iterator[None]:
        """Stop the running job at its next `look`, too, once `stop` returns True.

        Parameters
        ----------
        stop : callable
            Called on this thread, several times a second: whether to stop.
        """
        self._stops.append(stop)
        try:
            yield
        finally:
            self._stops.pop()

    def look(self) -> None:
        """Look whether the job that runs is still wanted: for long work, several times a second.

        Does nothing on any other thread.

        Raises
        ------
        Cancelled
            If it is not.
        """
        if self.is_current() and any(stop() for stop in self._stops):
            raise Cancelled

    def delays(self, future: Future[Any]) -> str:
        """Return the work that a job waits for, and how to stop it, in words; "" once it runs."""
        if future.running() or future.done():
            return ""
        doing = self._doing() if callable(self._doing) else self._doing
        # The progress of a solve means nothing to others; a compiler takes long, but only once.
        stage = f" ({self.stage})" if self.stage.startswith("compiling") else ""
        return f"waiting for {doing}{stage}" if doing else "starting"

    def is_current(self) -> bool:
        """Return whether the caller is on the compute thread itself."""
        return threading.current_thread() is self._thread

    def at_end(self, release: Callable[[], None]) -> None:
        """Register a callback that releases something on the compute thread before it ends."""
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

    def after_fork(self) -> None:
        """Start a new thread in the child of a fork; the parent releases what is registered."""
        self._forked = True
        self._torn |= self._working and not self.is_current()
        self._begin()

    def _run(self) -> None:
        if self._forked:
            _launch_numbas_threads()
        while True:
            item = self._jobs.get()
            if item is None:
                if self._ended():
                    return
                continue
            job, future, doing = item
            if future.set_running_or_notify_cancel():
                self._working, self._doing = True, doing
                try:
                    result = job()
                except BaseException as error:  # noqa: BLE001 - it belongs to the one who waits
                    self._working = False
                    future.set_exception(error)
                else:
                    # Before the result is there: the caller that gets it may fork at once.
                    self._working = False
                    future.set_result(result)
                    del result
            # Nothing of a job outlives it here: its arrays would stay until the next one.
            self._doing = self.stage = ""
            del item, job, future, doing

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


def in_child_of_fork(forget: Callable[[], object]) -> None:
    """Register a callback for every child of a fork, where only the caller's thread goes on."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=forget)


def _launch_numbas_threads() -> None:
    """Let numba start its threads from the new compute thread of this process."""
    # GNU OpenMP keeps a pool for each thread that uses it, so that a new thread can in a child of a
    # fork. As others cannot, numba ends a process whose parent is the one it was launched in.
    numba = sys.modules.get("numba.np.ufunc.parallel")
    if getattr(numba, "_is_initialized", False):
        numba._is_initialized = False  # type: ignore[union-attr]
        numba._launch_threads()  # type: ignore[union-attr]


#: The process's compute thread.
compute_thread = ComputeThread()
atexit.register(compute_thread.stop)
in_child_of_fork(compute_thread.after_fork)
