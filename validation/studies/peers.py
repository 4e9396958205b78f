"""Time, memory and error of this package beside other programs, in one process.

    python -m validation peers
    python -m validation peers.images --write

`peers.images` prints the table of the README: the elastic model by compiled loops and by shaders,
PyAMG, SuperLU and CalculiX. `peers.volumes` compares a growing ball with PyAMG, and
`peers.transforms` a random deformation with the elastic transforms of MONAI and SciPy. Two studies
run only if they are named, because they take minutes: `peers.direct` compares volumes of random
stiffness with MKL's PARDISO, and `peers.cube` a uniform cube with torch-fem. Programs that are not
installed are skipped: PyAMG belongs to the extra `report`, PARDISO and torch-fem to `peers`, MONAI
to `monai`; CalculiX is the system package `calculix-ccx`.
"""

from __future__ import annotations

import importlib.util
import math
import statistics
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from threadpoolctl import threadpool_limits

from benchmarks import table
from benchmarks.clock import (
    Times,
    now,
    one_heap,
    peak_of_programs,
    repeated,
    since,
    timed,
    with_memory,
)
from benchmarks.speed import Work, edit, growing, random_deformation
from napari_hmrf import (
    ConvergenceError,
    ElasticPrior,
    Multigrid,
    Problem,
    ProblemError,
    Solution,
    solve,
)
from napari_hmrf.data import phantom
from napari_hmrf.errors import HmrfError
from napari_hmrf.extras import how_to_install
from napari_hmrf.fields import rmsd
from validation.bodies import between_plates, random_block
from validation.oracles import calculix
from validation.oracles.elasticity import (
    System,
    assemble,
    direct_solution,
    exact_field,
    factorise,
    rigid_motions,
)
from validation.study import Options, Table, Target, backends, study
from validation.study import Results as StudyResults

Field = npt.NDArray[Any]
PHANTOM, PRIOR = "mass-effect", ElasticPrior()
#: Definition of "converged": largest distance of any site from the converged field, in pixels.
WITHIN = 0.01
#: Best of 18 settings of PyAMG that were tested on hard tissue at 257 x 257: symmetric strength
#: with thresholds from 0 to 0.08, and evolution; prolongators smoothed by Jacobi (filtered, by
#: blocks, locally) or by energy; relaxation by Gauss-Seidel (symmetric, or forward and backward)
#: or Chebyshev.
SETTING: dict[str, Any] = {
    "strength": ("symmetric", {"theta": 0.03}),
    "smooth": ("jacobi", {"omega": 4 / 3, "weighting": "block"}),
    "presmoother": ("block_gauss_seidel", {"sweep": "forward"}),
    "postsmoother": ("block_gauss_seidel", {"sweep": "backward"}),
    "improve_candidates": None,
    "max_coarse": 300,
    "coarse_solver": "splu",
}
# Runs are repeated only if one takes less than this, in seconds.
_SHORT = 1.0
_MOST_ITERATIONS = 300
_MOST_DECADES = 14
# Largest size of an image for a direct solve, because of its time and memory.
_LARGEST_DIRECT = 600


@dataclass(frozen=True)
class Run:
    """Result of a solver.

    Attributes
    ----------
    field : ndarray, shape (H, W, 2), or None
        Displacement in pixels; None if the solver failed.
    iterations : int
        Number of iterations.
    fault : str
        "", or the reason why there is no field or no sufficiently accurate field.
    reported, error : float
        Reported error, and true error: the largest distance of a site from the exact field, in
        pixels.
    how : str
        Method of the solution, or stopping criterion of PyAMG.
    seconds : float
        Time from a problem to a field; the median of several runs if short.
    megabytes : float
        Peak memory of the first run minus memory before the run.
    """

    field: Field | None
    iterations: int = 0
    fault: str = ""
    reported: float = math.nan
    how: str = ""
    seconds: float = math.nan
    megabytes: float = math.nan
    error: float = math.nan

    def against(self, exact: Field | None) -> Run:
        """Return the result with its true error and without its field."""
        if self.field is None or exact is None:
            return replace(self, field=None)
        return replace(self, field=None, error=distance(self.field, exact))


