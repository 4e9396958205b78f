"""Speed of the elastic model compared with other solvers, and limits of the speed."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from napari_hmrf import Multigrid, Problem, solve
from napari_hmrf.data import phantom
from report import contenders
from report.bounds import add_bounds
from report.contenders import PHANTOM, PRIOR, SOLVERS, WITHIN, Measured
from report.page import Section, Settings, Target, duration
from report.warm import add_warm_start
from validation.oracles.elasticity import assemble
from validation.oracles.elasticity import direct_solution as solve_directly

#: Largest size for a solver, from its time or memory at smaller sizes.
LARGEST = {"superlu": 600, "superlu-tuned": 600, "calculix": 300}
REPEATS = {"cpu": 15, "cpu-again": 15, "opengl": 7}
# Required ratio of times, by (backend, other solver, size).
BOUNDS = {
    ("cpu", "pyamg", 300): 80.0,
    ("cpu", "pyamg", 600): 90.0,
    ("cpu", "pyamg", 1200): 100.0,
    ("cpu", "superlu", 300): 150.0,
    ("cpu", "superlu", 600): 300.0,
    ("opengl", "pyamg", 300): 8.0,
    ("opengl", "pyamg", 600): 8.0,
    ("opengl", "pyamg", 1200): 8.0,
}
Results = dict[tuple[str, int], Measured]


def section(settings: Settings) -> Section:
    """Return the section with the table, the targets, and the limits of the speed."""
    page = Section("Speed")
    sizes = settings.choose((150, 300, 600, 1200), (48, 64))
    page.say(
        f"""**Question.** How long does each solver take, from the images to the displacement of
        the {PHANTOM} phantom (elastic, plane stress, Poisson's ratio {PRIOR.poisson}), until no
        site is further than {WITHIN} px from the converged field? Every solver and size has its
        own process, warmed up. Assembly and set-up count in every solve (only the second row has
        tissue that was solved before, whose set-up the package keeps). Multigrid stops by its
        own estimate. PyAMG (smoothed aggregation, rigid-body modes, conjugate gradients) needs
        no stopping criterion: its number of iterations is determined beforehand. The matrix is
        assembled slice by slice, without sorting triplets. *Tuned* means: PyAMG without
        relaxing the modes it is given; SuperLU in symmetric mode with minimum-degree ordering.
        CalculiX writes and reads text. The converged field is PyAMG's, to rounding, where it is
        available. Memory is the peak of the process during the solves minus its memory before
        them; for CalculiX it is that of its own process."""
    )
    results = measure_all(page, sizes)
    rows = [
        [title, *(_cell(results.get((name, size))) for size in sizes)]
        for name, (title, _) in SOLVERS.items()
        if any((name, size) in results for size in sizes)
    ]
    page.table(["solver", *(f"{size} x {size}" for size in sizes)], rows)
    page.say("Each cell: median time; iterations; largest error; memory.")
    page.targets += speed_targets(results, sizes)
    _reading(page, results, sizes)
    own = {size: results["cpu", size] for size in sizes if ("cpu", size) in results}
    add_bounds(page, own)
    add_warm_start(page, settings)
    return page


def measure_all(page: Section, sizes: Sequence[int]) -> Results:
    """Measure every available solver at every feasible size."""
    results: Results = {}
    with tempfile.TemporaryDirectory() as folder:
        for size in sizes:
            file = Path(folder) / f"{size}.npy"
            np.save(file, converged_field(phantom(PHANTOM, size).problem))
            for name in SOLVERS:
                if contenders.is_there(name) and size <= LARGEST.get(name, size):
                    slow = 1 if size > 600 or name == "calculix" else 3
                    try:
                        results[name, size] = contenders.measure(
                            name, size, REPEATS.get(name, slow), file
                        )
                    except RuntimeError as error:
                        page.say(f"*{SOLVERS[name][0]} at {size} failed: {error}*")
    if not contenders.is_there("pyamg"):
        page.missing("PyAMG", '`pip install -e ".[report]"`')
    if not contenders.is_there("calculix"):
        page.missing("CalculiX", contenders.calculix.HOW)
    return results


def converged_field(problem: Problem) -> npt.NDArray[np.float64]:
    """Return the converged field, (H, W, 2), by PyAMG if it is installed."""
    if not contenders.is_there("pyamg"):
        if max(problem.shape) <= LARGEST["superlu-tuned"]:
            return solve_directly(problem, PRIOR)
        found = solve(
            problem, PRIOR, optimizer=Multigrid(WITHIN / 1000), backend="cpu"
        ).displacement
        return found.astype(np.float64)
    system = assemble(problem, PRIOR)
    near = solve(problem, PRIOR, optimizer=Multigrid(WITHIN / 10), backend="cpu").displacement
    start = near[system.free].astype(np.float64).ravel()
    return system.field(contenders.solve_by_pyamg(system, 60, True, start, tolerance=1e-10))


def speed_targets(results: Results, sizes: Sequence[int]) -> list[Target]:
    """Return targets for ratios of times, iterations per size, and growth with the sites."""
    targets = []
    for (backend, other, size), bound in BOUNDS.items():
        if (backend, size) in results and (other, size) in results:
            gain = results[other, size].seconds / results[backend, size].seconds
            claim = f"{backend}: times faster than {SOLVERS[other][0]} at {size}"
            targets.append(Target(claim, gain, bound, at_least=True))
    large = [size for size in sizes if size >= 300]
    for backend in ("cpu", "opengl"):
        runs = [results[backend, size] for size in large if (backend, size) in results]
        if len(runs) < 2:
            continue
        cycles = [run.iterations for run in runs]
        claim = f"{backend}: iterations at {', '.join(map(str, large))} differ by"
        targets.append(Target(claim, max(cycles) - min(cycles), 2))
        growth = runs[-1].seconds / runs[0].seconds / (large[-1] / large[0]) ** 2
        claim = f"{backend}: growth of time over growth of sites, {large[0]} to {large[-1]}"
        targets.append(Target(claim, growth, 1.15))
    return targets


def _cell(run: Measured | None) -> str | None:
    if run is None:
        return None
    return f"{duration(run.seconds)}; {run.iterations}; {run.error:.0e} px; {run.megabytes:.0f} MB"


def _reading(page: Section, results: Results, sizes: Sequence[int]) -> None:
    gains = []
    for size in sizes:
        others = [
            (run.seconds, SOLVERS[name][0])
            for (name, at), run in results.items()
            if at == size and name not in REPEATS
        ]
        if others and ("cpu", size) in results:
            seconds, title = min(others)
            gain = seconds / results["cpu", size].seconds
            gains.append(f"{gain:.0f} times at {size} ({title})")
    page.say(
        f"""**Conclusion.** Compared with the fastest other solver at each size, tuned ones
        included, the compiled loops are faster:
        {"; ".join(gains) or "no comparison was measured"}. Part of the difference is not the
        algorithm: the others are general programs for any matrix, on one thread except for their
        dense kernels, in double precision, and they include its assembly. This solver uses the
        fact that its mesh is an image, runs on all cores, and computes in single precision where
        this is sufficient.{_left_out(results, sizes)}"""
    )


def _left_out(results: Results, sizes: Sequence[int]) -> str:
    """Return notes about sizes that were not measured, with extrapolated time and memory."""
    notes = ""
    for name in ("superlu-tuned", "calculix"):
        done = [size for size in sizes if (name, size) in results]
        if len(done) < 2 or max(sizes) == done[-1]:
            continue
        near, far = (results[name, size] for size in done[-2:])
        growth, following = done[-1] / done[-2], sizes[len(done)]
        steps = math.log(following / done[-1]) / math.log(growth)
        seconds = far.seconds * (far.seconds / near.seconds) ** steps
        gigabytes = far.megabytes * (far.megabytes / near.megabytes) ** steps / 1024
        notes += (
            f" {SOLVERS[name][0]} is left out above {done[-1]}: at {following}, by its growth so "
            f"far, it would take {seconds:.0f} s and {gigabytes:.0f} GB."
        )
    return notes
