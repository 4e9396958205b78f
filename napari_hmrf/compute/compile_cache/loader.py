"""Background thread that loads the cached loops in small steps, each time a job needs new ones.

The window and the compute thread continue meanwhile, because each step holds the GIL for less than
the duration of a frame. The loader does not execute loops, because numba's thread pool must not be
entered from two threads at once.
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
from pathlib import Path
from typing import Any

from napari_hmrf.compute.compile_cache import disk_cache, sets

_log = logging.getLogger("napari_hmrf")
#: Pause after each step, as a multiple of the duration of the step.
_REST = 1.0


class _Loader:
    """Thread that loads all loops on disk; a forked child creates a new loader."""

    def __init__(self) -> None:
        # Held during each step and during a fork. Otherwise a forked child could inherit a lock of
        # numba that is never released.
        self.step = threading.Lock()
        self.stopped = threading.Event()
        self.thread: threading.Thread | None = None
        # Jobs whose loops are loaded, or need no loading because it failed.
        self._jobs: frozenset[str] = frozenset()
        self._lock = threading.Lock()

    def has(self, job: str, wait: float) -> bool:
        """Return whether the loops of a compiled job are loaded; otherwise start to load them."""
        with self._lock:
            if job in self._jobs:
                return True
            if self.thread is None or not self.thread.is_alive():
                self.thread = threading.Thread(
                    target=self._run, name="napari-hmrf loader", daemon=True
                )
                self.thread.start()
            running = self.thread
        if wait:
            running.join(wait)
        return job in self._jobs

    def stop(self) -> None:
        """Stop the thread before the interpreter exits and frees memory that the thread uses."""
        self.stopped.set()
        if self.thread is not None:
            self.thread.join(2.0)

    def _run(self) -> None:
        jobs = frozenset(filter(disk_cache.compiled, (sets.EVERYTHING, *sets.COSTS)))
        steps = _steps()
        try:
            while not self.stopped.is_set():
                begun = time.perf_counter()
                with self.step:
                    if next(steps, None) is None:
                        break
                self.stopped.wait(_REST * (time.perf_counter() - begun))
        except Exception:  # noqa: BLE001 - each loop is then loaded at its first call
            _log.debug("the cached loops could not be loaded in the background", exc_info=True)
        self._jobs |= jobs


def loaded(job: str = sets.EVERYTHING, wait: float = 0.0) -> bool:
    """Start loading all loops on disk, and return whether those of a job are in memory.

    Parameters
    ----------
    job : str
        Job whose loops are on disk.
    wait : float
        Longest time to wait for the loader, in seconds.
    """
    return _loader.has(job, wait)


def begun() -> bool:
    """Return whether loading has started."""
    return _loader.thread is not None


def _steps() -> Iterator[str]:
    """Load modules and loops one by one, and yield the name of each."""
    before_numba()
    importlib.import_module("numba")
    yield "numba"
    for name in disk_cache.modules():
        importlib.import_module(name)
        yield name
    for loop in cached_loops():
        for signature in _signatures(loop):
            loop.compile(signature)
            yield loop.py_func.__name__


def before_numba() -> None:
    """Configure numba: cache folder, tolerance of a full disk, and short spin waits of threads.

    By default, a GNU OpenMP thread that waits for other threads occupies its core for several
    milliseconds. If a window uses a core at the same time, a sweep of 0.1 ms then takes 10 ms; with
    short spin waits, the sweep takes 0.3 ms. Without a window, short spin waits cost no time. The
    environment variable must be set before OpenMP is loaded.
    """
    disk_cache.folder()
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    _tolerate_full_disks()


def _tolerate_full_disks() -> None:
    """Make numba warn once, then continue, if it cannot write a loop to its cache."""
    from numba.core.caching import Cache  # heavy: numba

    save = Cache.save_overload
    if getattr(save, "is_tolerant", False):
        return

    def save_if_possible(self: Any, signature: Any, compiled: Any) -> None:
        try:
            save(self, signature, compiled)
        except OSError as error:
            if _Unwritable.is_known:
                return
            _Unwritable.is_known = True
            own, common = Path(self.cache_path), disk_cache.folder()
            _log.warning(
                "%s cannot be written to (%s), so each start compiles loops again. Free space "
                "there, or set NUMBA_CACHE_DIR to another folder.",
                common if own.is_relative_to(common) else own,
                error.strerror or error,
            )

    save_if_possible.is_tolerant = True  # type: ignore[attr-defined]
    Cache.save_overload = save_if_possible


class _Unwritable:
    """State of numba's cache folder in this process."""

    #: True once a loop could not be written.
    is_known = False


def is_unwritable() -> bool:
    """Return whether numba has failed to write a loop to its cache in this process."""
    return _Unwritable.is_known


def cached_loops() -> list[Any]:
    """List the loops of the imported modules that numba caches on disk."""
    from numba.core.caching import NullCache  # heavy: numba
    from numba.core.dispatcher import Dispatcher  # heavy: numba

    found: dict[int, Any] = {}
    for module in filter(None, map(sys.modules.get, disk_cache.modules())):
        for value in tuple(vars(module).values()):
            loop = _compiled(value)
            if not isinstance(loop, Dispatcher):
                continue
            if not isinstance(loop._cache, NullCache):  # type: ignore[attr-defined]
                found[id(loop)] = loop
    return list(found.values())


def _compiled(loop: Any) -> Any:
    """Return numba's object for a loop."""
    return getattr(loop, "compiled", loop)


def is_cached(loop: Any) -> bool:
    """Return whether a loop is cached for any argument types; False if the cache is unreadable."""
    try:
        return bool(_signatures(_compiled(loop)))
    except (AttributeError, OSError):
        return False


def _signatures(loop: Any) -> list[Any]:
    """Return the argument types for which a loop's current source is cached on this processor."""
    cache, processor = loop._cache, loop.targetctx.codegen()
    index = cache._cache_file._load_index()
    return [key[0] for key in index if key == cache._index_key(key[0], processor)]


_loader = _Loader()


def _reset_loader() -> None:
    global _loader
    _loader = _Loader()


def _before_fork() -> None:
    _loader.step.acquire()


def _after_fork() -> None:
    _loader.step.release()


atexit.register(lambda: _loader.stop())
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork, after_in_parent=_after_fork, after_in_child=_reset_loader
    )
