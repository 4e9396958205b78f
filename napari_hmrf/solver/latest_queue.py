"""Queue of the compute thread in which the latest job replaces the pending job.

Edits arrive faster than they can be solved, and a slider moves faster than images can be drawn. A
`LatestQueue` runs one job at a time. A job that is submitted in the meantime replaces the previous
pending job and is pending until the running job ends. Each job is called with a `Turn`, which
reports whether the job is out of date.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future

from napari_hmrf.compute.thread import STOPPED, compute_thread
from napari_hmrf.errors import Cancelled

_log = logging.getLogger("napari_hmrf")


class Turn:
    """State of a job in a `LatestQueue`, which also serves as the cancel flag of its solve.

    Attributes
    ----------
    generation : int
        Number of the job, counted from 1 for each queue.
    series : int
        Number of times that all jobs of the queue had been dropped before this job was submitted.
        Jobs of the same series belong together.
    submitted : float
        Time of submission, from `time.perf_counter`.
    patience : float
        Time, in seconds from the start of the job, during which a newer job does not stop it. The
        job may change this value.
    """

    def __init__(self, queue: LatestQueue, generation: int, series: int, patience: float) -> None:
        self.generation, self.series, self.patience = generation, series, patience
        self.submitted = time.perf_counter()
        self._queue = queue
        self._started = math.inf

    @property
    def dropped(self) -> bool:
        """True if the result of the job is obsolete, even if the job has ended."""
        return self.series != self._queue.series

    def is_set(self) -> bool:
        """Return whether the job should stop.

        A job stops if it was dropped, or if its patience has run out and another job could start.
        """
        late = time.perf_counter() > self._started + self.patience
        return self.dropped or (late and self._queue.can_go_on)

    def start(self) -> None:
        """Start measuring the time that `patience` limits."""
        self._started = time.perf_counter()


#: Function to run on the compute thread, called with its `Turn`. It must handle its own errors.
Job = Callable[[Turn], object]


class LatestQueue:
    """Queue of the compute thread in which the latest job replaces the pending job.

    All methods may be called from any thread. All methods except `wait` return immediately. The
    queues of a process share the compute thread and take turns after each job.

    Parameters
    ----------
    doing : str
        Description of the jobs in this queue and how to stop them, as a clause that follows
        "waiting for". Other users of the compute thread display this description.
    """

    def __init__(self, doing: str) -> None:
        self._doing = doing
        self._changed = threading.Condition()
        self._generation = 0
        #: Number of times that all jobs were dropped.
        self.series = 0
        self._waiting: tuple[Job, Turn] | None = None
        self._current: Turn | None = None
        # Set while a job of this queue is scheduled or running; there is at most one such job.
        self._scheduled: Future[None] | None = None
        self._is_held = self._closed = False

    def submit(self, job: Job, patience: float = math.inf) -> Turn:
        """Submit a job, which replaces any pending job.

        Parameters
        ----------
        job : callable
            Called with its turn on the compute thread, unless a newer job replaces it first.
        patience : float
            As for `Turn`; by default, the job runs to completion.

        Raises
        ------
        RuntimeError
            If the queue is closed.
        """
        with self._changed:
            if self._closed:
                raise RuntimeError("the queue is closed. Create a new queue.")
            self._generation += 1
            turn = Turn(self, self._generation, self.series, patience)
            self._waiting = job, turn
            self._go_on()
            return turn

    def hold(self) -> None:
        """Start no other job until `resume`, for example until a result is painted.

        Called by the running job; has no effect if that job was dropped.
        """
        with self._changed:
            self._is_held = self._current is not None and not self._current.dropped

    def resume(self) -> None:
        """End a `hold`, and start the pending job, if any."""
        with self._changed:
            self._is_held = False
            self._go_on()

    def drop(self) -> None:
        """Drop all submitted jobs; the running job stops at its next check for cancellation."""
        with self._changed:
            self.series += 1
            self._waiting, self._is_held = None, False
            self._changed.notify_all()

    def close(self) -> None:
        """Drop all jobs and accept no more; may be called repeatedly."""
        with self._changed:
            self._closed = True
            self.drop()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until no job is pending or running; return False after a timeout."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._waiting is None and self._scheduled is None, timeout
            )

    @property
    def busy(self) -> bool:
        """True until the last job has ended or has been dropped."""
        with self._changed:
            is_running = self._current is not None and not self._current.dropped
            return self._waiting is not None or is_running

    @property
    def closed(self) -> bool:
        """True after `close`."""
        return self._closed

    @property
    def is_held(self) -> bool:
        """True between `hold` and `resume`."""
        return self._is_held

    @property
    def has_pending(self) -> bool:
        """True if a job is pending."""
        return self._waiting is not None

    @property
    def can_go_on(self) -> bool:
        """True if a pending job can start once the running job stops."""
        return self._waiting is not None and not self._is_held

    @property
    def delay(self) -> str:
        """Description of the work that delays the pending job and how to stop it; "" if none."""
        with self._changed:
            return "" if self._scheduled is None else compute_thread.delays(self._scheduled)

    def _go_on(self) -> None:
        """Schedule the pending job, if any.

        Only one job is scheduled at a time, so that other queues get turns.
        """
        if self._scheduled is not None:
            return
        if self._waiting is None:
            self._changed.notify_all()
        elif not self._is_held:
            self._scheduled = compute_thread.submit(self._run, self._described)

    def _described(self) -> str:
        turn = self._current
        return STOPPED if turn is not None and turn.dropped else self._doing

    def _run(self) -> None:
        with self._changed:
            waiting, self._waiting = self._waiting, None
            self._current = turn = None if waiting is None else waiting[1]
        try:
            if waiting is not None and turn is not None:
                turn.start()
                with compute_thread.unless(lambda: turn.dropped):
                    waiting[0](turn)
        except Cancelled:
            pass
        except Exception:  # noqa: BLE001 - the result of the job is not awaited anywhere
            _log.exception("a background job failed")
        finally:
            del waiting
            with self._changed:
                self._current = self._scheduled = None
                self._go_on()
