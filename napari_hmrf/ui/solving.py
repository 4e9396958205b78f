"""Solves of the window: the engine, in step with repaints, and its progress in the footer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from psygnal import Signal
from qtpy.QtWidgets import QWidget

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.layers.painted_overlay import painted_overlay
from napari_hmrf.layers.result_layers import CompleteResult, complete_result
from napari_hmrf.results.rehearsal import rehearse
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.study.engine import Deformation, Engine
from napari_hmrf.study.study import Study
from napari_hmrf.ui import messages
from napari_hmrf.ui.events import repeating
from napari_hmrf.ui.footer import Footer
from napari_hmrf.ui.jobs import Jobs, Repainted
from napari_hmrf.ui.result.result_messages import DRAWING_OVERLAY

# Description of the work in the messages of jobs that wait for the compute thread.
_DOING = "a deformation in 'Soft tissue' (press Cancel there to stop it)"
#: Interval between updates, in milliseconds.
_INTERVAL = 30
#: Time without a new picture after which progress is shown, in seconds.
_PATIENCE = 0.4


class PacedEngine(Engine):
    """Engine that waits for each repaint of the window, and also creates the layers of a result.

    After each answer, the engine pauses until the answer is painted. Solving and painting use the
    same processor cores, so running both at the same time would delay each picture.

    Parameters
    ----------
    jobs : Jobs
    show : callable
        Called on the GUI thread with each answer.
    finish : callable
        Called on the GUI thread with the `CompleteResult` that `complete` has created.
    """

    def __init__(
        self,
        jobs: Jobs,
        show: Callable[[Deformation], None],
        finish: Callable[[CompleteResult], None],
    ) -> None:
        self._jobs, self._show, self._finish = jobs, show, finish
        super().__init__(self._pass_on, _DOING, painted_overlay)
        self._repainted = Repainted(self.live.resume)
        self._rehearsed = False

    def complete(self) -> None:
        """Create the layers of the latest answer in the background, unless a study is pending."""
        self._jobs.submit("layers", self._completed, self._on_completed, self._on_failed)

    def cancel(self) -> None:
        """Drop all pending work without showing its results; the next solve is a cold start."""
        super().cancel()
        self._jobs.cancel("layers")

    def rehearse(self, study: Study) -> None:
        """Load or compile the code for the first pull and stroke in background trial runs."""
        image = study.pictures.image
        if not self._rehearsed and image is not None:
            self._rehearsed = True
            arguments = study.prior, image, study.grid.spacing, self.report, self.closed
            for kind, more in (("first pull", False), ("first brush", True)):
                work = partial(rehearse, *arguments, more)
                # A drag reports the same errors.
                self._jobs.submit(kind, work, lambda _: None, lambda _: None)

    def close(self) -> None:
        """Drop all work and stop the engine permanently."""
        super().close()
        self._repainted.release()

    # On the compute thread

    def _pass_on(self, answer: Deformation) -> None:
        self.live.hold()
        self._jobs.gui.submit(partial(self._on_answer, answer))

    def _completed(self) -> CompleteResult | None:
        """Create the layers of the latest answer if an answer exists and no study is pending."""
        latest = self.latest
        if latest is None or latest.solution is None:
            return None
        with compute_thread.unless(lambda: self.busy):
            completed = complete_result(latest, compute_thread.check_cancelled)
        self.keep(latest)
        return completed

    # On the GUI thread

    def _on_answer(self, answer: Deformation) -> None:
        if not self.is_current(answer):
            return
        # A pending study either corrects the error or reports it again.
        try:
            if answer.error is None or not self.live.has_pending:
                self._show(answer)
        finally:
            self._repainted.schedule()

    def _on_completed(self, completed: CompleteResult | None) -> None:
        if completed is not None and not self.busy:
            self._finish(completed)

    def _on_failed(self, error: Exception) -> None:
        if self.latest is not None and not self.busy:
            self._show(replace(self.latest, error=error))


class SolveProgress:
    """Display of the engine's progress in the footer and as a message.

    Parameters
    ----------
    native : QWidget
        The dock.
    footer : Footer
    jobs : Jobs
    engine : PacedEngine
    is_working : callable
        Returns True until the layers of the result have changed; until then, the work can be
        cancelled.
    """

    #: Emitted with a progress message; "" when the work has ended.
    doing = Signal(str)

    def __init__(
        self,
        native: QWidget,
        footer: Footer,
        jobs: Jobs,
        engine: PacedEngine,
        is_working: Callable[[], bool],
    ) -> None:
        self._footer, self._jobs, self._engine = footer, jobs, engine
        self._is_working = is_working
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

    @property
    def _overlay(self) -> Monitor | None:
        """Progress while the overlay, or what it shows, is being computed, or None."""
        is_drawing = self._jobs.busy("overlay", "comparison")
        return self._jobs.monitor("uncertainty") or (DRAWING_OVERLAY if is_drawing else None)

    def _update(self) -> None:
        working, overlay = self._at_once or self._is_working(), self._overlay
        monitor = self._engine.monitor if working else overlay
        if monitor is None:
            self._timer.stop()
            self.stop()
        elif self._at_once or time.monotonic() - self._since > _PATIENCE:
            self._footer.show_update(working or overlay is not DRAWING_OVERLAY)
            self.doing.emit(messages.progress(monitor, self._work))
            self._footer.explain(monitor.message)
