"""Timers of the window, each with what it calls."""

from __future__ import annotations

from collections.abc import Callable

from qtpy.QtCore import QObject, QTimer


def single_shot(parent: QObject | None, milliseconds: int, answer: Callable[[], object]) -> QTimer:
    """A timer that rings once, so long after it was started last.

    Parameters
    ----------
    parent : QObject, optional
        With which it ends.
    milliseconds : int
        0: when Qt has nothing more urgent to do.
    answer : callable
        Called on the thread this was made on, by its event loop.

    Returns
    -------
    QTimer
        Not started yet.
    """
    timer = repeating(parent, milliseconds, answer)
    timer.setSingleShot(True)
    return timer


def repeating(parent: QObject | None, milliseconds: int, answer: Callable[[], object]) -> QTimer:
    """A timer that rings every so many milliseconds from its start until it is stopped.

    The parameters are those of `single_shot`.
    """
    timer = QTimer(parent)
    timer.setInterval(milliseconds)
    timer.timeout.connect(answer)
    return timer
