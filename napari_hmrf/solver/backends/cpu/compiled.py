"""Decorators that compile loops and cache them on disk for later processes.

Numba invalidates its cache of a function only when the function's own file changes, even if the
function inlines functions from other files. The decorators in this module invalidate the cache when
any file with compiled loops changes.
"""

from __future__ import annotations

import gc
from functools import partial

import numba
from numba.core import event

from napari_hmrf.compute.compile_cache.decorators import cached
from napari_hmrf.compute.compile_cache.decorators import callee as _callee
from napari_hmrf.compute.compile_cache.disk_cache import sources
from napari_hmrf.compute.compile_cache.threaded import (
    ALONE,
    bounds_of_part,
    portion,
    threaded,
)

__all__ = ["ALONE", "bounds_of_part", "portion"]

# Contraction (one rounding for x * y + z) is allowed. Reordering is not, because it could replace
# differences between displacements by sums in which large terms cancel.
_ARITHMETIC = {"contract", "nsz"}


class _Uncollected(event.Listener):  # type: ignore[misc]
    """Listener that pauses garbage collection while numba compiles, to save 10 % of the time."""

    _within = 0
    _paused = False

    def on_start(self, _: event.Event) -> None:
        """Pause garbage collection, unless an outer compilation has already paused it."""
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


# Loops are compiled again when any file of this folder changes.
_cached, _threaded = partial(cached, sources()), partial(threaded, sources())

#: Decorator for functions that numba inlines into the source of their callers.
inline = numba.njit(inline="always", error_model="numpy")
#: Decorator for functions that LLVM inlines: as fast as `inline`, with half the compile time.
shared = _callee(fastmath=_ARITHMETIC, forceinline=True)
#: Decorator for inlined loops whose outputs overlap none of their other arguments: such loops are
#: vectorized at any length. Lines of one scratch array count as a single argument.
disjoint = _callee(disjoint=True, fastmath=_ARITHMETIC, forceinline=True)
#: Decorator for functions called by other loops, with contraction.
callee = _callee(fastmath=_ARITHMETIC)
#: Decorator for the same, if the outputs overlap none of the other arguments.
disjoint_callee = _callee(disjoint=True, fastmath=_ARITHMETIC)
#: Decorator for functions called by other loops, with exact IEEE arithmetic.
strict_callee = _callee()
#: Decorator for functions that may add terms in any order.
reduction = _callee(fastmath={"reassoc", "nsz"})
#: Decorator for functions that may add terms in any order, with contraction.
contracted_reduction = _callee(fastmath=_ARITHMETIC | {"reassoc"})
#: Decorator for single-threaded loops called from Python, with contraction.
alone = _cached(fastmath=_ARITHMETIC)
#: Decorator for single-threaded loops called from Python, with exact IEEE arithmetic.
strict = _cached()
#: Decorator for multithreaded loops called from Python, with exact IEEE arithmetic.
strict_parallel = _threaded()
#: Decorator for the same, if the outputs overlap none of the other arguments.
disjoint_strict_parallel = _threaded(disjoint=True)
#: Decorator for multithreaded loops called from Python, with contraction.
parallel = _threaded(fastmath=_ARITHMETIC)
#: Decorator for the same, if the outputs overlap none of the other arguments.
disjoint_parallel = _threaded(disjoint=True, fastmath=_ARITHMETIC)
#: Decorator for multithreaded loops that create scratch arrays.
scratch_parallel = _threaded(creates=True, fastmath=_ARITHMETIC)
#: Decorator for loops over the planes of a volume that add to the sites of the next plane, too:
#: turn 0 clears the sites, turns 1 and 2 visit planes with even and with odd numbers.
by_parity = _threaded(creates=True, turns=3, fastmath=_ARITHMETIC)
