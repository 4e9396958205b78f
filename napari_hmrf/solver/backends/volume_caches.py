"""Registry of caches that volume solves retain, to clear the caches if memory is short."""

from __future__ import annotations

from collections.abc import Callable

_callbacks: list[Callable[[], None]] = []


def register(clear: Callable[[], None]) -> None:
    """Register a callback that clears the cache of a module."""
    _callbacks.append(clear)


def clear_all() -> None:
    """Clear all registered caches."""
    for each in _callbacks:
        each()
