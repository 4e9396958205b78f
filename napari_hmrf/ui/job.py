"""One deformation, computed away from the window."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import replace
from typing import Any, NamedTuple

from napari_hmrf.errors import Cancelled
from napari_hmrf.layers.inputs import Snapshot, prepare
from napari_hmrf.layers.layer_names import naming
from napari_hmrf.layers.result_layers import Kind, Outputs, result_layers
from napari_hmrf.solver.backends.thread import STOPPED, compute_thread
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import run_here

Report = Callable[[Monitor], None]
#: What those who wait for it are told.
_DOING = "a deformation that 'Deform tissue' computes, which its Cancel stops"
#: How far that is nobody knows: what moves the images may have to be compiled first.
_DRAWING = Monitor("drawing the result", 0.0)


class Done(NamedTuple):
    """What a job brings back: the layers to show, and what the user should know of them."""

    outputs: Outputs
    snapshot: Snapshot
    ignored: int
    notes: tuple[str, ...]


Work = Callable[[Report, threading.Event], Done]


def deforming(
    snapshot: Snapshot,
    prior: Prior,
    optimizer: Optimizer,
    backend: str,
    kinds: Collection[Kind],
) -> Work:
    """Read the copies, solve, and draw the result."""

    def work(report: Report, cancel: threading.Event) -> Done:
        checkpoint = _checkpoint(cancel)
        report(Monitor("reading what is painted", 0.0))
        inputs = prepare(snapshot, prior, optimizer, complete=True, checkpoint=checkpoint)
        tissue, boundary = snapshot.tissue_name, snapshot.boundary_name
        with naming(stiffness=tissue, poisson=tissue, observed=boundary, confidence=boundary):
            solution = run_here(inputs.problem, inputs.prior, optimizer, backend, report, cancel)
        solution = _with_tissue(solution, snapshot.record)
        report(_DRAWING)
        outputs = result_layers(solution, inputs.frame, inputs.pictures, kinds, checkpoint)
        return Done(outputs, snapshot, inputs.ignored, inputs.notes)

    return work


def drawing(done: Done, kinds: Collection[Kind]) -> Work:
    """Draw more layers of a result there is."""
    solution: Solution = done.outputs.solution

    def work(report: Report, cancel: threading.Event) -> Done:
        report(_DRAWING)
        snapshot = done.snapshot
        return done._replace(
            outputs=result_layers(
                solution, snapshot.frame, snapshot.pictures, kinds, _checkpoint(cancel)
            )
        )

    return work


def _with_tissue(solution: Solution, record: dict[str, Any]) -> Solution:
    """Keep with a solution what its tissue was made of."""
    run = solution.provenance
    parameters = {**run.parameters, "tissue": record}
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
