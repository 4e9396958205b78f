"""Paper of Seiler et al.: its tables, its two readings, and the questions that it leaves open."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from benchmarks.clock import fastest, timed
from napari_hmrf import (
    ICM,
    ElasticPrior,
    Multigrid,
    Problem,
    SeilerPrior,
    Solution,
    solve,
)
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from napari_hmrf.solver.backends.choice import open_backend
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.quadtree import levels, nearest_pixels
from validation.bodies import bar
from validation.oracles.elasticity import assemble, direct_solution
from validation.oracles.paper import equations, solve_exactly, solve_literally, start
from validation.study import (
    COLOURS,
    Options,
    Results,
    Table,
    Target,
    backends,
    new_figure,
    save,
    study,
)

Float64Array = npt.NDArray[np.float64]
PHANTOMS = ("expansion", "mass-effect")
READINGS = ("centred", "blanket")

# Tables 1 and 2.

_CONVERGED = ICM(iterations=50_000, steps=None, energy_change=1e-7)
_WARM_UP = 5
# Methods of table 1, and the largest accepted RMSD, in pixels.
_METHODS: tuple[tuple[str, Prior, Optimizer, float], ...] = (
    ("HMRF, 70 sweeps a level", SeilerPrior(), ICM(), 1.44),
    ("HMRF, converged by ICM", SeilerPrior(), _CONVERGED, 0.45),
    ("HMRF, converged by multigrid", SeilerPrior(), Multigrid(0.01), 0.45),
    ("elastic, multigrid", ElasticPrior(poisson=0.3), Multigrid(0.01), 0.005),
)
_OF_PAPER = (
    "*values of the paper*",
    "*HMRF, 70 sweeps a level*",
    0.19404,
    "1.44 px",
    700,
    "1.63 s",
)


def _table_1_targets(results: Results) -> Iterator[Target]:
    bounds = {method: bound for method, *_, bound in _METHODS}
    for name, rows in results.items():
        for _, method, _, off, *_ in rows:
            if method in bounds:
                off = float(off.removesuffix(" px"))
                yield Target(f"{name}, {method}: RMSD in px", off, bounds[method])


@study(
    "paper.table-1",
    lambda options: {name: (name, options.sizes_or((300,), (48,))[0]) for name in PHANTOMS},
    lambda results: [
        Table(
            ("phantom", "method", "mean energy", "RMSD", "iterations", "time"),
            lambda found: [*(row for rows in found.values() for row in rows), _OF_PAPER],
        )
    ],
    targets=_table_1_targets,
)
def table_1(case: tuple[str, int]) -> list[list[Any]]:
    """Compare the fields of table 1 with finite elements, inside the body."""
    name, size = case
    problem = phantom(name, size).problem
    truth, times = timed(lambda: direct_solution(problem, ElasticPrior(0.3)))
    motion = rmsd(truth, 0 * truth, problem.tissue)
    rows = []
    for method, prior, optimizer, _ in _METHODS:
        for _ in range(2):  # the first solve compiles
            found, took = timed(partial(solve, problem, prior, optimizer=optimizer, backend="cpu"))
        off = rmsd(found.displacement, truth, found.tissue)
        energy, seconds = f"{found.mean_energy:.5f}", f"{took.wall:.3f} s"
        rows.append([name, method, energy, f"{off:.4f} px", found.iterations, seconds])
    reference = f"finite elements (field: {motion:.2f} px rms)"
    rows.append([name, reference, None, "0", None, f"{times.wall:.2f} s"])
    return rows


class Timing(NamedTuple):
    """Row of table 2: seconds by backend, seconds of the literal program, and titles."""

    size: int
    backends: dict[str, float]
    literal: float
    titles: dict[str, str]


def _table_2(results: Results) -> list[Table]:
    rows = []
    for size, seconds, literal, _ in results.values():
        cells = (f"{own:.3f} s ({literal / own:.0f} times faster)" for own in seconds.values())
        rows.append([f"{size} x {size}", *cells, f"{literal:.1f} s"])
    titles = next(iter(results.values())).titles
    return [Table(["image", *titles.values(), "literal"], lambda _: rows)]


def _table_2_targets(results: Results) -> Iterator[Target]:
    """Yield targets for the ratios of times, and for the growth of time with the sites."""
    timings = results.values()
    first, last = (pick(timings, key=lambda timing: timing.size) for pick in (min, max))
    bounds = {"opengl": 55.0, "cpu": 300.0}
    for name in first.backends:
        gain = first.literal / first.backends[name]
        claim = f"{name}: times faster than the literal program at {first.size}"
        yield Target(claim, gain, bounds[name], at_least=True)
        growth = last.backends[name] / first.backends[name] / (last.size / first.size) ** 2
        yield Target(f"{name}: growth of time over growth of sites", growth, 1.1)


@study(
    "paper.table-2",
    lambda options: {
        str(size): (size, options.count or options.choose(7, 1))
        for size in options.sizes_or((300, 600, 1200), (48,))
    },
    _table_2,
    targets=_table_2_targets,
)
def table_2(case: tuple[int, int]) -> Timing:
    """Time the schedule of table 2, in a warm process, beside one thread of a processor."""
    size, repeats = case
    problem = phantom("expansion", size).problem
    seconds, titles = {}, {}
    for name in backends():
        runs = [
            solve(problem, SeilerPrior(), backend=name).provenance
            for _ in range(_WARM_UP + repeats)  # the first solves are slower
        ]
        seconds[name] = statistics.median(run.seconds for run in runs[_WARM_UP:])
        titles[name] = runs[-1].backend
    solve_literally(phantom("expansion", 32).problem)  # compile before timing
    return Timing(size, seconds, timed(lambda: solve_literally(problem))[1].wall, titles)


_VOLUME_TITLES = ("Poisson's ratio", "displacement of the elastic model")
_VOLUME_TITLES += ("difference, `paper, converged`", "difference, `paper`")


@study(
    "paper.volume",
    lambda options: {"growing cube": options.sizes_or((48,), (12,))[0]},
    _VOLUME_TITLES,
    page="../concepts/volumes.md",
    on_request=True,
)
def in_volume(size: int) -> list[list[Any]]:
    """Compare the field of the paper's prior with the elastic field in a volume, in voxels."""
    from benchmarks.speed import growing

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
        rows.append([poisson, *(f"{rmsd(each, 0 * each):.3f}" for each in fields)])
    return rows


