"""The paper's claim about global optimizers: Metropolis sampling with annealing."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from napari_hmrf import ICM, ElasticPrior, Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.data import phantom
from report.page import Section, Settings, Target
from report.pictures import COLOURS, new_figure, save
from validation.oracles.elasticity import assemble, direct_solution
from validation.oracles.paper import residual_matrix, solve_exactly

Float64Array = npt.NDArray[np.float64]
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
        started = time.perf_counter()
        share = _anneal(*args, x, temperature, step, sweeps, rng)
        spent += time.perf_counter() - started
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


def timed(name: str, energy: Callable[[Solution], float], runs: list[Callable[[], Solution]]):
    """Return a curve of whole solves, each from zero, with the shortest of several times."""
    curve = Curve(name)
    for run in runs:
        times = []
        for _ in range(8):
            started = time.perf_counter()
            solution = run()
            times.append(time.perf_counter() - started)
        curve.seconds.append(min(times))
        curve.excess.append(energy(solution))
    return curve


def paper_curves(problem: Problem, lengths: Sequence[int], counts: Sequence[int]) -> list[Curve]:
    """Return the curves of eq. 7 with prescribed boundary; `counts` are the sweeps of ICM."""
    prior = SeilerPrior(conditional="blanket")
    truth = solve_exactly(problem, "blanket")
    matrix, load, free = _quadratic(problem)
    minimum = float(prior.site_energy(problem, truth).sum())
    held = (problem.confidence > 0) & problem.tissue[..., None]

    def excess(solution: Solution) -> float:
        d = np.where(held, problem.observed, solution.displacement)
        return float(prior.site_energy(problem, d).sum()) / minimum - 1

    def icm(count: int) -> Callable[[], Solution]:
        optimizer = ICM(iterations=count, steps=None)
        return lambda: solve(problem, prior, optimizer=optimizer, backend="cpu")

    curves = [best_annealed(lengths, matrix, load, truth[free], minimum)]
    curves.append(timed("ICM through the levels", excess, [icm(count) for count in counts]))

    def cycles(tolerance: float) -> Callable[[], Solution]:
        return lambda: solve(problem, prior, optimizer=Multigrid(tolerance), backend="cpu")

    runs = [cycles(10.0**-k) for k in (0, 1, 2, 3, 4)]
    curves.append(timed("Multigrid", excess, runs))
    return curves


def _quadratic(problem: Problem):
    """Return the matrix, load and free components of eq. 7, which is quadratic."""
    free = (problem.confidence == 0) & problem.tissue[..., None]
    fixed = np.where((problem.confidence > 0) & problem.tissue[..., None], problem.observed, 0.0)
    residuals = residual_matrix(problem)
    matrix = 2 * (residuals.T @ residuals).tocsr()
    at = free.ravel()
    load = -(matrix[at][:, ~at] @ fixed.ravel()[~at])
    return matrix[at][:, at], np.asarray(load), free


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
    curves.append(timed("Multigrid", excess, [run(10.0**-k) for k in (0, 1, 2, 3, 4)]))
    return curves


def section(settings: Settings) -> Section:
    """Return the section with energy over time."""
    page = Section("Global optimisers")
    sizes = settings.choose((16, SIZE, 64), (16, SIZE))
    lengths = settings.choose((3, 10, 30, 100), (3,))
    longer = [10 * length for length in lengths]  # eq. 7 is of fourth order, and slower
    counts = settings.choose((1, 3, 10, 30, 100, 300, 1000, 3000, 10_000), (1, 10, 100))
    paper = paper_curves(phantom("mass-effect", SIZE).problem, longer, counts)
    elastic = {n: elastic_curves(phantom("mass-effect", n).problem, lengths) for n in sizes}
    families = {"the paper's energy (eq. 7)": paper, "the elastic energy": elastic[SIZE]}
    page.say(
        f"""**Question.** The paper prefers local optimisers on a hierarchy to global ones, which
        "do not guarantee convergence and the computation time is enormous", and gives no number.
        Here the mass-effect phantom at {SIZE} x {SIZE} is sampled by Metropolis's algorithm: one
        component of one site at a time, compiled, cooled geometrically by {_COOLED:.0e} in
        {_ROUNDS} rounds, steps adapted to 40 % acceptance. Of several lengths of schedule, the
        first that reaches the minimum is shown, together with the package's optimizers; every
        point is a whole solve. The curves show by what fraction the energy exceeds its exact
        minimum (float64 direct solve)."""
    )
    figure = new_figure(10, 4)
    for axes, (title, curves) in zip(figure.subplots(1, 2), families.items(), strict=True):
        for curve, colour in zip(curves, COLOURS, strict=False):
            above = np.maximum(curve.excess, 1e-10)
            axes.loglog(curve.seconds, above, "o-", ms=3, color=colour, label=curve.name)
        axes.axhline(NEAR, color="0.6", lw=0.8)
        axes.set_title(title)
        axes.set_xlabel("seconds")
        axes.set_ylabel("energy above the minimum, fraction")
        axes.grid(alpha=0.3)
        axes.legend()
    page.picture(save(figure, settings, "metropolis"), "energy over time")
    rows = [["eq. 7", f"{SIZE} x {SIZE}", curve.name, _seconds(curve.arrival)] for curve in paper]
    rows += [
        ["elastic", f"{size} x {size}", curve.name, _seconds(curve.arrival)]
        for size, curves in elastic.items()
        for curve in curves
    ]
    page.table(["energy", "image", "optimizer", f"time to {NEAR:.0e} above the minimum"], rows)
    gains = {size: curves[0].arrival / curves[1].arrival for size, curves in elastic.items()}
    page.say(
        f"""**Conclusion.** Both energies are convex: annealing has no local minimum to escape
        from, and reaches the minimum at the end of its schedule. However, a move of one site
        propagates motion by one pixel only, so the number of sweeps grows with the square of the
        image's width, and the work with its fourth power. For the elastic energy Multigrid
        reaches the minimum
        {", ".join(f"{gains[size]:.0f} times sooner at {size} x {size}" for size in sizes)}. The
        paper's claim holds, but local minima are not the reason. ICM minimises eq. 7 in its
        blanket reading here."""
    )
    page.targets.append(
        Target(f"times sooner than annealing, at {SIZE} x {SIZE}", gains[SIZE], 10, at_least=True)
    )
    return page


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if math.isfinite(value) else "not reached"
