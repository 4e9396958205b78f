"""What is kept of the last volume for the next one, which is let go where memory is short."""

from __future__ import annotations

from collections.abc import Callable

_forget: list[Callable[[], None]] = []


def forgotten_by(forget: Callable[[], None]) -> None:
    """Have something called that lets go of what a module keeps."""
    _forget.append(forget)


def forget() -> None:
    """Let go of everything."""
    for each in _forget:
        each()
