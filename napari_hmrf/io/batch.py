"""Batches of cases, solved in local processes or on a dask cluster.

The results of each case are written to a folder below `UNFINISHED`, which is moved to its final
location when it is complete. A batch can therefore be interrupted at any time without leaving
partial results, and resumed later. Only one process at a time can use the output folder of a batch;
this process also writes the summary.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import secrets
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from functools import cache, partial
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import threadpoolctl

from napari_hmrf.arguments import tuple_of
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import HmrfError, in_words
from napari_hmrf.extras import how_to_install
from napari_hmrf.field.deformation import magnitude
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.io.case import SolvedCase, solve_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.case_records import (
    RECORD,
    CaseOutcome,
    CaseRecord,
    fingerprints,
    finished_cases,
    leftovers,
    output_digests,
)
from napari_hmrf.io.case_tables import NamedCase
from napari_hmrf.io.table_files import write_csv
from napari_hmrf.wording import in_shell_words

_log = logging.getLogger("napari_hmrf")
#: Name of the folder for unfinished cases.
UNFINISHED = ".unfinished"
#: Name of the file that a batch locks while it uses the folder; the file remains.
LOCK = ".batch.lock"
#: Name of the file with the outcomes of all cases.
SUMMARY = "summary.csv"
#: Shortest time between two updates of the summary while the batch is running, in seconds.
_SUMMARY_INTERVAL = 5.0
#: Number of significant digits of the values in the summary.
_DIGITS = 6
#: Options that the notes and errors of a case may name.
_OPTIONS = {each.name for each in fields(Case)}
#: Function that solves a case, and function that submits a case to a worker.
_Solve = Callable[[NamedCase], CaseOutcome]
_Submit = Callable[[NamedCase], Future[CaseOutcome]]
#: Environment variables that limit the threads of libraries.
_THREAD_VARIABLES = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"


@dataclass(frozen=True)
class BatchProgress:
    """Progress of a batch.

    Attributes
    ----------
    done, failed, of : int
        Numbers of solved cases, failed cases and all cases.
    seconds_left : float, optional
        Estimated remaining time, in seconds, if a case is finished.
    latest_outcome : CaseOutcome, optional
        Outcome of the most recently finished case.
    """

    done: int
    failed: int
    of: int
    seconds_left: float | None = None
    latest_outcome: CaseOutcome | None = None

    @property
    def words(self) -> str:
        """Progress as one line of text."""
        text = f"{self.done + self.failed} of {self.of} case{'s' * (self.of != 1)}"
        text += f", {self.failed} failed" if self.failed else ""
        left = self.seconds_left
        return text if left is None else f"{text}, about {_duration(left)} left"


def solve_cases(
    cases: Sequence[NamedCase],
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    backend: str = "cpu",
    progress: Callable[[BatchProgress], object] | None = None,
    report: Callable[[str], object] | None = None,
) -> tuple[CaseOutcome, ...]:
    """Solve many cases, and write the results of each case to a separate folder.

    If a case fails, the remaining cases are still solved. The worker processes are started with the
    "spawn" method, so the code of a script must be inside ``if __name__ == "__main__":``.

    Parameters
    ----------
    cases : sequence of NamedCase
        Cases, as returned by `read_cases`.
    folder : path-like
        Folder for the results of the cases and for `summary.csv`. Only one batch at a time can use
        the folder.
    jobs : int, optional
        Number of single-threaded processes; by default one per core.
    scheduler : str, optional
        Address of a dask scheduler, or path of its scheduler file (.json). If given, the workers of
        the scheduler solve the cases; they need access to the same files.
    resume : bool
        If True, skip solved cases for which the table row and the input files are unchanged.
    backend : str
        As for `solve`. With "cpu", the field does not depend on the GPU of the machine.
    progress : callable, optional
        Called with a `BatchProgress` after each case.
    report : callable, optional
        Called with sentences about folders that do not belong to a case and about cases that are
        solved again. By default, the logger "napari_hmrf" logs these sentences as warnings.

    Returns
    -------
    tuple of CaseOutcome
        Outcomes in the order of the cases.

    Raises
    ------
    ArgumentError
        If `cases` is not a sequence of NamedCase.
    HmrfError
        If the folder contains results and `resume` is False, if another batch is using the folder,
        or if the scheduler does not respond.
    OSError
        If the folder cannot be written to.
    """
    cases = tuple_of(NamedCase, "cases", cases, 'read_cases("cases.csv")')
    target = Path(folder).absolute()
    with ExitStack() as stack:
        # Nothing is written before the scheduler responds.
        client = None if scheduler is None else stack.enter_context(_cluster(scheduler))
        target.mkdir(parents=True, exist_ok=True)
        stack.enter_context(_lock(target))
        existing = [case.name for case in cases if (target / case.name).exists()]
        existing += [SUMMARY] * (target / SUMMARY).exists()
        if existing and not resume:
            raise HmrfError(
                f"{target.name}: {existing[0]!r} already exists. Resume the batch "
                "(`resume=True`), or choose another folder."
            )
        finished, repeated = finished_cases(cases, target)
        for sentence in (*leftovers(cases, target), *repeated):
            (report or _log.warning)(sentence)
        shutil.rmtree(target / UNFINISHED, ignore_errors=True)
        todo = [case for case in cases if case.name not in finished]
        solve_one = partial(solve_into, folder=target, backend=backend)
        batch = _Batch(cases, finished, target)
        workers = (
            _processes(solve_one, min(jobs or _cores(), len(todo)))
            if client is None
            else _cluster_workers(solve_one, client)
        )
        try:
            with workers as submit:
                futures = {submit(case): case for case in todo}
                for future in as_completed(futures):
                    state = batch.record(_outcome(futures[future], future))
                    if progress is not None:
                        progress(state)
        finally:
            shutil.rmtree(target / UNFINISHED, ignore_errors=True)
            batch.write()
    return batch.outcomes


def solve_into(case: NamedCase, folder: Path, backend: str = "cpu") -> CaseOutcome:
    """Solve a case in this process, on one thread, and move its complete folder into place."""
    one_thread()
    started = time.perf_counter()
    unfinished = folder / UNFINISHED / f"{case.name}-{secrets.token_hex(4)}"
    try:
        inputs = fingerprints(case)  # before reading the files, so that later changes are detected
        solved = solve_case(case.case, unfinished, backend=backend, changes=case.changes)
        outcome = _done(case.name, solved, _seconds_since(started))
        record = CaseRecord(
            cells=dict(case.cells),
            outcome=outcome,
            inputs=inputs,
            outputs=output_digests(unfinished),
        )
        write_whole(unfinished / RECORD, record.model_dump_json(indent=2).encode())
        _publish(unfinished, folder / case.name)
    except Exception as error:  # noqa: BLE001 - a failed case must not stop the batch
        message = in_words(error)
        is_expected = isinstance(error, HmrfError | OSError)
        message = message if is_expected else f"{type(error).__name__}: {message}"
        message = in_shell_words(message, _OPTIONS)
        if (folder / case.name / RECORD).exists():
            message += (
                f" (the folder {case.name} still contains an earlier result, which is ignored)"
            )
        return CaseOutcome(case.name, "failed", message, seconds=_seconds_since(started))
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return outcome


@cache
def one_thread() -> None:
    """Limit this process to one thread, because the other processes use the remaining cores."""
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    if "numba" not in sys.modules:  # numba reads the variable only once
        os.environ["NUMBA_NUM_THREADS"] = "1"
    threadpoolctl.threadpool_limits(1)


def _lock(folder: Path) -> AbstractContextManager[object]:
    """Lock a folder until the end of a context, or of this process."""
    from filelock import FileLock, Timeout  # heavy: filelock

    try:
        return FileLock(folder / LOCK).acquire(timeout=0)
    except Timeout:
        raise HmrfError(
            f"{folder}: another batch is using this folder. Wait until that batch ends, or choose "
            "another folder."
        ) from None


def _seconds_since(started: float) -> float:
    """Return the time since `started`, a value of `perf_counter`, in seconds (rounded)."""
    return round(time.perf_counter() - started, 4)


def _in_digits(value: Any) -> Any:
    """Round a float to the precision of the summary, which is about single precision."""
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _done(name: str, solved: SolvedCase, seconds: float) -> CaseOutcome:
    solution = solved.solution
    return CaseOutcome(
        name,
        "done",
        notes="; ".join(in_shell_words(note, _OPTIONS) for note in solved.notes),
        seconds=seconds,
        folds=solved.folds,
        error_bound=None if solution.convergence is None else float(solution.convergence.error),
        largest_displacement=float(
            np.max(magnitude(solution.displacement)[solution.tissue], initial=0.0)
        ),
        unit=unit_symbol(solved.study.grid.unit),
    )


def _publish(unfinished: Path, target: Path) -> None:
    """Rename a complete folder to its final name, replacing an existing folder."""
    if target.exists():
        target.rename(unfinished.with_name(f"{unfinished.name}-old"))
    unfinished.rename(target)


class _Batch:
    """Outcomes of all cases of a batch, and their summary file."""

    def __init__(
        self, cases: Sequence[NamedCase], finished: dict[str, CaseOutcome], folder: Path
    ) -> None:
        self._outcomes = {
            case.name: finished.get(case.name, CaseOutcome(case.name)) for case in cases
        }
        self._folder = folder
        self._parameters = {case.name: case.parameters for case in cases}
        self._finished_before = len(finished)
        self._started = self._last_write = time.monotonic()

    @property
    def outcomes(self) -> tuple[CaseOutcome, ...]:
        return tuple(self._outcomes.values())

    def record(self, outcome: CaseOutcome) -> BatchProgress:
        """Record the outcome of a case, and update the summary file at intervals."""
        self._outcomes[outcome.case] = outcome
        now = time.monotonic()
        if now > self._last_write + _SUMMARY_INTERVAL:
            self.write()
            self._last_write = now
        states = [each.state for each in self._outcomes.values()]
        done, failed = states.count("done"), states.count("failed")
        solved = done + failed - self._finished_before
        seconds_left = (now - self._started) / solved * states.count("not done")
        return BatchProgress(done, failed, len(states), seconds_left, outcome)

    def write(self) -> None:
        """Write the summary: one row per case, with the values of the swept parameters."""
        titles = [*CaseOutcome.__dataclass_fields__]
        swept = [*dict.fromkeys(title for each in self._parameters.values() for title in each)]
        rows = []
        for outcome in self.outcomes:
            values = self._parameters[outcome.case]
            first, *others = (_in_digits(getattr(outcome, title)) for title in titles)
            rows.append([first, *(values.get(title) for title in swept), *others])
        write_csv(self._folder / SUMMARY, [titles[0], *swept, *titles[1:]], rows)


# Workers


class _Worker:
    """Process that solves one case at a time, and is started again if it has ended."""

    def __init__(self, solve_one: _Solve) -> None:
        self._solve_one = solve_one
        self._lock, self._is_stopped = threading.Lock(), False
        self._start()

    def _start(self) -> None:
        with self._lock:
            if self._is_stopped:
                return
            context = multiprocessing.get_context("spawn")
            self._pipe, child_end = context.Pipe()
            given = child_end, self._solve_one
            self.process = context.Process(target=_work, args=given, daemon=True)
            self.process.start()
            child_end.close()  # otherwise `recv` would not notice that the process has ended

    def stop(self) -> None:
        """End the process, and start no other one."""
        with self._lock:
            self._is_stopped = True
            self.process.terminate()

    def solve(self, case: NamedCase) -> CaseOutcome:
        """Return the outcome of a case, or a failure if the process ends during the case."""
        if not self.process.is_alive():
            self._start()
        try:
            self._pipe.send(case)
            outcome: CaseOutcome = self._pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return CaseOutcome(case.name, "failed", _exit_reason(self.process.exitcode))
        return outcome


@contextmanager
def _processes(solve_one: _Solve, count: int) -> Iterator[_Submit]:
    """Yield a function that submits a case to one of several processes.

    A thread waits for each process. In a `ProcessPoolExecutor`, the crash of one process would also
    end the cases in progress in all other processes.
    """
    workers: list[_Worker] = []
    idle = SimpleQueue[_Worker]()

    def solve(case: NamedCase) -> CaseOutcome:
        worker = idle.get()
        try:
            return worker.solve(case)
        finally:
            idle.put(worker)

    threads = ThreadPoolExecutor(max(count, 1))
    try:
        for _ in range(count):
            workers.append(_Worker(solve_one))
            idle.put(workers[-1])
        yield lambda case: threads.submit(solve, case)
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.stop()
        threads.shutdown()
        for worker in workers:
            worker.process.join()


def _work(pipe: Connection, solve_one: _Solve) -> None:
    """Solve the cases received from a pipe, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent process
    one_thread()
    with suppress(EOFError, OSError):
        while True:
            pipe.send(solve_one(pipe.recv()))


