"""Parts that slide along each other, and data in some directions only, beside exact motion.

`sliding` moves blocks along tilted planes and up a wedge, and turns a disc in a ring and a ball in
a shell; the exact motion is rigid on both sides. `data-term` slides tissue along surfaces that
observe its normal. ``python -m benchmarks.campaign sliding data`` compares random problems with
direct solutions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from benchmarks.clock import fastest, timed
from napari_hmrf import ElasticPrior, Problem, Solution, solve
from napari_hmrf.solver.interface_normals import interface_surface
from napari_hmrf.tissue import SlidingParts
from validation.study import Options, Table, study

Array = npt.NDArray[np.float64]
# Motion of the parts, in pixels, and Poisson's ratio.
_SLIP, _NU = 4.0, 0.3
# Distance from the interface at which both sides are compared, in pixels.
_BESIDE = 2.5
# Distance between points of an interface, in pixels; the kink is measured over one pixel.
_STEP = 0.1


@dataclass(frozen=True)
class Case:
    """Two parts with a known rigid motion.

    Attributes
    ----------
    name : str
    inner : ndarray of bool, shape (H, W)
        Sites of the part that moves.
    stiffness : ndarray, shape (H, W)
    held : ndarray of bool, shape (H, W, 2)
        Prescribed components.
    exact : ndarray, shape (H, W, 2)
        Exact displacement.
    points, normals, slips : ndarray, shape (n, 2)
        Points of the interface, normals towards the part at rest, and exact motion.
    """

    name: str
    inner: npt.NDArray[np.bool_]
    stiffness: Array
    held: npt.NDArray[np.bool_]
    exact: Array
    points: Array
    normals: Array
    slips: Array

    def problem(self, *, connected: bool = False) -> Problem:
        """Return the problem, with parts that slide unless they are connected."""
        parts = None if connected else SlidingParts(self.inner.astype(int))
        return Problem(
            observed=self.exact,
            confidence=self.held.astype(float),
            stiffness=self.stiffness,
            sliding=parts,
        )


def tilted(degrees: float, size: int) -> tuple[Array, Array, Array]:
    """Return the normal and the direction of a tilted line, and the sites from the middle."""
    angle = np.radians(degrees)
    normal = np.array([np.cos(angle), -np.sin(angle)])
    along = np.array([np.sin(angle), np.cos(angle)])
    return normal, along, np.moveaxis(np.indices((size, size)), 0, -1) - (size - 1) / 2


def plane(degrees: float, size: int = 64) -> Case:
    """Return a block that is dragged along a tilted plane by its far side."""
    normal, along, place = tilted(degrees, size)
    depth = place @ normal - 0.2
    inner = depth < 0
    exact = np.where(inner[..., None], _SLIP * along, 0.0)
    held = np.repeat((np.abs(depth) > 0.3 * size)[..., None], 2, axis=-1)
    at = np.arange(-0.35 * size, 0.35 * size, _STEP)[:, None]
    points = at * along + 0.2 * normal + (size - 1) / 2
    every = np.ones_like(at)
    name = f"plane at {degrees:g} degrees"
    stiffness = np.ones((size, size))
    return Case(name, inner, stiffness, held, exact, points, every * normal, every * _SLIP * along)


def wedge(degrees: float = 17.0, size: int = 64) -> Case:
    """Return a block that is pushed horizontally up a wedge, and is free to rise."""
    normal, along, place = tilted(degrees, size)
    depth = place @ normal - 6.2
    inner = depth < 0
    block = (place[..., 1] > -14) & (place[..., 1] < 12) & (place[..., 0] > -16)
    tissue = ~inner | block
    slip = _SLIP / along[1] * along
    exact = np.where((inner & tissue)[..., None], slip, 0.0)
    held = np.zeros((size, size, 2), np.bool_)
    held[-1] = True
    held[..., 1] |= inner & tissue & (place[..., 1] < -12.9)
    at = np.arange(-9.0, 8.0, _STEP)[:, None]
    points, every = at * along + 6.2 * normal + (size - 1) / 2, np.ones_like(at)
    stiffness = tissue.astype(float)
    name = f"wedge of {degrees:g} degrees"
    return Case(name, inner, stiffness, held, exact, points, every * normal, every * slip)


def disc(radius: float, size: int = 64, contrast: float = 1.0) -> Case:
    """Return a disc that turns in a ring, by its core."""
    middle = (size - 1) / 2 + np.array([0.13, 0.29])
    place = np.moveaxis(np.indices((size, size)), 0, -1) - middle
    away = np.linalg.norm(place, axis=-1)
    inner, turn = away < radius, _SLIP / radius
    exact = np.where(inner[..., None], turn * np.stack([-place[..., 1], place[..., 0]], -1), 0.0)
    held = np.zeros((size, size, 2), np.bool_)
    held[away < radius / 3] = held[0] = held[-1] = held[:, 0] = held[:, -1] = True
    angles = np.arange(0, 2 * np.pi, _STEP / radius)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    slips = _SLIP * np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    stiffness = np.where(inner, 1.0, contrast)
    name = f"disc of radius {radius:g}" + f", ring {contrast:g} times as stiff" * (contrast != 1)
    return Case(name, inner, stiffness, held, exact, middle + radius * normals, normals, slips)


def _at(field: Array, points: Array) -> Array:
    """Return a field, shape (H, W, 2), at points."""
    planes = np.moveaxis(field, -1, 0)
    values = [scipy.ndimage.map_coordinates(each, points.T, order=1) for each in planes]
    return np.stack(values, axis=-1)


def measure(case: Case, field: Array) -> tuple[float, float, float]:
    """Return slip (worst fraction), gap and kink, beside the interface."""
    errors, sides = [], []
    for side in (-1, 1):
        at = case.points + side * _BESIDE * case.normals
        sides.append(_at(field, at))
        errors.append(sides[-1] - _at(case.exact, at))
    jump = sides[0] - sides[1]
    true = jump - (errors[0] - errors[1])
    slips = (jump * case.slips).sum(axis=1) / (true * case.slips).sum(axis=1)
    gaps = np.abs(((errors[0] - errors[1]) * case.normals).sum(axis=1))
    kink = max(float(np.abs(np.diff(each[:: round(1 / _STEP)], axis=0)).max()) for each in errors)
    worst = float(slips[np.abs(slips - 1).argmax()])
    return worst, float(gaps.max()), kink


def _field_of(problem: Problem) -> Solution:
    return solve(problem, ElasticPrior(_NU), backend="cpu")


def _movements() -> dict[str, Case]:
    cases = (plane(0), plane(17), plane(45), wedge(), disc(20.3))
    return {case.name: case for case in cases}


@study("sliding.slip", _movements(), ("case", "slip", "gap (px)", "kink (px)"), page="sliding.md")
def slip(case: Case) -> list[str]:
    """Compare slip, gap and kink with exact motion."""
    found = measure(case, _field_of(case.problem()).displacement.astype(float))
    return [
        case.name,
        *(f"{value:.{digits}f}" for value, digits in zip(found, (3, 4, 4), strict=True)),
    ]


def ball(size: int, *, connected: bool = False) -> Problem:
    """Return a ball that turns in a shell, with parts that slide unless they are connected."""
    _, away, turn = _turning(size)
    core = away < 0.1 * size
    held = core.copy()
    for axis in range(3):
        held.swapaxes(0, axis)[[0, -1]] = True
    return Problem(
        observed=np.where(core[..., None], turn, 0.0),
        confidence=np.repeat(held[..., None], 3, axis=-1).astype(float),
        stiffness=np.ones((size,) * 3),
        sliding=None if connected else SlidingParts((away < 0.32 * size).astype(int)),
    )


def _turning(size: int) -> tuple[Array, Array, Array]:
    """Return places from the middle of a cube, their distances, and the motion of a turn."""
    place = np.moveaxis(np.indices((size,) * 3), 0, -1) - (size - 1) / 2
    away = np.linalg.norm(place, axis=-1)
    return place, away, 0.1 * np.stack([0 * away, -place[..., 2], place[..., 1]], axis=-1)


@study(
    "sliding.spheres",
    lambda options: {str(n): n for n in options.sizes_or((24, 36, 48), (16,))},
    ("ball", "slip", "gap", "exact slip at most"),
    page="sliding.md",
)
def spheres(size: int) -> list[str]:
    """Compare the slip and gap of a ball that turns in a shell with exact motion."""
    (place, away, turn), radius = _turning(size), 0.32 * size
    field = _field_of(ball(size)).displacement
    near, inner = np.abs(away - radius) < 1.5, away < radius
    fast = near & inner & (np.linalg.norm(turn, axis=-1) > 0.05 * radius)
    slips = ((field * turn).sum(axis=-1) / np.maximum((turn**2).sum(axis=-1), 1e-9))[fast]
    gap = np.abs((field * place).sum(axis=-1) / away)[near].max()
    return [f"radius {radius:.1f}", f"{slips.min():.3f}", f"{gap:.3f} px", f"{0.1 * radius:.1f} px"]


def interfaces(options: Options) -> dict[str, tuple[Problem, Problem]]:
    """Return problems with parts that slide, and the same with connected parts."""
    cases = [plane(17), plane(45), wedge(), disc(20.3), disc(20.3, contrast=10.0)]
    cases.append(disc(20.3, contrast=1000.0))
    sizes = options.choose((24, 48), (12,))
    if not options.quick:
        cases += [plane(17, 256), disc(82.0, 256)]
    pairs = {
        case.name + (f", {len(case.inner)} px" if len(case.inner) != 64 else ""): (
            case.problem(),
            case.problem(connected=True),
        )
        for case in cases
    }
    volumes = {f"ball in {n}^3 voxels": (ball(n), ball(n, connected=True)) for n in sizes}
    return pairs | volumes


@study(
    "sliding.cycles",
    interfaces,
    lambda results: [
        Table(
            ("case", "cycles", "connected"),
            lambda found: [[name, *counts] for name, (counts, _) in found.items()],
        ),
        Table(
            ("case", "time, relative to connected tissue"),
            lambda found: [[name, f"{ratio:.1f}"] for name, (_, ratio) in found.items()],
        ),
    ],
    page="sliding.md",
)
def cycles(pair: tuple[Problem, Problem]) -> tuple[list[int], float]:
    """Compare the numbers of cycles and the times with those of connected tissue."""
    counts, seconds = [], []
    for problem in pair:
        found, times = fastest(lambda given=problem: _field_of(given), 3)
        counts.append(len(found.energy) - 1)
        seconds.append(times.wall)
    return counts, seconds[0] / seconds[1]


def _blurred(case: Case, sites: npt.NDArray[np.intp]) -> Array:
    """Return the normals of a label that is blurred by 3 pixels."""
    blurred = scipy.ndimage.gaussian_filter(np.where(case.inner, -1.0, 0.0), 3, mode="nearest")
    slopes = np.stack(np.gradient(blurred), axis=-1)[tuple(sites.T)]
    return np.asarray(slopes / np.linalg.norm(slopes, axis=1, keepdims=True))


def _outlines() -> dict[str, Case]:
    cases = [plane(angle) for angle in (0, 2, 5, 17, 30, 45)]
    cases += [disc(radius) for radius in (5.3, 9.3, 14.7, 20.3, 26.4)]
    return {case.name: case for case in cases}


@study(
    "sliding.normals",
    lambda options: _outlines(),
    ("interface", "fitted, mean", "largest", "blurred, mean", "largest"),
    page="sliding.md",
)
def normals(case: Case) -> list[str]:
    """Compare fitted normals and those of blurred labels with the true ones, in degrees."""
    sites = np.unique(np.round(case.points).astype(int), axis=0)
    true = case.normals[scipy.spatial.cKDTree(case.points).query(sites)[1]]
    fitted, _ = interface_surface(case.inner, ~case.inner, sites, (1.0, 1.0))
    row = [case.name]
    for found in (fitted, _blurred(case, sites)):
        degrees = np.degrees(np.arccos(np.clip((found * true).sum(axis=1), -1, 1)))
        row += [f"{degrees.mean():.2f}", f"{degrees.max():.2f}"]
    return row


# Data term.


def _along_plane(degrees: float) -> tuple[float, float]:
    size = 64
    normal, along, place = tilted(degrees, size)
    depth = (place - 0.5) @ normal
    plane, far = np.abs(depth) <= 0.5, depth < -20
    y, c = np.zeros((size, size, 2)), np.zeros((size, size, 2))
    y[far], c[far] = 4 * along, 1
    data = 1e3 * plane[..., None, None] * np.outer(normal, normal)
    field = _field_of(
        Problem(observed=y, confidence=c, stiffness=(depth < 0.6).astype(float), precision=data)
    ).displacement
    middle = plane & (np.abs(place @ along) < 16)
    slip = float((field[middle] @ along).min()) / 4
    return slip, float(np.abs(field[middle] @ normal).max())


def _in_surface(strength: float) -> tuple[float, float]:
    radius, (place, away, turn) = 20, _turning(50)
    normal = place / away[..., None]
    surface, tissue = np.abs(away - radius) <= 0.5, away <= radius + 0.5
    data = strength * surface[..., None, None] * normal[..., :, None] * normal[..., None, :]
    core = (away <= 6)[..., None]
    field = _field_of(
        Problem(
            observed=turn * core, confidence=core * np.ones(3), stiffness=tissue, precision=data
        )
    ).displacement
    outer = surface & (np.hypot(place[..., 1], place[..., 2]) > 10)
    slip = (field * turn).sum(axis=-1)[outer] / (turn**2).sum(axis=-1)[outer]
    across = np.abs((field * normal).sum(axis=-1)[outer]).max()
    return float(slip.min()), float(across)


_SURFACES: dict[str, tuple[Callable[[float], tuple[float, float]], float]] = {
    **{f"plane at {degrees} degrees": (_along_plane, degrees) for degrees in (0, 17, 45)},
    **{f"ball of radius 20, k = {k:.0e}": (_in_surface, k) for k in (1e2, 1e3, 1e4)},
}


@study(
    "data-term.sliding",
    {name: (name, *case) for name, case in _SURFACES.items()},
    ("surface", "slip, of the exact one", "normal error, px"),
    page="data-term.md",
)
def data_slip(case: tuple[str, Callable[[float], tuple[float, float]], float]) -> list[str]:
    """Compare tissue on surfaces that observe its normal with exact motion."""
    name, measure_at, value = case
    slip, across = measure_at(value)
    return [name, f"{slip:.1%}", f"{across:.4f}"]


_TIME_TITLES = ("grid", "sites of each solve", "prescribed, s", "tensors, s", "ratio (asked: 1.5)")


@study(
    "data-term.times",
    lambda options: {
        f"{grid}, {moves}": (grid, moves, options.count or 5)
        for grid in options.choose(((600, 600), (128, 128, 128)), ((60, 60),))
        for moves in (False, True)
    },
    _TIME_TITLES,
    page="data-term.md",
)
def data_times(case: tuple[tuple[int, ...], bool, int]) -> list[Any]:
    """Time tensors at half of the sites, relative to prescribed motion there, in turn."""
    rng, (grid, moves, blocks) = np.random.default_rng(0), case
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
            times = timed(lambda given=problem: _field_of(given))[1]
            if repeat:  # the first solve of a block builds the model
                seconds[by_data].append(times.wall)
    one, other = (float(np.median(each)) for each in seconds.values())
    sites = "other" if moves else "the same"
    size = " x ".join(map(str, grid))
    return [size, sites, f"{one:.3f}", f"{other:.3f}", f"{other / one:.2f}"]