def distance(field: Field, exact: Field) -> float:
    """Return the largest distance of a site from its exact position."""
    return float(np.linalg.norm(field - exact, axis=-1).max())


def timed_run(run: Callable[[int], Run], turns: int = 3) -> Run:
    """Run and measure, and repeat short runs; `run` receives the number of the turn."""
    first, megabytes = with_memory(lambda: _with_time(run, 0))
    seconds = [first.seconds]
    while len(seconds) < turns and seconds[-1] < _SHORT:
        seconds.append(_with_time(run, len(seconds)).seconds)
    return replace(first, megabytes=megabytes, seconds=statistics.median(seconds))


def _with_time(run: Callable[[int], Run], turn: int) -> Run:
    """Return a run with its time; a run may report its own, which excludes other work."""
    found, times = timed(lambda: run(turn))
    return replace(found, seconds=times.wall) if math.isnan(found.seconds) else found


# Solvers of images.


def run_ours(
    images: Any,
    prior: ElasticPrior,
    optimizer: Multigrid | None = None,
    *,
    backend: str = "cpu",
    is_new: bool = True,
    turns: int = 3,
) -> Run:
    """Solve by napari-hmrf; if `is_new`, the tissue was not solved before."""
    optimizer = optimizer or Multigrid()

    def forget() -> None:
        """Solve another tissue to invalidate the caches."""
        small = phantom("bar", 24).problem
        solve(small, prior, optimizer=optimizer, backend=backend)

    def run(turn: int) -> Run:
        if is_new:
            forget()
        problem = Problem(
            observed=images.observed,
            confidence=images.confidence,
            # In another unit, earlier set-up cannot be reused.
            stiffness=images.stiffness * np.float32(2 ** (turn % 8) if is_new else 1),
            spacing=images.spacing,
        )
        started = now()
        try:
            found = solve(problem, prior, optimizer=optimizer, backend=backend)
        except ConvergenceError:
            return Run(None, fault="not converged", seconds=since(started).wall)
        took = since(started).wall
        reported = math.nan if found.convergence is None else found.convergence.error
        way = str(getattr(found.convergence, "way", ""))
        return Run(found.displacement, found.iterations, "", reported, way, took)

    forget()
    try:
        return timed_run(run, turns)
    except ProblemError:
        return Run(None, fault="refused")


def run_superlu(
    images: Any, prior: ElasticPrior, *, is_tuned: bool = True
) -> tuple[Run, tuple[System, Any, Field]]:
    """Solve by SuperLU; return the result, and the system, its factors and its solution.

    Tuned, it runs in symmetric mode by minimum degree; otherwise as `scipy.sparse.linalg.spsolve`
    calls it, and the factors are None.
    """
    kept: list[Any] = []

    def run(turn: int) -> Run:
        kept.clear()
        system = assemble(images, prior)
        if is_tuned:
            factor = factorise(system.matrix).solve
            solution = factor(system.load)
        else:
            factor = None
            solution = scipy.sparse.linalg.spsolve(system.matrix.tocsc(), system.load)
        kept[:] = system, factor, solution
        return Run(system.field(solution), 1)

    found = timed_run(run)
    return found, tuple(kept)


class _Enough(Exception):
    """Exception that stops the iteration because the error is small enough."""


class _Late(Exception):
    """Exception that stops the iteration because another solver would have finished."""


def has_pyamg() -> bool:
    """Return whether PyAMG is installed."""
    return importlib.util.find_spec("pyamg") is not None


