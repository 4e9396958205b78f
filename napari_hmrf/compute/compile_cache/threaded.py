"""Multithreaded loops that compile nearly as fast as loops of one thread.

With ``parallel=True``, numba compiles the body of a loop as a separate function, in many more
steps, which takes two to three times as long. Here a loop is compiled once, as a function that
computes the part of one thread, and the wrapper through which Python calls it lets each of numba's
threads compute its part.

The first argument `thread` of a loop contains the number of the thread, the number of threads, and
the number of the turn: all threads finish a turn before any of them starts the next one. Python
calls a loop without this argument (`ThreadedLoop`).

Without reference counts of arrays, loops vectorize and compile faster, but cannot create arrays.
"""

# mypy: disable-error-code="no-untyped-call, no-untyped-def, no-any-return, misc"
from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba import int64, types
from numba.core import cgutils, lowering
from numba.core.callwrapper import PyCallWrapper
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.ir import Expr
from numba.core.typed_passes import NativeLowering

from napari_hmrf.compute.compile_cache.decorators import LOOPS, SOURCE
from napari_hmrf.compute.compile_cache.disk_cache import stamp

#: Digest of this file and of the decorators; loops are compiled again after a change.
_SOURCE = SOURCE + hashlib.sha256(Path(__file__).read_bytes()).digest()
#: Argument `thread` of a loop that another compiled function calls on its own thread.
ALONE = (0, 1, 0)


class ThreadedLoop(partial[None]):
    """Compiled loop without its argument `thread`: a call runs it on all of numba's threads."""

    @property
    def compiled(self) -> Any:
        """Numba's object for the loop, which has the argument `thread`."""
        return self.func

    def in_turns(self, count: int, *arguments: Any) -> None:
        """Run the loop in several turns."""
        self.func((0, 0, count), *arguments)


@numba.njit(inline="always", error_model="numpy")
def bounds_of_part(number, count, total):
    """Return the start and stop of one of `count` parts of the indices from 0 to `total`."""
    return number * int64(total) // count, (number + 1) * int64(total) // count


@numba.njit(inline="always", error_model="numpy")
def portion(thread, total):
    """Return a thread's part of the indices from 0 to `total` (exclusive)."""
    start, stop = bounds_of_part(thread[0], thread[1], total)
    start = max(start, int64(0))
    return range(start, max(stop, start))


def _launch() -> None:
    """Start numba's threads, and thereby make their functions known to compiled loops."""
    numba.get_num_threads()


_VOID, _NUMBER, _CODE = ir.IntType(8).as_pointer(), ir.IntType(64), ir.IntType(32)


def _part(context, module, described, body, packed):
    """Return a function that computes one or a few parts; numba's threads call it.

    Numba passes the address of each array plus the number of the part times a step. The only
    "array" has the address 0 and the step 1, so the address is the number. `packed` is the type of
    the data: code of an error, number of parts, turn, and the arguments of the loop.
    """
    kind = ir.FunctionType(
        ir.VoidType(), [_VOID.as_pointer(), _NUMBER.as_pointer(), _NUMBER.as_pointer(), _VOID]
    )
    part = ir.Function(module, kind, f"{described.llvm_func_name}.part")
    part.linkage = "internal"
    builder = ir.IRBuilder(part.append_basic_block("entry"))
    places, sizes, _, data = part.args
    first = builder.ptrtoint(builder.load(places), _NUMBER)
    stored = builder.bitcast(data, packed.as_pointer())
    _, parts, turn, _, *values = cgutils.unpack_tuple(builder, builder.load(stored))
    with cgutils.for_range(builder, builder.load(sizes)) as loop:
        thread = ir.Constant(ir.ArrayType(_NUMBER, 3), ir.Undefined)
        for place, value in enumerate((builder.add(first, loop.index), parts, turn)):
            thread = builder.insert_value(thread, value, place)
        status, _ = context.call_conv.call_function(
            builder, body, described.restype, described.argtypes, [thread, *values]
        )
        with builder.if_then(status.is_error):
            builder.store(status.code, cgutils.gep_inbounds(builder, stored, 0, 0))
    builder.ret_void()
    return part


