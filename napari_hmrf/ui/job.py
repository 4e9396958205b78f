"""One deformation, computed away from the window."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import replace
from typing import Any, NamedTuple

from napari_hmrf.errors import Cancelled
from napari_hmrf.layers.result_layers import Kind, Outputs, result_layers
from napari_hmrf.solver.backends.thread import STOPPED, compute_thread
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import run_here
from napari_hmrf.study.ground import Ground, Statement
from napari_hmrf.study.study import Study

Report = Callable[[Monitor], None]
#: What those who wait for it are told.
_DOING = "a deformation that 'Deform tissue' computes, which its Cancel stops"
#: How far that is nobody knows: what moves the images may have to be compiled first.
_DRAWING = Monitor("drawing the result", 0.0)


class Done(NamedTuple):
    """What a job brings back: the layers to show, and what people should know of them."""

    outputs: Outputs
    study: Study
    ignored: int
    notes: tuple[str, ...]


Work = Callable[[Report, threading.Event], Done]


def deforming(study: Study, backend: str, kinds: Collection[Kind]) -> Work:
    """Understand a study, solve it from nothing, and draw the result."""

    def work(report: Report, cancel: threading.Event) -> Done:
        checkpoint = _checkpoint(cancel)
        report(Monitor("reading what is painted", 0.0))
        ground = Ground.of(study, checkpoint)
        stated = ground.statement()
        with study.naming():
            solution = run_here(
                stated.problem, stated.prior, stated.optimizer, backend, report, cancel
            )
        report(_DRAWING)
        return drawn(ground, stated, solution, kinds, checkpoint)

    return work


def drawing(done: Done, kinds: Collection[Kind]) -> Work:
    """Draw more layers of a result there is."""

    def work(report: Report, cancel: threading.Event) -> Done:
        report(_DRAWING)
        return done._replace(
            outputs=_layers(done.study, done.outputs.solution, kinds, _checkpoint(cancel))
        )

    return work


def drawn(
    ground: Ground,
    stated: Statement,
    solution: Solution,
    kinds: Collection[Kind],
    checkpoint: Callable[[], None],
) -> Done:
    """Draw the layers of a solution, and find what there is to say of it."""
    study = ground.study
    outputs = _layers(study, _with_tissue(solution, study.tissue.record), kinds, checkpoint)
    return Done(outputs, study, ground.ignored, ground.notes_on(stated))


def _layers(
    study: Study, solution: Solution, kinds: Collection[Kind], checkpoint: Callable[[], None]
) -> Outputs:
    return result_layers(solution, study.grid.place, study.pictures, kinds, checkpoint)


def _with_tissue(solution: Solution, record: Mapping[str, Any]) -> Solution:
    """Keep with a solution what its tissue was made of."""
    run = solution.provenance
    parameters = {**run.parameters, "tissue": dict(record)}
    return replace(solution, provenance=replace(run, parameters=parameters))


def _checkpoint(cancel: threading.Event) -> Callable[[], None]:
    def checkpoint() -> None:
        if cancel.is_set():
            raise Cancelled

    return checkpoint


class Job:
    """Queued on the compute thread when made; asked now and then how it is getting on.

    It holds copies only, and neither layers nor anything of Qt's: whoever started it may be gone
    when it ends.
    """

    def __init__(self, work: Work) -> None:
        self._cancel = threading.Event()
        self._progress = _Progress()
        # The thread is given no reference to the job itself.
        cancel, progress = self._cancel, self._progress

        def run() -> Done:
            _checkpoint(cancel)()
            return work(progress.report, cancel)

        self._future: Future[Done] = compute_thread.submit(
            run, lambda: STOPPED if cancel.is_set() else _DOING
        )

    @property
    def monitor(self) -> Monitor:
        """The latest report."""
        delay = compute_thread.delays(self._future)
        return Monitor(delay, 0.0) if delay else self._progress.latest

    @property
    def done(self) -> bool:
        """Whether there is a result, or an error."""
        return self._future.done()

    def result(self) -> Done:
        """The result, or the error raised; only when done."""
        return self._future.result(timeout=0)

    def cancel(self) -> None:
        """Have the work stop as soon as it can; returns at once."""
        self._cancel.set()
        self._future.cancel()


class _Progress:
    """The last report; written by one thread, read by another."""

    def __init__(self) -> None:
        self.latest = Monitor("starting", 0.0)

    def report(self, monitor: Monitor) -> None:
        self.latest = monitor
