"""Comparison of multigrid with rediscretized coarse levels and with Galerkin coarse operators.

    python benchmarks/coarse_operators.py [--sizes 75 150 300]

Galerkin's coarse matrix P' A P represents constraints and jumps of stiffness exactly. However, it
must be stored as a matrix, with nine blocks of 2 x 2 per site instead of two numbers, and must be
recomputed when the constraints change. Both variants use the same transfer, smoother and iteration
in double precision. The table lists the number of cycles until the relative residual is 1e-6, and
the time required to compute the matrices.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.coarse_levels import COARSEST, smoother_bounds
from napari_hmrf.solver.optimizers.cycle import STRETCHING, chebyshev
from validation.oracles.elasticity import assemble

_FALL = 1e-6


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[75, 150, 300])
    options = parser.parse_args(arguments)
    prior = ElasticPrior(0.45)
    header = f"{'phantom':14}{'size':>6}{'Galerkin':>10}{'its set-up':>12}{'same model':>12}"
    print(header + f"{'its solve':>12}")
    for name in ("expansion", "mass-effect"):
        for size in options.sizes:
            problem = phantom(name, size).problem
            cycles, seconds = galerkin(problem, prior)
            solve(problem, prior, backend="cpu")
            solution = solve(problem, prior, optimizer=Multigrid(1e-3), backend="cpu")
            print(
                f"{name:14}{size:6}{cycles:10}{1000 * seconds:9.0f} ms"
                f"{same_model(problem, prior):12}{1000 * solution.provenance.seconds:9.0f} ms",
                flush=True,
            )


def galerkin(problem: Problem, prior: ElasticPrior) -> tuple[int, float]:
    """Return the number of cycles with Galerkin operators, and the set-up time in seconds."""
    matrix, right = reduced_system(problem, prior)
    moves = matrix.diagonal() > 0
    started = time.perf_counter()
    matrices, transfers = [matrix], []
    grid = problem.shape
    while max(grid) > COARSEST:
        coarse = tuple(size // 2 + 1 for size in grid)
        transfer = sp.kron(
            sp.kron(_linear(grid[0], coarse[0]), _linear(grid[1], coarse[1])), sp.eye(2), "csr"
        )
        if len(matrices) == 1:
            transfer = sp.diags_array(moves.astype(float)) @ transfer
        transfers.append(transfer)
        matrices.append(sp.csr_array(transfer.T @ matrices[-1] @ transfer))
        grid = coarse
    seconds = time.perf_counter() - started
    usual, _ = smoother_bounds(prior.material(problem))
    part, sweeps, coarsest_part, coarsest_sweeps, visits = STRETCHING[:5]
    inverses = [_inverse(each.diagonal()) for each in matrices]
    smoothers = []
    for number, (each, inverse) in enumerate(zip(matrices, inverses, strict=True)):
        # A smoother amplifies eigenvalues above its bound, so each matrix gets a valid bound.
        bound = max(usual, _largest_eigenvalue(each, inverse))
        last = number == len(transfers)
        low, steps = (coarsest_part, coarsest_sweeps) if last else (part, sweeps)
        smoothers.append(chebyshev(low * bound, bound, steps))

    def cycle(load: np.ndarray, number: int = 0) -> np.ndarray:
        last = number == len(transfers)
        inner, matrix, inverse = smoothers[number], matrices[number], inverses[number]
        d = np.zeros_like(load)
        for _ in range(visits if number == 1 else 1):
            d = _smoothed(matrix, inverse, load, d, inner)
            if not last:
                rest = transfers[number].T @ (load - matrix @ d)
                d = d + transfers[number] @ cycle(rest, number + 1)
                d = _smoothed(matrix, inverse, load, d, inner)
        return d

    return _conjugate_gradients(matrix, right, cycle), seconds


def same_model(problem: Problem, prior: ElasticPrior) -> int:
    """Return the number of cycles of the package's V-cycle for the same criterion."""
    from napari_hmrf.solver.backends import host
    from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
    from napari_hmrf.solver.optimizers.cycle import Cycle

    matrix, right = reduced_system(problem, prior)
    model = CpuElasticModel(prior.material(problem))
    model.hold(host.prescribed(problem)[1])
    own = Cycle(model)

    def cycle(load: np.ndarray) -> np.ndarray:
        scale = np.abs(load).max()
        planes = host.planes(load.reshape(*problem.shape, 2) / scale).astype(np.float32)
        return scale * host.field(own.run(planes)).ravel().astype(float)

    return _conjugate_gradients(matrix, right, cycle)


def reduced_system(problem: Problem, prior: ElasticPrior) -> tuple[sp.csr_array, np.ndarray]:
    """Return the stiffness matrix, with zero rows and columns at fixed components, and the load."""
    system = assemble(problem, prior)
    held = (problem.confidence > 0) & problem.tissue[..., None]
    site = np.flatnonzero(system.free)
    place = np.stack([2 * site, 2 * site + 1], axis=-1).ravel()
    moves = ~held.ravel()[place]
    shape = (2 * system.free.size, len(place))
    spread = sp.csr_array((moves.astype(float), (place, np.arange(len(place)))), shape=shape)
    return sp.csr_array(spread @ system.matrix @ spread.T), spread @ system.load


def _linear(fine: int, coarse: int) -> sp.csr_array:
    """Return linear interpolation along an axis; coarse site i coincides with fine site 2 i."""
    at = np.arange(fine)
    rows = np.concatenate([at, at])
    columns = np.concatenate([at // 2, at // 2 + at % 2])
    values = np.full(2 * fine, 0.5)
    return sp.csr_array((values, (rows, columns)), shape=(fine, coarse))


def _largest_eigenvalue(matrix: sp.csr_array, inverse: np.ndarray) -> float:
    """Estimate the largest eigenvalue of D^-1 A by twenty steps of the power method, plus 5 %."""
    values = np.random.default_rng(1).normal(size=len(inverse))
    for _ in range(20):
        values = inverse * (matrix @ values)
        size = float(np.linalg.norm(values))
        values /= size
    return 1.05 * size


def _inverse(diagonal: np.ndarray) -> np.ndarray:
    return np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 1e-12)


def _smoothed(matrix, inverse, load, d, steps):  # type: ignore[no-untyped-def]
    step = np.zeros_like(d)
    for scale, momentum in steps:
        step = scale * inverse * (load - matrix @ d) + momentum * step
        d = d + step
    return d


def _conjugate_gradients(matrix, right, cycle):  # type: ignore[no-untyped-def]
    rest, direction, before = right.copy(), np.zeros_like(right), np.inf
    for cycles in range(1, 200):
        steepest = cycle(rest)
        slope = steepest @ rest
        direction = steepest + slope / before * direction
        image = matrix @ direction
        rest = rest - slope / (direction @ image) * image
        before = slope
        if np.linalg.norm(rest) <= _FALL * np.linalg.norm(right):
            return cycles
    return cycles


if __name__ == "__main__":
    main()
