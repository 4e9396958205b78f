"""Data term: errors against direct solves, sliding surfaces, and time beside prescribed sites.

    python -m benchmarks.data_term [errors] [sliding] [times]

`errors` compares random tensors, of any rank and strength, with a sparse direct solve that shares
only the element matrices with the solver. `sliding` moves a block along tilted planes, and turns
the core of a ball within a surface that observes its normal; the exact motion is known. `times`
compares tensors at half of the sites with prescribed motion at the same sites, in turn.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Problem, Solution, solve
from napari_hmrf.landmarks import Landmarks
from validation.oracles.posterior import posterior_mean

Array = npt.NDArray[np.float64]
_GRIDS = (((40, 50), (1.0, 1.0)), ((48, 36), (1.0, 2.0)), ((13, 14, 15), (1.0, 1.0, 1.0)))
_GRIDS += (((10, 14, 12), (2.0, 1.0, 1.5)),)


def _field(problem: Problem, nu: float = 0.3) -> Solution:
    return solve(problem, ElasticPrior(nu), backend="cpu")


def _random(seed: int) -> tuple[str, Problem]:
    """Return a random problem with a data term, and its description."""
    rng = np.random.default_rng(seed)
    grid, spacing = _GRIDS[seed % len(_GRIDS)]
    axes = len(grid)
    rank, share = int(rng.integers(1, axes + 1)), float(rng.choice([1.0, 0.3, 0.05]))
    contrast, strength = 10 ** rng.uniform(0, 4), 10 ** rng.uniform(-3, 4)
    factors = rng.normal(size=(*grid, axes, rank))
    data = strength * factors @ factors.swapaxes(-1, -2)
    data[rng.random(grid) > share] = 0
    y, c = rng.normal(size=(*grid, axes)), np.zeros((*grid, axes))
    if rng.random() < 0.5:
        c[0] = 1
    m = contrast ** rng.random(grid)
    m[(slice(6, 9),) * axes] = 0
    marks = None
    if rng.random() < 0.5:
        points = rng.random((8, axes)) * 4
        moved = points + rng.normal(size=points.shape)
        marks = Landmarks(points, moved, sd=10 ** rng.uniform(-2, 1))
    problem = Problem(
        observed=y, confidence=c, stiffness=m, spacing=spacing, precision=data, landmarks=marks
    )
    words = f"{grid}, rank {rank}, share {share}, strength {strength:.0e}, contrast {contrast:.0e}"
    return words, problem


def errors(count: int = 100) -> None:
    """Print the largest errors of random problems."""
    worst: list[tuple[float, float, str]] = []
    for seed in range(count):
        words, problem = _random(seed)
        solution = _field(problem)
        far = np.abs(solution.displacement - posterior_mean(problem, ElasticPrior(0.3)))
        assert solution.convergence is not None
        worst.append((float(far.max()) / problem.unit, solution.convergence.error, words))
    worst.sort(reverse=True)
    beyond = sum(error > 3 * reported + 1e-4 for error, reported, _ in worst)
    print(f"{count} random problems: largest error {worst[0][0]:.1e} px (asked 3e-3);", end=" ")
    print(f"{beyond} beyond three times the reported error plus 1e-4 px")
    for error, reported, words in worst[:3]:
        print(f"  {error:.1e} px, reported {reported:.1e}: {words}")


def _planes() -> Iterator[tuple[str, float, float]]:
    for degrees in (0, 17, 45):
        size, (up, across) = 64, (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
        along, normal = np.array([across, up]), np.array([up, -across])
        place = np.moveaxis(np.indices((size, size)), 0, -1) - size / 2
        depth = place @ normal
        plane, far = np.abs(depth) <= 0.5, depth < -20
        y, c = np.zeros((size, size, 2)), np.zeros((size, size, 2))
        y[far], c[far] = 4 * along, 1
        data = 1e3 * plane[..., None, None] * np.outer(normal, normal)
        field = _field(
            Problem(observed=y, confidence=c, stiffness=(depth < 0.6).astype(float), precision=data)
        ).displacement
        middle = plane & (np.abs(place @ along) < 16)
        slip = float((field[middle] @ along).min()) / 4
        yield f"plane at {degrees} degrees", slip, float(np.abs(field[middle] @ normal).max())


def _ball(strength: float) -> tuple[str, float, float]:
    size, radius = 50, 20
    place = np.moveaxis(np.indices((size,) * 3), 0, -1) - (size - 1) / 2
    away = np.linalg.norm(place, axis=-1)
    normal = place / away[..., None]
    surface, tissue = np.abs(away - radius) <= 0.5, away <= radius + 0.5
    data = strength * surface[..., None, None] * normal[..., :, None] * normal[..., None, :]
    turn = np.stack([0 * away, -0.1 * place[..., 2], 0.1 * place[..., 1]], axis=-1)
    core = (away <= 6)[..., None]
    field = _field(
        Problem(
            observed=turn * core, confidence=core * np.ones(3), stiffness=tissue, precision=data
        )
    ).displacement
    outer = surface & (np.hypot(place[..., 1], place[..., 2]) > 10)
    slip = (field * turn).sum(axis=-1)[outer] / (turn**2).sum(axis=-1)[outer]
    across = np.abs((field * normal).sum(axis=-1)[outer]).max()
    return f"ball of radius {radius}, k = {strength:.0e}", float(slip.min()), float(across)


def sliding() -> None:
    """Print slip (as a fraction of the exact slip) and normal error of sliding surfaces."""
    for words, slip, across in itertools.chain(_planes(), map(_ball, (1e2, 1e3, 1e4))):
        print(f"{words}: slip {slip:.1%} of the exact one, normal error {across:.4f} px")


def times(blocks: int = 5) -> None:
    """Print the time of tensors at half of the sites, relative to prescribed motion there."""
    rng = np.random.default_rng(0)
    for grid, moves in itertools.product(((600, 600), (128, 128, 128)), (False, True)):
        axes, place = len(grid), np.indices(grid)
        normal = rng.normal(size=(*grid, axes))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        tensor = normal[..., :, None] * normal[..., None, :]
        seconds: dict[bool, list[float]] = {False: [], True: []}
        for block, by_data in itertools.product(range(blocks), seconds):
            half = rng.random(grid) < 0.5
            for repeat in range(3):
                half = rng.random(grid) < 0.5 if moves else half
                angle = place / (20 + 3 * block + repeat)
                y = np.stack([3 * np.sin(angle[(axis + 1) % axes]) for axis in range(axes)], -1)
                c = np.zeros(y.shape) if by_data else half[..., None] * np.ones(axes)
                data = half[..., None, None] * tensor if by_data else None
                problem = Problem(observed=y, confidence=c, stiffness=np.ones(grid), precision=data)
                begun = time.perf_counter()
                _field(problem)
                if repeat:  # the first solve of a block builds the model
                    seconds[by_data].append(time.perf_counter() - begun)
        one, other = (float(np.median(each)) for each in seconds.values())
        print(
            f"{' x '.join(map(str, grid))}, {'other sites' if moves else 'the same sites'} in each "
            f"solve: prescribed {one:.3f} s, tensors {other:.3f} s, ratio {other / one:.2f} "
            "(asked 1.5)"
        )


def main() -> None:
    """Run the chosen parts, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parts = {"errors": errors, "sliding": sliding, "times": times}
    parser.add_argument("parts", nargs="*", choices=[*parts, []], default=list(parts))
    for name in parser.parse_args().parts or parts:
        parts[name]()


if __name__ == "__main__":
    main()
