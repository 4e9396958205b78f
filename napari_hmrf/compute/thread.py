"""Compute thread: the single thread on which the kernels of all backends run.

An OpenGL context belongs to the thread that made it current. No other thread may use it, least of
all the GUI thread, which has napari's own context. Numba's thread pool must not be used by two
threads at once either. Each process therefore has one compute thread with a queue of jobs. The
first job starts the thread. After a fork, the child process starts its own compute thread.
"""

from __future__ import annotations

import atexit
import logging
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import Any, TypeVar

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.compute.workspace import in_child_of_fork
from napari_hmrf.errors import BackendError, Cancelled

T = TypeVar("T")
_log = logging.getLogger("napari_hmrf")
#: Description of the running work and how to stop it, or a function that returns the description.
Doing = str | Callable[[], str]
_Job = tuple[Callable[[], Any], "Future[Any]", Doing]

#: Description of cancelled work, for callers that wait for the compute thread.
STOPPED = "cancelled work to stop (no action is needed)"
# Interval, in seconds, at which a waiting caller can be interrupted by Ctrl-C.
_TICK = 0.1
_SOMETHING = "a computation of a script or another plugin, which only that program can stop"


class ComputeThread:
    """Worker thread that runs one job at a time and returns results as futures."""

    def __init__(self) -> None:
        self._forked = self._is_inconsistent = False
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
        # Conditions under which the running job stops.
        self._stops: list[Callable[[], bool]] = []

    def submit(self, job: Callable[[], T], doing: Doing = _SOMETHING) -> Future[T]:
        """Queue a job and return a future for its result or error.

        Parameters
        ----------
        job : callable
        doing : str or callable
            Description of the work and how to stop it, for callers that wait. It completes a
            sentence that starts with "waiting for".

        Raises
        ------
        BackendError
            In a child process that was forked while another thread's job was running.
        """
        if self._is_inconsistent:
            raise BackendError(
                "this process was forked while its parent was computing, so the state of the "
                'compiler may be inconsistent. Start the process by "spawn" '
                '(multiprocessing.get_context("spawn")), or fork between two solves.'
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
        """Run a job like `submit` and wait for its result.

        If the caller is the compute thread, the job runs immediately. If the wait is interrupted,
        for example by Ctrl-C, the job stops at its next `check_cancelled`.
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
                pass  # without a timeout, Windows would not handle Ctrl-C during the wait
            return future.result()
        except BaseException:
            left.set()
            if future is not None:
                future.cancel()
            raise

    @contextmanager
    def unless(self, stop: Callable[[], bool]) -> Iterator[None]:
        """Stop the running job at its next `check_cancelled` once `stop` returns True.

        Parameters
        ----------
        stop : callable
            Called on this thread several times a second; returns whether to stop.
        """
        self._stops.append(stop)
        try:
            yield
        finally:
            self._stops.pop()

    def check_cancelled(self) -> None:
        """Raise `Cancelled` if the running job has been cancelled.

        A long job must call this method several times a second. On other threads, the method does
        nothing.

        Raises
        ------
        Cancelled
        """
        if self.is_current() and any(stop() for stop in self._stops):
            raise Cancelled

    def delays(self, future: Future[Any]) -> str:
        """Describe the work that delays a queued job and how to stop it; "" once the job runs."""
        if future.running() or future.done():
            return ""
        doing = self._doing  # read only once, because the compute thread may reset it
        doing = doing() if callable(doing) else doing
        # Only the preparation of the computer is so slow that a waiting caller needs its progress.
        stage = f" ({self.stage})" if self.stage.startswith(PREPARING) else ""
        return f"waiting for {doing}{stage}" if doing else "starting"

    def is_current(self) -> bool:
        """Return whether the current thread is the compute thread."""
        return threading.current_thread() is self._thread

    def at_end(self, release: Callable[[], None]) -> None:
        """Register a callback that releases a resource, called on the thread before it ends."""
        self._at_end.append(release)

    def stop(self, timeout: float = 2.0) -> bool:
        """End the thread after its queued jobs and call the callbacks of `at_end`.

        Parameters
        ----------
        timeout : float
            Longest time to wait for the end, in seconds.

        Returns
        -------
        bool
            True if the thread ended in time. Otherwise it ends after its running job. A job that is
            submitted before the end keeps the thread running; a later job starts a new thread.
        """
        with self._lock:
            thread = self._thread
            if thread is None:
                return True
            self._jobs.put(None)
        thread.join(timeout)
        return not thread.is_alive()

    def after_fork(self) -> None:
        """Switch to a new thread in the child of a fork; the parent keeps the callbacks."""
        self._forked = True
        self._is_inconsistent |= self._working and not self.is_current()
        self._begin()

    def _run(self) -> None:
        if self._forked:
            _launch_numbas_threads()
        while True:
            item = self._jobs.get()
            if item is None:
                if self._try_to_end():
                    return
                continue
            job, future, doing = item
            if future.set_running_or_notify_cancel():
                self._working, self._doing = True, doing
                try:
                    result = job()
                except BaseException as error:  # noqa: BLE001 - the future passes it to the caller
                    self._working = False
                    future.set_exception(error)
                else:
                    # Reset before the result is set, because the caller may then fork at once.
                    self._working = False
                    future.set_result(result)
                    del result
            # Drop all references to the job, to free its arrays before the next job.
            self._doing = self.stage = ""
            del item, job, future, doing

    def _try_to_end(self) -> bool:
        """Release all resources and end the thread, unless more jobs are queued."""
        with self._lock:
            if not self._jobs.empty():
                return False
            while self._at_end:
                try:
                    self._at_end.pop()()
                except Exception:  # noqa: BLE001 - the remaining callbacks must still run
                    _log.exception("releasing a device failed")
            self._thread = None
            return True


def _launch_numbas_threads() -> None:
    """Start numba's threads from the compute thread of a forked process."""
    # GNU OpenMP has a separate thread pool for each calling thread, so a new thread can use it
    # after a fork. Numba forbids this for all OpenMP libraries and ends the process, unless its
    # flag is reset.
    numba = sys.modules.get("numba.np.ufunc.parallel")
    if getattr(numba, "_is_initialized", False):
        numba._is_initialized = False  # type: ignore[union-attr]
        numba._launch_threads()  # type: ignore[union-attr]


#: Compute thread of this process.
compute_thread = ComputeThread()
atexit.register(compute_thread.stop)
in_child_of_fork(compute_thread.after_fork)
