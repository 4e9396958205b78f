"""Timers of the window, and hearing of events of napari's."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from qtpy.QtCore import QObject, QTimer

#: The events after which a layer's pixels, or their place, are others.
_EVENTS = (
    "data", "labels_update", "paint",
    "scale", "translate", "rotate", "shear", "affine", "units", "axis_labels",
)  # fmt: skip


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


class Listening:
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


class Pixels:
    """Listens to layers, other ones whenever it is told.

    Parameters
    ----------
    answer : callable
        A method, called without arguments.
    refreshed : bool
        Whether to hear, too, that a layer draws itself anew, as it does when a script has changed
        its array in place; but for many other reasons as well.
    """

    def __init__(self, answer: Callable[[], None], refreshed: bool = False) -> None:
        self._answer = answer
        self._names = (*_EVENTS, "set_data") if refreshed else _EVENTS
        self._layers: list[Any] = []
        self._heard = Listening()

    def listen_to(self, layers: Iterable[Any]) -> None:
        """Listen to these layers and no others."""
        wanted = list(layers)
        if [id(layer) for layer in wanted] == [id(layer) for layer in self._layers]:
            return
        self._heard.release()
        self._layers = wanted
        events = (event for layer in wanted for event in self._events(layer))
        self._heard = Listening(*((event, self._on_event) for event in events))

    def release(self) -> None:
        """Listen no more."""
        self.listen_to(())

    def _on_event(self, *_: Any) -> None:
        self._answer()

    def _events(self, layer: Any) -> list[Any]:
        return [getattr(layer.events, name) for name in self._names if hasattr(layer.events, name)]
