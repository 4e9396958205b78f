"""Batches of cases, each solved into its own folder, on local processes or a dask cluster.

A folder is either complete or absent: a case is written under `UNFINISHED`, and moved to its place
when it is complete, with `RECORD` in it. So the folders are right however and whenever a batch
ends, and `resume` solves the rest. One process at a time uses a folder (`folder_lock`), and only
that process writes the summary.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import secrets
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
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
from napari_hmrf.io.case_records import (
    RECORD,
    CaseOutcome,
    fingerprints,
    finished_cases,
    leftovers,
    output_digests,
)
from napari_hmrf.io.case_tables import NamedCase
from napari_hmrf.io.csv_files import write_csv
from napari_hmrf.io.folder_lock import exclusive
from napari_hmrf.wording import in_words_of

_log = logging.getLogger("napari_hmrf")
#: Folder for unfinished cases.
UNFINISHED = ".unfinished"
SUMMARY = "summary.csv"
#: Least time between two writes of the summary while cases finish, in seconds.
_SELDOM = 5.0
#: Number of finished cases over which the pace is averaged.
_PACE = 20
#: Significant digits of the numbers in the summary.
_DIGITS = 6
#: Environment variables that limit the threads of libraries.
_THREADS = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"


@dataclass(frozen=True)
class BatchProgress:
    """Progress of a batch.

    Attributes
    ----------
    done, failed, of : int
        Number of finished cases, of failed cases, and of all cases.
    seconds_left : float, optional
        Estimate at the pace so far; None until the pace is known.
    newest : CaseOutcome, optional
    """

    done: int
    failed: int
    of: int
    seconds_left: float | None = None
    newest: CaseOutcome | None = None

    @property
    def words(self) -> str:
        """Progress in a line."""
        said = f"{self.done + self.failed} of {self.of} case{'s' * (self.of != 1)}"
        said += f", {self.failed} failed" if self.failed else ""
        left = self.seconds_left
        return said if left is None else f"{said}, about {_duration(left)} left"


def solve_cases(
    cases: Sequence[NamedCase],
    folder: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    backend: str = "cpu",
    progress: Callable[[BatchProgress], object] | None = None,
    tell: Callable[[str], object] | None = None,
) -> tuple[CaseOutcome, ...]:
    """Solve many cases, each into its own folder; a failed case does not stop the others.

    The worker processes are started by "spawn", so a script needs ``if __name__ == "__main__":``
    around its code.

    Parameters
    ----------
    cases : sequence of NamedCase
        As returned by `read_cases`.
    folder : path-like
        Parent of the case folders and of `summary.csv`. One batch at a time may write there; a
        second one is refused.
    jobs : int, optional
        Number of processes, each with one thread; by default one for each core.
    scheduler : str, optional
        Address of a dask scheduler, or its file (.json): its workers solve the cases. They must
        see the same files.
    resume : bool
        Keep the finished cases whose row and files are unchanged, and solve the others.
    backend : str
        As for `solve`; with "cpu" the field does not depend on the machine's GPU.
    progress : callable, optional
        Called with a `BatchProgress` after each case.
    tell : callable, optional
        Called with a sentence for folders that are not counted and for cases that are solved again;
        by default these are logged as warnings of "napari_hmrf".

    Returns
    -------
    tuple of CaseOutcome
        In the order of the cases.

    Raises
    ------
    ArgumentError
        If `cases` is not a sequence of NamedCase.
    HmrfError
        If the folder has finished cases and `resume` is not given; if another batch writes into
        it; or if there is no scheduler.
    OSError
        If the folder cannot be written.
    """
    cases = tuple_of(NamedCase, "cases", cases, 'read_cases("cases.csv")')
    target = Path(folder).absolute()
    target.mkdir(parents=True, exist_ok=True)
    with exclusive(target):
        there = [case.name for case in cases if (target / case.name).exists()]
        there += [SUMMARY] * (target / SUMMARY).exists()
        if there and not resume:
            raise HmrfError(
                f"{target.name}: {there[0]!r} is there already. Resume the batch "
                "(`resume=True`), or take another folder."
            )
        found, again = finished_cases(cases, target)
        for sentence in (*leftovers(cases, target), *again):
            (tell or _log.warning)(sentence)
        shutil.rmtree(target / UNFINISHED, ignore_errors=True)
        todo = [case for case in cases if case.name not in found]
        solve_one = partial(solve_into, folder=target, backend=backend)
        batch = _Batch(cases, found, target)
        if scheduler is None:
            coming = _by_processes(todo, solve_one, jobs or _cores())
        else:
            coming = _by_cluster(todo, solve_one, scheduler)
        try:
            for outcome in coming:
                said = batch.take(outcome)
                if progress is not None:
                    progress(said)
        finally:
            coming.close()
            shutil.rmtree(target / UNFINISHED, ignore_errors=True)
            batch.write()
    return batch.outcomes


def solve_into(case: NamedCase, folder: Path, backend: str = "cpu") -> CaseOutcome:
    """Solve a case in this process, on one thread, into a folder that is complete or absent."""
    one_thread()
    begun = time.perf_counter()
    part = folder / UNFINISHED / f"{case.name}-{secrets.token_hex(4)}"
    try:
        inputs = fingerprints(case)  # before the files are read, so that a later change is detected
        solved = solve_case(case.case, part, backend=backend, changes=case.changes)
        outcome = _outcome(case.name, solved, _seconds_since(begun))
        record = {"cells": dict(case.cells), "outcome": asdict(outcome), "inputs": inputs}
        record["outputs"] = output_digests(part)
        write_whole(part / RECORD, json.dumps(record, indent=2).encode())
        _publish(part, folder / case.name)
    except Exception as error:  # noqa: BLE001 - a failed case does not stop the others
        said = in_words(error)
        known = isinstance(error, HmrfError | OSError)
        said = said if known else f"{type(error).__name__}: {said}"
        said = in_words_of("shell", said)
        if (folder / case.name / RECORD).exists():
            said += f" (the folder {case.name} still has an earlier result, which is not counted)"
        return CaseOutcome(case.name, "failed", said, seconds=_seconds_since(begun))
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return outcome


@cache
def one_thread() -> None:
    """Limit this process to one thread, as other processes compute beside it."""
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    if "numba" not in sys.modules:  # numba reads the variable only once
        os.environ["NUMBA_NUM_THREADS"] = "1"
    threadpoolctl.threadpool_limits(1)


def _seconds_since(begun: float) -> float:
    """Return the time since `begun` by `perf_counter`, rounded for a table."""
    return round(time.perf_counter() - begun, 4)


def _in_digits(value: Any) -> Any:
    """Round a number to the digits that a table shows; single precision has no more."""
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _outcome(name: str, solved: SolvedCase, seconds: float) -> CaseOutcome:
    solution = solved.solution
    return CaseOutcome(
        name,
        "done",
        notes="; ".join(in_words_of("shell", note) for note in solved.notes),
        seconds=seconds,
        folds=solved.folds,
        error_bound=None if solution.convergence is None else float(solution.convergence.error),
        largest_displacement=float(
            np.max(magnitude(solution.displacement)[solution.tissue], initial=0.0)
        ),
        unit=unit_symbol(solved.study.grid.unit),
    )


def _publish(part: Path, target: Path) -> None:
    """Move a complete folder to its final name, in place of one from an earlier table."""
    if target.exists():
        target.rename(part.with_name(f"{part.name}-old"))
    part.rename(target)


class _Batch:
    """Finished outcomes and their summary."""

    def __init__(
        self, cases: Sequence[NamedCase], found: dict[str, CaseOutcome], folder: Path
    ) -> None:
        self._found = {case.name: found.get(case.name, CaseOutcome(case.name)) for case in cases}
        self._folder = folder
        self._parameters = {case.name: case.parameters for case in cases}
        self._todo = len(cases) - len(found)
        self._come: list[float] = []
        self._written = time.monotonic()

    @property
    def outcomes(self) -> tuple[CaseOutcome, ...]:
        return tuple(self._found.values())

    def take(self, outcome: CaseOutcome) -> BatchProgress:
        """Record an outcome, and write the summary from time to time."""
        self._found[outcome.case] = outcome
        now = time.monotonic()
        self._come.append(now)
        if now > self._written + _SELDOM:
            self.write()
            self._written = now
        states = [each.state for each in self._found.values()]
        left = self._seconds_left()
        return BatchProgress(
            states.count("done"), states.count("failed"), len(states), left, outcome
        )

    def _seconds_left(self) -> float | None:
        """Estimate from the latest cases, as the first ones include start-up and compilation."""
        newest = self._come[-_PACE:]
        if len(newest) < _PACE:
            return None
        return (newest[-1] - newest[0]) / (_PACE - 1) * (self._todo - len(self._come))

    def write(self) -> None:
        """Write the summary: a row for each case, with the numbers that the table sweeps over."""
        titles = [*CaseOutcome.__dataclass_fields__]
        swept = [*dict.fromkeys(title for each in self._parameters.values() for title in each)]
        rows = []
        for outcome in self.outcomes:
            own = self._parameters[outcome.case]
            first, *others = (_in_digits(getattr(outcome, title)) for title in titles)
            rows.append([first, *(own.get(title) for title in swept), *others])
        write_csv(self._folder / SUMMARY, [titles[0], *swept, *titles[1:]], rows)


# Local processes


@dataclass
class _Worker:
    """Process that solves one case after the other, with its pipe."""

    process: Any
    pipe: Connection
    case: NamedCase

    @classmethod
    def start(cls, solve_one: Callable[[NamedCase], CaseOutcome], case: NamedCase) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=_work, args=(there, solve_one), daemon=True)
        process.start()
        there.close()  # so that this end detects the end of the process
        worker = cls(process, here, case)
        worker.give(case)
        return worker

    def give(self, case: NamedCase) -> None:
        self.case = case
        with suppress(OSError):  # the missing answer shows that the process has ended
            self.pipe.send(case)

    def answer(self) -> CaseOutcome:
        """Return the outcome of its case, or a failure if the process has ended."""
        try:
            outcome: CaseOutcome = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            return CaseOutcome(self.case.name, "failed", _ended(self.process.exitcode))
        return outcome


def _by_processes(
    cases: Sequence[NamedCase], solve_one: Callable[[NamedCase], CaseOutcome], count: int
) -> Generator[CaseOutcome, None, None]:
    """Yield the outcomes as they arrive; a process that ends loses only its own case."""
    todo = deque(cases)
    workers: dict[Connection, _Worker] = {}
    idle: list[_Worker] = []

    def start() -> None:
        worker = _Worker.start(solve_one, todo.popleft())
        workers[worker.pipe] = worker

    try:
        while todo and len(workers) < count:
            start()
        while workers:
            for pipe in wait(list(workers)):
                worker = workers[pipe]  # type: ignore[index]
                outcome = worker.answer()
                if worker.process.is_alive() and todo:
                    worker.give(todo.popleft())
                else:
                    idle.append(workers.pop(worker.pipe))
                    worker.pipe.close()  # the process then ends
                    if todo:
                        start()
                yield outcome
    finally:
        for worker in workers.values():
            worker.process.terminate()
        for worker in (*workers.values(), *idle):
            worker.process.join()


def _work(pipe: Connection, solve_one: Callable[[NamedCase], CaseOutcome]) -> None:
    """Solve cases from the pipe until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent process
    one_thread()
    with suppress(EOFError, OSError):
        while True:
            pipe.send(solve_one(pipe.recv()))


