"""Progress of loop compilation in this process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from napari_hmrf.compute.compile_cache.loader import before_numba, cached_loops
from napari_hmrf.compute.compile_cache.sets import COSTS
from napari_hmrf.compute.compile_cache.stage import Stage

# Time that this computer is assumed to have spent at the pace of `COSTS`, in seconds, so that the
# first loops do not decide the estimate.
_ASSUMED = 5.0


class _State:
    """State of the compilation in this process."""

    #: Number of loops that this process has compiled.
    compiled = 0
    #: Time that they took, and time that `COSTS` expects, in seconds.
    spent = expected = _ASSUMED
    #: True while a job reports its progress.
    watched = False


@contextmanager
def watched(job: str, report: Callable[[Stage], object]) -> Iterator[None]:
    """Report the progress of a job before each loop that this thread compiles.

    Nothing is reported within another watched job.

    Parameters
    ----------
    job : str
        Key of `sets.COSTS`, or "" for loops that are in no set.
    report : callable
        Function called with a `Stage`. It may raise an exception to stop the compilation.
    """
    if _State.watched:
        yield
        return
    before_numba()
    from numba.core import event  # heavy: numba

    here = threading.get_ident()
    first: int | None = None  # counted only if a loop is compiled, because this takes a millisecond
    cost = COSTS[job].seconds / COSTS[job].loops if job else 0.0
    depth, begun = 0, 0.0

    class Watch(event.Listener):  # type: ignore[misc]
        def on_start(self, happening: Any) -> None:
            nonlocal depth, begun, first
            if threading.get_ident() == here:
                depth += 1
                # Report only the outermost loop; numba catches exceptions raised in nested ones.
                if depth == 1:
                    first = _count_loops() if first is None else first
                    begun = time.perf_counter()
                    pace = _State.spent / _State.expected if job else 0.0
                    report(Stage(job, _count_loops() - first, pace))

        def on_end(self, happening: Any) -> None:
            nonlocal depth
            if threading.get_ident() == here:
                depth -= 1
                if depth == 0:
                    _State.compiled += 1
                    _State.spent += time.perf_counter() - begun
                    _State.expected += cost

    _State.watched = True
    try:
        with event.install_listener("numba:compile", Watch()):
            yield
    finally:
        _State.watched = False


def _count_loops() -> int:
    """Return the number of loops that this process has compiled or loaded.

    Loops that are called only by other loops are not counted.
    """
    loaded = sum(sum(loop.stats.cache_hits.values()) for loop in cached_loops())
    return _State.compiled + loaded
