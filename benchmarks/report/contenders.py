"""Solvers that are compared, each in a separate process.

    python -m report.contenders NAME SIZE REPEATS REFERENCE

A process runs one solver at one size, so that its memory can be measured. It warms up on a small
image, times `REPEATS` solves from a `Problem` to a displacement, and prints one line of JSON.
"""

from __future__ import annotations

import importlib.util
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse.linalg import spsolve

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from napari_hmrf.data import phantom
from report.memory import peak_megabytes, peak_of_programs
from validation.oracles import calculix
from validation.oracles.elasticity import System, assemble
from validation.oracles.elasticity import direct_solution as solve_directly

Field = npt.NDArray[Any]
#: Definition of "converged": largest distance of any site from the converged field, in pixels.
WITHIN = 0.01
PHANTOM = "mass-effect"
PRIOR = ElasticPrior()
WARM_UP_SIZE = 64


@dataclass(frozen=True)
class Measured:
    """Result of one solver at one size.

    Attributes
    ----------
    seconds : float
        Median wall time of a solve, from a `Problem` to its displacement.
    megabytes : float
        Peak memory of the process during the solves minus its memory before.
    error : float
        Largest distance of a site from the converged field, in pixels.
    iterations : int
        Number of iterations.
    """

    seconds: float
    megabytes: float
    error: float
    iterations: int


def run_multigrid(problem: Problem, iterations: int, backend: str) -> tuple[Field, int]:
    """Solve by napari-hmrf, to `WITHIN` by its own error estimate."""
    found = solve(problem, PRIOR, optimizer=Multigrid(tolerance=WITHIN), backend=backend)
    return found.displacement, found.iterations


def run_superlu(problem: Problem, iterations: int, tuned: bool) -> tuple[Field, int]:
    """Solve by SuperLU as called by `spsolve`, or in symmetric mode if `tuned`."""
    if tuned:
        return solve_directly(problem, PRIOR), 1
    system = assemble(problem, PRIOR)
    return system.field(spsolve(system.matrix.tocsc(), system.load)), 1


def run_calculix(problem: Problem, iterations: int) -> tuple[Field, int]:
    """Solve textbook plane stress by CalculiX, including writing the deck and reading results."""
    return calculix.textbook_plane_stress(problem, float(PRIOR.poisson)), 1


def run_pyamg(problem: Problem, iterations: int, tuned: bool) -> tuple[Field, int]:
    """Solve by conjugate gradients and smoothed aggregation with the rigid-body modes."""
    system = assemble(problem, PRIOR)
    field = system.field(solve_by_pyamg(system, iterations, tuned, None))
    return field, iterations


def solve_by_pyamg(
    system: System,
    iterations: int,
    tuned: bool,
    start: Field | None,
    each: Callable[[Field], None] | None = None,
    tolerance: float = 1e-14,
) -> Field:
    """Set up PyAMG and solve; `each` is called with every iterate."""
    import pyamg

    # Tuned: do not relax the rigid-body modes, which are already correct. This saves set-up time.
    options = {"improve_candidates": None} if tuned else {}
    hierarchy = pyamg.smoothed_aggregation_solver(
        system.matrix, B=rigid_body_modes(system), symmetry="symmetric", **options
    )
    found: Field = hierarchy.solve(
        system.load, x0=start, tol=tolerance, maxiter=iterations, accel="cg", callback=each
    )
    return found


def rigid_body_modes(system: System) -> Field:
    """Return two translations and the rotation as columns, (unknowns, 3)."""
    places = np.argwhere(system.free).astype(np.float64)
    places -= places.mean(axis=0)
    modes = np.zeros((2 * len(places), 3))
    modes[0::2, 0] = modes[1::2, 1] = 1
    modes[0::2, 2], modes[1::2, 2] = -places[:, 1], places[:, 0]
    modes[:, 2] /= np.abs(modes[:, 2]).max()
    return modes


