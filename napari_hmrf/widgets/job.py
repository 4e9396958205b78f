"""One deformation, computed away from the window."""

from __future__ import annotations

import threading
from collections.abc import Collection
from concurrent.futures import Future

from napari_hmrf.backends.thread import compute_thread
from napari_hmrf.errors import Cancelled
from napari_hmrf.layers.inputs import Inputs
from napari_hmrf.layers.outputs import Kind, Outputs, result_layers
from napari_hmrf.optimizers import Monitor, Optimizer
from napari_hmrf.priors import SeilerPrior
from napari_hmrf.solve import run_here


class Job:
    """Queued on the compute thread when made; asked now and then how it is getting on.

    It holds copies only, and neither layers nor anything of Qt's: whoever started it may be gone
    when it ends.
    """

    def __init__(
        self,
        inputs: Inputs,
        prior: SeilerPrior,
        optimizer: Optimizer,
        backend: str,
        kinds: Collection[Kind],
    ) -> None:
        self.inputs = inputs
        self._cancel = threading.Event()
        self._progress = _Progress()
        # The thread is given no reference to the job itself.
        cancel, progress = self._cancel, self._progress

        def work() -> Outputs:
            def checkpoint() -> None:
                if cancel.is_set():
                    raise Cancelled

            checkpoint()
            solution = run_here(inputs.problem, prior, optimizer, backend, progress.report, cancel)
            progress.report(Monitor("drawing the result", 1.0))
            return result_layers(solution, inputs.frame, inputs.pictures, kinds, checkpoint)

        self._future: Future[Outputs] = compute_thread.submit(work)

    @property
    def monitor(self) -> Monitor:
        """The latest report."""
        if not self._future.running() and not self._future.done():
            return Monitor("waiting for another computation to end", 0.0)
        return self._progress.latest

    @property
    def done(self) -> bool:
        """Whether there is a result, or an error."""
        return self._future.done()

    def result(self) -> Outputs:
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
