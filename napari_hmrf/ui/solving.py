"""Solves of the window: the engine, in step with repaints, and its progress in the footer."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from psygnal import Signal
from qtpy.QtWidgets import QWidget

from napari_hmrf.errors import Cancelled
from napari_hmrf.field.rehearsal import rehearse
from napari_hmrf.layers.painted_overlay import PaintedOverlay, ShownDeformation
from napari_hmrf.layers.result_layers import CompleteResult, complete_result
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.coarse_grid import Preview
from napari_hmrf.study.engine import Deformation, Engine
from napari_hmrf.study.study import Study
from napari_hmrf.ui import messages
from napari_hmrf.ui.events import repeating
from napari_hmrf.ui.footer import Footer
from napari_hmrf.ui.jobs import BackgroundJobs, GuiThread, Repainted
from napari_hmrf.ui.result.result_messages import DRAWING_OVERLAY

_log = logging.getLogger("napari_hmrf")
# Description of the work in the messages of jobs that wait for the compute thread.
_DOING = "a deformation in 'Soft tissue' (press Cancel there to stop it)"
#: Interval between updates, in milliseconds.
_INTERVAL = 30
#: Time without a new picture after which progress is shown, in seconds.
_PATIENCE = 0.4


class PacedEngine:
    """Engine that solves the newest submitted study, and waits for each repaint of the window.

    After each answer, the engine pauses until the answer is painted. Solving and painting use the
    same processor cores, so running both at the same time would delay each picture.

    Parameters
    ----------
    show : callable
        Called on the GUI thread with each answer, as a `ShownDeformation`.
    finish : callable
        Called on the GUI thread with the `CompleteResult` that `complete` has created.
    """

    def __init__(
        self, show: Callable[[ShownDeformation], None], finish: Callable[[CompleteResult], None]
    ) -> None:
        self._show, self._finish = show, finish
        self._gui = GuiThread()
        self._overlay = PaintedOverlay()
        self._engine = Engine(self._deliver, _DOING, self._overlay)
        self._repainted = Repainted(self._engine.resume)
        self._jobs = BackgroundJobs(lambda _: None)  # the solve of a drag reports its own errors
        self._rehearsed = False

    def submit(
        self,
        study: Study,
        backend: str = "auto",
        cold_start: bool = False,
        preview: Preview | None = None,
    ) -> None:
        """Submit a study (see `Engine.submit`); with `cold_start`, drop earlier work first."""
        if cold_start:  # the engine drops its own work
            self._jobs.cancel("layers")
        self._engine.submit(study, backend, cold_start, preview)

    def start_from(self, solution: Solution) -> None:
        """Use a solution from a file as the warm start of the next solve on its grid."""
        self._engine.start_from(solution)

    def deliver_again(self, study: Study, solution: Solution) -> None:
        """Deliver a solution from a file when its study is submitted, if the inputs are equal."""
        self._engine.deliver_again(study, solution)

    def complete(self) -> None:
        """Create the layers of the latest answer in the background, unless a study is pending."""
        self._jobs.submit("layers", self._completed, self._on_completed)

    def cancel(self) -> None:
        """Drop all pending work without showing its results."""
        self._engine.cancel()
        self._jobs.cancel("layers")

    @property
    def busy(self) -> bool:
        """True if the result of a submitted study is not painted yet."""
        return self._engine.busy

    @property
    def completing(self) -> bool:
        """True while `complete` creates layers."""
        return self._jobs.busy("layers")

    @property
    def at_work(self) -> bool:
        """True if a computation is running or pending."""
        return self.busy or self._jobs.busy()

    @property
    def monitor(self) -> Monitor:
        """Progress of the solve, or of the job that the solve is waiting for."""
        return self._engine.monitor

    def report(self, monitor: Monitor) -> None:
        """Record the progress of other work on the compute thread, from any thread."""
        self._engine.report(monitor)

    def rehearse(self, study: Study) -> None:
        """Load or compile the code for the first pull and stroke in background trial runs."""
        image, engine = study.pictures.image, self._engine
        if not self._rehearsed and image is not None:
            self._rehearsed = True
            arguments = study.prior, image, study.grid.spacing, engine.report, engine.closed
            for kind, more in (("first pull", False), ("first brush", True)):
                self._jobs.submit(kind, partial(rehearse, *arguments, more), lambda _: None)

    def release(self) -> None:
        """Drop all work and stop the engine permanently."""
        self._engine.close()
        self._gui.release()
        self._jobs.release()
        self._repainted.release()

    # On the compute thread

    def _deliver(self, answer: Deformation) -> None:
        state = self._overlay.with_marks(answer)
        self._engine.hold()
        self._gui.submit(partial(self._on_answer, state))

    def _completed(self) -> CompleteResult | ShownDeformation | None:
        """Create the layers of the latest answer if an answer exists and no study is pending."""
        latest = self._engine.latest
        if latest is None or latest.solution is None:
            return None
        try:
            with compute_thread.unless(lambda: self._engine.busy):
                completed = complete_result(latest, compute_thread.check_cancelled)
        except Cancelled:
            return None
        except Exception as error:  # noqa: BLE001 - every error is reported to the user
            _log.exception("the layers of a result could not be created")
            return ShownDeformation(replace(latest, error=error))
        self._engine.keep(latest)
        return completed

    # On the GUI thread

    def _on_answer(self, state: ShownDeformation) -> None:
        if not self._engine.is_current(state.moved):
            return
        # A pending study either corrects the error or reports it again.
        try:
            if state.moved.error is None or not self._engine.has_pending:
                self._show(state)
        finally:
            self._repainted.schedule()

    def _on_completed(self, completed: CompleteResult | ShownDeformation | None) -> None:
        if isinstance(completed, ShownDeformation):
            self._show(completed)
        elif completed is not None and not self.busy:
            self._finish(completed)


class SolveProgress:
    """Display of the engine's progress in the footer and as a message.

    Parameters
    ----------
    native : QWidget
        The dock.
    footer : Footer
    engine : PacedEngine
    is_working : callable
        Returns True until the layers of the result have changed; until then, the work can be
        cancelled.
    overlay_monitor : callable
        Returns the progress of the overlay of the result, or None.
    """

    #: Emitted with a progress message; "" when the work has ended.
    doing = Signal(str)

    def __init__(
        self,
        native: QWidget,
        footer: Footer,
        engine: PacedEngine,
        is_working: Callable[[], bool],
        overlay_monitor: Callable[[], Monitor | None],
    ) -> None:
        self._footer, self._engine = footer, engine
        self._is_working, self._overlay_monitor = is_working, overlay_monitor
        self._work = ""
        self._since = 0.0
        self._at_once = False
        self._timer = repeating(native, _INTERVAL, self._update)

    @property
    def active(self) -> bool:
        """True while progress is tracked, until the end of the work is shown."""
        return bool(self._timer.isActive())

    def start(self, work: str, at_once: bool = False) -> None:
        """Start showing the progress of a task.

        Parameters
        ----------
        work : str
            Name of the task, such as "Deforming".
        at_once : bool
            If True, progress is shown immediately until `stop` is called. Otherwise, progress is
            shown only if a picture takes a long time, until the result is drawn.
        """
        if at_once or not self._engine.busy:
            self.restart()
        self._work, self._at_once = work, at_once
        if at_once:
            self._footer.show_work(True)
        if not self.active:
            self._timer.start()

    def restart(self) -> None:
        """Reset the time since the last picture."""
        self._since = time.monotonic()

    def stop(self) -> None:
        """Show that no work is in progress."""
        self._at_once = False
        self._footer.show_work(False)
        self.doing.emit("")

    def release(self) -> None:
        """Stop all updates."""
        self._timer.stop()

    def _update(self) -> None:
        working, overlay = self._at_once or self._is_working(), self._overlay_monitor()
        monitor = self._engine.monitor if working else overlay
        if monitor is None:
            self._timer.stop()
            self.stop()
        elif self._at_once or time.monotonic() - self._since > _PATIENCE:
            self._footer.show_update(working or overlay is not DRAWING_OVERLAY)
            self.doing.emit(messages.progress(monitor, self._work))
            self._footer.explain(monitor.message)
