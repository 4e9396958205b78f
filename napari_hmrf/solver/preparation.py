"""Preparation of a solve: compilation of loops, and a trial run of the kernels."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from napari_hmrf.compute.compile_cache import compiler, loops
from napari_hmrf.compute.compile_cache.stage import Stage
from napari_hmrf.compute.compile_cache.watch import watched
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.base import Backend
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.optimizers import Monitor, Multigrid, Optimizer
from napari_hmrf.solver.problem import Problem

# Number of sites along each axis of the trial problem, by the number of axes.
_SIZES = {2: 40, 3: 12}
_prepared: set[tuple[str | bool, ...]] = set()


def provide_loops(job: str, report: Callable[[Monitor], None]) -> None:
    """Wait until another process has compiled the loops of a job, with progress reports.

    Parameters
    ----------
    job : str
        Name of a set of loops, from `SolveJob.loops`, or `sets.EVERYTHING`.
    report : callable
        Called several times a second; raises an exception to stop the wait.
    """
    compiler.provide(job, lambda progress: report(Monitor(progress.words, progress.fraction)))


def prepare(
    device: Backend[Any],
    job: SolveJob,
    optimizer: Optimizer,
    report: Callable[[Monitor], None],
) -> None:
    """Compile the kernels of a schedule by running it on a trial problem, once per process.

    The trial problem is small, but has intermediate levels, a nonzero solution, and too many sites
    to be solved without a cycle. Square pixels and volumes have their own kernels.

    Parameters
    ----------
    device : Backend
    job : SolveJob
    optimizer : ICM or Multigrid
    report : callable
        Called with a `Monitor` at intervals; raises an exception to cancel.
    """
    rehearsal, axes, prior = optimizer.rehearsal(), len(job.shape), job.prior
    square = len(set(job.spacing)) == 1
    name = f"{axes} axes", device.name, device.renderer
    key = (*name, loops.in_use(), prior.kernels, repr(rehearsal), square)
    if key in _prepared:
        return
    grid = (_SIZES[axes],) * axes
    y, c, m = np.zeros((*grid, axes)), np.zeros((*grid, axes)), np.ones(grid)
    c[0] = c[-1] = 1
    y[-1] = 1
    small = Problem(
        observed=y,
        confidence=c,
        stiffness=m,
        spacing=(1.0,) * axes if square else (1.0, 2.0, 2.0)[:axes],
    )
    tissue = prior.rehearsal(small.shape)

    def report_preparing(_: Monitor) -> None:
        report(Monitor("preparing", 0.0))

    with loop_watch(job.loops, report):
        displacement = rehearsal.run(small, tissue, device, report_preparing).displacement
        host.settle(displacement, small.tissue, small.unit)
        if isinstance(rehearsal, Multigrid):
            # Three solutions run both kernels that combine solutions: for two and for one.
            start = WarmStart((displacement,) * 3, (1.0, 0.0, 0.0), 1.0, math.inf)
            rehearsal.run(small, tissue, device, report_preparing, start)
    _prepared.add(key)


def loop_watch(job: str, report: Callable[[Monitor], None]) -> AbstractContextManager[None]:
    """Return a context manager that reports the loops compiled by this process.

    Parameters
    ----------
    job : str
        As for `watched`.
    report : callable
        As for `prepare`.
    """
    if not loops.in_use():
        return nullcontext()
    jobs = [job] if job else []

    def report_stage(stage: Stage) -> None:
        progress = stage.progress(jobs, jobs)
        report(Monitor(progress.words, progress.fraction))

    return watched(job, report_stage)
