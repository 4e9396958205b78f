"""Decorators for compiled functions of one thread: those that Python calls, and their callees.

Numba optimizes each function, turns it into machine code and loads that into the process. Where
only other compiled functions call it, they contain its optimized code, and its own machine code
would never run. Here no machine code is made of it, which saves a seventh of the time of all
compilation. (Optimizing it less saves another seventh, but volumes are then half as fast.)
"""

# mypy: disable-error-code="no-untyped-call, misc"
from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder

from napari_hmrf.compute.compile_cache.disk_cache import stamp

#: Options of all functions that numba compiles. Loops are never called from C, so no C wrapper is
#: needed. Without the last option, a function would or would not count references depending on
#: which loop calls it first.
LOOPS = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": True}
#: Digest of this file; loops are compiled again after a change.
SOURCE = hashlib.sha256(Path(__file__).read_bytes()).digest()


class _Linked(JITCodeLibrary):
    """Optimized code of a function, for other functions to link, without machine code."""

    @property
    def codegen(self) -> _Linked:
        """The library itself, in place of the generator, to which an environment would be given."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: only functions that Python calls use their environment."""

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0: there is no machine code."""
        self._ensure_finalized()
        return 0

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


class _Callee(CompilerBase):
    """Compiler of functions that only compiled functions call."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's usual pipeline, whose code is not loaded."""
        state = self.state
        state.library = _Linked(state.targetctx.codegen(), state.func_id.func_qualname)
        return [DefaultPassBuilder.define_nopython_pipeline(state)]


class _CalleeWithoutOverlap(_Callee):
    """Compiler that assumes that no array that a function writes overlaps its other arrays.

    Otherwise LLVM guards each vectorized loop with a comparison of all addresses, and short loops
    always run without vectors, because the comparison would take longer than the loop.
    """

    def define_pipelines(self) -> list[Any]:
        """Return the same pipeline, for arrays that do not overlap."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def callee(*, disjoint: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for functions that are called only by compiled functions.

    Parameters
    ----------
    disjoint : bool
        True if the function writes no array that overlaps another of its arguments.
    options : object
        Further options of `numba.njit`.
    """
    compiler = _CalleeWithoutOverlap if disjoint else _Callee
    made: Callable[[Callable[..., Any]], Any] = numba.njit(
        no_cpython_wrapper=True, pipeline_class=compiler, **LOOPS, **options
    )
    return made


def cached(source: bytes = b"", **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for functions that Python calls, which are cached on disk.

    Parameters
    ----------
    source : bytes
        Digest of other source files after a change of which the function is compiled again.
    options : object
        Further options of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        made = numba.njit(cache=True, nogil=True, **LOOPS, **options)(function)
        stamp(made, SOURCE + source)
        return made

    return decorate
