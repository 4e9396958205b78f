"""Timers of the window, and hearing of events of napari's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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


class EventConnections:
    """Has events answered, until it is released.

    Parameters
    ----------
    *answered : tuple of (event, callable)
        Events of napari's, each with the method that answers it.
    """

    def __init__(self, *answered: tuple[Any, Callable[..., object]]) -> None:
        self._answered = answered
        for event, answer in answered:
            event.connect(answer)

    def release(self) -> None:
        """Answer no more."""
        for event, answer in self._answered:
            event.disconnect(answer)
        self._answered = ()