def run_pyamg(
    images: Any,
    prior: ElasticPrior,
    exact: Field,
    within: float,
    *,
    options: dict[str, Any] = SETTING,
    by_decade: bool = False,
    patience: float = math.inf,
) -> Run:
    """Solve by conjugate gradients and smoothed aggregation with the rigid-body modes.

    The iteration stops as soon as the true error is at most `within`, in pixels, so PyAMG needs no
    stopping criterion; the time of the checks is not counted. With `by_decade`, only the relative
    residuals 0.1, 0.01, ... are checked. It counts as late after `patience` seconds.
    """
    import pyamg

    def run(turn: int) -> Run:
        started, checks = now(), 0.0
        np.random.seed(2008)  # PyAMG estimates spectral radii from a random vector  # noqa: NPY002
        system = assemble(images, prior)
        hierarchy = pyamg.smoothed_aggregation_solver(
            system.matrix, B=rigid_body_modes(system), symmetry="symmetric", **options
        )
        residuals: list[float] = []
        decades, iterations = 0, 0
        latest = np.zeros_like(system.load)

        def check(solution: Field) -> None:
            nonlocal decades, iterations, latest, checks
            begun = now()
            iterations += 1
            latest = solution
            if begun.wall - started.wall - checks > patience:
                raise _Late
            left = residuals[-1] / residuals[0]
            passed = math.floor(-math.log10(left)) if left > 0 else _MOST_DECADES
            is_checked = passed > decades or not by_decade
            decades = max(passed, decades)
            is_enough = is_checked and distance(system.field(solution), exact) <= within
            checks += since(begun).wall
            if is_enough:
                raise _Enough

        fault = "fails"
        try:
            with threadpool_limits(1, user_api="blas"):  # PyAMG is slower with more threads
                hierarchy.solve(
                    system.load,
                    tol=10.0**-_MOST_DECADES,
                    maxiter=_MOST_ITERATIONS,
                    accel="cg",
                    callback=check,
                    residuals=residuals,
                )
        except _Enough:
            fault = ""
        except _Late:
            fault = "later"
        took = since(started).wall - checks
        how = "" if fault else f"1e-{decades}"
        return Run(system.field(latest), iterations, fault, how=how, seconds=took)

    return timed_run(run)


def rigid_body_modes(system: System) -> Field:
    """Return the rigid motions as columns with a largest value of 1, (unknowns, 3 or 6)."""
    places = np.argwhere(system.free).astype(np.float64)
    modes = rigid_motions(places - places.mean(axis=0))
    return np.asarray(modes / np.abs(modes).max(axis=0))


def converged_field(problem: Problem, prior: ElasticPrior) -> Field:
    """Return the converged field, (H, W, 2), directly or, of a large image, by PyAMG."""
    if max(problem.shape) <= _LARGEST_DIRECT:
        return exact_field(problem, prior)
    if not has_pyamg():
        needs = f"images of more than {_LARGEST_DIRECT} pixels a side need PyAMG"
        raise HmrfError(f"{needs}: {how_to_install('peers')}")
    import pyamg

    near = solve(problem, prior, optimizer=Multigrid(WITHIN / 1000), backend="cpu").displacement
    system = assemble(problem, prior)
    hierarchy = pyamg.smoothed_aggregation_solver(
        system.matrix, B=rigid_body_modes(system), symmetry="symmetric", improve_candidates=None
    )
    start = near[system.free].astype(np.float64).ravel()
    return system.field(hierarchy.solve(system.load, x0=start, tol=1e-10, maxiter=60, accel="cg"))


def _ours(backend: str = "cpu", is_new: bool = True) -> Callable[[Problem, Field], Run]:
    def run(problem: Problem, exact: Field) -> Run:
        return run_ours(problem, PRIOR, Multigrid(WITHIN), backend=backend, is_new=is_new, turns=15)

    return run


def _pyamg(options: dict[str, Any]) -> Callable[[Problem, Field], Run]:
    return lambda problem, exact: run_pyamg(problem, PRIOR, exact, WITHIN, options=options)


def _superlu(is_tuned: bool) -> Callable[[Problem, Field], Run]:
    return lambda problem, exact: run_superlu(problem, PRIOR, is_tuned=is_tuned)[0]


def _calculix(problem: Problem, exact: Field) -> Run:
    poisson = float(PRIOR.poisson)
    found = timed_run(lambda _: Run(calculix.textbook_plane_stress(problem, poisson), 1))
    return replace(found, megabytes=peak_of_programs())


