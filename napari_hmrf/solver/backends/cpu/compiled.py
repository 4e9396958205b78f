"""Decorators that compile loops, and cache them on disk for later processes.

Numba's own cache of a function is valid until the file of that function changes, even if it inlines
functions of other files. Here the cache becomes invalid when any file of loops changes.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import event

from napari_hmrf.solver.backends.compile_cache.disk_cache import sources

# Contraction (one rounding for x * y + z) is allowed. Reordering is not, because it could replace
# differences of displacement by sums that cancel.
_ARITHMETIC = {"contract", "nsz"}
# Options of all loops; C code never calls them.
_ALL = {"error_model": "numpy", "no_cfunc_wrapper": True}


class _Uncollected(event.Listener):  # type: ignore[misc]
    """Listener that pauses garbage collection while numba compiles, to save 10 % of the time."""

    _within = 0
    _paused = False

    def on_start(self, _: event.Event) -> None:
        """Pause garbage collection, unless a compilation has paused it already."""
        if self._within == 0:
            self._paused = gc.isenabled()
            gc.disable()
        self._within += 1

    def on_end(self, _: event.Event) -> None:
        """Resume garbage collection after the outermost compilation."""
        self._within -= 1
        if self._within == 0 and self._paused:
            gc.enable()


event.register("numba:compile", _Uncollected())


def _cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles and caches a function until any file of loops changes."""

    def decorate(function: Callable[..., Any]) -> Any:
        made = numba.njit(cache=True, nogil=True, **_ALL, **options)(function)
        with suppress(AttributeError):  # other versions of numba may lack these attributes
            file = made._cache._cache_file
            file._source_stamp = (file._source_stamp, sources(Path(__file__).parent))
        return made

    return decorate


def _callee(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for functions that are called by compiled loops only, never by Python."""
    made: Callable[..., Any] = numba.njit(no_cpython_wrapper=True, **_ALL, **options)
    return made


#: Function that numba inlines into the source of its callers.
inline = numba.njit(inline="always", error_model="numpy")
#: Function that LLVM inlines: as fast as `inline`, and compiled in half the time.
shared = _callee(fastmath=_ARITHMETIC, forceinline=True)
#: Function that other loops call, with contraction.
callee = _callee(fastmath=_ARITHMETIC)
#: Function that other loops call, with exact IEEE arithmetic.
strict_callee = _callee()
#: Function that may add terms in any order.
reduction = _callee(fastmath={"reassoc", "nsz"})
#: Function that may add terms in any order, with contraction.
contracted_reduction = _callee(fastmath=_ARITHMETIC | {"reassoc"})
#: Loop that Python calls, on one thread, with contraction.
alone = _cached(fastmath=_ARITHMETIC)
#: Loop that Python calls, on one thread, with exact IEEE arithmetic.
strict = _cached()
#: Loop that Python calls, on all threads, with exact IEEE arithmetic.
strict_parallel = _cached(parallel=True)
#: Loop that Python calls, on all threads, with contraction.
parallel = _cached(parallel=True, fastmath=_ARITHMETIC)
