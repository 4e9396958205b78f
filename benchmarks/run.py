"""The paper's tables 1 and 2 and its figures 4 and 5, measured on this machine in one run.

    python benchmarks/run.py [--sizes 300 600 1200] [--repeats 15] [--out benchmark-output]

Times are medians of several solves in a warm process, uploads and read-back included; of the
literal program, one run. Ratios compare figures of the same run. The targets printed beside them
are for two cores without a GPU.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from fem import plane_stress_displacement, rmsd
from figures import save_figures
from literal import solve_literally

from napari_hmrf import ICM, BackendError, ElasticPrior, Phantom, Solution, phantom, solve

CONVERGED = ICM(iterations=50_000, steps=None, tolerance=1e-7)
WARM_UP = 5
PHANTOMS = ("expansion", "mass-effect")


@dataclass(frozen=True)
class Target:
    """A figure to reach, and whether it was."""

    claim: str
    found: float
    bound: float
    at_least: bool = False

    def __str__(self) -> str:
        """One line of the list of targets."""
        met = self.found >= self.bound if self.at_least else self.found <= self.bound
        sign = ">=" if self.at_least else "<="
        verdict = "met   " if met else "MISSED"
        return f"{verdict}  {self.claim}: {self.found:.3g} ({sign} {self.bound:g})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 whatever it finds, as a benchmark is not a test."""
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
    """Table 1: energy and distance to finite elements, of the paper's prior and of elasticity."""
    print(
        "Table 1: against finite elements (bilinear, plane stress, Poisson's ratio 0.3), 300 x 300"
    )
    print(
        f"  {'phantom':12} {'method':28} {'mean energy':>12} {'RMSD':>9} "
        f"{'iterations':>11} {'seconds':>9}"
    )
    targets = []
    for name in PHANTOMS:
        example = phantom(name)
        started = time.perf_counter()
        reference = plane_stress_displacement(example.problem)
        seconds = time.perf_counter() - started
        elastic = ElasticPrior(poisson=0.3)
        for prior in (None, elastic):
            solve(example.problem, prior, backend="cpu")
        rows: list[tuple[str, Solution, float]] = [
            ("HMRF, 70 sweeps a level", solve(example.problem, backend="cpu"), 1.44),
            ("HMRF, converged", solve(example.problem, optimizer=CONVERGED, backend="cpu"), 0.45),
            ("elastic, multigrid", solve(example.problem, elastic, backend="cpu"), 0.005),
        ]
        for label, solution, bound in rows:
            off = rmsd(solution.displacement, reference, solution.tissue)
            run = solution.provenance.seconds
            print(
                f"  {name:12} {label:28} {solution.mean_energy:12.5f} {off:6.4f} px "
                f"{solution.iterations:11d} {run:9.3f}"
            )
            targets.append(Target(f"{name}, {label}: RMSD in px", off, bound))
        motion = np.sqrt((reference[example.problem.tissue] ** 2).sum(-1).mean())
        print(
            f"  {name:12} {'finite elements':28} {'-':>12} {'0':>6} px {'-':>11} {seconds:9.3f}",
            end="",
        )
        print(f"   (its field: {motion:.2f} px rms)")
        save_figures(out, name, rows[1][1], reference)
    return targets


def speed(sizes: Sequence[int], repeats: int) -> list[Target]:
    """Table 2: the same 70 sweeps a level by shaders, compiled loops and the literal program."""
    print("\nTable 2: 70 sweeps a level, candidate set Gamma (seconds; times faster than literal)")
    backends = available(("opengl", "cpu"))
    header = "".join(f"{name:>28}" for name in backends.values())
    print(f"  {'size':12}{header}{'literal':>12}")
    seconds: dict[str, dict[int, float]] = {name: {} for name in backends}
    literal: dict[int, float] = {}
    solve_literally(phantom("expansion", 32).problem)  # compiled before the clock starts
    for size in sizes:
        example = phantom("expansion", size)
        for name in backends:
            seconds[name][size] = median_seconds(example, name, repeats)
        started = time.perf_counter()
        solve_literally(example.problem)
        literal[size] = time.perf_counter() - started
        cells = "".join(
            f"{seconds[name][size]:18.4f} ({literal[size] / seconds[name][size]:5.0f} x)"
            for name in backends
        )
        print(f"  {f'{size} x {size}':12}{cells}{literal[size]:12.2f}", flush=True)
    return speed_targets(sizes, seconds, literal)


def speed_targets(
    sizes: Sequence[int], seconds: dict[str, dict[int, float]], literal: dict[int, float]
) -> list[Target]:
    """The ratios to reach, and that time grows no faster than the number of sites."""
    first, last = min(sizes), max(sizes)
    bounds = {"opengl": 55.0, "cpu": 300.0}
    targets = []
    for name, times in seconds.items():
        gain = literal[first] / times[first]
        claim = f"{name}: times faster than the literal program at {first}"
        targets.append(Target(claim, gain, bounds[name], at_least=True))
        growth = (times[last] / times[first]) / (last / first) ** 2
        targets.append(Target(f"{name}: growth of time over growth of sites", growth, 1.1))
    return targets


def available(names: Sequence[str]) -> dict[str, str]:
    """The backends of this machine, and how the tables call them."""
    found = {}
    for name in names:
        try:
            run = solve(phantom("bar", 16).problem, backend=name).provenance
        except BackendError as error:
            print(f"  ({name} is not available: {error})", file=sys.stderr)
            continue
        found[name] = run.backend
        print(f"  {run.backend}: {run.renderer}")
    return found


def median_seconds(example: Phantom, backend: str, repeats: int) -> float:
    """Median wall time of a solve in a warm process: the first few are up to half as slow again."""
    for _ in range(WARM_UP):
        solve(example.problem, backend=backend)
    return statistics.median(
        solve(example.problem, backend=backend).provenance.seconds for _ in range(repeats)
    )


if __name__ == "__main__":
    sys.exit(main())
