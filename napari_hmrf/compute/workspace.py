"""Workspace of the solver: what a solve keeps for later solves of the process.

Models, checks of tissue and warm starts are kept one of a kind: each replaces the last one. A
forked process starts with an empty workspace, because the fork may have interrupted a solve that
uses it. Unless a module says otherwise, only the compute thread uses it.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class Kept(Generic[T]):
    """Latest value of one kind.

    Parameters
    ----------
    is_large : bool
        True if the value of a volume takes much memory; `clear_large` then forgets it.

    Attributes
    ----------
    value : T or None
        None until a value is kept.
    is_large : bool
    """

    value: T | None

    def __init__(self, *, is_large: bool = False) -> None:
        self.value, self.is_large = None, is_large
        _workspace.append(self)

    def clear(self) -> None:
        """Forget the value."""
        self.value = None

    def valid(self, is_valid: Callable[[T], bool]) -> T | None:
        """Return the value if it is valid, and None otherwise."""
        value = self.value
        return value if value is not None and is_valid(value) else None

    def get(self, is_valid: Callable[[T], bool], make: Callable[[], T]) -> T:
        """Return the value if it is valid, and otherwise a new one, which is kept.

        The old value is forgotten first, so that its memory is free for the new one.
        """
        value = self.valid(is_valid)
        if value is None:
            self.clear()
            value = self.value = make()
        return value


_workspace: list[Kept[Any]] = []


def clear_large() -> None:
    """Forget all values that take much memory for a volume."""
    for kept in _workspace:
        if kept.is_large:
            kept.clear()


def in_child_of_fork(forget: Callable[[], object]) -> None:
    """Register a callback that runs in every child of a fork, where other threads do not exist."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=forget)


def _clear_all() -> None:
    for kept in _workspace:
        kept.clear()


in_child_of_fork(_clear_all)
atexit.register(_clear_all)  # models are freed while all modules still exist