def _ended(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        with suppress(ValueError):
            name = signal.Signals(-exitcode).name
            more = ", as where memory runs out" if name == "SIGKILL" else ""
            return f"the process that solved it was ended by {name}{more}"
    return f"the process that solved it ended with exit code {exitcode}"


def _cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# dask cluster


def _by_cluster(
    cases: Sequence[NamedCase], solve_one: Callable[[NamedCase], CaseOutcome], address: str
) -> Generator[CaseOutcome, None, None]:
    """Yield the outcomes as they arrive from the workers of a dask scheduler."""
    try:
        from distributed import Client, as_completed  # optional: distributed
    except ImportError:
        raise HmrfError(
            "a scheduler takes dask.distributed, which is not installed: "
            f"{how_to_install('cluster')}."
        ) from None
    where = {"scheduler_file": address} if address.endswith(".json") else {"address": address}
    try:
        client = Client(**where, set_as_default=False)
    except (OSError, ValueError) as error:
        raise HmrfError(f"no dask scheduler answers at {address}: {error}") from error
    futures: dict[Any, NamedCase] = {}
    try:
        futures = dict(
            zip(client.map(solve_one, list(cases), pure=False, retries=0), cases, strict=True)
        )
        for future in as_completed(list(futures), loop=client.loop):
            case = futures.pop(future)
            if future.status == "finished":
                yield future.result()
            else:
                why = future.exception()
                said = f"its worker did not finish: {type(why).__name__}: {why}"
                yield CaseOutcome(case.name, "failed", said)
    finally:
        client.cancel(list(futures))
        client.close()


def _duration(seconds: float) -> str:
    whole = round(seconds)
    if whole < 100:
        return f"{whole} s"
    minutes = round(whole / 60)
    return f"{minutes} min" if minutes < 100 else f"{round(minutes / 60)} h"
