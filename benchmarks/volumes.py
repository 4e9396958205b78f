"""Volumes: how long they take, beside PyAMG, and whether what is reported holds.

    python benchmarks/volumes.py [--sizes 64 128 192] [--memory 96] [--pyamg 48] [--random 300]

Prints the CPU seconds of one thread, set-up included, until no voxel is further than 0.01 from the
converged field. PyAMG (smoothed aggregation, rigid-body modes, conjugate gradients) takes as many
iterations as it takes to the same residual; its assembly counts. Then small volumes of every kind
are drawn at random and compared with a direct solve of a matrix that scikit-fem assembled; exits
with 1 if one is further from it than was reported.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
# Else glibc keeps what is freed of arrays up to 32 MiB; those of large volumes are larger.
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", "1000000")

import numpy as np
import numpy.typing as npt
import psutil
import scipy.sparse as sp
from random_volumes import TOLERANCE, judge
from volume_oracle import parameters

from napari_hmrf import ElasticPrior, Multigrid, Problem, Solution, solve
from napari_hmrf.solver.priors.elements import Lame
from napari_hmrf.solver.priors.hexahedra import brick_shape

_NAMES = {False: "cube, held at its faces", True: "ball, held at a cap"}


def growing(size: int, free: bool = False) -> Problem:
    """Tissue in which a ball grows: a cube that is held at its faces, or a ball at a cap."""
    places = np.moveaxis(np.indices((size, size, size)), 0, -1) * (2 / size) - 1
    from_middle = places - (0.15, 0.1, 0.0)
    r = np.linalg.norm(from_middle, axis=-1)
    skin = (r < 0.25) & (r > 0.25 - 3 / size)
    y, c = np.zeros((size, size, size, 3)), np.zeros((size, size, size, 3))
    y[skin], c[skin] = 0.12 * size * from_middle[skin], 1
    m = np.ones((size, size, size))
    far = np.linalg.norm(places, axis=-1)
    if free:
        m[far > 0.95] = 0
        c[(far > 0.9) & (places[..., 0] > 0.6)] = 1
    else:
        c[[0, -1]] = c[:, [0, -1]] = c[:, :, [0, -1]] = 1
    return Problem(y, c, m)


def timed(problem: Problem, poisson: float) -> tuple[Solution, float]:
    """A solution, and the CPU seconds it took."""
    begun = time.process_time()
    found = solve(problem, ElasticPrior(poisson), optimizer=Multigrid(TOLERANCE), backend="cpu")
    return found, time.process_time() - begun


def print_times(sizes: list[int]) -> None:
    """A table of cycles and seconds."""
    print("| tissue | voxels | Poisson's ratio | cycles | CPU s | ns a voxel |")
    print("| --- | --- | --- | --- | --- | --- |")
    for size in sizes:
        for free in (False, True):
            problem = growing(size, free)
            for poisson in (0.3, 0.45, 0.49):
                found, seconds = timed(problem, poisson)
                each = 1e9 * seconds / size**3
                cells = f"{size}^3 | {poisson} | {found.iterations} | {seconds:.2f} | {each:.0f}"
                print(f"| {_NAMES[free]} | {cells} |", flush=True)


def print_memory(size: int) -> None:
    """What a solve takes at most beside its problem, each in a process of its own."""
    print("| tissue | voxels | cycles | bytes a voxel | GiB in all |")
    print("| --- | --- | --- | --- | --- |")
    for name in _TISSUES:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            cycles, taken, whole = pool.submit(memory_of, name, size).result()
        cells = f"{size}^3 | {cycles} | {taken / size**3:.0f} | {whole / 2**30:.2f}"
        print(f"| {name} | {cells} |", flush=True)


def memory_of(name: str, size: int) -> tuple[int, int, int]:
    """How many cycles a tissue takes; what its solve takes at most, and the whole process."""
    timed(growing(16), 0.45)  # loads the loops
    problem = _TISSUES[name](size)
    gc.collect()
    process, done = psutil.Process(), threading.Event()
    before = most = process.memory_info().rss

    def watch() -> None:
        nonlocal most
        while not done.wait(0.002):
            most = max(most, process.memory_info().rss)

    watcher = threading.Thread(target=watch)
    watcher.start()
    found, _ = timed(problem, 0.45)
    done.set()
    watcher.join()
    return found.iterations, most - before, most


def squeezed_shell(size: int) -> Problem:
    """A thin shell, a million times as stiff as what is around, that floats between plates."""
    y, c = np.zeros((size, size, size, 3)), np.zeros((size, size, size, 3))
    c[[0, -1]], y[-1] = 1, (2.0, 1.0, -0.5)
    places = np.indices((size, size, size), dtype=np.float32) - (size - 1) / 2
    r = np.sqrt((places**2).sum(axis=0))
    return Problem(y, c, np.where((r < 0.4 * size) & (r > 0.4 * size - 3), 1e6, 1.0))


_TISSUES: dict[str, Callable[[int], Problem]] = {
    "cube, held at its faces": growing,
    "ball, held at a cap": partial(growing, free=True),
    "shell, a million times as stiff": squeezed_shell,
}


def print_pyamg(size: int) -> None:
    """How many times as long PyAMG takes."""
    try:
        import pyamg
    except ImportError:
        print("PyAMG is not installed")
        return
    problem, poisson = growing(size), 0.45
    found, ours = timed(problem, poisson)
    begun = time.process_time()
    matrix = stiffness_matrix(problem, poisson)
    known, field = problem.known.ravel(), problem.observed.ravel().astype(float)
    inside = matrix[~known]
    right = -inside[:, known] @ field[known]
    inner = inside[:, ~known].tobsr(blocksize=(3, 3))
    modes = rigid_motions(problem.shape)[~known]
    solver = pyamg.smoothed_aggregation_solver(inner, B=modes)
    path: list[float] = []
    field[~known] = solver.solve(right, tol=1e-4, accel="cg", residuals=path)
    theirs = time.process_time() - begun
    apart = np.abs(found.displacement.ravel() - field).max()
    print(
        f"PyAMG at {size}^3: {len(path) - 1} iterations, {theirs:.1f} s, {theirs / ours:.0f} times "
        f"as long; the fields differ by {apart:.4f} voxel at most"
    )


def stiffness_matrix(problem: Problem, poisson: float) -> sp.csr_matrix:
    """The sum of all elements' matrices, each of which is two of one element, weighted."""
    first, shear = (each.ravel() for each in parameters(problem, poisson))
    one, none = np.ones((1, 1, 1)), np.zeros((1, 1, 1))
    shape, corners = brick_shape(problem.spacing), np.eye(24).reshape(24, 2, 2, 2, 3)
    parts = [
        np.array([shape.forces(lame, corner).ravel() for corner in corners])
        for lame in (Lame(one, none), Lame(none, one))
    ]
    number = np.arange(problem.observed.size, dtype=np.int32).reshape(problem.observed.shape)
    windows = np.lib.stride_tricks.sliding_window_view(number, (2, 2, 2), axis=(0, 1, 2))
    at = np.moveaxis(windows, 3, -1).reshape(-1, 24)
    values = first[:, None, None] * parts[0] + shear[:, None, None] * parts[1]
    rows, columns = np.broadcast_to(at[..., None], values.shape), at[:, None].repeat(24, axis=1)
    entries = values.ravel(), (rows.ravel(), columns.ravel())
    return sp.coo_matrix(entries, shape=(number.size, number.size)).tocsr()


def rigid_motions(shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """The six of them, a column each."""
    places = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3) - np.array(shape) / 2
    moves = [np.broadcast_to(axis, places.shape) for axis in np.eye(3)]
    turns = [np.cross(axis, places) for axis in np.eye(3)]
    return np.stack([each.ravel() for each in (*moves, *turns)], axis=-1)


def main() -> int:
    """Print all; 1 if an answer is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=[64, 128])
    parser.add_argument("--memory", type=int, default=96, metavar="SIZE", help="0: not at all")
    parser.add_argument("--pyamg", type=int, default=48, metavar="SIZE", help="0: not at all")
    parser.add_argument("--random", type=int, default=300, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    timed(growing(16), 0.3)  # loads the loops
    print_times(asked.sizes)
    if asked.memory:
        print_memory(asked.memory)
    if asked.pyamg:
        print_pyamg(asked.pyamg)
    told, wrong = judge(range(asked.seed, asked.seed + asked.random))
    print(told)
    return min(1, wrong)


if __name__ == "__main__":
    sys.exit(main())