def _forked(context, module, described, body):
    """Return a function with the arguments of a loop that lets numba's threads compute all parts.

    It computes as many parts as threads, in each turn.
    """
    forked = ir.Function(module, body.function_type, f"{described.llvm_func_name}.forked")
    forked.linkage = "internal"
    builder = ir.IRBuilder(forked.append_basic_block("entry"))
    convention = context.call_conv
    values = context.get_arg_packer(described.argtypes).from_arguments(
        builder, convention.get_arguments(forked)
    )
    count = cgutils.get_or_insert_function(module, ir.FunctionType(_NUMBER, []), "get_num_threads")
    parts, none = builder.call(count, []), _NUMBER(0)
    data = cgutils.alloca_once_value(
        builder, cgutils.make_anonymous_struct(builder, [_CODE(0), parts, none, *values])
    )
    part = _part(context, module, described, body, data.type.pointee)
    place = cgutils.alloca_once_value(builder, builder.inttoptr(none, _VOID))
    size, step = (cgutils.alloca_once_value(builder, value) for value in (parts, _NUMBER(1)))
    run = cgutils.get_or_insert_function(
        module, ir.FunctionType(ir.VoidType(), [_VOID] * 5 + [_NUMBER] * 3), "numba_parallel_for"
    )
    with cgutils.for_range(builder, builder.extract_value(values[0], 2)) as loop:
        builder.store(loop.index, cgutils.gep_inbounds(builder, data, 0, 2))
        with builder.if_else(builder.icmp_signed("==", parts, _NUMBER(1))) as (alone, together):
            with alone:
                builder.call(part, [place, size, step, builder.bitcast(data, _VOID)])
            with together:
                passed = (builder.bitcast(each, _VOID) for each in (part, place, size, step, data))
                builder.call(run, [*passed, none, _NUMBER(1), parts])
    code = builder.load(cgutils.gep_inbounds(builder, data, 0, 0))
    with builder.if_then(builder.icmp_signed("!=", code, _CODE(0)), likely=False):
        convention.return_user_exc(builder, MemoryError, ("not enough memory for a loop",))
    convention.return_value(builder, context.get_dummy_value())
    return forked


class _ForkedLower(lowering.Lower):
    """Translator of a loop whose wrapper for Python calls the loop from several threads."""

    def create_cpython_wrapper(self, release_gil: bool = False) -> None:
        """Make the wrapper."""
        context, described = self.context, self.fndesc
        module = context.create_module("wrapper")
        kind = context.call_conv.get_function_type(described.restype, described.argtypes)
        body = ir.Function(module, kind, described.llvm_func_name)
        PyCallWrapper(
            context,
            module,
            _forked(context, module, described, body),
            described,
            self.env,
            call_helper=self.call_helper,
            release_gil=release_gil,
        ).build()
        self.library.add_ir_module(module)


def _check_results(state: Any) -> None:
    """Check that a loop without reference counts calls no function that returns an array.

    Such a function counts a reference for its caller, and the array would never be freed.
    """
    for call, signature in state.calltypes.items():
        called = (
            state.typemap.get(call.func.name)
            if isinstance(call, Expr) and call.op == "call"
            else None
        )
        if isinstance(called, types.Dispatcher) and "array(" in str(signature.return_type).lower():
            name = called.dispatcher.py_func.__name__
            raise TypeError(f"{state.func_id.func_name} calls {name}, which returns an array")


@register_pass(mutates_CFG=True, analysis_only=False)
class _ForkedLowering(NativeLowering):
    """Pass that translates a multithreaded loop."""

    _name = "forked_lowering"

    @property
    def lowering_class(self) -> type[lowering.Lower]:
        """Translator of the pass."""
        return _ForkedLower

    def run_pass(self, state: Any) -> bool:
        """Translate a loop, and let numba's threads start before it is loaded from the cache."""
        if not state.flags.nrt:
            _check_results(state)
        _launch()
        state.reload_init.append(_launch)
        return super().run_pass(state)


class _Forked(CompilerBase):
    """Compiler of multithreaded loops."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's usual pipeline with another translator."""
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state)
        pipeline.passes = [
            (_ForkedLowering if step is NativeLowering else step, name)
            for step, name in pipeline.passes
        ]
        pipeline.finalize()
        return [pipeline]


class _ForkedWithoutOverlap(_Forked):
    """Compiler of multithreaded loops that write no array which overlaps another argument."""

    def define_pipelines(self) -> list[Any]:
        """Return the same pipeline, for arrays that do not overlap."""
        self.state.flags.noalias = True
        return super().define_pipelines()


def threaded(
    source: bytes = b"",
    *,
    disjoint: bool = False,
    creates: bool = False,
    turns: int = 1,
    **options: Any,
) -> Callable[[Callable[..., None]], ThreadedLoop]:
    """Return a decorator that compiles a multithreaded loop and caches it on disk.

    Parameters
    ----------
    source : bytes
        Digest of the source files that the loop inlines, if any; it is compiled again after a
        change.
    disjoint : bool
        True if the loop writes no array that overlaps another of its arguments; such a loop is
        vectorized without a comparison of addresses.
    creates : bool
        True if the loop creates arrays, and therefore needs reference counts.
    turns : int
        Number of turns, unless the loop is called with `ThreadedLoop.in_turns`.
    options : object
        Further options of `numba.njit`.
    """
    compiler = _ForkedWithoutOverlap if disjoint else _Forked
    compiled = numba.njit(
        cache=True, nogil=True, pipeline_class=compiler, **{**LOOPS, "_nrt": creates}, **options
    )

    def decorate(function: Callable[..., None]) -> ThreadedLoop:
        made = compiled(function)
        stamp(made, _SOURCE + source)
        return ThreadedLoop(made, (0, 0, turns))

    return decorate
