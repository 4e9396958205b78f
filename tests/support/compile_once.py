"""Each loop is compiled once, whatever the number of processes that test.

Two that begin together would compile every loop twice, side by side. Here whoever comes second
waits for what the first keeps on disk; and before a long run they go through the loops from either
end, so that they hardly wait.
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


def compile_most(backwards: bool) -> None:
    """Run what brings nearly all loops to disk."""
    from napari_hmrf.compiling import jobs
    from napari_hmrf.solver.backends.thread import compute_thread

    for job in reversed(jobs()) if backwards else jobs():
        compute_thread.submit(job.run).result()
