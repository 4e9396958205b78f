"""Knowing, outside of Qt, that the window is gone."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from napari_hmrf.widgets.job import Job

#: Qt's signals keep no strong reference to those they call: this does, until the window is gone.
_living: set[Life] = set()


class Life:
    """Ends with a Qt widget; then its job is cancelled and nothing of Qt's is touched any more.

    It refers to its owner weakly. A closure over the owner would be called by Qt even while Python
    is taking both apart.

    Parameters
    ----------
    native : QWidget
        Whose end it is.
    at_end : callable
        A method of the owner, called if that is still there.
    """

    def __init__(self, native: Any, at_end: Callable[[], None]) -> None:
        self.over = False
        self.job: Job | None = None
        self._at_end = weakref.WeakMethod(at_end)
        _living.add(self)
        native.destroyed.connect(self.end)

    def end(self, *_: Any) -> None:
        """The window is gone."""
        self.over = True
        _living.discard(self)
        if self.job is not None:
            self.job.cancel()
            self.job = None
        at_end = self._at_end()
        if at_end is not None:
            at_end()
