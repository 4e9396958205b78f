"""Waiting until a window has nothing left to do: for what is to come, and never for a time."""

import weakref
from collections import Counter

from qtpy.QtCore import QTimer
from qtpy.QtWidgets import QApplication

from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.ui import events
from tests.support.timeouts import LONG, LONG_MS

#: A timer that is started again so often waits for something else: somebody's mouse, a thread.
_OFTEN = 5
_made = weakref.WeakSet()


class _Noted(QTimer):
    """A timer of the package's that tests know of."""

    def __init__(self, parent=None):
        super().__init__(parent)
        _made.add(self)


events.QTimer = _Noted


class AtRest:
    """Has all that is posted, computed and put off be done at once.

    What is put off for a moment, until nothing else comes, has no need to wait here: its timer
    rings now. Timers that ring again and again are left alone.
    """

    def __init__(self, qtbot):
        self._qtbot = qtbot

    def __call__(self, *, thread=True):
        """Come to rest; without the compute thread where somebody keeps that busy."""
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
        """Come to rest until something is so that takes more than one turn of the thread."""

        def resting():
            self()
            return condition()

        self._qtbot.waitUntil(resting, timeout=LONG_MS)
        self()

    def pass_through(self):
        """Have all be answered that Qt and the window system have been told by now."""
        QApplication.sync()
        with self._qtbot.waitCallback(timeout=LONG_MS) as idle:
            last = events.single_shot(None, 0, idle)
            _made.discard(last)
            last.start()


def _active():
    """Timers that will ring once; those of windows that are gone will not."""
    active = []
    for timer in list(_made):
        try:
            if timer.isActive() and timer.isSingleShot():
                active.append(timer)
        except RuntimeError:
            _made.discard(timer)
    return active
