"""What bounds the rest: sweeps against the whole, and a sweep against memory; warm starts."""

from __future__ import annotations

import statistics
import time
from typing import NamedTuple

import numba
import numpy as np

from napari_hmrf import Multigrid, Problem, Solution, phantom, solve
from napari_hmrf.backends import compute_thread, open_backend
from napari_hmrf.backends import host as on_host
from napari_hmrf.optimizers.cycle import chebyshev
from report.contenders import PHANTOM, PRIOR, WITHIN, Measured
from report.page import Section, Settings, Target, duration

# Bytes per site that moves of one sweep, if nothing is read twice: the displacement, that before
# the last sweep, load, Lame's parameters and inverse diagonal are read, the displacement written.
SWEEP_BYTES = 4 * 2 * (5 + 1)
# Sweeps of a cycle in sweeps over the finest level: with all others visited twice, the levels have
# 5/3 of its sites.
CYCLE_SWEEPS = 4 * 5 / 3


class Bound(NamedTuple):
    """What bounds a solve at one size: times in seconds, bandwidth in bytes per second."""

    sweep: float
    bandwidth: float
    sites: int


def add_bounds(page: Section, runs: dict[int, Measured]) -> None:
    """Say which share of a solve is sweeps, and of a sweep memory; `runs` by size."""
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
        f"""**What bounds the rest.** A cycle smooths twice down and twice up, over all levels as
        much as {CYCLE_SWEEPS:.1f} sweeps over the finest. Sweeps times time per sweep is the part
        of the whole that any such method has to pay; the rest is residuals, dot products,
        transfers, set-up, and reading the images. A sweep moves at least {SWEEP_BYTES} bytes per
        site that is free to move; the memory's bandwidth is that of a = b + s c (a triad over
        single-precision arrays as large as all that a sweep touches, all threads), so that the last
        column says how far a sweep is from what memory, or the cache where it all fits, could
        carry."""
    )
    header = ["image", "whole", "cycles x sweeps x time", "together", "share"]
    header += ["sweep, per free site", "triad", "sweep over its memory time"]
    page.table(header, rows)


def bound(problem: Problem) -> Bound:
    """Time a smoothing sweep on the finest level, and a triad over as much memory."""
    system_sites = int((((problem.c == 0).any(axis=-1)) & problem.tissue).sum())

    def job() -> float:
        backend, _ = open_backend("cpu", lambda: None)
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
    """Bytes per second of a = b + s c, over arrays of `size` bytes together, best of several."""

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


def moved_patch(problem: Problem, pixels: float = 1.0) -> Problem:
    """The problem with an eighth of its moving boundary moved further down."""
    y = problem.y.copy()
    moving = (problem.c > 0).all(axis=-1) & (np.abs(y).max(axis=-1) > 0)
    place = np.argwhere(moving)
    angle = np.arctan2(*(place - place.mean(axis=0)).T)
    patch = place[np.abs(angle) < np.pi / 8]
    y[patch[:, 0], patch[:, 1], 0] += pixels
    return Problem(y, problem.c, problem.m, problem.spacing)


def add_warm_start(page: Section, settings: Settings) -> None:
    """Say how much a small edit costs."""
    size = settings.choose(300, 48)
    before = phantom(PHANTOM, size).problem
    after, half = moved_patch(before), moved_patch(before, 0.5)
    optimizer = Multigrid(WITHIN)
    earlier = solve(before, PRIOR, optimizer, backend="cpu")
    cold, warm, again = [], [], []
    first: Solution | None = None
    second: Solution | None = None
    third: Solution | None = None
    for number in range(15):
        # Stiffness in another unit: what was set up for the last problem is of no use to this.
        other = Problem(after.y, after.c, after.m * (2 + number), after.spacing)
        started = time.perf_counter()
        first = solve(other, PRIOR, optimizer, backend="cpu")
        cold.append(time.perf_counter() - started)
        earlier = solve(before, PRIOR, optimizer, backend="cpu")
        started = time.perf_counter()
        second = solve(after, PRIOR, optimizer, backend="cpu", start=earlier)
        warm.append(time.perf_counter() - started)
        known = [earlier, solve(half, PRIOR, optimizer, backend="cpu", start=earlier)]
        started = time.perf_counter()
        third = solve(after, PRIOR, optimizer, backend="cpu", start=known)
        again.append(time.perf_counter() - started)
    ratio = statistics.median(warm) / statistics.median(cold)
    assert first is not None
    assert second is not None
    assert third is not None
    drag = statistics.median(again) / statistics.median(cold)
    apart = float(np.abs(first.displacement - second.displacement)[before.tissue].max())
    page.say(
        f"""**Asked.** After an edit (an eighth of the tumour's rim moved by a pixel) at {size} x
        {size}, how much of a cold solve is a solve that starts with the earlier one? Cold
        {duration(statistics.median(cold))} in {first.iterations} cycles, warm
        {duration(statistics.median(warm))} in {second.iterations}: {ratio:.2f} of it, and the two
        fields are {apart:.0e} px apart at most. **Reading.** What is saved is the set-up (the
        tissue is the same) and those cycles that the earlier field has behind it; an error of a
        pixel still has to fall by as many powers of ten as the tolerance asks. Where the patch was
        moved before, as in every step but the first of a drag, both earlier fields are a start, and
        what is left is {duration(statistics.median(again))} in {third.iterations}: {drag:.2f} of a
        cold solve."""
    )
    page.targets.append(Target(f"warm restart over cold, {size}, first move", ratio, 1 / 3))
    page.targets.append(Target(f"warm restart over cold, {size}, moved before", drag, 1 / 3))
