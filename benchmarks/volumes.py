"""Elastic volumes: cycles, processor time and memory a voxel, and PyAMG beside them.

    python benchmarks/volumes.py [--sizes 32 48 64] [--poisson 0.3 0.45 0.49] [--turns 2]
                                 [--rival 48] [--head 64]

The volumes are cubes of three tissues (10, 20 and 40) between two plates of which one moves; their
other sides are held or free. Seconds are of the processor, all threads together, set-up included
and the best of some turns; a turn before the first loads the loops. With --rival PyAMG solves the
cube of that size, too (smoothed aggregation with the six rigid motions, conjugate gradients, its
assembly included), until it is as near as we are asked to be. With --head the head phantom is
solved and its image moved.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from napari_hmrf import ElasticPrior, Multigrid, Problem, Solution, head_phantom, solve, warp

#: How near the field is asked for, in voxels.
NEAR = 0.01
_HEADER = (
    f"{'n':>4} {'nu':>5} {'sides':>6} {'cycles':>6} {'CPU s':>8} {'ns/voxel':>9} {'reported':>9}"
)


def cube(size: int, held: bool = True) -> Problem:
    """Two balls in a cube; the lowest plane is held, and the highest moves by a tenth down.

    Parameters
    ----------
    size : int
    held : bool
        Whether the other sides are.
    """
    places = np.indices((size,) * 3) / (size - 1)
    m = np.full((size,) * 3, 20.0)
    for middle, radius, stiffness in (((0.4, 0.35, 0.5), 0.2, 40.0), ((0.6, 0.7, 0.4), 0.15, 10.0)):
        away = places - np.reshape(middle, (3, 1, 1, 1))
        m[(away**2).sum(axis=0) < radius**2] = stiffness
    y, c = np.zeros((*m.shape, 3)), np.zeros((*m.shape, 3))
    for axis in range(3 if held else 1):
        for side in (0, -1):
            c[(slice(None),) * axis + (side,)] = 1
    y[-1, ..., 0] = -0.1 * size
    if held:  # what is at the sides goes along
        y[..., 0] = np.where(c[..., 0] > 0, -0.1 * size * places[0], 0)
    return Problem(y, c, m)


def least(work: Callable[[], Any], turns: int) -> tuple[float, Any]:
    """Do work some times; the least processor time it took, and what it returned last."""
    seconds = []
    for _ in range(turns):
        start = time.process_time()
        found = work()
        seconds.append(time.process_time() - start)
    return min(seconds), found


def ours(problem: Problem, poisson: float) -> Solution:
    """Solve a cube."""
    return solve(problem, ElasticPrior(poisson), optimizer=Multigrid(NEAR), backend="cpu")


def assemble(problem: Problem, poisson: float) -> sp.bsr_matrix:
    """The stiffness matrix of hexahedra whose changes of volume count at their middle.

    Independent of the package: of each pair of corners a block, 3 x 3, of all elements at once.
    """
    m = problem.stiffness.astype(float)
    corners = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    cells = tuple(size - 1 for size in m.shape)

    def at(corner: tuple[int, ...]) -> tuple[slice, ...]:
        return tuple(slice(side, side + count) for side, count in zip(corner, cells, strict=True))

    young = np.mean([m[at(corner)] for corner in corners], axis=0).ravel()
    element = _element(poisson, problem.spacing, corners)
    number = np.arange(m.size).reshape(m.shape)
    sites = [number[at(corner)].ravel() for corner in corners]
    rows, cols, blocks = [], [], []
    for one, block_row in zip(sites, element, strict=True):
        for other, block in zip(sites, block_row, strict=True):
            rows.append(one)
            cols.append(other)
            blocks.append(young[:, None, None] * block)
    place = sp.coo_matrix(
        (np.arange(64 * young.size), (np.concatenate(rows), np.concatenate(cols)))
    )
    order = np.lexsort((place.col, place.row))
    row, col = place.row[order], place.col[order]
    first = np.flatnonzero(np.diff(row, prepend=-1) | np.diff(col, prepend=-1))
    data = np.add.reduceat(np.concatenate(blocks)[order], first, axis=0)
    counts = np.bincount(row[first], minlength=m.size)
    pointers = np.concatenate([[0], np.cumsum(counts)])
    return sp.bsr_matrix((data, col[first], pointers), shape=(3 * m.size,) * 2)


def _element(
    poisson: float, spacing: Sequence[float], corners: list[tuple[int, int, int]]
) -> npt.NDArray[np.float64]:
    """Blocks of an element of modulus 1, shape (8, 8, 3, 3)."""
    lam, mu = poisson / ((1 + poisson) * (1 - 2 * poisson)), 1 / (2 * (1 + poisson))
    step, signs = np.array(spacing, float), 2.0 * np.array(corners) - 1
    block = np.zeros((8, 8, 3, 3))

    def slopes(place: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The gradients of the eight shape functions, (8, 3)."""
        parts = (1 + signs * place) / 2
        others = np.stack([np.delete(parts, axis, axis=1).prod(axis=1) for axis in range(3)], -1)
        return signs / step * others

    gauss = [np.array(p) / np.sqrt(3) for p in 2.0 * np.array(corners) - 1]
    for place, first, weight in [(g, mu, 1 / 8) for g in gauss] + [(np.zeros(3), None, 1.0)]:
        g = slopes(place)
        volume = weight * step.prod()
        if first is None:
            block += lam * volume * np.einsum("ai,bj->abij", g, g)
        else:
            block += mu * volume * np.einsum("ai,bi,jk->abjk", g, g, np.eye(3))
            block += mu * volume * np.einsum("aj,bi->abij", g, g)
    return block


