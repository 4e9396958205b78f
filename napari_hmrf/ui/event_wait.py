"""Hearing of events until it is enough."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


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
