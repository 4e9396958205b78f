"""Compilation of each loop by only one of several test processes.

Two processes that start together would compile every loop twice. Here the second process waits for
the file of the first. Before a long run, the processes compile the loops from opposite ends, so
that they rarely wait.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Without such file locks, loops are compiled twice.
    fcntl = None  # type: ignore[assignment]


@contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Run the block in at most one process at a time; the lock is released if the process ends."""
    with file.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield


def compile_once() -> None:
    """Make numba wait for a loop that another process compiles, and load its file."""
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
        # Acquire numba's own lock first, so that no thread waits for a thread that waits for a
        # file.
        with global_compiler_lock, _alone(folder / f"{code.co_name}-{code.co_firstlineno}.lock"):
            return compile_here(loop, signature)

    Dispatcher.compile = compile_or_wait


def compile_most(backwards: bool) -> None:
    """Compile nearly all loops and store them on disk."""
    from napari_hmrf.compiling import jobs
    from napari_hmrf.compute.thread import compute_thread

    for job in reversed(jobs()) if backwards else jobs():
        compute_thread.submit(job.run).result()