def _exit_reason(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        with suppress(ValueError):
            name = signal.Signals(-exitcode).name
            hint = ", possibly for lack of memory" if name == "SIGKILL" else ""
            return f"the worker process was ended by {name}{hint}"
    return f"the worker process ended with exit code {exitcode}"


def _cores() -> int:
    """Return the number of CPU cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cluster(address: str) -> Any:
    """Return a client of a dask scheduler, which is to be closed."""
    is_file = address.endswith(".json")
    if is_file and not Path(address).is_file():  # dask would wait until it exists
        raise HmrfError(f"no dask scheduler: the scheduler file {address} does not exist.")
    try:
        from distributed import Client  # optional: distributed
    except ImportError:
        raise HmrfError(
            "a scheduler requires dask.distributed, which is not installed: "
            f"{how_to_install('cluster')}."
        ) from None
    location = {"scheduler_file" if is_file else "address": address}
    try:
        return Client(**location, set_as_default=False)
    except (OSError, ValueError) as error:
        raise HmrfError(f"no dask scheduler responds at {address}: {error}") from error


@contextmanager
def _cluster_workers(solve_one: _Solve, client: Any) -> Iterator[_Submit]:
    """Yield a function that submits a case to the workers of a dask scheduler."""
    executor: Executor = client.get_executor(pure=False, retries=0)
    try:
        yield lambda case: executor.submit(solve_one, case)
    finally:
        executor.shutdown(wait=False)  # cancels unfinished cases


def _outcome(case: NamedCase, future: Future[CaseOutcome]) -> CaseOutcome:
    """Return the outcome of a case, or a failure if its dask worker did not finish."""
    try:
        return future.result()
    except Exception as error:  # noqa: BLE001 - a failed case must not stop the batch
        message = f"the worker did not finish: {type(error).__name__}: {error}"
        return CaseOutcome(case.name, "failed", message)


def _duration(seconds: float) -> str:
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes = round(whole / 60)
    return f"{minutes} min" if minutes < 100 else f"{round(minutes / 60)} h"
