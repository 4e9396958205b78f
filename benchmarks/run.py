"""Tables 1 and 2 and figures 4 and 5 of the paper, measured on this machine in one run.

    python benchmarks/run.py [--sizes 300 600 1200] [--repeats 15] [--out benchmark-output]

Times are medians of several solves in a warm process, including uploads and read-back; the literal
program runs once. Ratios compare results of the same run. The printed targets are for two cores
without a GPU.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from figures import save_figures
from report.page import Target

from napari_hmrf import ICM, BackendError, ElasticPrior, Multigrid, SeilerPrior, Solution, solve
from napari_hmrf.data import Phantom, phantom
from napari_hmrf.fields import rmsd
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import Prior
from validation.oracles.elasticity import direct_solution
from validation.oracles.literal import solve_literally

CONVERGED = ICM(iterations=50_000, steps=None, energy_change=1e-7)
WARM_UP = 5
PHANTOMS = ("expansion", "mass-effect")


class Result(NamedTuple):
    """Row of table 1.

    Attributes
    ----------
    phantom, method : str
        Names of the phantom and the method.
    solution : Solution
        Solution by this method.
    off : float
        RMSD to finite elements, in pixels.
    bound : float
        Largest accepted value of `off`.
    """

    phantom: str
    method: str
    solution: Solution
    off: float
    bound: float

    @property
    def target(self) -> Target:
        """Target of this row."""
        return Target(f"{self.phantom}, {self.method}: RMSD in px", self.off, self.bound)


class Reference(NamedTuple):
    """Finite-element field (H, W, 2), its time in seconds, and its rms in pixels."""

    displacement: npt.NDArray[np.float64]
    seconds: float
    motion: float


class Timing(NamedTuple):
    """Row of table 2: seconds by backend, and seconds of the literal program."""

    size: int
    backends: dict[str, float]
    literal: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; always return 0, because a benchmark is not a test."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[300, 600, 1200])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("benchmark-output"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    print(f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, ", end="")
    print(f"Python {platform.python_version()}\n")
    targets = [*quality(options.out), *speed(options.sizes, options.repeats)]
    print("\nTargets")
    for target in targets:
        print(f"  {target}")
    print(f"\nFigures 4 and 5 are in {options.out}/")
    return 0


def quality(out: Path) -> list[Target]:
    """Print table 1: energy and distance to finite elements, for both models."""
    print(
        "Table 1: against finite elements (bilinear, plane stress, Poisson's ratio 0.3), 300 x 300"
    )
    print(
        f"  {'phantom':12} {'method':28} {'mean energy':>12} {'RMSD':>9} "
        f"{'iterations':>11} {'seconds':>9}"
    )
    targets = []
    for name in PHANTOMS:
        results, reference = table_1(name)
        for _, label, solution, off, _ in results:
            run = solution.provenance.seconds
            print(
                f"  {name:12} {label:28} {solution.mean_energy:12.5f} {off:6.4f} px "
                f"{solution.iterations:11d} {run:9.3f}"
            )
        print(
            f"  {name:12} {'finite elements':28} {'-':>12} {'0':>6} px {'-':>11} "
            f"{reference.seconds:9.3f}   (its field: {reference.motion:.2f} px rms)"
        )
        targets += [result.target for result in results]
        save_figures(out, name, results[1].solution, reference.displacement)
    return targets


def table_1(name: str, size: int = 300) -> tuple[list[Result], Reference]:
    """Solve a phantom by every method and by finite elements."""
    problem = phantom(name, size).problem
    started = time.perf_counter()
    truth = direct_solution(problem, ElasticPrior(0.3))
    seconds = time.perf_counter() - started
    motion = float(np.sqrt((truth[problem.tissue] ** 2).sum(-1).mean()))
    methods: list[tuple[str, Prior, Optimizer, float]] = [
        ("HMRF, 70 sweeps a level", SeilerPrior(), ICM(), 1.44),
        ("HMRF, converged by ICM", SeilerPrior(), CONVERGED, 0.45),
        ("HMRF, converged by multigrid", SeilerPrior(), Multigrid(0.01), 0.45),
        ("elastic, multigrid", ElasticPrior(poisson=0.3), Multigrid(0.01), 0.005),
    ]
    results = []
    for label, prior, optimizer, bound in methods:
        try:
            solve(problem, prior, optimizer=optimizer, backend="cpu")  # compile before timing
            solution = solve(problem, prior, optimizer=optimizer, backend="cpu")
        except ValueError as error:
            print(f"  ({label} is omitted: {error})", file=sys.stderr)
            continue
        off = rmsd(solution.displacement, truth, solution.tissue)
        results.append(Result(name, label, solution, off, bound))
    return results, Reference(truth, seconds, motion)


def speed(sizes: Sequence[int], repeats: int) -> list[Target]:
    """Print table 2: 70 sweeps per level by shaders, compiled loops and the literal program."""
    print("\nTable 2: 70 sweeps a level, candidate set Gamma (seconds; times faster than literal)")
    backends = available(("opengl", "cpu"))
    header = "".join(f"{name:>28}" for name in backends.values())
    print(f"  {'size':12}{header}{'literal':>12}")
    timings = []
    for size in sizes:
        timing = table_2(size, backends, repeats)
        cells = "".join(
            f"{seconds:18.4f} ({timing.literal / seconds:5.0f} x)"
            for seconds in timing.backends.values()
        )
        print(f"  {f'{size} x {size}':12}{cells}{timing.literal:12.2f}", flush=True)
        timings.append(timing)
    return speed_targets(timings)


def table_2(size: int, backends: Iterable[str], repeats: int) -> Timing:
    """Return the times of the paper's schedule at a size."""
    example = phantom("expansion", size)
    seconds = {name: median_seconds(example, name, repeats) for name in backends}
    solve_literally(phantom("expansion", 32).problem)  # compile before timing
    started = time.perf_counter()
    solve_literally(example.problem)
    return Timing(size, seconds, time.perf_counter() - started)


def speed_targets(timings: Sequence[Timing]) -> list[Target]:
    """Return targets for the ratios of times, and for the growth of time with the sites."""
    first, last = (pick(timings, key=lambda timing: timing.size) for pick in (min, max))
    bounds = {"opengl": 55.0, "cpu": 300.0}
    targets = []
    for name in first.backends:
        gain = first.literal / first.backends[name]
        claim = f"{name}: times faster than the literal program at {first.size}"
        targets.append(Target(claim, gain, bounds[name], at_least=True))
        growth = last.backends[name] / first.backends[name] / (last.size / first.size) ** 2
        targets.append(Target(f"{name}: growth of time over growth of sites", growth, 1.1))
    return targets


def available(names: Sequence[str]) -> dict[str, str]:
    """Return the available backends by name, with their names in the tables."""
    found = {}
    for name in names:
        try:
            run = solve(phantom("bar", 16).problem, SeilerPrior(), backend=name).provenance
        except BackendError as error:
            print(f"  ({name} is not available: {error})", file=sys.stderr)
            continue
        found[name] = run.backend
        print(f"  {run.backend}: {run.renderer}")
    return found


def median_seconds(example: Phantom, backend: str, repeats: int) -> float:
    """Return the median wall time of a solve after warm-up, as first solves are slower."""
    for _ in range(WARM_UP):
        solve(example.problem, SeilerPrior(), backend=backend)
    return statistics.median(
        solve(example.problem, SeilerPrior(), backend=backend).provenance.seconds
        for _ in range(repeats)
    )


if __name__ == "__main__":
    sys.exit(main())
