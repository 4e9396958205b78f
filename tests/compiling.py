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

import numpy as np

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


def _elastic(poisson: Any, spacing: tuple[float, float], penalty: float | None = None) -> None:
    from napari_hmrf import ElasticPrior, Multigrid, Problem, solve

    c = np.zeros((40, 40, 2))
    c[0] = c[-1] = 1
    problem = Problem(c, c, np.ones((40, 40)), spacing)
    prior = ElasticPrior(poisson) if penalty is None else ElasticPrior(poisson, penalty=penalty)
    solve(problem, prior, Multigrid(0.01), backend="cpu")


def _paper(optimizer: Any, conditional: str, spacing: tuple[float, float]) -> None:
    from napari_hmrf import Problem, SeilerPrior, solve

    c = np.zeros((40, 40, 2))
    c[0] = c[-1] = 1
    problem = Problem(c, c, np.ones((40, 40)), spacing)
    solve(problem, SeilerPrior(conditional=conditional), optimizer, backend="cpu")


def _pictures() -> None:
    from napari_hmrf import warp
    from napari_hmrf.backends.thread import compute_thread
    from napari_hmrf.warper import Warper

    still = np.zeros((9, 9, 2), np.float32)
    for kind in (np.uint8, np.float32):
        image = np.zeros((9, 9), kind)
        warp(image, still)
        compute_thread.submit(lambda image=image: Warper(image)(still)).result()


def compile_most(backwards: bool) -> None:
    """Run what brings nearly all loops to disk."""
    from napari_hmrf import ICM, Multigrid

    square, oblong = (1.0, 1.0), (2.0, 0.5)
    jobs = [
        lambda: _elastic(0.3, square),
        lambda: _elastic(np.full((40, 40), 0.3), oblong, 1.0),
        _pictures,
        lambda: _paper(ICM(iterations=2, steps=None), "centred", square),
        lambda: _paper(ICM(iterations=2, steps=None), "centred", oblong),
        lambda: _paper(ICM(iterations=2), "centred", square),
        lambda: _paper(ICM(iterations=2), "blanket", square),
        lambda: _paper(Multigrid(0.01), "blanket", square),
        lambda: _paper(Multigrid(0.01), "blanket", oblong),
        lambda: _paper(Multigrid(0.01), "centred", oblong),
        lambda: _paper(Multigrid(0.01), "centred", square),
    ]
    for job in reversed(jobs) if backwards else jobs:
        job()
