"""Solution of a problem: the single entry point to the solver."""

from __future__ import annotations

import logging
import platform
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_flag, shown
from napari_hmrf.compute.compile_cache.loops import are_compiled
from napari_hmrf.compute.thread import STOPPED, compute_thread
from napari_hmrf.errors import (
    ArgumentError,
    BackendError,
    Cancelled,
    ConvergenceError,
    ProblemError,
)
from napari_hmrf.solver.backends import BACKEND_NAMES, host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.choice import (
    Choice,
    failure_of_shaders,
    open_backend,
    use_loops_after,
)
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.caveats import rigid_caveat
from napari_hmrf.solver.connected import Connected, connected
from napari_hmrf.solver.drift import has_drift, solve_with_drift
from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.optimizers import ICM, Monitor, Multigrid, Optimizer
from napari_hmrf.solver.optimizers.base import Outcome, Report
from napari_hmrf.solver.preparation import loop_watch, prepare, provide_loops
from napari_hmrf.solver.priors import Elastic, ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.sliding_solve import solve_with_sliding
from napari_hmrf.solver.slipping_drift import solve_with_slipping_drift
from napari_hmrf.solver.solution import Provenance, Solution
from napari_hmrf.solver.staged_progress import StagedProgress
from napari_hmrf.solver.unconnected import left_at_rest, scraps
from napari_hmrf.solver.volume_memory import check_memory
from napari_hmrf.solver.warm_start import Initial, combine_solutions, nearest_to_targets

Progress = Callable[[Monitor], None]
T = TypeVar("T")
_log = logging.getLogger("napari_hmrf")
_announced: set[str] = set()

#: Description of a solve for other callers that wait for the compute thread.
_DOING = "a solve started by a script, which its cancel flag or Ctrl-C stops"
# Interval between checks of the cancel flag, in seconds.
_CHECK_INTERVAL = 0.1
# Time, in seconds, after which a cancelled call returns even if the work has not stopped.
_GRACE = 0.25


class CancelFlag(Protocol):
    """Flag that cancels the work, such as a `threading.Event`."""

    def is_set(self) -> bool:
        """Return whether the work should stop."""
        ...


def stop_if_cancelled(cancel: CancelFlag | None) -> None:
    """Raise `Cancelled` if a flag is set."""
    if cancel is not None and cancel.is_set():
        raise Cancelled


def solve(
    problem: Problem,
    prior: Prior | None = None,
    *,
    optimizer: Optimizer | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
    initial: Initial | None = None,
    rest_loose: bool = False,
) -> Solution:
    """Compute the displacement of the tissue.

    The work runs on the compute thread of the process, and the call waits for the result. Any
    thread may call this function.

    Parameters
    ----------
    problem : Problem
    prior : SeilerPrior, ElasticPrior or NeoHookeanPrior, optional
        Energy of the tissue; by default elastic tissue. The paper's energy is ``SeilerPrior()``.
        Large motion is ``NeoHookeanPrior()``, which requires multigrid and the compiled loops.
    optimizer : ICM or Multigrid, optional
        Schedule; by default multigrid, or 70 sweeps on each level for the paper's prior, as in the
        paper. ``Multigrid()`` solves the paper's prior to the limit of infinitely many sweeps.
    backend : {"auto", "opengl", "opengl:fragment", "opengl:compute", "cpu"}
        Backend to run on. "auto" chooses the shaders on a real GPU and the compiled loops
        otherwise, and logs the choice once. If the shaders fail in a solve, the loops take over,
        also for later solves. Volumes require compute shaders (OpenGL 4.3) or the loops.
    progress : callable, optional
        Called on the caller's thread with a `Monitor`: a message and the completed fraction, which
        never decreases, except that reports of the compiler have a fraction of their own. If
        `progress` is None, a solve that waits for the compiler logs a warning. Compilation takes
        minutes, once per machine.
    cancel : threading.Event or similar, optional
        Flag that cancels the solve once it is set. The call then returns within half a second, even
        while loops are compiled.
    initial : Solution or sequence of Solution, optional
        Warm start from earlier solutions on the same grid. After a small edit to the problem,
        multigrid then needs fewer cycles. Several solutions are combined linearly to match the
        observations and loads as closely as possible. Displacements are proportional to
        observations and loads, so moving the same patch again takes one cycle, or no cycle if the
        errors of the solutions add up to less than the tolerance. The result is the same within the
        tolerance. The paper's schedule starts from zero on its coarsest level and does not accept
        `initial`.
    rest_loose : bool
        True to leave small pieces of elastic tissue at rest if nothing holds them, as a study does;
        their number is in `Solution.notes`. By default, they are an error.

    Returns
    -------
    Solution

    Raises
    ------
    ArgumentError
        If an argument has the wrong type, or the optimizer does not support the prior.
    BackendError
        If the backend is not available or returns values that are not finite.
    ProblemError
        If the solution is not unique, because some tissue can move freely (see `rest_loose`).
    ConvergenceError
        If an iteration does not converge.
    Cancelled
        If `cancel` was set before the work was done.

    Examples
    --------
    >>> from napari_hmrf import solve
    >>> from napari_hmrf.data import phantom
    >>> solution = solve(phantom("expansion", size=64).problem)
    >>> solution.displacement.shape
    (64, 64, 2)
    """
    check_arguments(
        problem=problem,
        prior=prior,
        optimizer=optimizer,
        backend=backend,
        progress=progress,
        cancel=cancel,
        initial=initial,
    )
    require_flag("rest_loose", rest_loose)
    if rest_loose:
        return _with_loose_at_rest(problem, prior, optimizer, backend, progress, cancel, initial)

    def work(report: Progress | None) -> Solution:
        return _solve_all(problem, prior, optimizer, backend, report, initial)

    return on_compute_thread(work, progress, cancel)


