"""Loads the loops that are kept on disk, by a thread beside the work and in small steps.

The window and the compute thread go on meanwhile: no step keeps the interpreter to itself for as
long as a picture takes. Nothing is run, as numba's own threads must not be entered from two threads
at once.
"""

from __future__ import annotations

import atexit
import importlib
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

from napari_hmrf.solver.backends import kept

_log = logging.getLogger("napari_hmrf")
#: For each second of loading so many are left to the work.
_REST = 1.0


class _Loader:
    """Loads once, when first asked; the child of a fork begins anew."""

    def __init__(self) -> None:
        # Held for each step: a fork in the middle of one would never have numba's lock again.
        self.step = threading.Lock()
        self.stopped, self.done = threading.Event(), threading.Event()
        self.thread: threading.Thread | None = None
        self._lock = threading.Lock()

    def start(self) -> None:
        with self._lock:
            if self.thread is None:
                self.thread = threading.Thread(
                    target=self._run, name="napari-hmrf loader", daemon=True
                )
                self.thread.start()

    def stop(self) -> None:
        """End before the interpreter does: what is being loaded is not its own memory."""
        self.stopped.set()
        if self.thread is not None:
            self.thread.join(2.0)

    def _run(self) -> None:
        steps = _steps()
        try:
            while not self.stopped.is_set():
                begun = time.perf_counter()
                with self.step:
                    if next(steps, None) is None:
                        return
                self.stopped.wait(_REST * (time.perf_counter() - begun))
        except Exception:  # noqa: BLE001 - then whoever needs a loop loads it
            _log.debug("the loops could not be loaded beforehand", exc_info=True)
        finally:
            self.done.set()


def loaded(wait: float = 0.0) -> bool:
    """Whether all loops are in memory, after so many seconds at most; if not, they will be."""
    _loader.start()
    return _loader.done.wait(wait)


def begun() -> bool:
    """Whether loops are being loaded, or have been."""
    return _loader.thread is not None


def _steps() -> Iterator[str]:
    """Load one thing after the other; what it was."""
    before_numba()
    importlib.import_module("numba")
    yield "numba"
    for name in kept.modules():
        importlib.import_module(name)
        yield name
    for loop in loops_there():
        for signature in _signatures(loop):
            loop.compile(signature)
            yield loop.py_func.__name__


def before_numba() -> None:
    """Have numba find a folder to keep loops in, and cores that wait not burn.

    GNU OpenMP lets a thread that waits for the others burn its core for milliseconds unless told
    otherwise before it is loaded. Beside a window that wants a core, too, sweeps of 0.1 ms then
    take 10 ms; with a short wait they take 0.3 ms, and alone they lose nothing.
    """
    kept.folder()
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")


def loops_there() -> list[Any]:
    """All loops that are kept on disk, of the modules that have been imported."""
    from numba.core.caching import NullCache
    from numba.core.dispatcher import Dispatcher

    found: dict[int, Any] = {}
    for module in filter(None, map(sys.modules.get, kept.modules())):
        for value in tuple(vars(module).values()):
            loop: Any = value if isinstance(value, Dispatcher) else None
            if loop is not None and not isinstance(loop._cache, NullCache):
                found[id(loop)] = loop
    return list(found.values())


def _signatures(loop: Any) -> list[Any]:
    """For which types a loop is kept, as it is now and for this processor."""
    cache, processor = loop._cache, loop.targetctx.codegen()
    index = cache._cache_file._load_index()
    return [key[0] for key in index if key == cache._index_key(key[0], processor)]


_loader = _Loader()


def _begin_anew() -> None:
    global _loader
    _loader = _Loader()


def _before_fork() -> None:
    _loader.step.acquire()


def _after_fork() -> None:
    _loader.step.release()


atexit.register(lambda: _loader.stop())
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork, after_in_parent=_after_fork, after_in_child=_begin_anew
    )
