"""Preparation of a computer: ``python -m napari_hmrf.compiling`` compiles all CPU loops.

Numba compiles a loop when it is called, and caches the result on disk. The program therefore solves
a small problem with each solver. Loops for which a solve is waiting, or which a window will need
soon, are compiled first; all others, and with ``--idle`` these too, at the lowest priority. The
program prints its progress. It can be stopped at any time; the next start continues.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_hmrf.compute.compile_cache import compiler, disk_cache, loader, loops, sets
from napari_hmrf.compute.compile_cache.stage import Stage
from napari_hmrf.compute.compile_cache.watch import watched
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.strain import small_strain
from napari_hmrf.field.warp import warp
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solve import solve

#: Number of sites along each axis of the small problems in 2-D and in 3-D.
_SIZE, _SLICES = 40, 12


class _Preempted(Exception):
    """Interruption of a job because a solve is waiting for other loops.

    The loops that were already compiled remain in the cache.
    """


Run = Callable[[], Any]


class Job(NamedTuple):
    """Computation that triggers the compilation of a set of loops.

    Attributes
    ----------
    name : str
        Name of the set of loops, as in `SolveJob.loops`.
    run : callable
        Function without arguments that runs the computation.
    """

    name: str
    run: Run


def jobs() -> list[Job]:
    """Return the jobs that compile all loops, in the order of `sets.COSTS`."""
    square, oblong = (1.0, 1.0), (2.0, 0.5)
    mapped = np.full((_SIZE, _SIZE), 0.3)
    blanket = SeilerPrior(conditional="blanket")
    schedule = ICM(iterations=2)
    image, volume = (_SIZE, _SIZE), (_SLICES, _SLICES, _SLICES)

    def solving(prior: Any, optimizer: Any, spacing: tuple[float, float] = square) -> Run:
        return lambda: _solve(prior, optimizer, spacing)

    runs: dict[str, Run] = {
        "elastic": solving(ElasticPrior(0.3), Multigrid()),
        sets.PICTURES: _pictures,
        "slipping": solving(ElasticPrior(mapped, penalty=1.0), Multigrid()),
        "rigid": lambda: _solve(ElasticPrior(0.3), Multigrid(), square, bone=True),
        "large-motion": solving(NeoHookeanPrior(0.3), Multigrid()),
        sets.DATA: lambda: _data(image, ElasticPrior(0.3)),
        sets.VOLUMES: lambda: _volume(ElasticPrior(0.3), Multigrid()),
        sets.LARGE_VOLUMES: lambda: _volume(NeoHookeanPrior(0.3), Multigrid()),
        sets.VOLUME_DATA: lambda: _data(volume, ElasticPrior(0.3)),
        sets.LARGE_DATA: lambda: _data(image, NeoHookeanPrior(0.3)),
        sets.LARGE_VOLUME_DATA: lambda: _data(volume, NeoHookeanPrior(0.3)),
        "schedule": solving(SeilerPrior(), schedule),
        "converged": solving(SeilerPrior(), Multigrid()),
        "schedule-oblong": solving(SeilerPrior(), schedule, oblong),
        "converged-oblong": solving(SeilerPrior(), Multigrid(), oblong),
        "blanket-schedule": solving(blanket, schedule),
        "blanket-converged": solving(blanket, Multigrid()),
        "exact-steps": solving(SeilerPrior(), ICM(iterations=2, steps=None)),
        "volume-schedule": lambda: _volume(SeilerPrior(), schedule),
        "volume-converged": lambda: _volume(SeilerPrior(), Multigrid()),
    }
    return [Job(name, runs[name]) for name in sets.COSTS]


def _solve(prior: Any, optimizer: Any, spacing: tuple[float, float], bone: bool = False) -> None:
    c = np.zeros((_SIZE, _SIZE, 2))
    c[0] = c[-1] = 1
    m = np.ones((_SIZE, _SIZE))
    if bone:
        m[18:23, 12:17] = np.inf
    problem = Problem(observed=c, confidence=c, stiffness=m, spacing=spacing)
    solve(problem, prior, optimizer=optimizer, backend="cpu")


def _data(grid: tuple[int, ...], prior: Any) -> None:
    y = np.ones((*grid, len(grid)))
    problem = Problem(
        observed=y, confidence=np.zeros_like(y), stiffness=np.ones(grid), precision=1.0
    )
    solve(problem, prior, backend="cpu")


def _volume(prior: Any, optimizer: Any) -> None:
    c = np.zeros((_SLICES, _SLICES, _SLICES, 3))
    c[0] = c[-1] = 1
    solve(
        Problem(observed=c, confidence=c, stiffness=np.ones(c.shape[:3])),
        prior,
        optimizer=optimizer,
        backend="cpu",
    )
    if isinstance(prior, ElasticPrior):
        for kind in (np.float32, np.float64):
            warp(c[..., 0].astype(kind), c, spacing=1)
        smallest_determinant(c, spacing=1)
        small_strain(c, spacing=1)


def _pictures() -> None:
    still = np.zeros((9, 9, 2), np.float32)
    for kind in (np.uint8, np.float32, np.float64):
        image = np.zeros((9, 9), kind)
        warp(image, still, spacing=1)
        # Labels use the nearest pixel, as in the live preview.
        Warper(Picture(image, order=0 if image.dtype.kind == "u" else 1), spacing=(1, 1))(still)


def _is_cached() -> bool:
    """Return whether numba's cache on disk contains compiled loops."""
    from napari_hmrf.solver.backends.cpu import exact  # heavy: numba

    if loader.is_unwritable():
        return False
    folder = exact.add.compiled.stats.cache_path
    return folder is not None and any(Path(folder).glob("*.nbi"))


def run(job: Job, report: Callable[[Stage], object]) -> None:
    """Run a job on the compute thread and report its progress."""
    with watched(job.name, report):
        job.run()


def _next(todo: list[Job]) -> Job:
    """Return the requested job, or otherwise the first job."""
    by_name = {job.name: job for job in todo}
    requested = (by_name[name] for name in compiler.requested_jobs() if name in by_name)
    return next(requested, todo[0])


def _run_next(todo: list[Job]) -> None:
    """Run the next job, and remove it from the list."""
    while True:
        job = _next(todo)
        if job.name not in compiler.requested_jobs():
            compiler.lower_priority()

        def tell(stage: Stage, job: Job = job) -> None:
            compiler.publish_stage(stage)
            if _next(todo) is not job:
                raise _Preempted

        with suppress(_Preempted):
            compute_thread.submit(partial(run, job, tell)).result()
            todo.remove(job)
            if _is_cached():
                disk_cache.mark(job.name).touch()
            return


def main() -> int:
    """Compile all loops, and return the exit code: 0 if all loops are cached, otherwise 1."""
    if not compiler.begin():
        return 1
    os.environ[loops.HERE] = "here"  # prevents this process from waiting for itself
    if compiler.IDLE in sys.argv[1:]:
        compiler.lower_priority()
    compiled = False
    try:
        todo = [job for job in jobs() if not disk_cache.compiled(job.name)]
        count = len(todo)
        while todo:
            _run_next(todo)
            if not _is_cached():
                break
            print(f"{count - len(todo)} of {count}", flush=True)
        compiled = not todo and _is_cached()
    finally:
        compiler.end(compiled)
    return 0 if compiled else 1


if __name__ == "__main__":
    sys.exit(main())