#: Title, function that solves, and largest size, by name.
SOLVERS: dict[str, tuple[str, Callable[[Problem, Field], Run], float]] = {
    "cpu": ("Multigrid, compiled loops", _ours(), math.inf),
    "again": ("the same, tissue as before", _ours(is_new=False), math.inf),
    "opengl": ("Multigrid, shaders", _ours("opengl"), math.inf),
    "pyamg": ("PyAMG, its defaults", _pyamg({}), math.inf),
    "pyamg-tuned": ("PyAMG, tuned", _pyamg(SETTING), math.inf),
    "superlu": ("SciPy SuperLU, its defaults", _superlu(is_tuned=False), _LARGEST_DIRECT),
    "superlu-tuned": ("SciPy SuperLU, tuned", _superlu(is_tuned=True), _LARGEST_DIRECT),
    "calculix": ("CalculiX", _calculix, 300),
}
_OURS = ("cpu", "again", "opengl")
#: Runs of `images` by solver and size; RMS differences from finite elements by size, in pixels.
Results = dict[tuple[str, int], Run]
Differences = dict[int, float]


def solve_images(sizes: Sequence[int]) -> tuple[Results, Differences]:
    """Run every available solver at every feasible size, one after the other."""
    one_heap()
    small = phantom(PHANTOM, 64).problem
    exact = converged_field(small, PRIOR)
    for name, (_, run, _) in SOLVERS.items():
        if is_there(name):
            run(small, exact)  # imports and compiles
    results: Results = {}
    differences: Differences = {}
    for size in sizes:
        problem = phantom(PHANTOM, size).problem
        exact = converged_field(problem, PRIOR)
        for name, (title, run, largest) in SOLVERS.items():
            if not is_there(name) or size > largest:
                continue
            print(f"{title}, {size} x {size}", file=sys.stderr, flush=True)
            found = run(problem, exact)
            results[name, size] = found.against(exact)
            if name == "cpu" and found.field is not None and size <= _LARGEST_DIRECT:
                elements = direct_solution(problem, PRIOR)
                differences[size] = rmsd(found.field, elements, problem.tissue)
    return results, differences


def is_there(name: str) -> bool:
    """Return whether a solver is installed, or OpenGL is available."""
    if name.startswith("pyamg"):
        return has_pyamg()
    if name == "opengl":
        return name in backends()
    return name != "calculix" or calculix.is_there()


_README_TITLES = ("image", "compiled loops", "shaders (software OpenGL)", "PyAMG", "SuperLU")
_README_TITLES += ("RMS difference from finite elements",)


def readme_table(results: Results, differences: Differences) -> str:
    """Return the table of the README."""
    rows = []
    for size in sorted({size for _, size in results}):
        names = ("cpu", "opengl", "pyamg", "superlu")
        runs = [results.get((name, size)) for name in names]
        times = [None if run is None else table.duration(run.seconds) for run in runs]
        off = f"{differences[size]:.3f} px" if size in differences else None
        rows.append([f"{size} x {size}", *times, off])
    return table.markdown(_README_TITLES, rows)


def _images(sizes: Sequence[int]) -> Callable[[Options], dict[str, Sequence[int]]]:
    return lambda options: {"images": options.sizes_or(sizes, (48, 64))}


@study(
    "peers.images",
    _images((300, 600, 1200)),
    lambda results: [readme_table(*results["images"]), all_solvers(results["images"][0])],
    page="../../README.md",
)
def images(sizes: Sequence[int]) -> tuple[Results, Differences]:
    """Time every solver, and compare the fields with finite elements."""
    return solve_images(sizes)


def all_solvers(results: Results) -> str:
    """Return the table with time, iterations, largest error and memory of each solver."""
    sizes = sorted({size for _, size in results})
    rows = [
        [title, *(_cell(results.get((name, size))) for size in sizes)]
        for name, (title, *_) in SOLVERS.items()
        if any((name, size) in results for size in sizes)
    ]
    return table.markdown(["solver", *(f"{size} x {size}" for size in sizes)], rows)


def _cell(run: Run | None) -> str | None:
    if run is None or run.fault:
        return None if run is None else run.fault
    seconds = table.duration(run.seconds)
    return f"{seconds}; {run.iterations}; {run.error:.0e} px; {run.megabytes:.0f} MB"


# Studies of the report.

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


@study(
    "speed.solvers",
    _images((150, 300, 600, 1200)),
    lambda results: [all_solvers(results["images"])],
    targets=lambda results: speed_targets(results["images"]),
)
def every_solver(sizes: Sequence[int]) -> Results:
    """Time every solver until all sites are within 0.01 px of the converged field."""
    return solve_images(sizes)[0]


