"""Comparison of volumes with two heavy programs: MKL's direct solver and torch-fem.

`benchmarks/volumes.py --direct` and `--torch-fem` print these comparisons. The required packages
are the extra `rivals` in pyproject.toml.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Multigrid, Problem, Solution, solve
from napari_hmrf.extras import how_to_install
from validation.oracles.elasticity import direct_solution

_MISSING = f"is not installed: {how_to_install('rivals')}"
_OBLONG = (1.0, 1.7, 0.6)
# Ratio of the largest to the smallest stiffness, and tolerance in voxels.
_RATIO, _TOLERANCE = 1e4, 0.001
# PARDISO's type of a real symmetric positive definite matrix, given by its upper triangle.
_DEFINITE = 2
# Relative residual at which torch-fem's conjugate gradients stop by default.
_RESIDUAL = 1e-10
_POISSON = 0.3


def random_block(size: int, seed: int = 0) -> Problem:
    """Return oblong voxels of random stiffness, with void balls, between two plates."""
    draw = np.random.default_rng(seed)
    shape = (size,) * 3
    m = _RATIO ** draw.random(shape)
    sites = np.indices(shape)
    for _ in range(24):
        middle = draw.uniform(0.15, 0.85, 3) * size
        m[np.linalg.norm(sites - middle.reshape(3, 1, 1, 1), axis=0) < 0.08 * size] = 0
    y, c = np.zeros((2, *shape, 3))
    c[0] = c[-1] = 1
    y[-1] = np.array((2.0, 1.0, -0.6)) * _OBLONG
    return Problem(observed=y, confidence=c, stiffness=m, spacing=_OBLONG)


def print_direct(size: int, ratios: Sequence[float] = (0.3, 0.45, 0.49)) -> None:
    """Print distances to the solution of scikit-fem's matrix by PARDISO."""
    try:
        from pypardiso import PyPardisoSolver
    except ImportError:
        print(f"pypardiso {_MISSING}")
        return

    def by_pardiso(matrix: Any, right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        solver, upper = PyPardisoSolver(mtype=_DEFINITE), triangle(matrix)
        found = solver.solve(upper, right)
        solver.free_memory(everything=True)
        return np.asarray(found)

    problem = random_block(size)
    empty = 100 * float((problem.stiffness == 0).mean())
    print(
        f"{size}^3 voxels of {_OBLONG}, of random stiffness to 1 : {_RATIO:g}, {empty:.0f} % void"
    )
    print(
        "| Poisson's ratio | largest difference, voxels | reported error | cycles | s | direct, s |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for poisson in ratios:
        begun = time.perf_counter()
        found = solve(
            problem, ElasticPrior(poisson), optimizer=Multigrid(_TOLERANCE), backend="cpu"
        )
        between = time.perf_counter()
        expected = direct_solution(problem, ElasticPrior(poisson), solved=by_pardiso)
        ended = time.perf_counter()
        off = float(np.abs(found.displacement - expected).max()) / problem.unit
        assert found.convergence is not None
        cells = f"{off:.1e} | {found.convergence.error:.1e} | {found.iterations}"
        times = f"{between - begun:.1f} | {ended - between:.1f}"
        print(f"| {poisson} | {cells} | {times} |", flush=True)


def triangle(matrix: Any) -> Any:
    """Return the upper triangle of a matrix in the format of PARDISO."""
    import scipy.sparse as sp

    upper = sp.triu(matrix, format="csr")
    upper.sort_indices()
    return upper


def stretched_cube(nodes: int) -> Problem:
    """Return a uniform cube with one face fixed and the opposite face pulled and sheared."""
    shape = (nodes,) * 3
    y, c = np.zeros((2, *shape, 3))
    c[0] = c[-1] = 1
    y[-1] = (0.05 * nodes, 0.02 * nodes, 0.0)
    return Problem(observed=y, confidence=c, stiffness=np.ones(shape))


def residual(problem: Problem, d: npt.NDArray[np.floating]) -> float:
    """Return ||forces(d)|| / ||forces(d_0)|| at free components; d_0 is 0 there."""
    prior = ElasticPrior(_POISSON)
    first = np.where(problem.known, problem.observed, 0.0)
    norms = [
        float(np.linalg.norm(prior.forces(problem, each)[~problem.known]))
        for each in (d.astype(np.float64), first)
    ]
    return norms[0] / norms[1]


def print_torch_fem(nodes: int) -> None:
    """Print the times of a uniform cube, here and by torch-fem, for the same residual."""
    try:
        import torch
        import torchfem  # noqa: F401
    except ImportError:
        print(f"torch-fem {_MISSING}")
        return
    problem = stretched_cube(nodes)
    unknowns = int((~problem.known).sum())
    print(
        f"a uniform cube of {nodes}^3 nodes, {unknowns / 1e6:.2f} M unknowns, nu {_POISSON}, to a "
        f"residual of {_RESIDUAL:g}; {torch.get_num_threads()} threads for torch-fem"
    )
    small = stretched_cube(16)
    for size in (small, problem):  # the first loads the loops
        found, ours = to_residual(size)
    d = found.displacement
    print(f"ours: {found.iterations} cycles, {ours}, to {residual(problem, d):.1e}", flush=True)
    for preconditioner in ("amg", "jacobi"):
        for size in (small, problem):
            theirs, field = by_torch_fem(size, preconditioner)
        apart = float(np.abs(field - d).max())
        print(
            f"torch-fem, {preconditioner}: {theirs}, {theirs.cpu / ours.cpu:.0f} times our CPU "
            f"time; the fields differ by at most {apart:.1e} voxel, of {np.abs(d).max():.1f}",
            flush=True,
        )


class Seconds:
    """Timer of wall-clock time, which other processes affect, and CPU time of all cores."""

    def __init__(self) -> None:
        self._begun = time.perf_counter(), time.process_time()
        self.clock = self.cpu = 0.0

    def stop(self) -> Seconds:
        """Stop the timer."""
        self.clock = time.perf_counter() - self._begun[0]
        self.cpu = time.process_time() - self._begun[1]
        return self

    def __str__(self) -> str:
        """Return both times as text."""
        return f"{self.clock:.1f} s, {self.cpu:.1f} of CPU"


def to_residual(problem: Problem) -> tuple[Solution, Seconds]:
    """Return the first solution with at most torch-fem's residual, and its time.

    The tolerance is divided by ten until the residual is small enough.
    """
    for power in range(5, 14):
        seconds = Seconds()
        found = solve(
            problem, ElasticPrior(_POISSON), optimizer=Multigrid(10.0**-power), backend="cpu"
        )
        seconds.stop()
        if residual(problem, found.displacement) <= _RESIDUAL:
            break
    return found, seconds


def by_torch_fem(problem: Problem, preconditioner: str) -> tuple[Seconds, npt.NDArray[np.float64]]:
    """Return the time of torch-fem, including its set-up, and its field."""
    import torch
    from torchfem import Solid
    from torchfem.materials import IsotropicElasticity3D
    from torchfem.mesh import cube_hexa

    torch.set_default_dtype(torch.float64)
    seconds = Seconds()
    lengths = [size - 1.0 for size in problem.shape]
    nodes, elements = cube_hexa(*problem.shape, *lengths)
    model = Solid(nodes, elements, IsotropicElasticity3D(E=1.0, nu=_POISSON))
    model.constraints = torch.tensor(problem.known.reshape(-1, 3))
    model.displacements = torch.tensor(problem.observed.reshape(-1, 3).astype(np.float64))
    found, *_ = model.solve(method="cg", preconditioner=preconditioner, stol=_RESIDUAL)
    return seconds.stop(), found.numpy().reshape(*problem.shape, 3)
