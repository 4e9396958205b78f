"""Tables 1 and 2 of the paper, measured on this machine, and the paper's model in a volume.

    python benchmarks/paper.py [--sizes 300 600 1200] [--repeats 15]
    python benchmarks/paper.py --volume 48

`make report` writes the same tables to its page. Times are medians of several solves in a warm
process, including uploads and read-back; the literal program runs once. With --volume, only the
distance of the paper's field from the elastic field in a volume is printed. Figures 4 and 5 are in
the section "Finite elements" of the report.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import table
from clock import conditions, timed
from report.page import Section, Settings, Target
from speed import growing

from napari_hmrf import ICM, BackendError, ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import Prior
from validation.oracles.elasticity import direct_solution
from validation.oracles.literal import solve_literally

PHANTOMS = ("expansion", "mass-effect")
_CONVERGED = ICM(iterations=50_000, steps=None, energy_change=1e-7)
_WARM_UP = 5


def section(settings: Settings, sizes: Sequence[int] = (), repeats: int = 7) -> Section:
    """Return the section of the report with tables 1 and 2."""
    page = Section("The paper's tables")
    _add_table_1(page, settings)
    _add_table_2(
        page, sizes or settings.choose((300, 600, 1200), (48,)), settings.choose(repeats, 1)
    )
    if settings.quick:
        page.targets.clear()
    return page


def _add_table_1(page: Section, settings: Settings) -> None:
    size = settings.choose(300, 48)
    page.say(
        f"""**Question.** Table 1: how far is the field from finite elements (bilinear quads on
        the pixel grid, plane stress, Poisson's ratio 0.3, scikit-fem), inside the body, at
        {size} x {size}? Each prior has its own energy; energies of different priors do not
        compare."""
    )
    rows: list[list[Any]] = []
    for name in PHANTOMS:
        own, targets = table_1(name, size)
        rows += own
        page.targets += targets
    rows.append(["*the paper's*", "*HMRF, 70 sweeps a level*", 0.19404, "1.44 px", 700, "1.63 s"])
    page.table(["phantom", "method", "mean energy", "RMSD", "iterations", "time"], rows)
    page.say(
        """**Conclusion.** The paper's schedule stops far from convergence: most of its distance
        to finite elements does not come from the model. The distance of the converged field
        does, because its energy has no Poisson effect. The elastic prior has almost no distance,
        because it is the same discretisation; see *Finite elements* for an independent program,
        and *Analytic fields* for the error of any discretisation by pixels. The paper's phantom
        is not public, so its 1.44 px belongs to another geometry."""
    )


def table_1(name: str, size: int) -> tuple[list[list[Any]], list[Target]]:
    """Solve a phantom by every method and by finite elements; return the rows and targets."""
    problem = phantom(name, size).problem
    truth, times = timed(lambda: direct_solution(problem, ElasticPrior(0.3)))
    motion = float(np.sqrt((truth[problem.tissue] ** 2).sum(-1).mean()))
    # Largest accepted RMSD, in pixels.
    methods: list[tuple[str, Prior, Optimizer, float]] = [
        ("HMRF, 70 sweeps a level", SeilerPrior(), ICM(), 1.44),
        ("HMRF, converged by ICM", SeilerPrior(), _CONVERGED, 0.45),
        ("HMRF, converged by multigrid", SeilerPrior(), Multigrid(0.01), 0.45),
        ("elastic, multigrid", ElasticPrior(poisson=0.3), Multigrid(0.01), 0.005),
    ]
    rows, targets = [], []
    for method, prior, optimizer, bound in methods:
        for _ in range(2):  # the first solve compiles
            found = solve(problem, prior, optimizer=optimizer, backend="cpu")
        off = rmsd(found.displacement, truth, found.tissue)
        targets.append(Target(f"{name}, {method}: RMSD in px", off, bound))
        energy, seconds = f"{found.mean_energy:.5f}", f"{found.provenance.seconds:.3f} s"
        rows.append([name, method, energy, f"{off:.4f} px", found.iterations, seconds])
    reference = f"finite elements (field: {motion:.2f} px rms)"
    rows.append([name, reference, None, "0", None, f"{times.wall:.2f} s"])
    return rows, targets


class Timing(NamedTuple):
    """Row of table 2: seconds by backend, and seconds of the literal program."""

    size: int
    backends: dict[str, float]
    literal: float


def _add_table_2(page: Section, sizes: Sequence[int], repeats: int) -> None:
    page.say(
        """**Question.** Table 2: how much faster are 70 sweeps on each level than on one thread
        of a processor? *Literal* is the algorithm as printed, compiled, on one thread; the
        others do the same sweeps. The times are medians in a warm process, with uploads and
        read-back; the literal program ran once. The paper reports 56 times, on a graphics card
        of 2006."""
    )
    backends = available(("opengl", "cpu"))
    timings = [table_2(size, backends, repeats) for size in sizes]
    page.table(
        ["image", *backends.values(), "literal"],
        [
            [
                f"{timing.size} x {timing.size}",
                *(
                    f"{seconds:.3f} s ({timing.literal / seconds:.0f} times faster)"
                    for seconds in timing.backends.values()
                ),
                f"{timing.literal:.1f} s",
            ]
            for timing in timings
        ],
    )
    page.say(
        """**Conclusion.** The paper's ratio compares two machines, this one two programs on one
        machine. Part of it comes from evaluating each clique once per site instead of once per
        candidate, which is independent of the device. Without a GPU, OpenGL is a software
        rasteriser."""
    )
    page.targets += speed_targets(timings)


def table_2(size: int, backends: Iterable[str], repeats: int) -> Timing:
    """Return the times of the paper's schedule at a size."""
    problem = phantom("expansion", size).problem
    seconds = {}
    for name in backends:
        times = [
            solve(problem, SeilerPrior(), backend=name).provenance.seconds
            for _ in range(_WARM_UP + repeats)  # the first solves are slower
        ]
        seconds[name] = statistics.median(times[_WARM_UP:])
    solve_literally(phantom("expansion", 32).problem)  # compile before timing
    return Timing(size, seconds, timed(lambda: solve_literally(problem))[1].wall)


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
            print(f"({name} is not available: {error})", file=sys.stderr)
            continue
        found[name] = run.backend
    return found


def volume_table(size: int) -> str:
    """Return the distance of the paper's field from the elastic field in a volume."""
    cube = growing(size)
    places = np.moveaxis(np.indices(cube.shape), 0, -1) * (2 / size) - 1
    m = np.full(cube.shape, 20.0)
    m[np.linalg.norm(places - (0.15, 0.1, 0.0), axis=-1) < 0.25] = 40
    m[np.linalg.norm(places - (-0.2, -0.3, -0.2), axis=-1) < 0.35] = 10
    problem = Problem(observed=cube.observed, confidence=cube.confidence, stiffness=m)
    converged, schedule = (
        solve(problem, SeilerPrior(), optimizer=optimizer, backend="cpu").displacement
        for optimizer in (Multigrid(0.01), ICM())
    )
    rows = []
    for poisson in (0.0, 0.3, 0.45):
        prior = ElasticPrior(poisson)
        truth = solve(problem, prior, optimizer=Multigrid(0.01), backend="cpu").displacement
        fields = (truth, converged - truth, schedule - truth)
        rms = (float(np.sqrt((np.linalg.norm(each, axis=-1) ** 2).mean())) for each in fields)
        rows.append([poisson, *(f"{each:.3f}" for each in rms)])
    titles = ("Poisson's ratio", "displacement of the elastic model")
    return table.markdown((*titles, "difference, `paper, converged`", "difference, `paper`"), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables and their targets."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[300, 600, 1200])
    parser.add_argument("--repeats", type=int, default=15, help="default: %(default)s")
    parser.add_argument("--quick", action="store_true", help="small sizes, for a quick check")
    parser.add_argument("--volume", type=int, metavar="SIZE", help="only the volume")
    options = parser.parse_args(arguments)
    print(conditions(), end="\n\n")
    if options.volume:
        print(volume_table(options.volume))
        return 0
    sizes = () if options.quick else options.sizes
    page = section(Settings(Path(), options.quick), sizes, options.repeats)
    print("\n\n".join([str(page), "\n".join(map(str, page.targets))]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
