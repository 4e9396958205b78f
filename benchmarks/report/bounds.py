"""Limits of the speed: time of sweeps relative to a solve, and memory bandwidth of a sweep."""

from __future__ import annotations

import time
from typing import NamedTuple

import numba
import numpy as np

from napari_hmrf import Problem
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends import SolveJob, compute_thread, open_backend
from napari_hmrf.solver.backends import host as on_host
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.optimizers.cycle import chebyshev
from report.contenders import PHANTOM, PRIOR, Measured
from report.page import Section, duration

# Bytes per free site of a sweep if nothing is read twice: displacement, previous displacement,
# load, Lame's parameters and inverse diagonal are read, and the displacement is written.
SWEEP_BYTES = 4 * 2 * (5 + 1)
# Sweeps of a cycle in units of sweeps over the finest level. Coarser levels are visited twice, so
# all visits together cover 5/3 of its sites.
CYCLE_SWEEPS = 4 * 5 / 3


class Bound(NamedTuple):
    """Limits of a solve at one size: sweep in seconds, bandwidth in bytes/s, free sites."""

    sweep: float
    bandwidth: float
    sites: int


def add_bounds(page: Section, runs: dict[int, Measured]) -> None:
    """Add the time of sweeps and the memory time of a sweep to the page; `runs` is by size."""
    rows = []
    for size, run in runs.items():
        found = bound(phantom(PHANTOM, size).problem)
        sweeps = run.iterations * CYCLE_SWEEPS * found.sweep
        least = found.sites * SWEEP_BYTES / found.bandwidth
        rows.append(
            [
                f"{size} x {size}",
                duration(run.seconds),
                f"{run.iterations} x {CYCLE_SWEEPS:.1f} x {duration(found.sweep)}",
                duration(sweeps),
                f"{sweeps / run.seconds:.0%}",
                f"{1e9 * found.sweep / found.sites:.2f} ns",
                f"{found.bandwidth / 1e9:.0f} GB/s",
                f"{found.sweep / least:.1f}",
            ]
        )
    page.say(
        f"""**Limits of the speed.** A cycle smooths twice down and twice up; over all levels
        this equals {CYCLE_SWEEPS:.1f} sweeps over the finest. The number of sweeps times the
        time per sweep is the unavoidable part of any such method. The rest is residuals, dot
        products, transfers, set-up, and reading the images. A sweep moves at least {SWEEP_BYTES}
        bytes per free site. The memory's bandwidth is that of a = b + s c (a triad over
        single-precision arrays as large as the data of a sweep, all threads). The last column
        compares a sweep with the time that memory, or the cache if the data fits, would need."""
    )
    header = ["image", "whole", "cycles x sweeps x time", "together", "share"]
    header += ["sweep, per free site", "triad", "sweep over its memory time"]
    page.table(header, rows)


def bound(problem: Problem) -> Bound:
    """Measure a smoothing sweep on the finest level, and a triad over as much memory."""
    system_sites = int((((problem.confidence == 0).any(axis=-1)) & problem.tissue).sum())

    def job() -> float:
        backend = open_backend(
            SolveJob.of(problem, PRIOR, Multigrid()), "cpu", lambda: None
        ).backend
        try:
            model = backend.elastic_model(PRIOR.material(problem))
            d, held = on_host.prescribed(problem)
            model.hold(held)
            level = model.levels[0]
            level.load = level.vector(model.balance(d, None).rest.copy())
            few, many = chebyshev(0.3, 3.0, 4), chebyshev(0.3, 3.0, 24)
            times = {len(steps): [] for steps in (few, many)}
            for _ in range(9):
                for steps in (few, many):
                    started = time.perf_counter()
                    level.descend(steps, None)
                    times[len(steps)].append(time.perf_counter() - started)
            return (min(times[24]) - min(times[4])) / 20
        finally:
            backend.close()

    sweep = compute_thread.submit(job).result()
    return Bound(sweep, triad(system_sites * SWEEP_BYTES), system_sites)


@numba.njit(cache=True, parallel=True, fastmath=True)
def _triad(a, b, c, s):
    for i in numba.prange(len(a)):
        a[i] = b[i] + s * c[i]


def triad(size: int) -> float:
    """Return the best bandwidth of a = b + s c in bytes/s, over `size` bytes in three arrays."""

    def job() -> float:
        a, b, c = (np.ones(max(size // 12, 1000), dtype=np.float32) for _ in range(3))
        best = np.inf
        _triad(a, b, c, np.float32(0.5))
        rounds = max(1, int(2e7 / len(a)))
        for _ in range(7):
            started = time.perf_counter()
            for _ in range(rounds):
                _triad(a, b, c, np.float32(0.5))
            best = min(best, (time.perf_counter() - started) / rounds)
        return 12 * len(a) / best

    return float(compute_thread.submit(job).result())
