"""Comparison of large motion in volumes with CalculiX, a finite-element program.

``python -m benchmarks.large_volumes calculix`` prints the comparison.

`validation.oracles.calculix` describes the law and the elements of CalculiX. Its elements C3D8
evaluate the change of volume at each Gauss point, and those of this package evaluate it as the mean
of an element.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.loads import Loads
from validation.oracles import calculix
from validation.oracles.large_motion import large_field

Field = npt.NDArray[np.float64]
# Size of the block, in elements.
_SIZE = 16
# Size of the block in the comparison with an assembled matrix, in elements.
_SMALL = 8
_RATIOS = 0.3, 0.45
# Tolerance of a solve, in voxels.
_TOLERANCE = 1e-4


def run() -> None:
    """Print the largest differences of any site, in voxels, for each case and Poisson's ratio."""
    if not calculix.is_there():
        print(f"CalculiX is not installed: {calculix.HOW}.")
        return
    for (name, case), poisson in product(CASES.items(), _RATIOS):
        print(f"{name}, nu {poisson}")
        for comparison, difference in _differences(case, poisson):
            print(f"    {comparison:50} {np.abs(difference).max():.1e}", flush=True)


def _differences(
    case: Callable[[int, float], Problem], poisson: float
) -> Iterator[tuple[str, Field]]:
    small = case(_SMALL, 1.0)
    assembled = large_field(small, NeoHookeanPrior(poisson), calculix.PARTS, textbook=True)
    by_calculix = calculix.large_field(small, poisson)
    yield "CalculiX to an assembled matrix of its elements", by_calculix - assembled
    whole, half = case(_SIZE, 1.0), case(_SIZE, 0.5)
    theirs = calculix.large_field(whole, poisson)
    their_half = calculix.large_field(half, poisson)[::2, ::2, ::2]
    ours, our_half = by_package(whole, poisson), by_package(half, poisson)[::2, ::2, ::2]
    yield "this package to CalculiX, same voxels", ours - theirs
    yield "this package to CalculiX, both at half size", our_half - their_half
    yield "this package to CalculiX at half size", ours - their_half
    yield "this package to itself at half size", ours - our_half
    yield "CalculiX to itself at half size", theirs - their_half
    limits = ((4 * half - whole) / 3 for whole, half in ((ours, our_half), (theirs, their_half)))
    yield "this package to CalculiX, both extrapolated", np.subtract(*limits)
    linear = solve(whole, ElasticPrior(poisson), backend="cpu").displacement
    yield "linear elasticity to CalculiX at half size", linear - their_half


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


CASES: dict[str, Callable[[int, float], Problem]] = {
    "pulled by 20 %": pulled,
    "twisted by 60 degrees": twisted,
    "bent by 45 degrees": bent,
    "ball grown by 60 %": grown,
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
