"""Progress of a solve and of its drawing, shown in the dock if the work takes a long time."""

from __future__ import annotations

import time
from collections.abc import Callable

from psygnal import Signal
from qtpy.QtWidgets import QWidget

from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.ui import messages
from napari_hmrf.ui.events import repeating
from napari_hmrf.ui.footer import Footer
from napari_hmrf.ui.paced_engine import PacedEngine
from napari_hmrf.ui.result.result_messages import DRAWING_OVERLAY

#: Interval between updates, in milliseconds.
_INTERVAL = 30
#: Time without a new picture after which progress is shown, in seconds.
_PATIENCE = 0.4


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
