"""Benchmark of large motion in volumes.

    python -m benchmarks.large_volumes [exact] [calculix] [cold] [drag] [memory]

``--random 1000`` solves random problems; ``--first 400 --random 200`` solves a part of them.

Measures the distance to an independent Newton's method and to CalculiX, the time relative to a
linear solve in the same process (processor time of all threads), the peak memory, and failures on
random problems.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import numpy.typing as npt

from benchmarks import large_calculix, random_large_volumes
from benchmarks.large_motion import print_frames
from benchmarks.report.memory import added_by
from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.solver.solution import Solution
from validation.oracles.large_motion import large_field, smallest_jacobian
from validation.problems import framed_volume, growing_ball

Field = npt.NDArray[np.float64]
# Default number of random problems.
_FEW = 40
# Number of sites up to which ten points along each axis are checked in each voxel, instead of four.
_DENSE = 150_000
# Number of frames of a drag.
_FRAMES = 10
# Distance of each frame, in voxels.
_FRAME = 0.5
# Tolerance of a frame, in voxels.
_LIVE = 0.1


def main() -> None:
    """Print the requested sections, or all sections."""
    parser = argparse.ArgumentParser(description="Benchmark of large motion in volumes.")
    parser.add_argument("names", nargs="*", help=f"{', '.join(_SECTIONS)}; by default all")
    parser.add_argument("--sizes", nargs="+", type=int, default=[48, 96, 128])
    parser.add_argument("--random", type=int, default=0, metavar="COUNT")
    parser.add_argument("--first", type=int, default=0, help="number of the first random problem")
    given = parser.parse_args()
    everything = not given.names and not given.random
    for name, section in _SECTIONS.items():
        if everything or name in given.names:
            section(given.sizes)
    count = _FEW if everything else given.random
    if count:
        random_large_volumes.run(given.first, count)


def bent_bar(size: int) -> Problem:
    """Return a bar of a sixth of its length whose end is turned by 90 degrees along an arc."""
    height = max(size // 6, 3)
    radius = (size - 1) / (np.pi / 2)
    off = np.arange(height) - (height - 1) / 2
    end = np.zeros((height, height, 3))
    end[..., 0] = (radius - off - (size - 1))[:, None]
    end[..., 1] = (radius - off)[:, None]
    y = np.zeros((size, height, height, 3))
    c = np.zeros_like(y)
    c[0] = c[-1] = 1
    y[-1] = end
    return Problem(observed=y, confidence=c, stiffness=np.ones((size, height, height)))


def dragged_patch(size: int, far: float) -> Problem:
    """Return a ball in a head-like block that is dragged along the last axis."""
    around = np.indices((size, size, size)) - (size - 1) / 2
    around[2] += size / 6
    ball = np.linalg.norm(around, axis=0) <= size / 8
    return framed_volume(size, ball, np.broadcast_to([0.0, 0.0, far], (*ball.shape, 3)))


def exact(sizes: list[int]) -> None:
    """Print the largest distance of any site from an independent method, in voxels."""
    size, worst = 16, 0.0
    y = np.zeros((size, size, size, 3))
    c = np.zeros_like(y)
    c[0] = c[-1] = 1
    m = np.ones((size, size, size))
    m[:, : size // 2] = 5
    for name, end in (("pulled by 20 %", [0.2 * size, 0, 0]), ("sheared", [0, 0.2 * size, 0])):
        y[-1] = end
        for poisson in (0.3, 0.45):
            problem = Problem(observed=y, confidence=c, stiffness=m)
            prior = NeoHookeanPrior(poisson)
            found = solve(problem, prior, backend="cpu")
            off = float(np.abs(found.displacement - large_field(problem, prior, 4)).max())
            worst = max(worst, off)
            print(f"{name:16} nu {poisson:4} error {off:.5f} voxel", flush=True)
    print(f"worst {worst:.5f} voxel", flush=True)


def calculix(sizes: list[int]) -> None:
    """Print the largest distance of any site from CalculiX, in voxels."""
    large_calculix.run()


def cold(sizes: list[int]) -> None:
    """Print the cost of cold solves relative to linear solves of the same problem."""
    for size in sizes:
        cases = {
            "ball grown to twice its radius": growing_ball(size, 2.0),
            "bar bent by 90 degrees": bent_bar(size),
            "patch dragged by a third": dragged_patch(size, size / 3),
        }
        for name, problem in cases.items():
            _print_cost(f"{size:4} {name}", problem)


def _print_cost(name: str, problem: Problem) -> None:
    solve(problem, ElasticPrior(), backend="cpu")
    linear, small = _seconds(lambda: solve(_anew(problem), ElasticPrior(), backend="cpu"))
    large, found = _seconds(lambda: solve(_anew(problem), NeoHookeanPrior(), backend="cpu"))
    folded = smallest_jacobian(problem, small.displacement, 3) <= 0
    points = 10 if found.displacement[..., 0].size <= _DENSE else 4
    least = smallest_jacobian(problem, found.displacement, points)
    print(
        f"{name:40} linear {linear:6.2f} s ({'folds' if folded else 'does not fold'}), "
        f"large {large:7.2f} s = {large / linear:5.1f} linear solves, {found.iterations} steps, "
        f"least Jacobian {least:.3f}, {_reached(found)}",
        flush=True,
    )


def _reached(found: Solution) -> str:
    reach = found.reach
    assert reach is not None
    if reach.missing == 0 and reach.grown == 1:
        return "reached"
    return f"reached to {reach.part:.0%}, growth {reach.grown:.0%}"


def drag(sizes: list[int]) -> None:
    """Print the cost of each frame of a drag relative to a linear solve, and its error."""
    for size in sizes[:2]:
        first = dragged_patch(size, _FRAME)
        solve(first, ElasticPrior(), backend="cpu")
        linear, _ = _seconds(lambda first=first: solve(_anew(first), ElasticPrior(), backend="cpu"))
        print(f"{size} x {size} x {size}:")
        frames = (dragged_patch(size, _FRAME * frame) for frame in range(1, _FRAMES + 1))
        print_frames(frames, linear, Multigrid(_LIVE))


def memory(sizes: list[int]) -> None:
    """Print the peak memory of a solve in addition to the problem, in a separate process."""
    for size in sizes:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            most = pool.submit(memory_of, size).result()
        print(f"{size:4} memory of a solve: {most / size**3:.0f} bytes per voxel", flush=True)


def memory_of(size: int) -> int:
    """Return the peak memory of a solve, in bytes."""
    solve(growing_ball(12, 1.2), NeoHookeanPrior(), backend="cpu")
    problem = growing_ball(size, 2.0)
    return added_by(lambda: solve(problem, NeoHookeanPrior(), backend="cpu"))[1]


def _anew(problem: Problem) -> Problem:
    """Return an equal problem with slightly other targets, which no cache has."""
    y = problem.observed * np.float32(1.0001)
    m = problem.stiffness * np.float32(1.0001)
    return Problem(observed=y, confidence=problem.confidence, stiffness=m, loads=problem.loads)


def _seconds(work: Callable[[], Solution]) -> tuple[float, Solution]:
    """Return the processor time of all threads, and the result."""
    begun = time.process_time()
    result = work()
    return time.process_time() - begun, result


_SECTIONS: dict[str, Callable[[list[int]], None]] = {
    "exact": exact,
    "calculix": calculix,
    "cold": cold,
    "drag": drag,
    "memory": memory,
}


if __name__ == "__main__":
    main()
