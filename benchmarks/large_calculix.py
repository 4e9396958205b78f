"""Comparison of large motion in volumes with CalculiX, a finite-element program.

``python -m benchmarks.large_volumes calculix`` prints the comparison.

CalculiX has the law of `NeoHookeanPrior`: the user material CIARLET_EL, with the second
Piola-Kirchhoff stress mu (1 - C^-1) + lambda/2 (det C - 1) C^-1. Its elements C3D8 evaluate the
change of volume at each Gauss point, and those of this package evaluate it as the mean of an
element. CalculiX subtracts thermal expansion from the deformation gradient, instead of dividing by
it. The deck therefore does not use thermal expansion: each element that grows is a separate brick
of the grown size, and equations tie its corners to the sites.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.report import calculix
from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.loads import Loads
from tests.support.finite_volume_oracle import solved

Field = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
# Size of the block, in elements.
_SIZE = 16
# Size of the block in the comparison with an assembled matrix, in elements.
_SMALL = 8
_RATIOS = 0.3, 0.45
# Tolerance of a solve, in voxels.
_TOLERANCE = 1e-4
# Number of load increments of CalculiX.
_PARTS = 5
# Corners of an element, in the order of CalculiX.
_CORNERS = [(*face, k) for k in (0, 1) for face in ((0, 0), (1, 0), (1, 1), (0, 1))]


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
    if case is not grown:  # the assembled matrix does not have growth
        small = case(_SMALL, 1.0)
        assembled = solved(small, poisson, _PARTS, locking=True)
        yield (
            "CalculiX to an assembled matrix of its elements",
            by_calculix(small, poisson) - assembled,
        )
    whole, half = case(_SIZE, 1.0), case(_SIZE, 0.5)
    theirs, their_half = by_calculix(whole, poisson), by_calculix(half, poisson)[::2, ::2, ::2]
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


def by_calculix(problem: Problem, poisson: float) -> Field:
    """Return the field of CalculiX with the same law and voxels."""
    numbers, values = calculix.run(deck(problem, poisson))
    field = np.zeros((problem.stiffness.size, 3))
    field[numbers - 1] = values
    return field.reshape(*problem.shape, 3)


def deck(problem: Problem, poisson: float) -> str:
    """Return the input file of a volume without void; growth is equal in all directions.

    Nodes are numbered by site. Corners of elements that grow have the numbers after those of the
    sites and of a node whose first displacement is the part of the growth that is applied.
    """
    number = 1 + np.arange(problem.stiffness.size).reshape(problem.shape)
    places = np.stack(np.indices(problem.shape), axis=-1).reshape(-1, 3) * problem.spacing
    young = _at_corners(problem.stiffness.astype(np.float64)).mean(axis=-1)
    corners = _at_corners(number)
    lines = ["*NODE, NSET=SITES", *_nodes(1, places)]
    ties, scale = [], len(places) + 1
    if problem.loads is not None and problem.loads.growth is not None:
        growth = _at_corners(problem.loads.growth.astype(np.float64)).mean(axis=-1)
        grows = np.flatnonzero(growth)
        at = places[corners[grows] - 1]
        offsets = growth[grows, None, None] * (at - at.mean(axis=1, keepdims=True))
        own = scale + 1 + np.arange(offsets[..., 0].size).reshape(-1, 8)
        lines += ["*NODE", *_nodes(scale, np.zeros((1, 3)))]
        lines += _nodes(scale + 1, (at + offsets).reshape(-1, 3))
        ties = ["*EQUATION", *_ties(own, corners[grows], scale, offsets)]
        corners[grows] = own
    values, kind = np.unique(young, return_inverse=True)
    for index, modulus in enumerate(values):
        lines.append(f"*ELEMENT, TYPE=C3D8, ELSET=E{index}")
        for element in np.flatnonzero(kind == index):
            lines.append(f"{element + 1}, {', '.join(map(str, corners[element]))}")
        lines += [f"*MATERIAL, NAME=CIARLET_EL{index}", "*USER MATERIAL, CONSTANTS=2"]
        lines += [f"{modulus:.12g}, {poisson:.12g}, 0."]
        lines += [f"*SOLID SECTION, ELSET=E{index}, MATERIAL=CIARLET_EL{index}"]
    lines += [*ties, "*STEP, NLGEOM, INC=1000", "*STATIC, SOLVER=ITERATIVE CHOLESKY"]
    lines += [f"{1 / _PARTS:.9g}, 1.", "*CONTROLS, PARAMETERS=FIELD", "1.E-7, 1.E-6", "*BOUNDARY"]
    for *site, along in np.argwhere(problem.known):
        y = problem.observed[(*site, along)]
        lines.append(f"{number[tuple(site)]}, {along + 1}, {along + 1}, {y:.12g}")
    if ties:
        lines += [f"{scale}, 1, 1, 1.", f"{scale}, 2, 3, 0."]
    lines += ["*NODE PRINT, NSET=SITES", "U", "*END STEP", ""]
    return "\n".join(lines)


def _at_corners(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the values at the corners of each element, (N, 8)."""
    ends = slice(None, -1), slice(1, None)
    parts = [values[tuple(ends[end] for end in corner)].ravel() for corner in _CORNERS]
    return np.stack(parts, axis=-1)


def _nodes(first: int, places: Field) -> list[str]:
    return [f"{n}, {x:.12g}, {y:.12g}, {z:.12g}" for n, (x, y, z) in enumerate(places, first)]


def _ties(own: Numbers, sites: Numbers, scale: int, offsets: Field) -> list[str]:
    """Return the equations u_own - u_site + (applied part of the growth) offset = 0."""
    lines = []
    for index in np.ndindex(own.shape):
        for along, offset in enumerate(offsets[index], start=1):
            ends = f"{own[index]}, {along}, 1., {sites[index]}, {along}, -1."
            lines += ["3", f"{ends}, {scale}, 1, {offset:.12g}"]
    return lines


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
