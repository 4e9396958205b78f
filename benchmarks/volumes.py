"""Volumes: how long they take, beside PyAMG, and whether what is reported holds.

    python benchmarks/volumes.py [--sizes 64 128] [--pyamg 48] [--head 190]
        [--random 300] [--seed 0]

Prints the CPU seconds of one thread, set-up included, until no voxel is further than 0.01 from the
converged field. PyAMG (smoothed aggregation, rigid-body modes, conjugate gradients) takes as many
iterations as it takes to the same residual; its assembly counts. Then small volumes of every kind
are drawn at random and compared with a direct solve of a matrix that scikit-fem assembled; exits
with 1 if one is further from it than was reported. Between these it prints how long one slice of a
volume that moves takes to draw; and, as parts of the time that a head at 1 mm takes to solve, how
long it takes to move, and to say where it folds.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("NAPARI_HMRF_COMPILE", "here")

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from volume_oracle import direct_solution, parameters

from napari_hmrf import ElasticPrior, Multigrid, Problem, Solution, Warper, head_phantom, solve
from napari_hmrf.errors import ConvergenceError, ProblemError
from napari_hmrf.field.deformation import arrows_apart, smallest_determinant
from napari_hmrf.field.resample import resample
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.priors.elements import Lame
from napari_hmrf.solver.priors.hexahedra import brick_shape

TOLERANCE = 0.01
# What is stored in single precision is rounded.
_ROUNDED = 1e-6
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


def print_slices(shape: tuple[int, int, int] = (180, 220, 180)) -> None:
    """How long the middle slice of an ellipsoid takes whose motion is known finely, or coarsely."""
    places = np.moveaxis(np.indices(shape, dtype=np.float32), 0, -1) / np.float32(shape) * 2 - 1
    tissue = np.asarray((places**2).sum(axis=-1) < 0.9)
    hill = np.cos(np.float32(np.pi / 2) * places).prod(axis=-1)[..., None]
    image = places[..., 0] + places[..., 1]
    warper = Warper(image, spacing=(1.0, 1.0, 1.0))
    for far in (8, 20):
        motion = far * hill * np.float32((1, -1, 0.5))
        for every in (1, 2):
            coarse = np.ascontiguousarray(motion[::every, ::every, ::every])

            def seconds(motion: Any = coarse, every: int = every) -> float:
                begun = time.process_time()
                warper.slice(shape[0] // 2, motion, tissue, every=every)
                return time.process_time() - begun

            times = [compute_thread.submit(seconds).result() for _ in range(6)][1:]
            known = "every voxel" if every == 1 else f"every {every}nd voxel"
            print(
                f"a slice of {' x '.join(map(str, shape))} that moves by up to {far} voxels, known "
                f"at {known}: {1e3 * float(np.median(times)):.0f} ms of CPU",
                flush=True,
            )


def print_motion(size: int) -> None:
    """What is done with the motion of a head, as parts of the time its solve takes."""
    head = head_phantom(size)
    found, solving = min((timed(head.problem, 0.45) for _ in range(2)), key=lambda each: each[1])
    field = (found.displacement, found.spacing, found.tissue)
    warper = Warper(head.image, spacing=found.spacing)

    def layers() -> None:
        smallest_determinant(*field)
        origin, covered, _ = inverse_map_and_overlaps(*field)
        resample(head.image, origin, covered)
        arrows_apart(field[0], spacing=field[1], tissue=field[2], about=250)

    tasks: dict[str, Callable[[], Any]] = {
        "the warp": lambda: warper(found.displacement, found.tissue),
        "the smallest determinants": lambda: smallest_determinant(*field),
        "all that a result's layers take": layers,
    }
    shape = " x ".join(map(str, head.image.shape))
    sites = int(found.tissue.sum())
    print(f"a head of {shape} voxels, {sites:,} of them tissue: {solving:.2f} s of CPU to solve")
    for name, task in tasks.items():

        def seconds(task: Callable[[], Any] = task) -> float:
            begun = time.process_time()
            task()
            return time.process_time() - begun

        least = min(compute_thread.submit(seconds).result() for _ in range(4))
        print(f"{name}: {least:.2f} s, {least / solving:.2f} of that", flush=True)


def random_volume(seed: int) -> tuple[Any, ...]:
    """What a problem is made of, its spacing, and Poisson's ratio."""
    draw = np.random.default_rng(seed)
    shape = tuple(draw.integers(2, 14, 3))
    size, ratio = draw.integers(1, 5), 10 ** draw.choice([0, 0.3, 0.7, 1, 2, 3, 4, 5, 6])
    coarse = draw.random(tuple(-(-extent // size) for extent in shape))
    blobs = np.kron(coarse, np.ones((size, size, size)))[tuple(map(slice, shape))]
    m = np.where(blobs > draw.uniform(0, 0.7), ratio, 1.0) if draw.random() < 0.5 else ratio**blobs
    if draw.random() < 0.5:
        m[blobs < draw.uniform(0, 0.3)] = 0
    held = draw.random(shape) < draw.choice([0.002, 0.02, 0.2])
    held[[0, -1][: draw.integers(3)]] = True
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    c[held] = 1
    y[held] = draw.normal(size=3) + draw.integers(2) * draw.normal(size=(held.sum(), 3)) / 2
    spacing = (1.0, 1.0, 1.0) if draw.random() < 0.5 else tuple(draw.uniform(0.5, 2, 3))
    poisson = draw.choice([0, 0.3, 0.45, 0.49, 0.499])
    each = (draw.random(shape) * 0.499).astype(np.float32)
    return y * spacing, c, m, spacing, each if draw.random() < 0.2 else float(poisson)


def wrong_of(seeds: range) -> int:
    """How many random volumes are further from the direct solution than was reported."""
    became: Counter[str] = Counter()
    for seed in seeds:
        y, c, m, spacing, poisson = random_volume(seed)
        try:
            problem = Problem(y, c, m, spacing=spacing)
            found, _ = timed(problem, poisson)
        except ProblemError:
            became["have no one answer"] += 1
            continue
        except ConvergenceError:
            became["are refused, as cycles cannot be sure"] += 1
            continue
        apart = np.abs(found.displacement - direct_solution(problem, poisson)).max() / problem.unit
        assert found.convergence is not None
        right = apart <= found.convergence.error + _ROUNDED
        became["are right" if right else "are WRONG"] += 1
        if not right:
            print(f"volume {seed}: {apart:.2g}, reported {found.convergence.error:.2g}", flush=True)
    print(f"of {len(seeds)} random volumes", ", ".join(f"{n} {what}" for what, n in became.items()))
    return became["are WRONG"]


def main() -> int:
    """Print all; 1 if an answer is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=[64, 128])
    parser.add_argument("--pyamg", type=int, default=48, metavar="SIZE", help="0: not at all")
    parser.add_argument("--head", type=int, default=190, metavar="SIZE", help="0: not at all")
    parser.add_argument("--random", type=int, default=300, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    timed(growing(16), 0.3)  # loads the loops
    print_times(asked.sizes)
    if asked.pyamg:
        print_pyamg(asked.pyamg)
    print_slices()
    if asked.head:
        print_motion(asked.head)
    return min(1, wrong_of(range(asked.seed, asked.seed + asked.random)))


if __name__ == "__main__":
    sys.exit(main())
