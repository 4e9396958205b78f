"""Watching numba compile loops, and saying how far it is."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from napari_hmrf.solver.backends.compile_cache import sets
from napari_hmrf.solver.backends.compile_cache.compiler import Stage
from napari_hmrf.solver.backends.compile_cache.loader import before_numba, loops_there


class _State:
    """Loops that this process has compiled."""

    #: Number of compiled loops.
    compiled = 0
    watched = False


@contextmanager
def watched(job: str, tell: Callable[[Stage], object]) -> Iterator[None]:
    """Say how far a job is, before each loop that this thread compiles.

    Within a job that is watched this does nothing.

    Parameters
    ----------
    job : str
        A key of `sets.COUNTS`.
    tell : callable
        Given a `Stage`; raises to have nothing more compiled.
    """
    if _State.watched:
        yield
        return
    before_numba()
    from numba.core import event  # heavy: numba

    of = min(_there() + sets.COUNTS[job], sets.FULL_COUNT)
    here, begun = threading.get_ident(), time.perf_counter()
    before, depth = _State.compiled, 0

    class Watch(event.Listener):  # type: ignore[misc]
        def on_start(self, happening: Any) -> None:
            nonlocal depth
            if threading.get_ident() == here:
                depth += 1
                # One that is called by another is part of it, and numba would take an error for
                # its own.
                if depth == 1:
                    compiled = _State.compiled - before
                    pace = (time.perf_counter() - begun) / compiled if compiled else 0.0
                    tell(Stage(job, _there(), of, pace))

        def on_end(self, happening: Any) -> None:
            nonlocal depth
            if threading.get_ident() == here:
                depth -= 1
                _State.compiled += depth == 0

    _State.watched = True
    try:
        with event.install_listener("numba:compile", Watch()):
            yield
    finally:
        _State.watched = False


def _there() -> int:
    """Return the number of loops compiled or loaded here, without those that only loops call."""
    loaded = sum(sum(loop.stats.cache_hits.values()) for loop in loops_there())
    return _State.compiled + loaded
