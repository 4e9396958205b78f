"""Benchmark of volumes: time, comparison with PyAMG, and check of the reported errors.

    python benchmarks/volumes.py [--sizes 64 128 192] [--memory 96] [--pyamg 48] [--paper 48]
    python benchmarks/volumes.py --direct 48
    python benchmarks/volumes.py --torch-fem 80

Prints the CPU time of one thread, including set-up, until every voxel is within 0.01 voxel of the
converged field. PyAMG (smoothed aggregation, rigid-body modes, conjugate gradients) iterates until
it has the same residual; its time includes assembly. Our time is the median of ten solves, five
before and five after it; with NUMBA_NUM_THREADS=2, our wall-clock time is that of two cores. For
the paper's model, the time and the distance to finite elements are printed. For a moving volume,
the time to draw one slice is printed, and the times to warp a head of 1 mm voxels and to locate its
folds, relative to the time of its solve. Finally, random small volumes of every kind are compared
with a direct solve of a matrix with elements by scikit-fem, or of that of the paper's model. Exits
with 1 if a distance exceeds the reported error.

With --direct, prints the distance of volumes of random stiffness to the solution of scikit-fem's
matrix by MKL's PARDISO. With --torch-fem, prints the time of a uniform cube compared with
torch-fem. The packages of these two comparisons are too heavy for the other extras:
`pip install -e ".[rivals]"`. Both comparisons run on all cores.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

if not {"--direct", "--torch-fem"} & {*sys.argv}:
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("NAPARI_HMRF_COMPILE", "here")
# Otherwise glibc may retain freed arrays of up to 32 MiB; arrays of large volumes are larger.
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", "1000000")

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from random_volumes import TOLERANCE, judge
from report.memory import added_by
from volume_rivals import print_direct, print_torch_fem

from napari_hmrf import ICM, ElasticPrior, Multigrid, Problem, SeilerPrior, Solution, solve
from napari_hmrf.data import head_phantom
from napari_hmrf.field.deformation import arrows_apart, smallest_determinant
from napari_hmrf.field.resample import resample
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.fields import Warper
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.priors.elements import Lame
from napari_hmrf.solver.priors.hexahedra import brick_shape
from validation.oracles.elasticity import lame_parameters as parameters

WITHIN = Multigrid(TOLERANCE)
_NAMES = {False: "cube, held at its faces", True: "ball, held at a cap"}


def growing(size: int, free: bool = False) -> Problem:
    """Return tissue in which a ball grows: a cube with fixed faces, or a ball with a fixed cap."""
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
    return Problem(observed=y, confidence=c, stiffness=m)


def timed(problem: Problem, prior: Prior, optimizer: Optimizer = WITHIN) -> tuple[Solution, float]:
    """Return a solution and its CPU time in seconds."""
    begun = time.process_time()
    found = solve(problem, prior, optimizer=optimizer, backend="cpu")
    return found, time.process_time() - begun


def print_times(sizes: list[int]) -> None:
    """Print a table of cycles and seconds."""
    print("| tissue | voxels | Poisson's ratio | cycles | CPU s | ns a voxel |")
    print("| --- | --- | --- | --- | --- | --- |")
    for size in sizes:
        for free in (False, True):
            problem = growing(size, free)
            for poisson in (0.3, 0.45, 0.49):
                found, seconds = timed(problem, ElasticPrior(poisson))
                each = 1e9 * seconds / size**3
                cells = f"{size}^3 | {poisson} | {found.iterations} | {seconds:.2f} | {each:.0f}"
                print(f"| {_NAMES[free]} | {cells} |", flush=True)


def print_memory(size: int) -> None:
    """Print the peak memory of solves in addition to the problem, in separate processes."""
    print("| tissue | voxels | cycles | bytes a voxel | GiB in all |")
    print("| --- | --- | --- | --- | --- |")
    for name in _TISSUES:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            cycles, taken, whole = pool.submit(memory_of, name, size).result()
        cells = f"{size}^3 | {cycles} | {taken / size**3:.0f} | {whole / 2**30:.2f}"
        print(f"| {name} | {cells} |", flush=True)


def memory_of(name: str, size: int) -> tuple[int, int, int]:
    """Return the number of cycles, the peak memory of a solve, and that of the whole process."""
    timed(growing(16), ElasticPrior(0.45))  # loads the loops
    problem = _TISSUES[name](size)
    (found, _), taken, whole = added_by(lambda: timed(problem, ElasticPrior(0.45)))
    return found.iterations, taken, whole


def squeezed_shell(size: int) -> Problem:
    """Return a thin shell, 1e6 times as stiff as its surroundings, floating between plates."""
    y, c = np.zeros((size, size, size, 3)), np.zeros((size, size, size, 3))
    c[[0, -1]], y[-1] = 1, (2.0, 1.0, -0.5)
    places = np.indices((size, size, size), dtype=np.float32) - (size - 1) / 2
    r = np.sqrt((places**2).sum(axis=0))
    return Problem(
        observed=y,
        confidence=c,
        stiffness=np.where((r < 0.4 * size) & (r > 0.4 * size - 3), 1e6, 1.0),
    )


_TISSUES: dict[str, Callable[[int], Problem]] = {
    "cube, held at its faces": growing,
    "ball, held at a cap": partial(growing, free=True),
    "shell, a million times as stiff": squeezed_shell,
}


def print_pyamg(size: int) -> None:
    """Print the ratios of PyAMG's times to the medians of our times, without the first solve."""
    try:
        import pyamg
    except ImportError:
        print("PyAMG is not installed")
        return
    problem, poisson = growing(size), 0.45
    found, _ = timed(problem, ElasticPrior(poisson))

    def turns() -> list[tuple[float, float]]:
        taken = []
        for _ in range(5):
            begun = time.perf_counter()
            _, cpu = timed(problem, ElasticPrior(poisson))
            taken.append((time.perf_counter() - begun, cpu))
        return taken

    ours, begun, begun_cpu = turns(), time.perf_counter(), time.process_time()
    matrix = stiffness_matrix(problem, poisson)
    known, field = problem.known.ravel(), problem.observed.ravel().astype(float)
    inside = matrix[~known]
    right = -inside[:, known] @ field[known]
    inner = inside[:, ~known].tobsr(blocksize=(3, 3))
    modes = rigid_motions(problem.shape)[~known]
    solver = pyamg.smoothed_aggregation_solver(inner, B=modes)
    path: list[float] = []
    field[~known] = solver.solve(right, tol=1e-4, accel="cg", residuals=path)
    wall, cpu = time.perf_counter() - begun, time.process_time() - begun_cpu
    our_wall, our_cpu = np.median(ours + turns(), axis=0)
    apart = np.abs(found.displacement.ravel() - field).max()
    print(
        f"PyAMG at {size}^3: {len(path) - 1} iterations, {wall:.1f} s, {wall / our_wall:.0f} times "
        f"as long as our {our_wall:.2f} s (CPU time: {cpu:.1f} s, {cpu / our_cpu:.0f} times); the "
        f"fields differ by at most {apart:.4f} voxel"
    )


