"""Live solver, which solves the latest edit of a problem with a warm start.

Edits arrive faster than solves end, so only the latest edit is kept pending, and each solve starts
from the most recent solutions. All work runs on the compute thread.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeGuard

from napari_hmrf.arguments import real, refuse_unless
from napari_hmrf.errors import Cancelled, HmrfError
from napari_hmrf.solver.earlier_solutions import EarlierSolutions
from napari_hmrf.solver.latest_queue import LatestQueue, Turn
from napari_hmrf.solver.optimizers import Monitor, Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments, solve
from napari_hmrf.solver.staged_progress import StagedProgress
from napari_hmrf.solver.warm_start import nearest_to_targets

#: Tolerance of a live solution, in pixels; smaller errors are not visible.
TOLERANCE = 0.01
#: Tolerance of a preview, in pixels.
PREVIEW_TOLERANCE = 0.3
#: Time to the first picture of a solve of large motion, and between later ones, in seconds.
FIRST_PICTURE = 0.25
PICTURE_INTERVAL = 0.5
#: Expected time of the first solution, in seconds, above which a preview is shown.
PATIENCE = 0.1
# Time of a cold start per site on two cores, in seconds.
_SITE_SECONDS = 2e-7
_log = logging.getLogger("napari_hmrf")


@dataclass(frozen=True, eq=False)
class Update:
    """Result of an edit.

    Attributes
    ----------
    number : int
        Number of the edit, as returned by `LiveSolver.submit`.
    problem : Problem or None
        Solved problem; None if it could not be built.
    solution : Solution or None
        Solution of the problem; None if there is an error.
    error : Exception or None
        Error, such as a `ProblemError` if the problem has no unique solution yet; None if there is
        a solution.
    final : bool
        False for a preview, which is accurate to `PREVIEW_TOLERANCE`, or is as far as large motion
        has come; one follows every `PICTURE_INTERVAL`. The final solution follows unless there is
        a newer edit.
    seconds : float
        Time since the edit was submitted.
    is_earlier : bool
        True for the earlier solution of a `Known`.
    """

    number: int
    problem: Problem | None
    solution: Solution | None
    error: Exception | None
    final: bool
    seconds: float
    is_earlier: bool = False


class Known(NamedTuple):
    """Problem with its prior and an earlier solution of the same problem.

    Attributes
    ----------
    problem : Problem
    prior : Prior
    solution : Solution
    is_answer : bool
        True to deliver the earlier solution without a solve. If False, the problem is solved, and
        the earlier solution is delivered only if this solve ends farther from its targets.
    """

    problem: Problem
    prior: Prior
    solution: Solution
    is_answer: bool


#: Input of an edit: a problem, a problem with its own prior, or also with an earlier solution.
Input = Problem | tuple[Problem, Prior] | Known


class LiveSolver:
    """Live solver, which solves the latest edit of a problem with a warm start.

    Of several edits submitted during a solve, only the last is solved. By default the running solve
    is completed and delivered first, so that the tissue follows a drag without pausing. A newer
    edit cancels the solve only after its preview was delivered, or after its `patience`. Whatever
    the timing, the last update belongs to the last edit.

    All methods may be called from any thread. All methods except `wait` return immediately.

    Parameters
    ----------
    deliver : callable
        Called with an `Update` on the compute thread. The function may also warp an image there,
        but should return soon, because the solver waits for it.
    prior : Prior, optional
        Energy of the tissue; by default elastic tissue. The attribute `prior` may be set at any
        time and applies to later edits.
    optimizer : Optimizer, optional
        Schedule; by default multigrid, to `TOLERANCE`. The paper's schedule is possible but always
        makes a cold start. The attribute `optimizer` may be set at any time and applies to later
        edits.
    backend : str
        Backend, as for `solve`. The attribute `backend` may be set at any time and applies to later
        edits.
    progress : callable, optional
        Called with a `Monitor` on the compute thread. The first solve on a machine compiles for
        half a minute.
    doing : str
        Description of the work and how to stop it, for other users of the compute thread.

    Examples
    --------
    >>> from napari_hmrf.data import phantom
    >>> updates = []
    >>> with LiveSolver(updates.append) as live:
    ...     number = live.submit(phantom("expansion", size=32).problem)
    ...     ended = live.wait(60)
    >>> updates[-1].solution.displacement.shape
    (32, 32, 2)
    """

    # With slots, setting a misspelt attribute, such as `optimiser`, raises an AttributeError.
    __slots__ = (
        "__weakref__",
        "_deliver",
        "_earlier",
        "_given",
        "_progress",
        "_queue",
        "backend",
        "optimizer",
        "prior",
    )

    def __init__(
        self,
        deliver: Callable[[Update], object],
        prior: Prior | None = None,
        *,
        optimizer: Optimizer | None = None,
        backend: str = "auto",
        progress: Progress | None = None,
        doing: str = "a live solver of a script, which its close() stops",
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
        self._queue = LatestQueue(doing)
        # Used on the compute thread only.
        self._earlier = EarlierSolutions()
        self._given: Solution | None = None

    def submit(
        self,
        problem: Input | Callable[[], Input],
        *,
        preview: bool = True,
        patience: float | None = None,
    ) -> int:
        """Submit an edit, which replaces any pending edit.

        Parameters
        ----------
        problem : Problem, tuple of Problem and Prior, Known, or callable
            Problem, or a function that returns the problem. The function is called on the compute
            thread, unless the edit is replaced first. An error that it raises is delivered.
            Building a problem may take as long as a solve. With a function, a replaced edit does
            not cost this time.
        preview : bool
            True if a preview may be delivered when the solution takes a long time. Without a
            preview, the solution of the first edit after `cancel` is bitwise equal to that of
            `solve` with the same optimizer: ``solve(problem, optimizer=live.optimizer)``.
        patience : float, optional
            Time, in seconds, for which the solve of this edit continues while a newer edit is
            pending; by default, the solve runs to completion.

        Returns
        -------
        int
            Number of the edit, counted from 1.

        Raises
        ------
        ArgumentError
            If `patience` is not a non-negative number.
        RuntimeError
            If the solver is closed.
        """
        right = patience is None or real(patience) >= 0
        refuse_unless(right, "patience", patience, "a time in seconds, such as 0.2, or None")
        if self._queue.closed:
            raise RuntimeError("the live solver is closed. Create a new LiveSolver.")
        edit = _Edit(problem, self.prior, self.optimizer, self.backend, preview)
        patience = math.inf if patience is None else patience
        return self._queue.submit(partial(self._answer, edit), patience).generation

    def start_from(self, solution: Solution) -> None:
        """Use a solution, such as one from a file, as the warm start of the next solve on its grid.

        Parameters
        ----------
        solution : Solution
        """
        self._given = solution

    def cancel(self) -> None:
        """Drop the pending and the running edit; the next solve is a cold start.

        Results of the edits submitted up to now are no longer delivered, unless a delivery has
        already started.
        """
        self._queue.drop()

    def close(self) -> None:
        """Drop all edits and accept no more; may be called repeatedly."""
        self._queue.close()

    def hold(self) -> None:
        """Start no newer edit until `resume`, for example until a solution is painted.

        The call has an effect only while an update is being delivered.
        """
        self._queue.hold()

    def resume(self) -> None:
        """Start the pending edit, after `hold`."""
        self._queue.resume()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the last edit is solved.

        This method is for scripts. Never call it on the GUI thread.

        Returns
        -------
        bool
            True if an update for the last edit was delivered before the timeout.
        """
        return self._queue.wait(timeout)

    @property
    def busy(self) -> bool:
        """True until the last edit is solved or dropped."""
        return self._queue.busy

    @property
    def has_pending(self) -> bool:
        """True if an edit is pending."""
        return self._queue.has_pending

    @property
    def is_held(self) -> bool:
        """True between `hold` and `resume`."""
        return self._queue.is_held

    @property
    def delay(self) -> str:
        """Description of the work that delays the pending edit and how to stop it; "" if none."""
        return self._queue.delay

    def __enter__(self) -> LiveSolver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer(self, edit: _Edit, turn: Turn) -> None:
        problem: Problem | None = None
        try:
            given = edit.problem() if callable(edit.problem) else edit.problem
            known = given if isinstance(given, Known) else None
            unchecked, prior = given[:2] if isinstance(given, tuple) else (given, edit.prior)
            check_arguments(problem=unchecked, prior=prior)
            problem = unchecked
            self._earlier.keep_for(problem, turn.series)
            start, self._given = self._given, None
            if start is not None:
                self._earlier.begin_with(start, problem)
            if known is not None and known.is_answer:
                self._deliver_known(turn, known)
                return
            report = self._progress
            if edit.preview and isinstance(prior, NeoHookeanPrior):
                report = self._with_pictures(report, problem, turn)
            progress = None if report is None else StagedProgress(report)
            solved = partial(self._solve, problem, prior, edit.backend, progress, stop=turn)
            if edit.preview and self._takes_preview(problem, prior, edit.optimizer):
                self._deliver_preview(
                    turn, problem, solved(Multigrid(PREVIEW_TOLERANCE), is_preview=True)
                )
            solution = solved(edit.optimizer)
            best = solution if known is None else nearest_to_targets(solution, known.solution)
            if known is not None and best is not solution:
                self._deliver_known(turn, known._replace(solution=best))
            else:
                self._deliver_update(turn, problem, solution)
        except Cancelled:
            raise
        except Exception as error:  # noqa: BLE001 - the caller always gets an answer
            if not isinstance(error, HmrfError):
                _log.exception("a live solve failed")
            self._deliver_update(turn, problem, error=error)

    def _takes_preview(self, problem: Problem, prior: Prior, optimizer: Optimizer) -> bool:
        """Return whether a preview is solved first, to its own tolerance."""
        # With a warm start, a preview costs nearly as much time as the solution.
        is_long = not self._earlier.solutions and problem.stiffness.size * _SITE_SECONDS > PATIENCE
        return is_long and _has_preview(optimizer) and not isinstance(prior, NeoHookeanPrior)

    def _with_pictures(self, report: Progress | None, problem: Problem, turn: Turn) -> Progress:
        """Return a report that also delivers the field of large motion at intervals.

        Tissue never moves back: a new attempt, from coarser grids, is shown once it is farther.
        """
        next_at, part = time.perf_counter() + FIRST_PICTURE, 0.0

        def progress(monitor: Monitor) -> None:
            nonlocal next_at, part
            if report is not None:
                report(monitor)
            if monitor.so_far is None or time.perf_counter() < next_at:
                return
            preview, wait = monitor.so_far(), FIRST_PICTURE
            if preview is not None and preview.reach.part >= part:
                part, wait = preview.reach.part, PICTURE_INTERVAL
                self._earlier.keep_on_its_way(problem, preview)
                self._deliver_preview(turn, problem, preview)
            next_at = time.perf_counter() + wait

        return progress

    def _solve(
        self,
        problem: Problem,
        prior: Prior,
        backend: str,
        progress: StagedProgress | None,
        optimizer: Optimizer,
        *,
        stop: CancelFlag,
        is_preview: bool = False,
    ) -> Solution:
        """Solve with a warm start and store the solution for the next solve."""
        if progress is not None:
            progress.begin(preview=is_preview)
        initial: list[Solution] = []
        if isinstance(optimizer, Multigrid):
            is_large = isinstance(prior, NeoHookeanPrior)
            initial = self._earlier.starts(problem, large_motion=is_large)
        solution = solve(
            problem,
            prior,
            optimizer=optimizer,
            backend=backend,
            progress=progress,
            cancel=stop,
            initial=initial or None,
        )
        self._earlier.add(problem, solution)
        return solution

    def _deliver_preview(self, turn: Turn, problem: Problem, preview: Solution) -> None:
        """Deliver a preview, after which a newer edit cancels the solve."""
        self._deliver_update(turn, problem, preview, final=False)
        turn.patience = 0

    def _deliver_known(self, turn: Turn, known: Known) -> None:
        """Deliver an earlier solution, from which the next solve starts."""
        self._earlier.add(known.problem, known.solution)
        self._deliver_update(turn, known.problem, known.solution, is_earlier=True)

    def _deliver_update(
        self,
        turn: Turn,
        problem: Problem | None,
        solution: Solution | None = None,
        error: Exception | None = None,
        final: bool = True,
        is_earlier: bool = False,
    ) -> None:
        # A newer edit either corrects this error or raises the error again.
        if turn.dropped or (error is not None and self._queue.has_pending):
            return
        seconds = time.perf_counter() - turn.submitted
        try:
            self._deliver(
                Update(turn.generation, problem, solution, error, final, seconds, is_earlier)
            )
        except Cancelled:
            raise
        except Exception:  # noqa: BLE001 - later edits must still be answered
            _log.exception("a live result could not be shown")


def _has_preview(optimizer: Optimizer) -> TypeGuard[Multigrid]:
    """Return whether the optimizer has a smaller tolerance than a preview."""
    return isinstance(optimizer, Multigrid) and optimizer.tolerance < PREVIEW_TOLERANCE


def has_stopped(solution: Solution) -> bool:
    """Return whether the budget ended a solve."""
    return solution.reach is not None and solution.reach.stopped


class _Edit(NamedTuple):
    """Problem to solve, with the solver settings at the time of submission."""

    problem: Input | Callable[[], Input]
    prior: Prior
    optimizer: Optimizer
    backend: str
    preview: bool
