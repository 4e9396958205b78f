"""Time, memory and true error of three solvers on a hard problem: ours, PyAMG and SuperLU."""

from __future__ import annotations

import hashlib
import importlib.util
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

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
from report.contenders import rigid_body_modes
from report.memory import one_heap, peak_megabytes, trim_memory
from report.tissues import TISSUES, Images
from validation.oracles.elasticity import assemble, exact_field, factorise, refined

Field = npt.NDArray[Any]
#: Required true error of a solver, in pixels.
WITHIN = 3e-3
PRIOR = ElasticPrior(0.3)
# Solvers are timed three times if a solve takes less than this, in seconds.
_SHORT = 1.0
_MOST_ITERATIONS = 300
_MOST_DECADES = 14
#: Best of 18 settings that were tested at 257 x 257: symmetric strength with thresholds from 0 to
#: 0.08, and evolution; prolongators smoothed by Jacobi (filtered, by blocks, locally) or by energy;
#: relaxation by Gauss-Seidel (symmetric, or forward and backward) or Chebyshev.
SETTING: dict[str, Any] = {
    "strength": ("symmetric", {"theta": 0.03}),
    "smooth": ("jacobi", {"omega": 4 / 3, "weighting": "block"}),
    "presmoother": ("block_gauss_seidel", {"sweep": "forward"}),
    "postsmoother": ("block_gauss_seidel", {"sweep": "backward"}),
    "improve_candidates": None,
    "max_coarse": 300,
    "coarse_solver": "splu",
}


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
        Time from a problem to a field; the median of three runs if short.
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


def timed(run: Callable[[int], Run]) -> Run:
    """Run and measure, and repeat short runs; `run` receives the number of the run."""
    trim_memory()
    before = peak_megabytes(begin=True)
    seconds: list[float] = []
    found: Run | None = None
    for turn in range(3):
        started = time.perf_counter()
        latest = run(turn)
        took = time.perf_counter() - started
        # A run may report its own time, which excludes other work.
        seconds.append(took if math.isnan(latest.seconds) else latest.seconds)
        if found is None:
            found = replace(latest, megabytes=peak_megabytes() - before)
        if seconds[-1] >= _SHORT:
            break
    assert found is not None
    return replace(found, seconds=statistics.median(seconds))


def run_ours(images: Images, prior: ElasticPrior = PRIOR) -> Run:
    """Solve tissue that was not solved before by napari-hmrf at its default tolerance."""

    def run(turn: int) -> Run:
        _forget(prior)
        unit = np.float32(2**turn)
        problem = Problem(
            observed=images.observed,
            confidence=images.confidence,
            stiffness=images.stiffness * unit,
            spacing=images.spacing,
        )
        started = time.perf_counter()
        try:
            found = solve(problem, prior, optimizer=Multigrid(), backend="cpu")
        except ConvergenceError:
            took = time.perf_counter() - started
            return Run(None, fault="not converged", seconds=took)
        took = time.perf_counter() - started
        reported = math.nan if found.convergence is None else found.convergence.error
        return Run(found.displacement, found.iterations, "", reported, _how(found), took)

    _forget(prior)
    try:
        return timed(run)
    except ProblemError:
        return Run(None, fault="refused")


def _forget(prior: ElasticPrior) -> None:
    """Solve another tissue to invalidate the caches."""
    solve(phantom("bar", 24).problem, prior, optimizer=Multigrid(), backend="cpu")


def _how(found: Solution) -> str:
    """Return the method of a solution, or "" if it is unknown."""
    return str(getattr(found.convergence, "way", ""))


def run_superlu(images: Images) -> tuple[Run, Field]:
    """Solve by SuperLU in symmetric mode by minimum degree; also return the exact field."""
    kept: list[Any] = []

    def run(turn: int) -> Run:
        kept.clear()
        system = assemble(images, PRIOR)
        factor = factorise(system.matrix)
        solution = factor.solve(system.load)
        kept[:] = system, factor.solve, solution
        return Run(system.field(solution), 1)

    found = timed(run)
    return found, refined(images, PRIOR, *kept)


class _Enough(Exception):
    """Exception that stops the iteration because the error is small enough."""


class _Late(Exception):
    """Exception that stops the iteration because another solver would have finished."""


def has_pyamg() -> bool:
    """Return whether PyAMG is installed."""
    return importlib.util.find_spec("pyamg") is not None


def run_pyamg(images: Images, exact: Field, patience: float = math.inf) -> Run:
    """Solve by conjugate gradients and smoothed aggregation with the rigid-body modes.

    The iteration stops at the first of the relative residuals 0.1, 0.01, ... with a true error of
    at most `WITHIN`. It counts as late after `patience` seconds.
    """
    import pyamg

    def run(turn: int) -> Run:
        started = time.perf_counter()
        np.random.seed(2008)  # PyAMG estimates spectral radii from a random vector  # noqa: NPY002
        system = assemble(images, PRIOR)
        modes = rigid_body_modes(system)
        hierarchy = pyamg.smoothed_aggregation_solver(
            system.matrix, B=modes, symmetry="symmetric", **SETTING
        )
        residuals: list[float] = []
        decades, iterations = 0, 0
        latest = np.zeros_like(system.load)

        def look(solution: Field) -> None:
            nonlocal decades, iterations, latest
            iterations += 1
            latest = solution
            if time.perf_counter() - started > patience:
                raise _Late
            left = residuals[-1] / residuals[0]
            passed = math.floor(-math.log10(left)) if left > 0 else _MOST_DECADES
            if passed > decades:
                decades = passed
                if distance(system.field(solution), exact) <= WITHIN:
                    raise _Enough

        try:
            hierarchy.solve(
                system.load,
                tol=10.0**-_MOST_DECADES,
                maxiter=_MOST_ITERATIONS,
                accel="cg",
                callback=look,
                residuals=residuals,
            )
        except _Enough:
            return Run(system.field(latest), iterations, how=f"1e-{decades}")
        except _Late:
            return Run(system.field(latest), iterations, fault="later")
        return Run(system.field(latest), iterations, fault="fails")

    return timed(run)


def warm_up() -> None:
    """Import and compile all solvers; must be called first in a process."""
    one_heap()
    for contrast in (4.0, 1e6):
        images = TISSUES["noise-2"](33).images(contrast)
        run_ours(images)
        run_ours(images, ElasticPrior(0.499, plane="strain"))
        _, exact = run_superlu(images)
        if has_pyamg():
            run_pyamg(images, exact)


def stored_reference(images: Images, prior: ElasticPrior, folder: Path) -> Field:
    """Return the exact field, loaded from an earlier run if possible."""
    file = _file(images, prior, folder)
    if file.exists():
        return np.load(file)
    exact = exact_field(images, prior)
    store_reference(images, prior, folder, exact)
    return exact


def store_reference(images: Images, prior: ElasticPrior, folder: Path, exact: Field) -> None:
    """Store a reference for later runs, with an accuracy of a millionth of a pixel."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(_file(images, prior, folder), exact.astype(np.float32))


def _file(images: Images, prior: ElasticPrior, folder: Path) -> Path:
    return folder / f"{digest(images)[:16]}-{prior.poisson}-{prior.plane}.npy"


def digest(images: Images) -> str:
    """Return a digest that is equal for equal images."""
    parts = (images.observed, images.confidence, images.stiffness)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()