def rival(problem: Problem, poisson: float, exact: npt.NDArray[np.floating]) -> tuple[int, float]:
    """Solve a cube by PyAMG until it is near enough; iterations, and the largest error."""
    import pyamg

    matrix = assemble(problem, poisson).tocsr()
    known = np.asarray(problem.known).ravel()
    field = np.where(problem.known, problem.observed, 0).astype(float).ravel()
    free = np.flatnonzero(~known)
    right = -(matrix[free] @ field)
    inner = matrix[free][:, free]
    places = np.stack(np.meshgrid(*map(np.arange, problem.shape), indexing="ij"), -1)
    places = places.reshape(-1, 3) * problem.spacing
    motions = np.zeros((len(places), 3, 6))
    motions[:, range(3), range(3)] = 1
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        motions[:, one, 3 + axis], motions[:, other, 3 + axis] = -places[:, other], places[:, one]
    # Sites are held in all components or in none, so that blocks stay whole.
    hierarchy = pyamg.smoothed_aggregation_solver(
        inner.tobsr((3, 3)), B=motions.reshape(-1, 6)[free], max_coarse=500
    )
    residuals: list[float] = []
    tolerance = 1e-2
    while True:
        field[free] = hierarchy.solve(right, tol=tolerance, accel="cg", residuals=residuals)
        away = float(np.abs(field.reshape(exact.shape) - exact).max())
        if away < NEAR or tolerance < 1e-9:
            return len(residuals) - 1, away
        tolerance /= 10
        residuals.clear()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=(32, 48, 64))
    parser.add_argument("--poisson", type=float, nargs="*", default=(0.3, 0.45, 0.49))
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--rival", type=int, help="the size of the cube that PyAMG solves, too")
    parser.add_argument("--head", type=int, help="solve the head phantom of that size")
    options = parser.parse_args()
    ours(cube(12), 0.45)
    print(_HEADER)
    for size in options.sizes:
        for poisson in options.poisson:
            for held in (True, False):
                problem = cube(size, held)
                seconds, found = least(lambda p=problem, nu=poisson: ours(p, nu), options.turns)
                print(
                    f"{size:4} {poisson:5} {'held' if held else 'free':>6} {found.iterations:6} "
                    f"{seconds:8.2f} {1e9 * seconds / size**3:9.0f} "
                    f"{found.convergence.error:9.1g}",
                    flush=True,
                )
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    largest = max(options.sizes, default=0)
    print(f"peak memory of the process {peak / 1e6:.0f} MB, the largest cube {largest}^3")
    if options.rival:
        problem = cube(options.rival)
        exact = solve(problem, ElasticPrior(0.45), optimizer=Multigrid(1e-4)).displacement
        seconds, found = least(lambda: ours(problem, 0.45), options.turns)
        others, (iterations, away) = least(lambda: rival(problem, 0.45, exact), 1)
        print(
            f"{options.rival}^3, nu 0.45: ours {seconds:.2f} s ({found.iterations} cycles), PyAMG "
            f"{others:.1f} s ({iterations} iterations, {away:.1g} voxel off): "
            f"{others / seconds:.0f} times"
        )
    if options.head:
        head = head_phantom(options.head)
        problem = head.problem
        seconds, found = least(lambda: ours(problem, 0.45), options.turns)
        field = {"spacing": head.spacing, "tissue": found.tissue}
        warp(head.image[:4, :4, :4], found.displacement[:4, :4, :4], spacing=head.spacing)
        moving, _ = least(lambda: warp(head.image, found.displacement, **field), options.turns)
        shape = " x ".join(map(str, head.image.shape))
        print(f"head, {shape}: {found.iterations} cycles, {seconds:.2f} s; moved in {moving:.2f} s")


if __name__ == "__main__":
    main()