def speed_targets(results: Results) -> list[Target]:
    """Return targets for ratios of times, iterations per size, and growth with the sites."""
    targets = []
    for (backend, other, size), bound in BOUNDS.items():
        if (backend, size) in results and (other, size) in results:
            gain = results[other, size].seconds / results[backend, size].seconds
            claim = f"{backend}: times faster than {SOLVERS[other][0]} at {size}"
            targets.append(Target(claim, gain, bound, at_least=True))
    large = sorted({size for _, size in results if size >= 300})
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


def _edits(options: Options) -> dict[str, tuple[int, Work]]:
    size = options.sizes_or((300,), (48,))[0]
    return {name: (size, work) for name, work in edit(size).items()}


def _edit_targets(results: StudyResults) -> list[Target]:
    return [
        Target(f"warm restart over cold, {size}, {name}", ratio, 1 / 3)
        for name, (size, ratio) in results.items()
    ]


@study(
    "speed.edit",
    _edits,
    lambda results: [
        Table(
            ("warm start after an edit", "time, relative to a cold start"),
            lambda found: [[name, ratio] for name, (_, ratio) in found.items()],
        )
    ],
    targets=_edit_targets,
)
def warm_starts(case: tuple[int, Work]) -> tuple[int, float]:
    """Time a warm start after an edit, in turn with a cold start."""
    size, work = case
    assert work.baseline is not None
    times: list[list[Times]] = [[], []]
    for _ in range(12):  # in turn; the first three are slower
        for each, own in zip((work, work.baseline), times, strict=True):
            own.append(repeated(each.run, each.prepare))
    warm, cold = (statistics.median(each.wall for each in own[3:]) for own in times)
    return size, warm / cold


# Volumes.

# Ratio of the largest to the smallest stiffness, and tolerance in voxels, of `direct`.
_CONTRAST, _TOLERANCE = 1e4, 0.001
# PARDISO's type of a real symmetric positive definite matrix, given by its upper triangle.
_DEFINITE = 2
# Relative residual at which torch-fem's conjugate gradients stop by default.
_RESIDUAL = 1e-10
_UNIFORM = ElasticPrior(0.3)


def _is_missing(module: str, extra: str) -> bool:
    """Print that a module is not installed, and return whether this is so."""
    missing = importlib.util.find_spec(module) is None
    if missing:
        print(f"{module} is skipped: {how_to_install(extra)}")
    return missing


def _cubes(size: int, quick: int) -> Callable[[Options], dict[str, int]]:
    return lambda options: {f"{each}^3": each for each in options.sizes_or((size,), (quick,))}


_VOLUMES = ("voxels", "solver", "iterations", "wall", "processor", "relative")
_VOLUMES += ("difference, voxels",)


@study(
    "peers.volumes",
    _cubes(32, 12),
    _VOLUMES,
    page="../concepts/volumes.md",
)
def volumes(size: int) -> list[list[Any]]:
    """Time PyAMG and this package for a cube in which a ball grows."""
    return [] if _is_missing("pyamg", "report") else _beside_pyamg(growing(size))


def _beside_pyamg(problem: Problem) -> list[list[Any]]:
    """Return the rows of this package and of PyAMG, which iterates to a residual of 1e-4.

    PyAMG's time does not include the assembly of its matrix.
    """
    import pyamg

    system = assemble(problem, PRIOR)
    modes, path, answer = rigid_body_modes(system), list[float](), list[Field]()

    def theirs(_: object) -> None:
        path.clear()
        hierarchy = pyamg.smoothed_aggregation_solver(system.matrix, B=modes)
        answer[:] = [hierarchy.solve(system.load, tol=1e-4, accel="cg", residuals=path)]

    def ours(_: object) -> Solution:
        return solve(problem, PRIOR, optimizer=Multigrid(WITHIN), backend="cpu")

    found = ours(None)
    own, other = repeated(ours, least=5), repeated(theirs)
    apart = float(np.abs(found.displacement - system.field(answer[0])).max())
    name, relative = f"{problem.shape[0]}^3", other.processor / own.processor
    return [
        [name, "napari-hmrf", found.iterations, *map(table.duration, own), 1, None],
        [name, "PyAMG", len(path) - 1, *map(table.duration, other), relative, f"{apart:.4f}"],
    ]


