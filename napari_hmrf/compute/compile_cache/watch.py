"""Progress of loop compilation in this process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from napari_hmrf.compute.compile_cache import sets
from napari_hmrf.compute.compile_cache.compiler import Stage
from napari_hmrf.compute.compile_cache.loader import before_numba, cached_loops


class _State:
    """State of the compilation in this process."""

    #: Number of loops that this process has compiled.
    compiled = 0
    #: True while a job reports its progress.
    watched = False


@contextmanager
def watched(job: str, report: Callable[[Stage], object]) -> Iterator[None]:
    """Report the progress of a job before each loop that this thread compiles.

    Nothing is reported within another watched job.

    Parameters
    ----------
    job : str
        Key of `sets.COUNTS`.
    report : callable
        Function called with a `Stage`. It may raise an exception to stop the compilation.
    """
    if _State.watched:
        yield
        return
    before_numba()
    from numba.core import event  # heavy: numba

    of = min(_count_loops() + sets.COUNTS[job], sets.FULL_COUNT)
    here, begun = threading.get_ident(), time.perf_counter()
    before, depth = _State.compiled, 0

    class Watch(event.Listener):  # type: ignore[misc]
        def on_start(self, happening: Any) -> None:
            nonlocal depth
            if threading.get_ident() == here:
                depth += 1
                # Report only the outermost loop; numba catches exceptions raised in nested ones.
                if depth == 1:
                    compiled = _State.compiled - before
                    pace = (time.perf_counter() - begun) / compiled if compiled else 0.0
                    report(Stage(job, _count_loops(), of, pace))

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


def _count_loops() -> int:
    """Return the number of loops that this process has compiled or loaded.

    Loops that are called only by other loops are not counted.
    """
    loaded = sum(sum(loop.stats.cache_hits.values()) for loop in cached_loops())
    return _State.compiled + loaded
