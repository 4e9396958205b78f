"""The tissue while it is being edited: always the newest problem, from where the last one ended.

Edits come faster than solves end. So only the newest waits, and each solve begins with what the
last ones found. Everything is computed on the compute thread; there is no other.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

from napari_hmrf.errors import Cancelled, HmrfError
from napari_hmrf.solver.backends.thread import STOPPED, compute_thread
from napari_hmrf.solver.earlier_solutions import Earlier
from napari_hmrf.solver.optimizers import Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments, run_here

#: How close to the converged field a live solution is, in pixels: less than can be seen.
TOLERANCE = 0.01
#: How close a first glance is, in pixels.
GLANCE = 0.3
#: Where the first solution takes longer than so many seconds, a glance is shown before it.
PATIENCE = 0.1
# What a site takes from nothing, on two cores.
_SITE_SECONDS = 2e-7

# Of its area, at some corner of a pixel.
_CRUSHED = 0.01

_log = logging.getLogger("napari_hmrf")


@dataclass(frozen=True, eq=False)
class Update:
    """What became of an edit.

    Attributes
    ----------
    number : int
        Which: what `LiveSolver.submit` returned.
    problem : Problem or None
        What was solved; None if it could not be made.
    solution : Solution or None
        How the tissue moves now; None if there is an error.
    error : Exception or None
        A `ProblemError`, say, if what is painted cannot be solved yet.
    final : bool
        False of a first glance: within `GLANCE` pixels, and followed by better unless there is a
        newer edit.
    seconds : float
        Since it was submitted.
    """

    number: int
    problem: Problem | None
    solution: Solution | None
    error: Exception | None
    final: bool
    seconds: float


#: What can be solved: a problem, alone or with a prior of its own.
Input = Problem | tuple[Problem, Prior]


class LiveSolver:
    """Solves the newest of what is submitted, and says what came of it.

    Of several edits submitted while one is solved, only the last is looked at. The one being solved
    is shown when it is done, so that the tissue follows a drag that never pauses; what is left of
    it after a first glance, or after its time is up, is given up for a newer one. Whatever the
    timing, the last thing delivered is the answer to the last edit. All methods may be called from
    any thread, and return at once.

    Parameters
    ----------
    deliver : callable
        Called with an `Update`, on the compute thread: the place to warp an image, too. It should
        hand over and return; while it runs nothing is solved.
    prior : Prior, optional
        By default elastic tissue. `prior` may be set at any time, for the edits to come.
    optimizer : Optimizer, optional
        By default multigrid, to `TOLERANCE`. The paper's schedule works, but starts from nothing
        each time. `optimizer` may be set at any time, for the edits to come.
    backend : str
        As for `solve`. `backend` may be set at any time, for the edits to come.
    progress : callable, optional
        Called with a `Monitor` on the compute thread: the first solve on a machine compiles for
        half a minute, and somebody is waiting.
    doing : str
        What others who wait for it are told: what it is, and how to stop it, as a clause.

    Examples
    --------
    >>> from napari_hmrf import phantom
    >>> updates = []
    >>> with LiveSolver(updates.append) as live:
    ...     number = live.submit(phantom("expansion", size=32).problem)
    ...     ended = live.wait(60)
    >>> updates[-1].solution.displacement.shape
    (32, 32, 2)
    """

    def __init__(
        self,
        deliver: Callable[[Update], object],
        prior: Prior | None = None,
        *,
        optimizer: Optimizer | None = None,
        backend: str = "auto",
        progress: Progress | None = None,
        doing: str = "tissue that a script has follow its edits, which its close() stops",
    ) -> None:
        check_arguments(
            deliver=deliver,
            prior=prior,
            optimizer=optimizer,
            backend=backend,
            progress=progress,
            doing=doing,
        )
        self.prior: Prior = prior or ElasticPrior()
        self.optimizer: Optimizer = optimizer or Multigrid(TOLERANCE)
        self.backend = backend
        self._deliver = deliver
        self._progress = progress
        self._doing = doing
        self._job: Future[None] | None = None
        self._changed = threading.Condition()
        self._number = 0
        self._waiting: _Request | None = None
        # Whether a job of ours is queued or runs; there is never more than one.
        self._busy = False
        # Whether what was submitted last is not answered yet, nor dropped.
        self._owed = False
        self._closed = False
        # Set when nothing of what was submitted so far is wanted any more.
        self._dropped = threading.Event()
        # Only the compute thread looks at what was found.
        self._earlier = Earlier()

    def submit(
        self,
        problem: Input | Callable[[], Input],
        *,
        glance: bool = True,
        patience: float | None = None,
    ) -> int:
        """Have this solved instead of whatever waits.

        Parameters
        ----------
        problem : Problem, tuple of Problem and Prior, or callable
            A callable is called on the compute thread, if its turn comes, and makes the problem;
            what it raises is delivered. Reading what is painted takes as long as a solve, and an
            edit that is replaced should not cost that.
        glance : bool
            Whether a first glance may be shown where the solution takes long. Without, what is
            submitted after `forget` is solved bit by bit as `solve` does.
        patience : float, optional
            For how many seconds it is solved on though something newer waits; by default to its
            end.

        Returns
        -------
        int
            The number of the edit, one more than that of the last.

        Raises
        ------
        RuntimeError
            After `close`.
        """
        with self._changed:
            if self._closed:
                raise RuntimeError("this live solver is closed; make a new one")
            self._number += 1
            request = _Request(
                self._number,
                problem,
                self.prior,
                self.optimizer,
                self.backend,
                time.perf_counter(),
                self._dropped,
                glance,
                patience,
            )
            self._waiting, self._owed = request, True
            self._go_on()
            return self._number

    def forget(self) -> None:
        """Drop what waits, what is being solved, and what was found: the tissue is another one.

        Of the edits submitted so far nothing is delivered any more, except by a delivery that has
        already begun.
        """
        with self._changed:
            self._dropped.set()
            self._dropped = threading.Event()
            self._waiting, self._owed = None, False

    def close(self) -> None:
        """Drop everything, for good; harmless if repeated."""
        with self._changed:
            self._closed = True
            self.forget()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the last edit is answered; for scripts, never for a window.

        Returns
        -------
        bool
            Whether it was, in time.
        """
        with self._changed:
            return self._changed.wait_for(lambda: not self._busy, timeout)

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        with self._changed:
            return self._owed

    @property
    def delay(self) -> str:
        """What an edit waits for before it is looked at, and how to stop that; "" if nothing."""
        with self._changed:
            return "" if self._job is None else compute_thread.delays(self._job)

    def __enter__(self) -> LiveSolver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _go_on(self) -> None:
        """Queue a job, if there is work for one; each solve is one, so that others get turns."""
        if self._waiting is None:
            self._busy = self._owed = False
            self._changed.notify_all()
        elif not self._busy:
            self._busy = True
            dropped = self._dropped
            self._job = compute_thread.submit(
                self._run, lambda: STOPPED if dropped.is_set() else self._doing
            )

    def _run(self) -> None:
        with self._changed:
            request, self._waiting = self._waiting, None
        try:
            if request is not None:
                self._answer(request)
        finally:
            del request
            with self._changed:
                self._busy = False
                self._go_on()

    def _answer(self, request: _Request) -> None:
        try:
            with compute_thread.unless(request.dropped.is_set):
                self._follow(request)
        except Cancelled:
            return

    def _follow(self, request: _Request) -> None:
        problem: Problem | None = None
        try:
            made = request.problem() if callable(request.problem) else request.problem
            found, prior = made if isinstance(made, tuple) else (made, request.prior)
            check_arguments(problem=found, prior=prior)
            problem = found
            self._earlier.look_at(problem, request.dropped)
            solve = partial(self._solve, problem, prior, request.backend)
            optimizer = request.optimizer
            stop = _Overtaken(self, request, request.patience)
            long = request.glance and self._takes_long(problem)
            if long and isinstance(optimizer, Multigrid):
                glance = replace(optimizer, tolerance=GLANCE)
                self._say(request, problem, solve(glance, stop), final=False)
                stop = _Overtaken(self, request, 0)
            self._say(request, problem, solve(optimizer, stop))
        except Cancelled:
            raise
        except Exception as error:  # noqa: BLE001 - whoever edits hears of it, whatever it is
            if not isinstance(error, HmrfError):
                _log.exception("a live solve failed")
            self._say(request, problem, error=error)

    def _takes_long(self, problem: Problem) -> bool:
        """Whether this is the first look at some tissue, and a large one."""
        # With something to begin with, a glance costs nearly as much as the solution, and what
        # comes after it has less to begin with.
        return not self._earlier.solutions and problem.stiffness.size * _SITE_SECONDS > PATIENCE

    def _solve(
        self,
        problem: Problem,
        prior: Prior,
        backend: str,
        optimizer: Optimizer,
        stop: CancelFlag,
    ) -> Solution:
        """Solve from what is known, and know it."""
        known = self._earlier.solutions if isinstance(optimizer, Multigrid) else ()
        initial = [each for each in known if not _is_crushed(each)] or None
        solution = run_here(problem, prior, optimizer, backend, self._progress, stop, initial)
        self._earlier.add(problem, solution)
        return solution

    def _say(
        self,
        request: _Request,
        problem: Problem | None,
        solution: Solution | None = None,
        error: Exception | None = None,
        final: bool = True,
    ) -> None:
        # What was wrong with an edit that has been replaced is put right by now, or said again.
        if request.dropped.is_set() or (error is not None and self._waits()):
            return
        seconds = time.perf_counter() - request.submitted
        try:
            self._deliver(Update(request.number, problem, solution, error, final, seconds))
        except Cancelled:
            raise
        except Exception:  # noqa: BLE001 - the edits to come are answered all the same
            _log.exception("a live result could not be shown")

    def _waits(self) -> bool:
        return self._waiting is not None


def _is_crushed(solution: Solution) -> bool:
    """Whether it is no beginning for large motion: the way back takes longer than from nothing."""
    return solution.reach is not None and solution.reach.least_jacobian < _CRUSHED


class _Request(NamedTuple):
    """An edit that waits for its turn."""

    number: int
    problem: Input | Callable[[], Input]
    prior: Prior
    optimizer: Optimizer
    backend: str
    submitted: float
    dropped: threading.Event
    glance: bool
    patience: float | None


class _Overtaken:
    """Set when an edit is dropped, or when it has had its time and there is a newer one."""

    def __init__(self, live: LiveSolver, request: _Request, patience: float | None) -> None:
        self._live = live
        self._dropped = request.dropped
        self._until = math.inf if patience is None else request.submitted + patience

    def is_set(self) -> bool:
        late = time.perf_counter() > self._until
        return self._dropped.is_set() or (late and self._live._waits())
