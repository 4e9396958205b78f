"""The ways in which loops are compiled, and kept on disk for the next process.

Numba keeps what it has compiled of a function until that function's own file changes, whatever
happens to the functions of other files that it has taken in. Here it notices when any file of
kernels changes.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core import event

from napari_hmrf.solver.backends.compile_cache.kept import sources

# Contraction (one rounding for x * y + z) is allowed; reordering is not, as differences must stay.
_ARITHMETIC = {"contract", "nsz"}
# Nothing calls a loop as C does.
_ALL = {"error_model": "numpy", "no_cfunc_wrapper": True}


class _Uncollected(event.Listener):  # type: ignore[misc]
    """Pause the collection of garbage while numba compiles: a tenth of its time or more."""

    _within = 0
    _paused = False

    def on_start(self, _: event.Event) -> None:
        """Pause the collection, unless it is paused already."""
        if self._within == 0:
            self._paused = gc.isenabled()
            gc.disable()
        self._within += 1

    def on_end(self, _: event.Event) -> None:
        """Go on, at the end of what was begun first."""
        self._within -= 1
        if self._within == 0 and self._paused:
            gc.enable()


event.register("numba:compile", _Uncollected())


def _kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function by these options of numba's, and keep it while no kernel changes."""

    def decorate(function: Callable[..., Any]) -> Any:
        made = numba.njit(cache=True, nogil=True, **_ALL, **options)(function)
        with suppress(AttributeError):  # a numba made otherwise looks at the function's file alone
            file = made._cache._cache_file
            file._source_stamp = (file._source_stamp, sources(Path(__file__).parent))
        return made

    return decorate


def _callee(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function for loops alone, and keep it with them: Python must not call it."""
    made: Callable[..., Any] = numba.njit(no_cpython_wrapper=True, **_ALL, **options)
    return made


#: Functions that become part of their caller's source.
inline = numba.njit(inline="always", error_model="numpy")
#: Compiled once for all callers and inlined by LLVM: as fast, and ready in half the time.
shared = _callee(fastmath=_ARITHMETIC, forceinline=True)
#: On one thread.
callee = _callee(fastmath=_ARITHMETIC)
#: The same, with no liberties taken.
strict_callee = _callee()
#: Sums that may be taken in any order.
reduction = _callee(fastmath={"reassoc", "nsz"})
contracted_reduction = _callee(fastmath=_ARITHMETIC | {"reassoc"})
#: Loops that Python calls: on one thread; on one or on all, with exact arithmetic.
alone = _kept(fastmath=_ARITHMETIC)
strict = _kept()
strict_parallel = _kept(parallel=True)
#: On all threads.
parallel = _kept(parallel=True, fastmath=_ARITHMETIC)
