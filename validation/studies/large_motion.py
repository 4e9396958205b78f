"""Large motion beside an independent Newton's method, textbook finite elements and CalculiX.

`validation.oracles.calculix` describes the law and the elements of CalculiX. Its elements C3D8
evaluate the change of volume at each Gauss point, and those of this package evaluate it as the mean
of an element. ``python -m benchmarks.speed large large-volume`` measures time and memory.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.loads import Loads, growth, weight
from napari_hmrf.solver.model_names import Plane
from validation.bodies import bar, between_plates, turned
from validation.oracles import calculix
from validation.oracles.large_motion import large_field
from validation.study import Options, Results, Table, study

Field = npt.NDArray[np.float64]
_RATIOS = 0.3, 0.45


class Large(NamedTuple):
    """Problem in large motion, kinds of elements, steps of Newton's method, and format."""

    name: str
    problem: Problem
    planes: tuple[Plane, ...]
    steps: int
    words: str


def images(options: Options) -> dict[str, Large]:
    """Return bars that are pulled, sheared and bent, a disc that grows, and a beam that sags."""
    size = options.sizes_or((48,), (16,))[0]
    ends = {
        **{
            f"pulled by {part} %": np.array([0.0, part / 100 * (size - 1)]) for part in (10, 30, 50)
        },
        "sheared by 30 %": np.array([0.3 * size, 0.0]),
        # A block as high as it is long creases on its inner side, and has several solutions.
        "bent by 60 degrees": turned(size // 3, size, 60),
    }
    problems = {}
    for name, end in ends.items():
        height = len(end) if end.ndim == 2 else size
        m = np.ones((height, size))
        m[: height // 2] = 5
        problems[name] = bar(height, size, np.broadcast_to(end, (height, 2)), m)
    problems |= _loaded(size)
    return {
        name: Large(name, each, ("stress", "strain"), 6, "{:.4f} px")
        for name, each in problems.items()
    }


def _loaded(size: int) -> dict[str, Problem]:
    """Return a disc that doubles its area within a frame, and a beam that sags under its weight."""
    row, col = np.indices((size, size))
    disc = np.hypot(row - size / 2, col - size / 2) < size / 5
    c = np.zeros((size, size, 2))
    c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    m = np.where(disc, 5.0, 1.0)
    strain = growth((math.sqrt(2) - 1) * disc)
    height = size // 3
    beam = bar(height, size, np.zeros((height, 2)), 1.0)
    heavy = weight(beam.stiffness, (2e-3, 0.0), spacing=1)
    return {
        "a disc grown to twice its area": Problem(
            observed=0 * c, confidence=c, stiffness=m, loads=strain
        ),
        "a beam that sinks under its weight": Problem(
            observed=beam.observed,
            confidence=beam.confidence,
            stiffness=beam.stiffness,
            loads=heavy,
        ),
    }


def volumes(options: Options) -> dict[str, Large]:
    """Return cubes of two tissues that are pulled and sheared."""
    size = options.sizes_or((16,), (8,))[0]
    m = np.ones((size, size, size))
    m[:, : size // 2] = 5
    ends = {"pulled by 20 %": (0.2 * size, 0.0, 0.0), "sheared by 20 %": (0.0, 0.2 * size, 0.0)}
    return {
        name: Large(name, between_plates(m, end), ("stress",), 4, "{:.5f} voxel")
        for name, end in ends.items()
    }


@study("large-volumes.exact", volumes, ("case", "largest difference"), page="large-volumes.md")
@study("large-motion.exact", images, ("case", "largest difference"), page="large-motion.md")
def exact(case: Large) -> list[str]:
    """Compare with an independent Newton's method, for two Poisson's ratios."""
    worst = 0.0
    for nu, plane in itertools.product(_RATIOS, case.planes):
        prior = NeoHookeanPrior(nu, plane=plane)
        found = solve(case.problem, prior, backend="cpu").displacement
        off = np.abs(found - large_field(case.problem, prior, case.steps)).max()
        worst = max(worst, float(off))
    return [case.name, case.words.format(worst)]


@study(
    "large-motion.textbook",
    lambda options: {f"{nu}": (nu, options.sizes_or((48,), (16,))[0]) for nu in _RATIOS},
    ("Poisson's ratio", "largest difference four pixels from the clamps, px"),
    page="large-motion.md",
)
def textbook(case: tuple[float, int]) -> list[Any]:
    """Compare a bar pulled by 30 % with textbook elements without a barrier."""
    nu, size = case
    problem = bar(size, size, np.broadcast_to([0.0, 0.3 * (size - 1)], (size, 2)))
    prior = NeoHookeanPrior(nu)
    found = solve(problem, prior, backend="cpu").displacement
    off = np.abs(found - large_field(problem, prior, 10, textbook=True))[:, 4:-4].max()
    return [nu, f"{off:.4f}"]


# CalculiX.

# Size of the block, and in the comparison with an assembled matrix, in elements.
_SIZE, _SMALL = 16, 8
# Tolerance of a solve, in voxels.
_TOLERANCE = 1e-4


_SAME = "same voxels"
_BOTH = "voxels of half the size in both"
_THEIRS = "half the size in CalculiX only"
_LINEAR = "linear elasticity, half the size in CalculiX only"
_OTHERS = (
    "CalculiX to an assembled matrix of its elements",
    "this package to itself at half size",
    "CalculiX to itself at half size",
    "both extrapolated",
)


def blocks(options: Options) -> Iterator[tuple[str, tuple[Any, tuple[int, int]]]]:
    """Yield blocks in large motion, if CalculiX is installed."""
    if calculix.is_missing():
        return
    for name, block in BLOCKS.items():
        yield name, (block, options.choose((_SIZE, _SMALL), (6, 4)))


def _calculix_tables(results: Results) -> Iterator[Table]:
    for columns in ((_SAME, _BOTH, _THEIRS, _LINEAR), _OTHERS):
        rows = [
            [name, *(" / ".join(f"{own[each]:.2g}" for own in by_ratio) for each in columns)]
            for name, by_ratio in results.items()
        ]
        yield Table(["case", *columns], lambda _, rows=rows: rows)


@study("large-volumes.calculix", blocks, _calculix_tables, page="large-volumes.md")
def beside_calculix(case: tuple[Any, tuple[int, int]]) -> list[dict[str, float]]:
    """Compare blocks with CalculiX, on voxels of two sizes, for two Poisson's ratios."""
    block, sizes = case
    return [
        {words: float(np.abs(off).max()) for words, off in _differences(block, nu, *sizes)}
        for nu in _RATIOS
    ]


def _differences(
    case: Callable[[int, float], Problem], poisson: float, size: int, small_size: int
) -> Iterator[tuple[str, Field]]:
    small = case(small_size, 1.0)
    assembled = large_field(small, NeoHookeanPrior(poisson), calculix.PARTS, textbook=True)
    by_calculix = calculix.large_field(small, poisson)
    yield _OTHERS[0], by_calculix - assembled
    whole, half = case(size, 1.0), case(size, 0.5)
    theirs = calculix.large_field(whole, poisson)
    their_half = calculix.large_field(half, poisson)[::2, ::2, ::2]
    ours, our_half = by_package(whole, poisson), by_package(half, poisson)[::2, ::2, ::2]
    yield _SAME, ours - theirs
    yield _BOTH, our_half - their_half
    yield _THEIRS, ours - their_half
    yield _OTHERS[1], ours - our_half
    yield _OTHERS[2], theirs - their_half
    limits = ((4 * half - whole) / 3 for whole, half in ((ours, our_half), (theirs, their_half)))
    yield _OTHERS[3], np.subtract(*limits)
    linear = solve(whole, ElasticPrior(poisson), backend="cpu").displacement
    yield _LINEAR, linear - their_half


def by_package(problem: Problem, poisson: float) -> Field:
    """Return the field of this package."""
    prior, schedule = NeoHookeanPrior(poisson), Multigrid(_TOLERANCE)
    return solve(problem, prior, optimizer=schedule, backend="cpu").displacement.astype(np.float64)


# Each case takes the size of the block, in voxels of the first grid, and the size of its voxels.
def pulled(size: int, side: float) -> Problem:
    """Return a block with a stiff ball, pulled by 20 % between plates on which it slides."""
    places = _places(size, side)
    c, y = np.zeros((2, *places.shape))
    c[0, ..., 0] = c[-1, ..., 0] = c[:, 0, :, 1] = c[:, :, 0, 2] = 1
    y[-1, ..., 0] = 0.2 * size
    return _problem(y, c, 1 + 4 * _ball(places, (0.45, 0.5, 0.5)), side)


def twisted(size: int, side: float) -> Problem:
    """Return a block with a stiff ball, whose surface is twisted by 60 degrees."""
    places = _places(size, side)
    angle = np.pi / 3 * places[..., 0] / size
    _, y, z = np.moveaxis(places - size / 2, -1, 0)
    to = places.copy()
    to[..., 1] = size / 2 + y * np.cos(angle) - z * np.sin(angle)
    to[..., 2] = size / 2 + y * np.sin(angle) + z * np.cos(angle)
    ball = _ball(places, (0.5, 0.6, 0.5))
    return _problem(to - places, _surface(ball), 1 + 4 * ball, side)


def bent(size: int, side: float) -> Problem:
    """Return a block with a stiff ball, whose surface is bent by 45 degrees with equal volume."""
    places = _places(size, side)
    far = size / (np.pi / 4)
    angle = places[..., 0] / far
    radius = np.sqrt(far**2 - 2 * far * (places[..., 1] - size / 2))
    to = places.copy()
    to[..., 0] = radius * np.sin(angle)
    to[..., 1] = size / 2 + far - radius * np.cos(angle)
    ball = _ball(places, (0.5, 0.5, 0.5))
    return _problem(to - places, _surface(ball), 1 + 4 * ball, side)


def grown(size: int, side: float) -> Problem:
    """Return a held block of increasing stiffness, with a ball that grows by 60 %."""
    places = _places(size, side)
    ball = _ball(places, (0.5, 0.5, 0.5))
    m = 1 + 2 * places[..., 0] / size
    return _problem(np.zeros(places.shape), _surface(ball), m, side, Loads(growth=0.6 * ball))


BLOCKS: dict[str, Callable[[int, float], Problem]] = {
    "pulled by 20 %": pulled,
    "surface twisted by 60 degrees": twisted,
    "surface bent by 45 degrees": bent,
    "a ball that grows by 60 %": grown,
}


def _problem(y: Field, c: Field, m: Field, side: float, loads: Loads | None = None) -> Problem:
    return Problem(observed=y, confidence=c, stiffness=m, spacing=(side,) * 3, loads=loads)


def _places(size: int, side: float) -> Field:
    return np.stack(np.indices((round(size / side) + 1,) * 3), axis=-1) * side


def _ball(places: Field, centre: tuple[float, ...]) -> Field:
    """Return the share of a ball in each voxel; it decreases over a quarter of the block."""
    size = places.max()
    distance = np.linalg.norm(places / size - centre, axis=-1)
    return np.clip(1.5 - 4 * distance, 0, 1)


def _surface(values: Field) -> Field:
    """Return the confidence of a volume whose surface is prescribed."""
    c = np.ones((*values.shape, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    return c
