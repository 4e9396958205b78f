"""Queue of the compute thread in which only the latest job counts.

Edits come faster than they can be solved, and a slider moves faster than pictures can be drawn. A
`LatestQueue` runs one job at a time. A job that is submitted meanwhile waits, and replaces the job
that waited before. Each job is called with a `Turn`, which shows whether the job is out of date.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future

from napari_hmrf.errors import Cancelled
from napari_hmrf.solver.backends.thread import STOPPED, compute_thread

_log = logging.getLogger("napari_hmrf")


class Turn:
    """Turn of a job of a `LatestQueue`; also the flag that stops its solve.

    Attributes
    ----------
    generation : int
        Number of the job: 1 for the first that was submitted to its queue, then counting up.
    series : int
        Number of times that the jobs of the queue had been dropped before. Jobs with the same
        number belong together.
    submitted : float
        Time of submission, by `time.perf_counter`.
    patience : float
        Time, in seconds from its start, for which the job goes on although a newer one may start.
        The job may change it.
    """

    def __init__(self, queue: LatestQueue, generation: int, series: int, patience: float) -> None:
        self.generation, self.series, self.patience = generation, series, patience
        self.submitted = time.perf_counter()
        self._queue = queue
        self._started = math.inf

    @property
    def dropped(self) -> bool:
        """True if the result of the job is no longer wanted, even if it has ended by now."""
        return self.series != self._queue.series

    def is_set(self) -> bool:
        """Return whether to stop: the job is dropped, or too late while a newer job waits."""
        late = time.perf_counter() > self._started + self.patience
        return self.dropped or (late and self._queue.can_go_on)

    def start(self) -> None:
        """Start the time that `patience` limits."""
        self._started = time.perf_counter()


#: Work on the compute thread, called with its turn; it handles its own errors.
Job = Callable[[Turn], object]


class LatestQueue:
    """Queue of the compute thread in which the latest job replaces the pending job.

    All methods may be called from any thread, and all but `wait` return at once. The queues of a
    process share the compute thread and take turns after each job.

    Parameters
    ----------
    doing : str
        Description of the jobs of this queue and how to stop them, as a clause after "waiting for";
        shown to other users of the compute thread.
    """

    def __init__(self, doing: str) -> None:
        self._doing = doing
        self._changed = threading.Condition()
        self._generation = 0
        #: Number of times that all jobs were dropped.
        self.series = 0
        self._waiting: tuple[Job, Turn] | None = None
        self._current: Turn | None = None
        # Set while a job of this queue is scheduled or runs; there is at most one.
        self._scheduled: Future[None] | None = None
        self._is_held = self._closed = False

    def submit(self, job: Job, patience: float = math.inf) -> Turn:
        """Submit a job, which replaces the pending job.

        Parameters
        ----------
        job : callable
            Called with its turn on the compute thread, unless it is replaced before.
        patience : float
            As for `Turn`; by default the job runs to its end.

        Raises
        ------
        RuntimeError
            After `close`.
        """
        with self._changed:
            if self._closed:
                raise RuntimeError("the queue is closed. Make a new one.")
            self._generation += 1
            turn = Turn(self, self._generation, self.series, patience)
            self._waiting = job, turn
            self._go_on()
            return turn

    def hold(self) -> None:
        """Start no other job until `resume`, for instance until a result is painted.

        Called by the running job; without effect if that job was dropped.
        """
        with self._changed:
            self._is_held = self._current is not None and not self._current.dropped

    def resume(self) -> None:
        """Start the job that waits, after `hold`."""
        with self._changed:
            self._is_held = False
            self._go_on()

    def drop(self) -> None:
        """Drop all jobs so far; the one that runs stops at its next checkpoint."""
        with self._changed:
            self.series += 1
            self._waiting, self._is_held = None, False
            self._changed.notify_all()

    def close(self) -> None:
        """Drop all jobs, and accept none from now on; harmless if repeated."""
        with self._changed:
            self._closed = True
            self.drop()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until no job waits or runs; return whether that happened in time."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._waiting is None and self._scheduled is None, timeout
            )

    @property
    def busy(self) -> bool:
        """True until the last job has ended or was dropped."""
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
        """True if a job waits that is newer than the one that runs."""
        return self._waiting is not None

    @property
    def can_go_on(self) -> bool:
        """True if the job that waits would start if the one that runs stopped."""
        return self._waiting is not None and not self._is_held

    @property
    def delay(self) -> str:
        """Description of other work that the job waits for, and how to stop it; "" if none."""
        with self._changed:
            return "" if self._scheduled is None else compute_thread.delays(self._scheduled)

    def _go_on(self) -> None:
        """Schedule the waiting job, if any: one job at a time, so that other queues get turns."""
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
            _log.exception("a job in the background failed")
        finally:
            del waiting
            with self._changed:
                self._current = self._scheduled = None
                self._go_on()
