"""Loader of the cached loops: a background thread that works in small steps.

The window and the compute thread continue meanwhile: no step holds the interpreter's lock for as
long as a picture takes. No loop is run, because numba's own threads must not be entered from two
threads at once.
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

from napari_hmrf.solver.backends.compile_cache import kept

_log = logging.getLogger("napari_hmrf")
#: Seconds left to other work for each second of loading.
_REST = 1.0


class _Loader:
    """Thread that loads once, on the first call; the child of a fork has a new one."""

    def __init__(self) -> None:
        # Locked during each step: a fork within a step would never release numba's lock.
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
        """End before the interpreter does, which does not own the memory being loaded."""
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
        except Exception:  # noqa: BLE001 - then a loop is loaded when it is called
            _log.debug("the loops could not be loaded beforehand", exc_info=True)
        finally:
            self.done.set()


def loaded(wait: float = 0.0) -> bool:
    """Start to load all loops; return whether they are in memory, after at most `wait` seconds."""
    _loader.start()
    return _loader.done.wait(wait)


def begun() -> bool:
    """Return whether loops are being loaded, or have been."""
    return _loader.thread is not None


def _steps() -> Iterator[str]:
    """Load modules and loops one after the other, yielding the name of each."""
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
    """Import numba with a cache folder, a cache that may fail, and cores that do not spin.

    GNU OpenMP lets a thread that waits for the others spin for milliseconds unless it is configured
    before it is loaded. Beside a window that uses a core, too, sweeps of 0.1 ms then take 10 ms;
    with a short wait they take 0.3 ms, and alone they lose nothing.
    """
    kept.folder()
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    _tolerate_full_disks()


def _tolerate_full_disks() -> None:
    """Let numba continue without its cache where a loop cannot be written, with one warning."""
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
            own, all_of_them = Path(self.cache_path), kept.folder()
            _log.warning(
                "%s cannot be written to (%s), so each start compiles loops again. Free space "
                "there, or set NUMBA_CACHE_DIR to another folder.",
                all_of_them if own.is_relative_to(all_of_them) else own,
                error.strerror or error,
            )

    save_if_possible.is_tolerant = True  # type: ignore[attr-defined]
    Cache.save_overload = save_if_possible


class _Unwritable:
    """State of numba's cache folder in this process."""

    is_known = False


def is_unwritable() -> bool:
    """Return whether numba has failed to cache a loop in this process."""
    return _Unwritable.is_known


def loops_there() -> list[Any]:
    """List all loops with a cache on disk, of the imported modules."""
    from numba.core.caching import NullCache  # heavy: numba
    from numba.core.dispatcher import Dispatcher  # heavy: numba

    found: dict[int, Any] = {}
    for module in filter(None, map(sys.modules.get, kept.modules())):
        for value in tuple(vars(module).values()):
            loop: Any = value if isinstance(value, Dispatcher) else None
            if loop is not None and not isinstance(loop._cache, NullCache):
                found[id(loop)] = loop
    return list(found.values())


def is_cached(loop: Any) -> bool:
    """Return whether a loop is cached for some types; False if the cache is unreadable."""
    try:
        return bool(_signatures(loop))
    except (AttributeError, OSError):
        return False


def _signatures(loop: Any) -> list[Any]:
    """Return the types for which a loop is cached, as it is now and for this processor."""
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
