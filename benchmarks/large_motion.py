"""Benchmark of large motion.

    python -m benchmarks.large_motion [exact] [textbook] [cold] [budget] [drag]

``--random 3000`` solves random problems; ``--first 400 --random 200`` solves a part of them.

Measures the distance to an independent Newton's method and to textbook finite elements, the time
relative to a linear solve in the same process (processor time of one thread), and failures on
random problems.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable
from typing import Any

import numba
import numpy as np

from benchmarks import random_large_motion
from napari_hmrf import (
    ElasticPrior,
    LiveSolver,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    Solution,
    Update,
    solve,
)
from napari_hmrf.data import phantom
from napari_hmrf.loads import growth, weight
from napari_hmrf.solver.backends.cpu import elastic_model, finite_model
from napari_hmrf.solver.backends.thread import compute_thread
from validation.oracles.large_motion import large_field
from validation.problems import bar, turned

_LIVE = 0.01
# Default number of random problems.
_FEW = 200


def main() -> None:
    """Print the requested sections, or all sections."""
    parser = argparse.ArgumentParser(description="Benchmark of large motion.")
    parser.add_argument("names", nargs="*", help=f"{', '.join(_SECTIONS)}; by default all")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT")
    parser.add_argument("--first", type=int, default=0, help="number of the first random problem")
    given = parser.parse_args()
    everything = not given.names and not given.random
    for name, section in _SECTIONS.items():
        if everything or name in given.names:
            section() if section is budget else compute_thread.submit(section).result()
    count = _FEW if everything else given.random
    if count:
        compute_thread.submit(lambda: random_large_motion.run(given.first, count)).result()


def exact(size: int = 48) -> None:
    """Print the largest distance of any site from an independent method, in pixels."""
    ends = {
        **{f"pull {part} %": np.array([0.0, part / 100 * (size - 1)]) for part in (10, 30, 50)},
        "shear": np.array([0.3 * size, 0.0]),
        # A block as high as it is long creases on its inner side, and has several solutions.
        "bend 60": turned(size // 3, size, 60),
    }
    problems = {}
    for name, end in ends.items():
        height = len(end) if end.ndim == 2 else size
        m = np.ones((height, size))
        m[: height // 2] = 5
        problems[name] = bar(height, size, np.broadcast_to(end, (height, 2)), m)
    problems |= _loaded(size)
    worst = 0.0
    for name, problem in problems.items():
        for nu in (0.3, 0.45):
            for plane in ("stress", "strain"):
                prior = NeoHookeanPrior(nu, plane=plane)  # type: ignore[arg-type]
                found = solve(problem, prior, backend="cpu")
                off = float(np.abs(found.displacement - large_field(problem, prior, 6)).max())
                worst = max(worst, off)
                print(f"{name:16} nu {nu:4} plane {plane:6} error {off:.5f} px", flush=True)
    print(f"worst {worst:.5f} px", flush=True)


def _loaded(size: int) -> dict[str, Problem]:
    """Return a disc that doubles its area within a frame, and a beam that sags under its weight."""
    row, col = np.indices((size, size))
    disc = np.hypot(row - size / 2, col - size / 2) < size / 5
    c = np.zeros((size, size, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    m = np.where(disc, 5.0, 1.0)
    strain = growth((math.sqrt(2) - 1) * disc)
    height = size // 3
    beam = bar(height, size, np.zeros((height, 2)), 1.0)
    heavy = weight(beam.stiffness, (2e-3, 0.0), spacing=1)
    return {
        "area + 100 %": Problem(observed=0 * c, confidence=c, stiffness=m, loads=strain),
        "beam that sinks": Problem(
            observed=beam.observed,
            confidence=beam.confidence,
            stiffness=beam.stiffness,
            loads=heavy,
        ),
    }


def textbook(size: int = 48, stretch: float = 0.3) -> None:
    """Print the distance to finite elements with 2 x 2 Gauss points and no barrier."""
    for nu in (0.3, 0.45):
        problem = bar(size, size, np.broadcast_to([0.0, stretch * (size - 1)], (size, 2)))
        prior = NeoHookeanPrior(nu)
        found = solve(problem, prior, backend="cpu").displacement
        off = np.abs(found - large_field(problem, prior, 10, textbook=True))[:, 4:-4].max()
        print(
            f"textbook, pull 30 %, nu {nu}: error {off:.4f} px, four pixels from the clamps",
            flush=True,
        )


def cold(size: int = 300) -> None:
    """Print the time of a cold start relative to a linear solve."""
    numba.set_num_threads(1)
    cases = {
        "rim 8 px": _rim(size, 8),
        "rim 12 px": _rim(size, 12),
        "patch 60 px": _patch(size, 15, 60),
        "bar + 50 %": bar(size, size, np.broadcast_to([0.0, (size - 1) / 2], (size, 2))),
    }
    for name, problem in cases.items():
        ratio, found = _times_linear(problem)
        print(
            f"{name:12} {ratio:.1f} linear solves, {found.iterations} steps, least corner "
            f"Jacobian {found.reach.least_jacobian:.3f}",
            flush=True,
        )


def budget(size: int = 512) -> None:
    """Print time and result of solves that would take long without a budget."""
    cases = {
        "patch dragged by a fifth": _patch(size, size / 20, size / 5),
        "patch dragged by two fifths": _patch(size, size / 20, 2 * size / 5),
        "patch dragged across the sample": _across_sample(size),
        "free edge pulled into the tissue": _free_edge(size),
        "tissue pressed to 2 %": _pressed(size),
        "bar bent by 90 degrees": bar(size // 5, size, turned(size // 5, size, 90)),
    }
    for name, problem in cases.items():
        solve(problem, ElasticPrior(), backend="cpu")
        elastic_model._last.clear()
        begun = time.perf_counter()
        solve(problem, ElasticPrior(), backend="cpu")
        linear, pictures = time.perf_counter() - begun, list[float]()
        last: list[Solution] = []

        def show(update: Update, pictures: list[float] = pictures, last: Any = last) -> None:
            pictures.append(update.seconds)
            last[:] = [update.solution]

        begun = time.perf_counter()
        found = solve(problem, NeoHookeanPrior(), backend="cpu")
        seconds = time.perf_counter() - begun
        with LiveSolver(show, NeoHookeanPrior(), backend="cpu") as live:
            live.submit(problem)
            live.wait()
        print(
            f"{name:32} {seconds / linear:5.1f} linear solves, {seconds:5.2f} s, "
            f"{_told(found)}; live: pictures after "
            f"{', '.join(f'{each:.2f}' for each in pictures)} s, {_told(last[0])}",
            flush=True,
        )


def _told(found: Solution) -> str:
    reach = found.reach
    assert reach is not None
    if not reach.stopped:
        return "reached"
    return f"{reach.missing:.2g} px missing, {reach.unbalanced:.2g} px from equilibrium"


def _across_sample(size: int) -> Problem:
    """Return the sample with a patch that is dragged by half of its width, across the tumour."""
    given = phantom("mass-effect", size=size).problem
    row, col = np.indices((size, size)) - size // 2
    patch = (np.hypot(row, col + size / 4) < size / 20) & given.tissue
    still = given.known & (given.observed == 0).all(axis=-1, keepdims=True)
    c, y = still.astype(float), np.zeros((size, size, 2))
    c[patch], y[patch] = 1, (0, size / 2)
    return Problem(observed=y, confidence=c, stiffness=given.stiffness)


def _free_edge(size: int) -> Problem:
    """Return a block that is held on its left, with a patch at its right edge pushed inwards."""
    row, col = np.indices((size, size))
    c, y = np.zeros((2, size, size, 2))
    c[:, 0] = 1
    patch = (np.abs(row - size // 2) < size // 30) & (col > size - size // 15)
    c[patch], y[patch] = 1, (size / 8, -size / 2)
    return Problem(observed=y, confidence=c, stiffness=np.ones((size, size)))


def _pressed(size: int) -> Problem:
    """Return a block with two patches that press the tissue between them to 2 % of its length."""
    row, col = np.indices((size, size))
    c, y = np.zeros((2, size, size, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    level = np.abs(row - size // 2) < size // 5
    for way, middle in ((1, size // 4), (-1, 3 * size // 4)):
        patch = level & (np.abs(col - middle) < size // 10)
        c[patch], y[patch] = 1, (0, way * 0.49 * (size / 2 - size / 5))
    return Problem(observed=y, confidence=c, stiffness=np.ones((size, size)))


def drag(size: int = 300, frames: int = 20, far: float = 3.0) -> None:
    """Print the time of a frame of a drag relative to a linear solve, and its error."""
    numba.set_num_threads(1)
    linear = _least_time(
        lambda: solve(_patch(size, 15, far), ElasticPrior(), backend="cpu"), elastic_model
    )
    print_frames(
        (_patch(size, 15, far * frame, begun=60) for frame in range(1, frames + 1)),
        linear,
        Multigrid(_LIVE),
    )


def print_frames(frames: Iterable[Problem], linear: float, live: Multigrid) -> None:
    """Print the cost of each frame of a drag relative to a linear solve, and its error.

    Parameters
    ----------
    frames : iterable of Problem
        Problem of each frame.
    linear : float
        Processor time of a linear solve, in seconds.
    live : Multigrid
        Optimizer during the drag.
    """
    prior = NeoHookeanPrior()
    last: list[Any] = []
    for frame, problem in enumerate(frames, 1):
        begun = time.process_time()
        found = solve(problem, prior, optimizer=live, backend="cpu", initial=last[:2] or None)
        ratio = (time.process_time() - begun) / linear
        last.insert(0, found)
        tight = solve(problem, prior, optimizer=Multigrid(1e-4), backend="cpu", initial=found)
        off = float(np.abs(found.displacement - tight.displacement).max())
        print(
            f"frame {frame:2}: {ratio:.1f} linear solves, {found.iterations} steps, error "
            f"{off:.4f} px, least {found.reach.least_jacobian:.3f}",
            flush=True,
        )


def _patch(size: int, radius: float, far: float, begun: float | None = None) -> Problem:
    row, col = np.indices((size, size)) - size // 2
    inside = row**2 + (col + (far if begun is None else begun) / 2) ** 2 <= radius**2
    c, y = np.zeros((2, size, size, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    c[inside], y[inside] = 1, (0, far)
    return Problem(observed=y, confidence=c, stiffness=np.ones((size, size)))


def _rim(size: int, far: float) -> Problem:
    given = phantom("mass-effect", size=size).problem
    y = np.array(given.observed)
    length = np.linalg.norm(y, axis=-1, keepdims=True)
    return Problem(
        observed=np.where(length > 0, y / np.maximum(length, 1e-9) * far, 0),
        confidence=given.confidence,
        stiffness=given.stiffness,
    )


def _times_linear(problem: Problem) -> tuple[float, Any]:
    found = solve(problem, NeoHookeanPrior(), backend="cpu")
    finite = _least_time(lambda: solve(problem, NeoHookeanPrior(), backend="cpu"), finite_model)
    linear = _least_time(lambda: solve(problem, ElasticPrior(0.45), backend="cpu"), elastic_model)
    return finite / linear, found


def _least_time(work: Callable[[], Any], models: Any, repeats: int = 5) -> float:
    """Return the least processor time over several runs with an empty model cache."""
    times = []
    for _ in range(repeats):
        models._last.clear()
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


_SECTIONS: dict[str, Callable[[], None]] = {
    "exact": exact,
    "textbook": textbook,
    "cold": cold,
    "budget": budget,
    "drag": drag,
}


if __name__ == "__main__":
    main()