def on_compute_thread(
    work: Callable[[Progress | None], T], progress: Progress | None, cancel: CancelFlag | None
) -> T:
    """Run work on the compute thread, and wait for its result.

    Parameters
    ----------
    work : callable
        Called with a function for progress reports, or with None if `progress` is None.
    progress, cancel
        As for `solve`.

    Raises
    ------
    Cancelled
        If `cancel` was set before the work was done.
    """
    interrupted = threading.Event()

    def is_stopped() -> bool:
        return interrupted.is_set() or (cancel is not None and cancel.is_set())

    def run(report: Progress | None) -> T:
        with compute_thread.unless(is_stopped):
            return work(report)

    if compute_thread.is_current():
        return run(progress)
    reports: queue.SimpleQueue[Monitor | None] = queue.SimpleQueue()

    def put(monitor: Monitor) -> None:
        reports.put(replace(monitor, so_far=None))  # the work does not wait for the caller

    # Without `progress`, send no reports: each report wakes the caller, which slows the work.
    send = None if progress is None else put
    job: Future[T] | None = None
    try:
        job = compute_thread.submit(lambda: run(send), lambda: STOPPED if is_stopped() else _DOING)
        job.add_done_callback(lambda _: reports.put(None))
        while (report := _next(reports, cancel)) is not None:
            if progress is not None:
                progress(report)
    except BaseException:
        # After Ctrl-C or an error in `progress`, the work must not continue in the background.
        interrupted.set()
        if job is not None:
            job.cancel()
        raise
    return job.result()


def _with_loose_at_rest(
    problem: Problem,
    prior: Prior | None,
    optimizer: Optimizer | None,
    backend: str,
    progress: Progress | None,
    cancel: CancelFlag | None,
    initial: Initial | None,
) -> Solution:
    """Solve without the loose pieces of elastic tissue, and note how many stay at rest."""
    notes: tuple[str, ...] = ()
    if isinstance(prior, Elastic | None):
        loose = scraps(problem.tissue, problem.observed_components)
        if loose.any():
            problem, notes = problem.with_rest(loose), (left_at_rest(loose),)
    solution = solve(
        problem,
        prior,
        optimizer=optimizer,
        backend=backend,
        progress=progress,
        cancel=cancel,
        initial=initial,
    )
    return replace(solution, notes=(*solution.notes, *notes))


def _next(reports: queue.SimpleQueue[Monitor | None], cancel: CancelFlag | None) -> Monitor | None:
    """Wait for the next report, but only briefly once the work is cancelled."""
    # The compilation of a loop cannot be interrupted, so a cancelled call returns before it ends.
    if cancel is None:
        return reports.get()
    for _ in iter(cancel.is_set, True):
        with suppress(queue.Empty):
            return reports.get(timeout=_CHECK_INTERVAL)
    try:
        return reports.get(timeout=_GRACE)
    except queue.Empty:
        raise Cancelled from None


def _has(method: str, value: object) -> bool:
    return not isinstance(value, type) and callable(getattr(value, method, None))


def _is_initial(value: object) -> bool:
    solutions = value if isinstance(value, Sequence) else (value,)
    return all(isinstance(solution, Solution) for solution in solutions)


