"""Waiting for the end of all pending work of a window, instead of for a fixed time."""

import weakref
from collections import Counter

from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QApplication

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.ui import events
from tests.support.timeouts import LONG, LONG_MS

#: A timer that was restarted this many times waits for another event, such as the mouse.
_OFTEN = 5
_made = weakref.WeakSet()


class _Noted(QTimer):
    """Timer of the package that is registered for tests."""

    def __init__(self, parent=None):
        super().__init__(parent)
        _made.add(self)


events.QTimer = _Noted


class AtRest:
    """Helper that runs all posted events, computations and delayed calls at once.

    Timers of delayed calls fire immediately. Timers that are restarted repeatedly are left alone.
    """

    def __init__(self, qtbot):
        self._qtbot = qtbot

    def __call__(self, *, thread=True):
        """Run all pending work; without the compute thread if a test keeps that thread busy."""
        rung = Counter()
        while True:
            if thread:
                compute_thread.submit(lambda: None).result(LONG)
            self.pass_through()
            ringing = [timer for timer in _active() if rung[timer] < _OFTEN]
            if not ringing:
                break
            rung.update(ringing)
            for timer in ringing:
                if timer in _active():
                    timer.stop()
                    timer.timeout.emit()

    def until(self, condition):
        """Run pending work until a condition is true, which may take several runs of the thread."""

        def resting():
            self()
            return bool(condition())

        self._qtbot.waitUntil(resting, timeout=LONG_MS)
        self()

    def pass_through(self):
        """Process all events that Qt and the window system have received."""
        QApplication.sync()
        with self._qtbot.waitCallback(timeout=LONG_MS) as idle:
            last = events.single_shot(None, 0, idle)
            _made.discard(last)
            last.start()


def _active():
    """Return the active single-shot timers, without those of closed windows."""
    active = []
    for timer in list(_made):
        try:
            if timer.isActive() and timer.isSingleShot():
                active.append(timer)
        except RuntimeError:
            _made.discard(timer)
    return active