_DIRECT = ("voxels", "Poisson's ratio", "largest difference of any site, voxels")
_DIRECT += ("reported error, voxels", "cycles")


@study("peers.direct", _cubes(48, 10), _DIRECT, page="volumes.md", on_request=True)
def direct(size: int) -> Iterator[list[Any]]:
    """Compare a volume of random stiffness with the solution of scikit-fem's matrix by PARDISO."""
    if _is_missing("pypardiso", "peers"):
        return
    from pypardiso import PyPardisoSolver

    def by_pardiso(matrix: Any, right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        upper = scipy.sparse.triu(matrix, format="csr")
        upper.sort_indices()
        solver = PyPardisoSolver(mtype=_DEFINITE)
        found = solver.solve(upper, right)
        solver.free_memory(everything=True)
        return np.asarray(found)

    problem = random_block(size, _CONTRAST, (2.0, 1.0, -0.6), balls=24)
    for poisson in (0.3, 0.45, 0.49):
        prior, optimizer = ElasticPrior(poisson), Multigrid(_TOLERANCE)
        found = solve(problem, prior, optimizer=optimizer, backend="cpu")
        expected, times = timed(
            lambda prior=prior: direct_solution(problem, prior, solved=by_pardiso)
        )
        print(f"PARDISO: {table.duration(times.wall)}", file=sys.stderr, flush=True)
        off = float(np.abs(found.displacement - expected).max()) / problem.unit
        assert found.convergence is not None
        error = f"{found.convergence.error:.1e}"
        yield [f"{size}^3", poisson, f"{off:.1e}", error, found.iterations]


_CUBE = ("solver of the uniform cube", "CPU seconds", "relative to napari-hmrf")


@study("peers.cube", _cubes(40, 10), _CUBE, page="volumes.md", on_request=True)
def cube(nodes: int) -> Iterator[list[Any]]:
    """Time the solve of a uniform cube, here and by torch-fem, for the same residual."""
    if _is_missing("torchfem", "peers"):
        return
    small, problem = stretched_cube(16), stretched_cube(nodes)
    for each in (small, problem):  # the first loads the loops
        found, ours = to_residual(each)
    left = residual(problem, found.displacement)
    name = f"napari-hmrf, {nodes}^3 nodes, {found.iterations} cycles, to {left:.1e}"
    yield [name, f"{ours.processor:.1f}", 1]
    for title, preconditioner in (("Jacobi", "jacobi"), ("algebraic multigrid", "amg")):
        for each in (small, problem):
            field, theirs = by_torch_fem(each, preconditioner)
        relative = theirs.processor / ours.processor
        yield [f"torch-fem, {title}", f"{theirs.processor:.1f}", f"{relative:.0f}"]
        apart = float(np.abs(field - found.displacement).max())
        print(f"{title}: the fields differ by at most {apart:.1e} voxel")


def stretched_cube(nodes: int) -> Problem:
    """Return a uniform cube with one face fixed and the opposite face pulled and sheared."""
    return between_plates(np.ones((nodes,) * 3), (0.05 * nodes, 0.02 * nodes, 0.0))


def residual(problem: Problem, d: npt.NDArray[np.floating]) -> float:
    """Return ||forces(d)|| / ||forces(d_0)|| at free components; d_0 is 0 there."""
    first = np.where(problem.known, problem.observed, 0.0)
    norms = [
        float(np.linalg.norm(_UNIFORM.forces(problem, each)[~problem.known]))
        for each in (d.astype(np.float64), first)
    ]
    return norms[0] / norms[1]


def to_residual(problem: Problem) -> tuple[Solution, Times]:
    """Return the first solution with at most torch-fem's residual, and its times.

    The tolerance is divided by ten until the residual is small enough.
    """
    for power in range(5, 14):
        optimizer = Multigrid(10.0**-power)
        found, times = timed(
            lambda optimizer=optimizer: solve(problem, _UNIFORM, optimizer=optimizer, backend="cpu")
        )
        if residual(problem, found.displacement) <= _RESIDUAL:
            break
    return found, times


def by_torch_fem(problem: Problem, preconditioner: str) -> tuple[Field, Times]:
    """Return the field of torch-fem, and its times, including its set-up."""
    import torch
    from torchfem import Solid
    from torchfem.materials import IsotropicElasticity3D
    from torchfem.mesh import cube_hexa

    torch.set_default_dtype(torch.float64)

    def run() -> Any:
        lengths = [size - 1.0 for size in problem.shape]
        nodes, elements = cube_hexa(*problem.shape, *lengths)
        model = Solid(nodes, elements, IsotropicElasticity3D(E=1.0, nu=float(_UNIFORM.poisson)))
        model.constraints = torch.tensor(problem.known.reshape(-1, 3))
        model.displacements = torch.tensor(problem.observed.reshape(-1, 3).astype(np.float64))
        return model.solve(method="cg", preconditioner=preconditioner, stol=_RESIDUAL)[0]

    found, times = timed(run)
    return found.numpy().reshape(*problem.shape, 3), times


# Random deformations.


def _grids(options: Options) -> dict[str, tuple[int, ...]]:
    shapes = [
        (options.sizes_or((size,), (quick,))[0],) * axes
        for axes, size, quick in ((2, 256, 48), (3, 96, 16))
    ]
    return {" x ".join(map(str, shape)): shape for shape in shapes}


_TRANSFORMS = ("image and labels", "transform", "wall", "processor", "relative processor time")


@study("peers.transforms", _grids, _TRANSFORMS, page="../how-to/random-deformations.md")
def transforms(shape: tuple[int, ...]) -> Iterator[list[Any]]:
    """Time a random deformation of an image and its labels."""
    from napari_hmrf.fields import Picture

    image, labels, deformation = random_deformation(shape)
    pictures, seeds = (Picture(image), Picture(labels, order=0)), iter(range(10**9))

    def ours(seed: int) -> object:
        return deformation.sample(seed).pictures(*pictures)

    ours(next(seeds))
    own = repeated(ours, lambda: next(seeds), seconds=2.0)
    name = " x ".join(map(str, shape))
    yield [name, "napari-hmrf", *map(table.duration, own), 1]
    others = {"SciPy": by_scipy(image, labels)}
    if not _is_missing("monai", "monai"):
        others[f"MONAI's Rand{len(shape)}DElasticd"] = by_monai(image, labels)
    for title, transform in others.items():
        transform(None)
        times = repeated(transform, seconds=2.0)
        relative = times.processor / own.processor
        yield [name, title, *map(table.duration, times), relative]


def by_scipy(image: Field, labels: Field) -> Callable[[object], object]:
    """Return the usual elastic transform, as implemented in many pipelines."""
    random, n = np.random.default_rng(0), image.ndim
    own = np.indices(image.shape, dtype=np.float32)

    def transform(_: object) -> object:
        noise = random.standard_normal((n, *image.shape), dtype=np.float32)
        at = own + 60 * np.stack([scipy.ndimage.gaussian_filter(each, 8) for each in noise])
        moved = scipy.ndimage.map_coordinates(image, at, order=1, mode="nearest")
        return moved, scipy.ndimage.map_coordinates(labels, at, order=0, mode="nearest")

    return transform


def by_monai(image: Field, labels: Field) -> Callable[[object], object]:
    """Return MONAI's elastic transform of an image and its labels, set as in MONAI's tutorial."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from monai.transforms import Rand2DElasticd, Rand3DElasticd

        keys, mode = ("image", "label"), ("bilinear", "nearest")
        if image.ndim == 2:
            more = {"spacing": (30, 30), "magnitude_range": (5, 6)}
            made = Rand2DElasticd(keys, prob=1.0, mode=mode, **more)
        else:
            more = {"sigma_range": (5, 8), "magnitude_range": (100, 200)}
            made = Rand3DElasticd(keys, prob=1.0, mode=mode, **more)
    made.set_random_state(0)
    given = {"image": image[None], "label": labels[None]}
    return lambda _: made(given)
