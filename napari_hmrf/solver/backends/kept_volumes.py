"""Registry of caches that survive a volume's solve, and are cleared where memory is short."""

from __future__ import annotations

from collections.abc import Callable

_forget: list[Callable[[], None]] = []


def forgotten_by(forget: Callable[[], None]) -> None:
    """Register a callback that clears the cache of a module."""
    _forget.append(forget)


def forget() -> None:
    """Let go of everything."""
    for each in _forget:
        each()
