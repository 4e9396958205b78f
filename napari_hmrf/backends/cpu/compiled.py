"""The ways in which loops are compiled, and kept on disk for the next process.

Numba keeps what it has compiled of a function until that function's own file changes, whatever
happens to the functions of other files that it has taken in. Here it notices when any file of
kernels changes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba

from napari_hmrf.backends.loops import sources

# Contraction (one rounding for x * y + z) is allowed; reordering is not, as differences must stay.
_ARITHMETIC = {"contract", "nsz"}


def _kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function by these options of numba's, and keep it while no kernel changes."""

    def decorate(function: Callable[..., Any]) -> Any:
        made = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        with suppress(AttributeError):  # a numba made otherwise looks at the function's file alone
            file = made._cache._cache_file
            file._source_stamp = (file._source_stamp, sources(Path(__file__).parent))
        return made

    return decorate


#: Become part of the source of whoever calls them.
inline = numba.njit(inline="always", error_model="numpy")
#: Compiled once for all callers and inlined by LLVM: as fast, and ready in half the time.
shared = numba.njit(error_model="numpy", fastmath=_ARITHMETIC, forceinline=True)
#: As `alone`, but kept with its callers only.
callee = numba.njit(error_model="numpy", fastmath=_ARITHMETIC)
#: On one thread.
alone = _kept(fastmath=_ARITHMETIC)
#: On one thread, or on all, with no liberties taken.
strict = _kept()
strict_parallel = _kept(parallel=True)
#: On all threads.
parallel = _kept(parallel=True, fastmath=_ARITHMETIC)
#: Sums that may be taken in any order.
reduction = _kept(fastmath={"reassoc", "nsz"})
contracted_reduction = _kept(fastmath=_ARITHMETIC | {"reassoc"})