def stiffness_matrix(problem: Problem, poisson: float) -> sp.csr_matrix:
    """Return the stiffness matrix, a weighted sum of the two matrices of one element."""
    first, shear = (each.ravel() for each in parameters(problem, ElasticPrior(poisson)))
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
    """Return the six rigid motions as columns."""
    places = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3) - np.array(shape) / 2
    moves = [np.broadcast_to(axis, places.shape) for axis in np.eye(3)]
    turns = [np.cross(axis, places) for axis in np.eye(3)]
    return np.stack([each.ravel() for each in (*moves, *turns)], axis=-1)


def print_slices(shape: tuple[int, int, int] = (180, 220, 180)) -> None:
    """Print the time of the middle slice of an ellipsoid with fine or coarse displacements."""
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
                f"a slice of {' x '.join(map(str, shape))} that moves by up to {far} voxels, "
                f"sampled at {known}: {1e3 * float(np.median(times)):.0f} ms of CPU time",
                flush=True,
            )


def print_paper(size: int) -> None:
    """Print the distance of the paper's field to finite elements, and its time."""
    cube = growing(size)
    places = np.moveaxis(np.indices(cube.shape), 0, -1) * (2 / size) - 1
    m = np.full(cube.shape, 20.0)
    m[np.linalg.norm(places - (0.15, 0.1, 0.0), axis=-1) < 0.25] = 40
    m[np.linalg.norm(places - (-0.2, -0.3, -0.2), axis=-1) < 0.35] = 10
    problem = Problem(observed=cube.observed, confidence=cube.confidence, stiffness=m)
    converged, seconds = timed(problem, SeilerPrior())
    schedule, longer = timed(problem, SeilerPrior(), ICM())
    print(
        f"the paper's model at {size}^3: converged in {converged.iterations} cycles and "
        f"{seconds:.2f} CPU s; its schedule takes {longer:.2f} CPU s"
    )
    print("| Poisson's ratio | rms of the elastic field | RMSD, converged | by its schedule |")
    print("| --- | --- | --- | --- |")
    for poisson in (0.0, 0.3, 0.45):
        truth, _ = timed(problem, ElasticPrior(poisson))
        rms = [
            float(np.sqrt((np.linalg.norm(each, axis=-1) ** 2).mean()))
            for each in (
                truth.displacement,
                converged.displacement - truth.displacement,
                schedule.displacement - truth.displacement,
            )
        ]
        print(f"| {poisson} | {' | '.join(f'{each:.3f}' for each in rms)} |", flush=True)