_ARGUMENTS: dict[str, tuple[Callable[[object], bool], str]] = {
    "problem": (
        lambda value: isinstance(value, Problem),
        "a Problem: Problem(observed=observed, confidence=confidence, stiffness=stiffness)",
    ),
    "prior": (
        lambda value: isinstance(value, Prior | None),
        "a prior: ElasticPrior(), NeoHookeanPrior() or SeilerPrior()",
    ),
    "optimizer": (
        lambda value: value is None or _has("run", value),
        "an optimizer: Multigrid() or ICM()",
    ),
    "backend": (lambda value: isinstance(value, str), f"one of {', '.join(BACKEND_NAMES)}"),
    "progress": (
        lambda value: value is None or callable(value),
        "a function to call with a Monitor, such as print",
    ),
    "cancel": (
        lambda value: value is None or _has("is_set", value),
        "an object with a method is_set(), such as a threading.Event",
    ),
    "initial": (lambda value: value is None or _is_initial(value), "a Solution, or a list of them"),
    "deliver": (callable, "a function to call with an Update"),
    "doing": (lambda value: isinstance(value, str), "a description of the work"),
}


def check_arguments(**given: object) -> None:
    """Raise an error if an argument has the wrong type, before any work is done.

    Raises
    ------
    ArgumentError
        If an argument has the wrong type; the message names the argument and the expected type.
    """
    for name, value in given.items():
        is_valid, expected = _ARGUMENTS[name]
        if not is_valid(value):
            kind = type(value).__name__
            raise ArgumentError(f"{name} is {shown(value)}, of type {kind}. Pass {expected}.")


def _solve_all(
    problem: Problem,
    prior: Prior | None,
    optimizer: Optimizer | None,
    backend: str,
    progress: Progress | None,
    initial: Initial | None,
) -> Solution:
    """Solve a problem, which may have sliding parts or a drift."""
    progress = None if progress is None else StagedProgress(progress)
    if problem.sliding is None:
        return _solve_connected(problem, prior, optimizer, backend, progress, initial)

    def solve_parts(
        parts: Problem,
        of_parts: Elastic,
        schedule: Optimizer,
        begin: Initial | None,
        fold: Callable[[Solution], Solution],
    ) -> Solution:
        report = None if progress is None else _mapped(progress, fold)
        return _solve_connected(parts, of_parts, schedule, backend, report, begin)

    return solve_with_sliding(problem, prior, optimizer, initial, solve_parts)


def _mapped(progress: Progress, convert: Callable[[Any], Solution]) -> Progress:
    """Return a report that converts what `Monitor.so_far` returns."""
    return lambda monitor: progress(monitor.with_field(convert))


def _solve_connected(
    problem: Problem,
    prior: Prior | None,
    optimizer: Optimizer | None,
    backend: str,
    progress: Progress | None,
    initial: Initial | None,
) -> Solution:
    """Solve a problem without sliding parts, or with parts that are unfolded, and its drift."""
    if not has_drift(problem, prior):
        return _solution_of(problem, prior, optimizer, backend, progress, initial)
    elastic = prior if isinstance(prior, ElasticPrior) else ElasticPrior()

    def solve_with(
        part: Problem,
        of_part: ElasticPrior,
        schedule: Optimizer,
        begin: Initial | None,
        report: Progress | None,
    ) -> Solution:
        return _solution_of(part, of_part, schedule, backend, report, begin)

    schedule = optimizer or Multigrid()
    if elastic.can_slip(problem):
        return solve_with_slipping_drift(problem, elastic, schedule, progress, initial, solve_with)
    return solve_with_drift(problem, elastic, schedule, progress, initial, solve_with)


def _solution_of(
    problem: Problem,
    prior: Prior | None,
    optimizer: Optimizer | None,
    backend: str,
    progress: Progress | None,
    initial: Initial | None,
) -> Solution:
    """Prepare the backend, run the schedule, and record the run.

    If shaders that nobody has requested fail, the loops take over.
    """
    begun = time.perf_counter()
    check_memory(problem, prior)
    given = prior or ElasticPrior()
    joined = connected(problem, given)
    whole, problem = problem, joined.problem
    prior = given.resolved(whole if isinstance(given, SeilerPrior) else problem)
    optimizer = optimizer or (ICM() if isinstance(prior, SeilerPrior) else Multigrid())
    begin = combine_solutions(initial, problem) if initial else None
    started = time.perf_counter()
    ready = started

    def solution_of(outcome: Outcome) -> Solution:
        done, device = time.perf_counter(), choice.backend
        displacement = outcome.displacement
        settle(displacement, joined, device.renderer, outcome.energy)
        # The solution keeps this array itself, because warm starts recognize it.
        displacement.setflags(write=False)
        grown = 1.0 if outcome.reach is None else outcome.reach.grown
        of_prior = dict(prior.parameters)
        if problem.is_volume:
            of_prior.pop("plane", None)  # a volume has no plane
        energy = outcome.energy
        if isinstance(prior, SeilerPrior) and (problem is not whole or any(joined.extension)):
            # An energy is reported per site of all tissue, and the last one is that of the field.
            energy = energy * (np.count_nonzero(problem.tissue) / np.count_nonzero(whole.tissue))
            energy[-1] = prior.mean_energy(whole, displacement)
        return Solution(
            displacement=displacement,
            energy=energy,
            levels=outcome.levels,
            convergence=outcome.convergence,
            reach=outcome.reach,
            tissue=whole.tissue,
            spacing=problem.spacing,
            provenance=Provenance(
                backend=device.name,
                renderer=device.renderer,
                reason=choice.reason,
                seconds=started - begun + done - ready,
                preparation_seconds=ready - started,
                parameters={
                    "prior": of_prior,
                    "optimizer": optimizer.parameters,
                },
                versions=_versions(),
                inputs=whole.digests,
            ),
            loads=whole.loads,
            elasticity=Elasticity.of_problem(whole, prior, grown)
            if isinstance(prior, ElasticPrior | NeoHookeanPrior)
            else None,
            notes=(*filter(None, (rigid_caveat(whole, given),)), *joined.notes),
        )

    before = failure_of_shaders()
    try:
        with open_device(problem, prior, optimizer, backend, progress) as (choice, report):
            ready = time.perf_counter()
            reported = _mapped(report, solution_of)
            outcome = _run(optimizer, problem, prior, choice.backend, reported, begin)
            solution = solution_of(outcome)
    except BackendError as error:
        if failure_of_shaders() is before:
            raise
        _log.warning("%s The compiled loops are used instead.", error)
        return _solution_of(whole, given, optimizer, backend, progress, initial)
    return solution if initial is None else nearest_to_targets(solution, initial)


