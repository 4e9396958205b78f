"""Knowing, outside of Qt, whether a dock is there, was closed, or is gone with its window."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from magicgui.widgets import Container

#: Qt's signals keep no strong reference to those they call: this does, until the window is gone.
_living: set[Life] = set()


class Life:
    """Ends with a dock widget; then nothing of Qt's is touched any more.

    It refers to its owner weakly. A closure over the owner would be called by Qt even while Python
    is taking both apart.

    Parameters
    ----------
    owner : Container
        The dock widget whose life it is; of the others, its methods.
    at_opening, at_closing : callable
        Called when it is put into a dock, and when that is closed.
    at_end : callable
        Called when the window is gone, if the owner is still there.
    """

    def __init__(
        self,
        owner: Container,
        at_opening: Callable[[], None],
        at_closing: Callable[[], None],
        at_end: Callable[[], None],
    ) -> None:
        self.over = False
        self._docked = False
        self._owner = weakref.ref(owner)
        self._at_opening = weakref.WeakMethod(at_opening)
        self._at_closing = weakref.WeakMethod(at_closing)
        self._at_end = weakref.WeakMethod(at_end)
        _living.add(self)
        owner.native.destroyed.connect(self.end)
        owner.native_parent_changed.connect(self._on_parent)

    @property
    def away(self) -> bool:
        """Whether the window is gone, or the dock was closed."""
        return self.over or (self._docked and not self._has_parent)

    @property
    def docked(self) -> bool:
        """Whether there is a dock around the widget."""
        return not self.over and self._has_parent

    def end(self, *_: Any) -> None:
        """The window is gone."""
        self.over = True
        _living.discard(self)
        _call(self._at_end)

    @property
    def _has_parent(self) -> bool:
        owner = self._owner()
        return owner is not None and owner.native.parent() is not None

    def _on_parent(self, *_: Any) -> None:
        """Napari closes a dock by taking the widget out of it."""
        if self.over:
            return
        if self._has_parent:
            self._docked = True
            _call(self._at_opening)
        elif self._docked:
            _call(self._at_closing)


def _call(method: weakref.WeakMethod[Callable[[], None]]) -> None:
    called = method()
    if called is not None:
        called()