# The two readings of "U_total at a site", by direct solves in double precision.


def bar_strain_ratio(length: int, ratio: float, reading: str) -> float:
    """Return the strain ratio of the soft and stiff halves of a bar with prescribed ends."""
    m = np.ones((1, length))
    m[:, : length // 2] = ratio
    return ratio_of_halves(solve_exactly(bar(1, length, (0.0, 1.0), m), reading)[0, :, 1])


def ratio_of_halves(along: npt.NDArray[np.floating[Any]]) -> float:
    """Return the strain of the second half of a bar over that of the first.

    The element between the halves is in neither. `along` is the displacement along the bar, of an
    even number of sites.
    """
    middle = len(along) // 2
    return float((along[-1] - along[middle]) / (along[middle - 1] - along[0]))


_IN_WORDS = {"expansion": "outline expands", "mass-effect": "tumour grows"}
_RMS = "*rms of the finite-element field*"


def _reading_tables(results: Results) -> list[Table]:
    sizes = next(iter(results.values()))
    rows = [
        [
            f"{_IN_WORDS[name]}: {what}" if what in READINGS else what,
            *(
                f"{by_size[n][what]:.3f}" if what in READINGS else f"*{by_size[n][what]:.2f}*"
                for n in sizes
            ),
        ]
        for name, by_size in results.items()
        for what in (*READINGS, _RMS)
    ]
    return [Table(["RMSD inside the body, px", *(f"{n} x {n}" for n in sizes)], lambda _: rows)]


@study(
    "paper.readings",
    lambda options: {name: (name, options.sizes_or((64, 128, 256), (32,))) for name in PHANTOMS},
    _reading_tables,
    page="../method.md",
)
def readings(case: tuple[str, list[int]]) -> dict[int, dict[str, float]]:
    """Compare both readings with finite elements, by size, in pixels."""
    name, sizes = case
    found = {}
    for size in sizes:
        problem = phantom(name, size).problem
        truth = direct_solution(problem, ElasticPrior(0.3))
        fields = {reading: solve_exactly(problem, reading) for reading in READINGS}
        own = {key: rmsd(field, truth, problem.tissue) for key, field in fields.items()}
        own[_RMS] = rmsd(truth, 0 * truth, problem.tissue)
        found[size] = own
    return found


BAR_LENGTHS = (8, 64, 256, 1200)


@study(
    "paper.bar",
    {reading: reading for reading in READINGS},
    ("strain ratio (truth: 5)", *(f"{length} px" for length in BAR_LENGTHS)),
    page="../method.md",
)
def bar_ratios(reading: str) -> list[str]:
    """Compare the strains of a bar whose halves have stiffness ratio 5, by length."""
    ratios = (bar_strain_ratio(length, 5.0, reading) for length in BAR_LENGTHS)
    return [reading, *(f"{ratio:.2f}" for ratio in ratios)]


# How many levels?

#: Root mean square distance from the converged field to reach, in pixels.
WITHIN = 0.01
# Sweeps of a coarser level end if no site moves further than this in a sweep, in pixels.
_STILL = 1e-4
_MOST = 200_000


class _Shallow:
    """Wrapper of a backend or model that restricts the number of levels."""

    def __init__(self, inner: Any, count: int) -> None:
        self._inner, self._count = inner, count

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def elastic_model(self, material: Any) -> Any:
        return _Shallow(self._inner.elastic_model(material), self._count)

    @property
    def levels(self) -> Any:
        every = self._inner.levels[: self._count]
        return [_Alone(level) if level.finishes_cycle else level for level in every]


class _Alone:
    """Wrapper of a level that would otherwise include all coarser levels in its cycle."""

    takes_rest = False

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def finish(self, steps: Any, coarsest: Any) -> None:
        """Smooth as the coarsest level."""
        self._inner.descend(coarsest, None)


def multigrid_cycles(problem: Problem, count: int | None = None) -> tuple[int, int]:
    """Return the number of cycles with `count` levels, and the number of all levels."""
    deepest = 0

    def job() -> int:
        nonlocal deepest
        prior = ElasticPrior()
        backend = open_backend(
            SolveJob.of(problem, prior, Multigrid()), "cpu", lambda: None
        ).backend
        try:
            deepest = len(backend.elastic_model(prior.material(problem)).levels)
            some: Any = _Shallow(backend, count or deepest)
            found = Multigrid(WITHIN, max_iterations=5000).run(problem, prior, some, lambda _: None)
        finally:
            backend.close()
        return sum(level.iterations for level in found.levels)

    return compute_thread.submit(job).result(), deepest


def icm_sweeps(problem: Problem, truth: npt.NDArray[np.float64], count: int) -> list[float]:
    """Run ICM in closed form through the finest `count` levels, from a field of zero.

    Returns
    -------
    list of float
        Number of sweeps of each level, finest first, in units of sweeps over the finest level.
    """
    above: tuple[npt.NDArray[Any], npt.NDArray[Any]] | None = None
    spent = []
    for level in reversed(levels(problem.shape)[:count]):
        at = np.ix_(*nearest_pixels(level, problem.shape))
        m, y = (np.ascontiguousarray(field[at]) for field in (problem.stiffness, problem.observed))
        held = np.ascontiguousarray(problem.confidence[at]) > 0
        d = np.where(held, y, start(m, above, np.float32)).astype(np.float64)
        matrix = equations(m, (1.0, 1.0), "centred")
        free = ~held.ravel() & (matrix.diagonal() > 0)
        rows, diagonal, moved = matrix[free], matrix.diagonal()[free], d.reshape(-1)
        sweeps, finest = 0, level.number == 0
        while sweeps < _MOST:
            if finest and sweeps % 10 == 0 and rmsd(d, truth, problem.tissue) <= WITHIN:
                break
            change = rows @ moved / diagonal  # all sites move simultaneously
            moved[free] -= change
            sweeps += 1
            if not finest and np.abs(change).max(initial=0.0) <= _STILL:
                break
        spent.append(sweeps * level.sites / problem.stiffness.size)
        above = d.astype(np.float32), m
    return spent[::-1]


def _level_tables(results: Results) -> list[Table]:
    sweeps, cycles = results["mass-effect"]
    rows = [
        ["ICM, sweeps", *(f"{value:.0f}" for value in sweeps.values())],
        ["Multigrid, cycles", *(cycles.get(count) for count in sweeps)],
    ]
    return [Table(["levels", *map(str, sweeps)], lambda _: rows)]


def _draw_levels(results: Results, folder: Path) -> None:
    figure = new_figure(10, 4)
    titles = ("ICM: sweeps (in sweeps over the image)", "Multigrid: cycles")
    for axes, found, title in zip(
        figure.subplots(1, 2), results["mass-effect"], titles, strict=True
    ):
        axes.plot(list(found), list(found.values()), "o-", color=COLOURS[0])
        axes.set_ylim(bottom=0)
        axes.set_xlabel("levels in use")
        axes.set_title(title)
        axes.grid(alpha=0.3)
    save(figure, folder, "levels")


@study(
    "paper.levels",
    lambda options: {"mass-effect": options.sizes_or((200,), (32,))[0]},
    _level_tables,
    draw=_draw_levels,
)
def iterations_by_levels(size: int) -> tuple[dict[int, float], dict[int, int]]:
    """Count sweeps of ICM and cycles of Multigrid to 0.01 px, with a limited number of levels."""
    problem = phantom("mass-effect", size).problem
    truth = solve_exactly(problem, "centred")
    depth = len(levels(problem.shape))
    sweeps = {count: sum(icm_sweeps(problem, truth, count)) for count in range(1, depth + 1)}
    _, deepest = multigrid_cycles(problem)
    cycles = {count: multigrid_cycles(problem, count)[0] for count in range(1, deepest + 1)}
    return sweeps, cycles


# Global optimizers.

SIZE = 32
#: The minimum is reached if the relative excess of the energy is below this.
NEAR = 1e-6
# Annealing: ratio of the final temperature to the initial one, which randomizes the field.
_COOLED = 1e-14
_ROUNDS = 60


@dataclass
class Curve:
    """Energy above the minimum, relative to the minimum, against time in seconds."""

    name: str
    seconds: list[float] = field(default_factory=list)
    excess: list[float] = field(default_factory=list)

    @property
    def arrival(self) -> float:
        """Time at which the minimum was reached; infinity if it was not reached."""
        pairs = zip(self.seconds, self.excess, strict=True)
        return min((second for second, above in pairs if above <= NEAR), default=math.inf)


@numba.njit(cache=True, error_model="numpy")
def _anneal(data, indices, indptr, load, x, temperature, step, sweeps, rng):
    """Run Metropolis sweeps for the energy x A x / 2 - load x; return the acceptance rate."""
    accepted = 0
    for _ in range(sweeps):
        for i in range(len(x)):
            slope = -load[i]
            curvature = 0.0
            for k in range(indptr[i], indptr[i + 1]):
                slope += data[k] * x[indices[k]]
                if indices[k] == i:
                    curvature = data[k]
            move = step * rng.standard_normal()
            change = move * slope + 0.5 * move * move * curvature
            if change <= 0 or rng.random() < np.exp(-change / temperature):
                x[i] += move
                accepted += 1
    return accepted / (sweeps * len(x))


def anneal(matrix, load: Float64Array, least: Float64Array, minimum: float, sweeps: int) -> Curve:
    """Cool a field of zero geometrically, with proposals adapted to about 40 % acceptance."""
    curve = Curve(f"annealed, {sweeps * _ROUNDS} sweeps")
    args = (matrix.data, matrix.indices, matrix.indptr, load)
    x, rng = np.zeros(len(load)), np.random.default_rng(0)
    _anneal(*args, x.copy(), 1.0, 0.1, 1, rng)  # compile before timing
    temperature, step, spent = minimum / len(load), 1.0, 0.0
    for _ in range(_ROUNDS):
        share, times = timed(lambda t=temperature, s=step: _anneal(*args, x, t, s, sweeps, rng))
        spent += times.wall
        step *= 1.5 if share > 0.45 else 1 / 1.5 if share < 0.35 else 1.0
        temperature *= _COOLED ** (1 / _ROUNDS)
        off = x - least
        curve.seconds.append(spent)
        curve.excess.append(0.5 * float(off @ (matrix @ off)) / minimum)
    return curve


def best_annealed(lengths: Sequence[int], *problem: Any) -> Curve:
    """Return the schedule that reaches the minimum first, or the longest if none does."""
    curves = [anneal(*problem, sweeps) for sweeps in lengths]
    return min(reversed(curves), key=lambda curve: curve.arrival)


def solved(name: str, energy: Callable[[Solution], float], runs: list[Callable[[], Solution]]):
    """Return a curve of whole solves, each from zero, with the shortest of several times."""
    curve = Curve(name)
    for run in runs:
        solution = run()
        curve.seconds.append(fastest(run, 8)[1].wall)
        curve.excess.append(energy(solution))
    return curve


def paper_curves(problem: Problem, lengths: Sequence[int], counts: Sequence[int]) -> list[Curve]:
    """Return the curves of eq. 7 with prescribed boundary; `counts` are the sweeps of ICM."""
    prior = SeilerPrior(conditional="blanket")
    truth = solve_exactly(problem, "blanket")
    minimum = float(prior.site_energy(problem, truth).sum())
    held = (problem.confidence > 0) & problem.tissue[..., None]
    free = ((problem.confidence == 0) & problem.tissue[..., None]).ravel()
    rows = 2 * equations(problem.stiffness, problem.spacing, "blanket")[free]
    load = -(rows @ np.where(held, problem.observed, 0.0).ravel())

    def excess(solution: Solution) -> float:
        d = np.where(held, problem.observed, solution.displacement)
        return float(prior.site_energy(problem, d).sum()) / minimum - 1

    def icm(count: int) -> Callable[[], Solution]:
        optimizer = ICM(iterations=count, steps=None)
        return lambda: solve(problem, prior, optimizer=optimizer, backend="cpu")

    curves = [best_annealed(lengths, rows[:, free], load, truth.ravel()[free], minimum)]
    curves.append(solved("ICM through the levels", excess, [icm(count) for count in counts]))

    def cycles(tolerance: float) -> Callable[[], Solution]:
        return lambda: solve(problem, prior, optimizer=Multigrid(tolerance), backend="cpu")

    runs = [cycles(10.0**-k) for k in (0, 1, 2, 3, 4)]
    curves.append(solved("Multigrid", excess, runs))
    return curves


def elastic_curves(problem: Problem, lengths: Sequence[int]) -> list[Curve]:
    """Return the curves of the elastic energy, by annealing and by Multigrid."""
    prior = ElasticPrior()
    system = assemble(problem, prior)
    least = direct_solution(problem, prior)
    minimum = prior.energy(problem, least)

    def run(tolerance: float) -> Callable[[], Solution]:
        return lambda: solve(problem, prior, optimizer=Multigrid(tolerance), backend="cpu")

    def excess(solution: Solution) -> float:
        return prior.energy(problem, solution.displacement) / minimum - 1

    found = least[system.free].ravel()
    curves = [best_annealed(lengths, system.matrix.tocsr(), system.load, found, minimum)]
    curves.append(solved("Multigrid", excess, [run(10.0**-k) for k in (0, 1, 2, 3, 4)]))
    return curves


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if math.isfinite(value) else "not reached"


def _annealing_rows(results: Results) -> Iterator[list[str]]:
    for name, curves in results.items():
        for curve in curves:
            yield [*name.split(", "), curve.name, _seconds(curve.arrival)]


def _annealing_target(results: Results) -> Iterator[Target]:
    if curves := results.get(f"elastic, {SIZE} x {SIZE}"):
        gain = curves[0].arrival / curves[1].arrival
        claim = f"times sooner than annealing, at {SIZE} x {SIZE}"
        yield Target(claim, gain, 10, at_least=True)


def _draw_annealing(results: Results, folder: Path) -> None:
    figure = new_figure(10, 4)
    families = {"the paper's energy (eq. 7)": "eq. 7", "the elastic energy": "elastic"}
    for axes, (title, energy) in zip(figure.subplots(1, 2), families.items(), strict=True):
        curves = results[f"{energy}, {SIZE} x {SIZE}"]
        for curve, colour in zip(curves, COLOURS, strict=False):
            above = np.maximum(curve.excess, 1e-10)
            axes.loglog(curve.seconds, above, "o-", ms=3, color=colour, label=curve.name)
        axes.axhline(NEAR, color="0.6", lw=0.8)
        axes.set_title(title)
        axes.set_xlabel("seconds")
        axes.set_ylabel("energy above the minimum, fraction")
        axes.grid(alpha=0.3)
        axes.legend()
    save(figure, folder, "metropolis")


def energies(options: Options) -> Iterator[tuple[str, Callable[[], list[Curve]]]]:
    """Yield functions that return the curves of an energy and a size."""
    lengths = options.choose((3, 10, 30, 100), (3,))
    counts = options.choose((1, 3, 10, 30, 100, 300, 1000, 3000, 10_000), (1, 10, 100))
    longer = [10 * length for length in lengths]  # eq. 7 is of fourth order, and slower

    def of_paper() -> list[Curve]:
        return paper_curves(phantom("mass-effect", SIZE).problem, longer, counts)

    yield f"eq. 7, {SIZE} x {SIZE}", of_paper
    for n in options.sizes_or((16, SIZE, 64), (16, SIZE)):
        problem = phantom("mass-effect", n).problem
        yield f"elastic, {n} x {n}", lambda own=problem: elastic_curves(own, lengths)


_ANNEALING_TITLES = ("energy", "image", "optimizer", f"time to {NEAR:.0e} above the minimum")


@study(
    "paper.annealing",
    energies,
    _ANNEALING_TITLES,
    rows=_annealing_rows,
    targets=_annealing_target,
    draw=_draw_annealing,
)
def annealing(curves: Callable[[], list[Curve]]) -> list[Curve]:
    """Time Metropolis's algorithm and the optimizers of this package to the exact minimum."""
    return curves()
