"""Each loop is compiled once, whatever the number of processes that test.

Two that begin together would compile every loop twice, side by side. Here whoever comes second
waits for what the first keeps on disk; and before a long run they go through the loops from either
end, so that they hardly wait.

Machine code is made of what Python calls, not of each piece that LLVM has taken into it already:
that is a sixth of the time, and what Python calls is the same to the bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # where files have no such locks, loops are compiled twice
    fcntl = None  # type: ignore[assignment]


@contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Among all processes, inside this block at most one; a process that ends lets go."""
    with file.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield


def compile_once() -> None:
    """Compile no loop that another process is compiling, but wait and take what it keeps."""
    if fcntl is None:
        return
    from numba.core.caching import NullCache
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compile_here = Dispatcher.compile

    def compile_or_wait(loop: Any, signature: Any) -> Any:
        if isinstance(loop._cache, NullCache):
            return compile_here(loop, signature)
        folder, code = Path(loop._cache.cache_path), loop.py_func.__code__
        folder.mkdir(parents=True, exist_ok=True)
        # Numba's own lock first: a thread that waits for a file must not be waited for.
        with global_compiler_lock, _alone(folder / f"{code.co_name}-{code.co_firstlineno}.lock"):
            return compile_here(loop, signature)

    Dispatcher.compile = compile_or_wait


def emit_late() -> None:
    """Make machine code of a library when it is first called, not of all that others took in."""
    from numba.core.codegen import JITCodeLibrary, JITCPUCodegen

    finalize, pointer = (
        JITCodeLibrary._finalize_final_module,
        JITCodeLibrary.get_pointer_to_function,
    )
    serialize, set_env = JITCodeLibrary.serialize_using_object_code, JITCPUCodegen.set_env

    def emit(library: Any) -> None:
        if library.__dict__.pop("_is_late", False):
            library._dynamic_globals.clear()  # which are listed again
            finalize(library)

    def finalize_late(library: Any) -> None:
        if library._disable_inspection:  # comes from disk
            finalize(library)
            return
        library._finalize_dynamic_globals()
        library._verify_declare_only_symbols()
        library._finalized = library._is_late = True

    def pointer_of(library: Any, name: str) -> int:
        library._ensure_finalized()
        if library.__dict__.get("_is_late"):
            try:
                is_here = not library._final_module.get_function(name).is_declaration
            except NameError:
                is_here = False
            if not is_here:
                return 0
            emit(library)
        address: int = pointer(library, name)
        return address

    def serialize_emitted(library: Any) -> Any:
        library._ensure_finalized()
        emit(library)
        return serialize(library)

    def set_env_of_emitted(codegen: Any, name: str, env: Any) -> None:
        if codegen._engine._ee.get_global_value_address(name):
            set_env(codegen, name, env)

    JITCodeLibrary._finalize_final_module = finalize_late
    JITCodeLibrary.get_pointer_to_function = pointer_of
    JITCodeLibrary.serialize_using_object_code = serialize_emitted
    JITCPUCodegen.set_env = set_env_of_emitted


def compile_most(backwards: bool) -> None:
    """Run what brings nearly all loops to disk."""
    from napari_hmrf.compiling import jobs
    from napari_hmrf.solver.backends.thread import compute_thread

    for job in reversed(jobs()) if backwards else jobs():
        compute_thread.submit(job.run).result()