def print_motion(size: int) -> None:
    """Print the times of post-processing a head, relative to the time of its solve."""
    head = head_phantom(size)
    found, solving = min(
        (timed(head.problem, ElasticPrior(0.45)) for _ in range(2)), key=lambda each: each[1]
    )
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
        "all result layers": layers,
    }
    shape = " x ".join(map(str, head.image.shape))
    sites = int(found.tissue.sum())
    print(
        f"a head of {shape} voxels, {sites:,} of them tissue: {solving:.2f} s of CPU time to solve"
    )
    for name, task in tasks.items():

        def seconds(task: Callable[[], Any] = task) -> float:
            begun = time.process_time()
            task()
            return time.process_time() - begun

        least = min(compute_thread.submit(seconds).result() for _ in range(4))
        print(f"{name}: {least:.2f} s, {least / solving:.2f} of the solve", flush=True)


def main() -> int:
    """Print all results; return 1 if a solution is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="*")
    parser.add_argument("--head", type=int, default=190, metavar="ROWS", help="0: skip")
    parser.add_argument("--memory", type=int, default=96, metavar="SIZE", help="0: skip")
    parser.add_argument("--pyamg", type=int, default=48, metavar="SIZE", help="0: skip")
    parser.add_argument("--paper", type=int, default=48, metavar="SIZE", help="0: skip")
    parser.add_argument("--direct", type=int, metavar="SIZE", help="only PARDISO")
    parser.add_argument("--torch-fem", type=int, metavar="NODES", help="only torch-fem")
    parser.add_argument("--random", type=int, default=300, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if asked.direct:
        print_direct(asked.direct)
    if asked.torch_fem:
        print_torch_fem(asked.torch_fem)
    if asked.direct or asked.torch_fem:
        return 0
    for prior in (ElasticPrior(0.3), SeilerPrior()):
        timed(growing(16), prior)  # loads the loops
    print_times([64, 128] if asked.sizes is None else asked.sizes)
    if asked.memory:
        print_memory(asked.memory)
    if asked.pyamg:
        print_pyamg(asked.pyamg)
    print_slices()
    if asked.head:
        print_motion(asked.head)
    if asked.paper:
        print_paper(asked.paper)
    seeds = range(asked.seed, asked.seed + asked.random)
    judged = [judge(seeds, paper) for paper in (False, True)]
    print("\n".join(told for told, _ in judged))
    return min(1, sum(wrong for _, wrong in judged))


if __name__ == "__main__":
    sys.exit(main())