def pyamg_iterations(problem: Problem, reference: Field, tuned: bool) -> int:
    """Return the number of iterations until no site is further than `WITHIN` from `reference`."""
    system = assemble(problem, PRIOR)
    expected = reference[system.free]
    off: list[float] = []
    for limit in (12, 100):
        off.clear()
        solve_by_pyamg(
            system,
            limit,
            tuned,
            None,
            lambda found: off.append(float(np.abs(found.reshape(-1, 2) - expected).max())),
        )
        near = [number for number, each in enumerate(off, 1) if each <= WITHIN]
        if near:
            return near[0]
    raise RuntimeError(f"PyAMG is still {min(off):.2g} px away after {len(off)} iterations")


#: Title in the report, and function that solves, by name.
SOLVERS: dict[str, tuple[str, Callable[..., tuple[Field, int]]]] = {
    "cpu": ("Multigrid, compiled loops", lambda p, k: run_multigrid(p, k, "cpu")),
    "cpu-again": ("the same, tissue as before", lambda p, k: run_multigrid(p, k, "cpu")),
    "opengl": ("Multigrid, shaders", lambda p, k: run_multigrid(p, k, "opengl")),
    "pyamg": ("PyAMG, its defaults", lambda p, k: run_pyamg(p, k, tuned=False)),
    "pyamg-tuned": ("PyAMG, tuned", lambda p, k: run_pyamg(p, k, tuned=True)),
    "superlu": ("SciPy SuperLU, its defaults", lambda p, k: run_superlu(p, k, tuned=False)),
    "superlu-tuned": ("SciPy SuperLU, tuned", lambda p, k: run_superlu(p, k, tuned=True)),
    "calculix": ("CalculiX", run_calculix),
}


def is_there(name: str) -> bool:
    """Return whether the required package of a solver is installed."""
    if name.startswith("pyamg"):
        return importlib.util.find_spec("pyamg") is not None
    return name != "calculix" or calculix.is_there()


def measure(name: str, size: int, repeats: int, reference: Path) -> Measured:
    """Run a solver in a new process; `reference` is a .npy file with the converged field.

    Raises
    ------
    RuntimeError
        If the process fails; the message is the last line of its error output.
    """
    command = [sys.executable, "-m", "report.contenders", name, str(size), str(repeats)]
    # PyAMG is faster without threads in dense kernels.
    environment = {**os.environ, **({"OPENBLAS_NUM_THREADS": "1"} if "pyamg" in name else {})}
    done = subprocess.run(
        [*command, str(reference)],
        cwd=Path(__file__).parent.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError((done.stderr.strip() or "no message").splitlines()[-1])
    return Measured(**json.loads(done.stdout.splitlines()[-1]))


def main(name: str, size: int, repeats: int, reference_file: str) -> Measured:
    """Measure a solver in this process."""
    _, run = SOLVERS[name]
    reference = np.load(reference_file)
    problem = phantom(PHANTOM, size).problem
    iterations = 3
    for _ in range(3 if repeats > 3 else 1):
        run(phantom(PHANTOM, WARM_UP_SIZE).problem, iterations)
    if name.startswith("pyamg"):
        iterations = pyamg_iterations(problem, reference, tuned=name.endswith("tuned"))
    # The same tissue in another unit of stiffness, so that no earlier set-up can be reused.
    turns = 3 + repeats if repeats > 3 else repeats  # the first solves are slower
    before = peak_megabytes(begin=True)
    seconds = []
    for turn in range(turns):
        unit = 1 if name.endswith("again") else 1 + turn
        again = Problem(
            observed=problem.observed,
            confidence=problem.confidence,
            stiffness=problem.stiffness * unit,
            spacing=problem.spacing,
        )
        started = time.perf_counter()
        field, taken = run(again, iterations)
        seconds.append(time.perf_counter() - started)
    seconds = seconds[-repeats:]
    added = peak_megabytes() - before
    if name == "calculix":
        added = peak_of_programs()
    off = float(np.abs(field - reference)[problem.tissue].max())
    return Measured(statistics.median(seconds), added, off, taken)


if __name__ == "__main__":
    print(json.dumps(asdict(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]))))
