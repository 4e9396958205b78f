"""Random problems of large motion, and checks of their results.

``python -m validation large-motion.random --count 3000`` solves these problems.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf import HmrfError, NeoHookeanPrior, Problem, Solution, solve
from napari_hmrf.fields import count_folds
from napari_hmrf.loads import Loads, growth
from napari_hmrf.solver.optimizers import Multigrid
from validation.oracles.large_motion import smallest_jacobian
from validation.problems import turned

Field = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Largest distance of the tissue from a target that is reached, in pixels.
_MET = 0.01
# Rounding of distances in single precision, in pixels.
_ROUNDED = 1e-5
# Least Jacobian of a map from which targets are sampled.
_LEAST = 0.2


class Case(NamedTuple):
    """Random problem and prior, and whether the targets are sampled from a map without folds."""

    problem: Problem
    prior: NeoHookeanPrior
    known: bool


def run(
    first: int,
    count: int,
    case_of: Callable[[int], Case] | None = None,
    points: int = 2,
) -> None:
    """Solve random problems and print the numbers of faults, refusals and missed targets.

    Parameters
    ----------
    first, count : int
        Number of the first problem, and number of problems.
    case_of : callable, optional
        Returns the problem of a number; by default `make_case`.
    points : int
        Points along each axis of an element at which the Jacobian is computed.
    """
    counts: Counter[str] = Counter()
    slowest, begun = (0.0, first), time.perf_counter()
    for number in range(first, first + count):
        case = (case_of or make_case)(number)
        counts["known"] += case.known
        started = time.perf_counter()
        try:
            found = solve(case.problem, case.prior, backend="cpu")
        except HmrfError as error:
            counts["refused"] += 1
            counts["refused of a known map"] += case.known
            print(f"problem {number} refused: {type(error).__name__}: {error}", flush=True)
            continue
        finally:
            slowest = max(slowest, (time.perf_counter() - started, number))
        least = smallest_jacobian(case.problem, found.displacement, points)
        faults = _faults(case, found, least)
        gap = _gap(case.problem, found.displacement).max()
        counts["beyond the tolerance"] += found.convergence.error > Multigrid().tolerance
        counts["met"] += case.known and gap <= _MET
        if gap > _MET:
            counts["continued"] += 1
            faults += [_FARTHER] if _ends_farther(case, found, gap) else []
        counts.update(faults)
        if faults or (case.known and gap > _MET):
            what = ", ".join(faults) or "not reached"
            print(
                f"problem {number} (known map: {case.known}): {what}; least Jacobian {least:.2g}; "
                f"{found.reach}; error {found.convergence.error:.2g} px",
                flush=True,
            )
    took = time.perf_counter() - begun
    for name in _FAULTS:
        print(f"{counts[name]} of {count}: {name}")
    print(f"{counts[_FARTHER]} of {counts['continued']}: {_FARTHER}")
    print(f"{counts['refused']} of {count}: refused, with the reasons above")
    print(f"{counts['beyond the tolerance']} of {count}: error beyond the tolerance, as reported")
    print(f"{counts['met']} of {counts['known']}: targets of a known map reached to {_MET} px")
    print(f"slowest: problem {slowest[1]}, {slowest[0]:.1f} s; all: {took:.0f} s")


_FAULTS = (
    "folded",
    "error that is not a number",
    "count_folds above 0",
    "unreported error beyond the tolerance",
    "missed target that is not reported",
)


#: Fault of a solve that continues from a solution that misses its targets.
_FARTHER = "continued, and refused or farther from the targets"


def _ends_farther(case: Case, found: Solution, gap: float) -> bool:
    """Continue from a solution; return whether this is refused or ends farther from the targets.

    As in `reach`, growth that was completed counts before the distance from the targets.
    """
    try:
        further = solve(case.problem, case.prior, backend="cpu", initial=found)
    except HmrfError:
        return True
    assert found.reach is not None
    assert further.reach is not None
    if further.reach.grown != found.reach.grown:
        return further.reach.grown < found.reach.grown
    return bool(_gap(case.problem, further.displacement).max() > gap + _ROUNDED)


def _faults(case: Case, found: Any, least: float) -> list[str]:
    """Return the names of the faults of a result."""
    problem, reach = case.problem, found.reach
    displacement, error = found.displacement, found.convergence.error
    missing = _gap(problem, displacement)
    there = 0.0 if reach.where is None else missing[reach.where]
    said = reach.missing / problem.unit
    beyond = error > Multigrid().tolerance
    is_said = reach.unbalanced_at is not None and reach.unbalanced >= 0.99 * error * problem.unit
    folds = count_folds(displacement, spacing=problem.spacing, tissue=problem.tissue)
    are = (
        not least > 0 or not reach.least_jacobian > 0,
        not (math.isfinite(error) and math.isfinite(found.convergence.residual)),
        folds > 0,
        beyond and not is_said,
        not max(abs(missing.max() - said), abs(there - said)) <= _MET,
    )
    return [name for name, is_so in zip(_FAULTS, are, strict=True) if is_so]


def _gap(problem: Problem, displacement: Any) -> Field:
    """Return the distance of each site from its target, in pixels."""
    gap = np.where(problem.known, problem.observed - displacement.astype(np.float64), 0)
    return np.asarray(np.linalg.norm(gap, axis=-1) / problem.unit)


def make_case(number: int) -> Case:
    """Return a random problem; for even numbers, its targets belong to a map without folds."""
    random, known = np.random.default_rng(number), number % 2 == 0
    shape = tuple(int(size) for size in random.integers(12, 49, 2))
    spacing = (1.0, 1.0)
    if random.random() < 0.5:  # oblong pixels, in any unit
        rows, cols = (float(size) for size in 2 ** random.uniform(-2, 2, 2))
        spacing = (rows, cols)
    m = _tissue(random, shape, known)
    tissue = m > 0
    rigid = np.isinf(m)
    row, col = np.indices(shape)
    c, y = np.zeros((2, *shape, 2))
    if random.random() < 0.5:
        c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
    else:
        c[:, 0] = 1
    c[~tissue] = 0
    at, kind = _target(random, shape)
    at &= tissue & ~rigid
    centre = np.array(shape) / 2 if not at.any() else np.argwhere(at).mean(axis=0)
    away = np.stack([row - centre[0], col - centre[1]], axis=-1)
    size = min(shape)
    if known:
        held = (c[..., 0] > 0) | at
        y[held] = _smooth_map(random, shape)[held]
    elif kind == "drag":
        y[at] = random.normal(size=2) * size / 6 * random.choice([1.0, 1.0, 4.0])
    elif kind == "rim":
        y[at] = away[at] * random.uniform(-0.5, 1.5)
    elif kind == "bend":
        y[at] = turned(*shape, float(random.uniform(20, 90)))[at[:, -1]]
    else:
        y[at] = random.normal(size=(int(at.sum()), 2)) * 2
    moves, sides = y * np.array(spacing), np.array(shape) * np.array(spacing)
    # Targets far beyond the image are refused.
    farthest = float(np.linalg.norm(moves, axis=-1).max())
    moves *= min(1.0, 1.99 * float(np.linalg.norm(sides)) / max(farthest, 1e-9))
    penalty = math.inf
    c[at] = 1
    if not known and not rigid.any() and random.random() < 0.3:
        penalty = float(10 ** random.uniform(-2, 1))
        c[at] = random.uniform(0.3, 1)
    prior = NeoHookeanPrior(
        float(random.choice([0.0, 0.3, 0.45, 0.49])),
        plane="stress" if random.random() < 0.5 else "strain",
        penalty=penalty,
    )
    loads = _growth(random, shape, rigid) if random.random() < 0.4 else None
    problem = Problem(observed=moves, confidence=c, stiffness=m, spacing=spacing, loads=loads)
    return Case(problem, prior, known)


def _tissue(random: np.random.Generator, shape: tuple[int, ...], known: bool) -> Field:
    """Return stiffness of several values, with holes, a border of air and rigid bodies."""
    m = np.ones(shape)
    decades = random.choice([1.0, 3.0, 4.0])
    for _ in range(int(random.integers(0, 4))):
        m[_disc(random, shape, 3, max(shape) / 3)] = 10 ** random.uniform(0, decades)
    if random.random() < 0.4:
        for _ in range(int(random.integers(1, 4))):
            m[_disc(random, shape, 1, min(shape) / 5)] = 0
    if random.random() < 0.2:
        row, col = np.indices(shape)
        middle, half = (np.array(shape) - 1) / 2, np.array(shape) / 2
        off = ((row - middle[0]) / half[0]) ** 2 + ((col - middle[1]) / half[1]) ** 2
        m[off > random.uniform(1.0, 1.6)] = 0
    if not known and random.random() < 0.35:
        body = _disc(random, shape, 1.5, min(shape) / 5)
        body[[0, -1]] = body[:, [0, -1]] = False
        m[body & (m > 0)] = np.inf
    return m


def _disc(random: np.random.Generator, shape: tuple[int, ...], least: float, most: float) -> Mask:
    row, col = np.indices(shape)
    centre = random.uniform(0, 1, 2) * shape
    radius = random.uniform(least, max(most, least + 1))
    return np.asarray((row - centre[0]) ** 2 + (col - centre[1]) ** 2 < radius**2)


def _target(random: np.random.Generator, shape: tuple[int, ...]) -> tuple[Mask, str]:
    """Return a mask of the sites with a target, and their kind of motion."""
    kind = str(random.choice(["drag", "rim", "none", "bend", "landmarks"]))
    row, col = np.indices(shape)
    size = min(shape)
    centre = random.uniform(1 / 3, 2 / 3, 2) * shape
    radius = random.uniform(2, max(size / 6, 3))
    far = np.hypot(row - centre[0], col - centre[1])
    at = np.zeros(shape, dtype=bool)
    if kind == "drag":
        at = far < radius
    elif kind == "rim":
        at = abs(far - radius) < 1
    elif kind == "bend":
        at = col == shape[1] - 1
    elif kind == "landmarks":
        count = int(random.integers(2, 9))
        at[tuple(random.integers(2, side - 2, count) for side in shape)] = True
    return np.asarray(at), kind


def _growth(random: np.random.Generator, shape: tuple[int, ...], rigid: Mask) -> Loads:
    """Return the growth of a disc, from half to four times its length, maybe along one axis."""
    strain = random.uniform(-0.5, 3) if random.random() < 0.5 else random.uniform(-0.5, 0.5)
    grows = _disc(random, shape, 2, min(shape) / 2) & ~rigid
    along = random.normal(size=2) if random.random() < 0.2 else None
    return growth(strain * grows, along=along)


def _smooth_map(random: np.random.Generator, shape: tuple[int, ...]) -> Field:
    """Return a map of waves, scaled down until it has no folds."""
    row, col = np.indices(shape)
    size = min(shape)
    waves = np.zeros((*shape, 2))
    for _ in range(4):
        k, phase = random.uniform(-6, 6, 2) / size, random.uniform(0, 6)
        waves += random.normal(size=2) * np.sin(k[0] * row + k[1] * col + phase)[..., None]
    strength = size / 4
    whole = Problem(observed=waves, confidence=np.ones_like(waves), stiffness=np.ones(shape))
    while smallest_jacobian(whole, strength * waves, 2) < _LEAST:
        strength *= 0.9
    return strength * waves