@contextmanager
def open_device(
    problem: Problem, prior: Prior, optimizer: Optimizer, backend: str, progress: Progress | None
) -> Iterator[tuple[Choice, Report]]:
    """Open a backend and prepare its kernels, on the compute thread only.

    Parameters
    ----------
    problem : Problem
    prior : Prior
        Prior, as returned by its method `resolved`.
    optimizer, backend, progress
        As for `solve`.

    Yields
    ------
    Choice
        Backend, which is closed at the end.
    callable
        Function for progress reports, which raises `Cancelled` once the work must stop.
    """
    job = SolveJob.of(problem, prior, optimizer)

    def report(monitor: Monitor) -> None:
        compute_thread.stage = monitor.message
        compute_thread.check_cancelled()
        if progress is not None:
            progress(monitor)

    def provide() -> None:
        if progress is None and not are_compiled(job.loops):
            _announce_compilation()
        provide_loops(job.loops, report)

    report(Monitor("preparing", 0.0))
    choice = open_backend(job, backend, compute_thread.check_cancelled, provide)
    try:
        _announce(choice)
        prepare(choice.backend, job, optimizer, report)
        with loop_watch("", report):  # loops for tissue on which cycles converge slowly
            yield choice, report
    except BackendError as error:
        if backend == "auto" and choice.backend.name != "cpu":
            use_loops_after(error)
        raise
    finally:
        choice.backend.close()


def settle(
    displacement: npt.NDArray[np.floating],
    joined: Connected,
    renderer: str,
    energies: npt.ArrayLike = (),
) -> None:
    """Convert the displacement of a solve to units of length, and complete it, in place.

    Parameters
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement of the solved problem, in pixels.
    joined : Connected
        The solved problem.
    renderer : str
        Device of the solve.
    energies : array_like
        Energies of the solve.

    Raises
    ------
    BackendError
        If a value is not finite.
    """
    problem = joined.problem
    finite = host.settle(displacement, problem.tissue, problem.unit)
    joined.extend(displacement)
    if not (finite and np.isfinite(energies).all()):
        raise BackendError(
            f"{renderer} returned NaN or infinite values, so the result was discarded. Check the "
            "size of the observed displacement; if it is reasonable, use the compiled loops "
            '(`backend="cpu"`).'
        )


def _run(
    optimizer: Optimizer,
    problem: Problem,
    prior: Prior,
    device: Backend[Any],
    report: Report,
    begin: WarmStart | None,
) -> Outcome:
    """Run the schedule; a problem that fails from a warm start is solved from a cold start."""
    if begin is not None:
        with suppress(ProblemError, ConvergenceError):
            return optimizer.run(problem, prior, device, report, begin)
    return optimizer.run(problem, prior, device, report)


def _announce(choice: Choice) -> None:
    """Log the device that runs the kernels and the reason for its choice, once per device."""
    message = f"{choice.backend.renderer} ({choice.reason})"
    if message not in _announced:
        _announced.add(message)
        _log.info("solving on %s", message)


@cache
def _announce_compilation() -> None:
    """Log, once per process, that a solve waits for the compiler, which takes minutes."""
    _log.warning(
        "the solver is compiled for this computer, once, which takes up to a few minutes; "
        "solve(..., progress=print) shows the progress"
    )


@cache
def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version(), "system": platform.system()}
    for package in ("napari-hmrf", "numpy", "numba", "moderngl", "napari"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions
