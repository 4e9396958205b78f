"""Random small problems with cavities and sliding parts, compared with dense solutions.

    python -m benchmarks.cavities_and_interfaces [--problems 2000] [--seed 0] [--processes 1]
    python -m benchmarks.cavities_and_interfaces --only 17 [--seed 0]

Every third problem has removed tissue with weight and a loaded cavity, every third has parts that
slide along each other, and every third has both. The reference is a dense system in double
precision. scikit-fem integrates the matrix of one element. Loops over elements, faces and pairs of
sites, which share no code with the package, add elements, weight, cavity loads and the coupling of
parts. Only the fitted normals of an interface are taken from the package.
"""

from __future__ import annotations

import argparse
import itertools
import math
import multiprocessing
import sys
import time
from collections import Counter
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.ndimage

from napari_hmrf import ConvergenceError, ElasticPrior, Problem, ProblemError, solve
from napari_hmrf.loads import Loads, cavity, weight
from napari_hmrf.solver.interface_normals import interface_normals
from napari_hmrf.solver.neighbours import around_sites, in_elements
from napari_hmrf.tissue import SlidingParts
from validation.oracles.elasticity import element_matrices

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Sites = npt.NDArray[np.intp]
Kind = Literal["cavity", "sliding", "both"]

#: Largest accepted error, in pixels.
LARGEST = 0.01
#: Largest accepted error: this multiple of the reported error, plus `ROUNDED` pixels.
REPORTED, ROUNDED = 3.0, 1e-4
#: Least eigenvalue, of the matrix with a diagonal of 1, below which the dense system is singular.
SINGULAR = 1e-10
#: Least eigenvalue up to which a dense solution has no correct digits.
UNRESOLVED = 1e-13
#: Tilt of the normals that tests whether labels determine a motion, in degrees. Fitted normals of
#: small curved interfaces have errors of this size.
TILT = 2.0
#: Number of random tilts.
TILTS = 4
#: Change of the field under a tilt, relative to its largest value, from which labels do not
#: determine the motion.
UNDETERMINED = 0.3
# Largest motion of a random problem, in pixels; larger ones are scaled down.
_MOTION = 4.0
# Sides of an image and of a volume, in sites.
_SIDES = {2: (4, 17), 3: (3, 7)}
_KINDS: tuple[Kind, ...] = ("cavity", "sliding", "both")
_REFUSED = "refused, well-posed"
_SINGULAR, _NEARLY = "refused, singular", "refused, motion depends on the normals"
_WRONG, _FREE, _RIGHT = "wrong", "solved, singular", "right"
_OUTCOMES = (_RIGHT, _WRONG, _REFUSED, _NEARLY, _SINGULAR, _FREE)


@dataclass(frozen=True, eq=False)
class Case:
    """Random problem.

    Attributes
    ----------
    kind : str
        "cavity", "sliding" or "both".
    stiffness : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness of the remaining tissue; 0 in void and in removed tissue.
    removed : ndarray of bool, same shape
        Removed tissue.
    labels : ndarray of int, same shape
        Labels of the sliding parts, all 0 if no parts slide.
    observed : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Prescribed displacement, in the unit of the spacing.
    held : ndarray of bool, same shape as `observed`
        Prescribed components.
    poisson : float or ndarray, shape of the grid, float32
    plane : str
    spacing : tuple of float
    gravity : ndarray, shape (n,)
        Weight of the tissue per volume.
    pressure, fluid, level : float
        Contents of the cavity, as for `Cavity`.
    """

    kind: Kind
    stiffness: npt.NDArray[np.float32]
    removed: Flags
    labels: npt.NDArray[np.int32]
    observed: Array
    held: Flags
    poisson: float | npt.NDArray[np.float32]
    plane: Literal["stress", "strain"]
    spacing: tuple[float, ...]
    gravity: Array
    pressure: float
    fluid: float
    level: float

    @property
    def unit(self) -> float:
        """Length of a pixel: the geometric mean of its sides."""
        return float(math.prod(self.spacing) ** (1 / len(self.spacing)))

    def scaled(self, share: float) -> Case:
        """Return the problem with all motion and all loads multiplied by a number."""
        return replace(
            self,
            observed=share * self.observed,
            gravity=share * self.gravity,
            pressure=share * self.pressure,
            fluid=share * self.fluid,
        )

    def problem(self) -> Problem:
        """Return the problem with the loads of the package."""
        loads: Loads | None = None
        if self.removed.any():
            down = self.gravity / np.linalg.norm(self.gravity)
            loads = weight(self.stiffness, self.gravity, spacing=self.spacing) + cavity(
                self.stiffness,
                self.removed,
                spacing=self.spacing,
                pressure=self.pressure,
                fluid=self.fluid * down,
                level=self.level,
            )
        return Problem(
            observed=self.observed,
            confidence=self.held.astype(float),
            stiffness=self.stiffness,
            spacing=self.spacing,
            loads=loads,
            sliding=SlidingParts(self.labels) if self.kind != "cavity" else None,
        )


@dataclass(frozen=True)
class Verdict:
    """Outcome of a problem.

    Attributes
    ----------
    number : int
    kind : str
    axes : int
        2 for an image, 3 for a volume.
    outcome : str
    error : float
        Largest difference from the dense solution, in pixels; nan without a solution.
    reported : float
        Reported error, in pixels; nan without a solution.
    least : float
        Least eigenvalue of the dense system, for a diagonal of 1.
    remark : str
        First words of a refusal; "" for a solution.
    """

    number: int
    kind: Kind
    axes: int
    outcome: str
    error: float
    reported: float
    least: float
    remark: str = ""

    @property
    def failed(self) -> bool:
        """True if the solution is wrong or a well-posed problem is refused."""
        return self.outcome in (_WRONG, _REFUSED)


def random_case(seed: int, number: int) -> Case:
    """Return a random problem, which depends only on the seed and the number."""
    dice = np.random.default_rng((seed, number))
    kind, axes = _KINDS[number % 3], 3 if number // 3 % 3 == 0 else 2
    while True:
        case = _drawn(dice, kind, axes)
        tissue = case.stiffness > 0
        has_parts = kind == "cavity" or len(np.unique(case.labels[tissue])) > 1
        has_cavity = kind == "sliding" or case.removed.any()
        if in_elements(tissue).any() and case.held.any() and has_parts and has_cavity:
            return case


def _drawn(dice: np.random.Generator, kind: Kind, axes: int) -> Case:
    """Return a random problem, which may lack elements, a cavity or parts."""
    grid = tuple(int(side) for side in dice.integers(*_SIDES[axes], axes))
    place = np.moveaxis(np.indices(grid), 0, -1)
    long = dice.random() < 0.5
    spacing = tuple(map(float, dice.uniform(0.5, 2.5, axes).round(2))) if long else (1.0,) * axes
    contrast = 10 ** dice.uniform(0, 3)
    coarse = dice.random(grid) if dice.random() < 0.5 else _near(dice, place, 4) / 3.0
    m = contrast**coarse * 10 ** dice.uniform(-1, 1)
    if dice.random() < 0.3:
        m[dice.random(grid) < 0.08] = 0.0
    removed = np.zeros(grid, np.bool_)
    if kind != "sliding":
        middle = dice.uniform(0.2, 0.8, axes) * (np.array(grid) - 1)
        radii = dice.uniform(0.1, 0.35, axes) * np.array(grid) + 0.4
        removed = (((place - middle) / radii) ** 2).sum(axis=-1) <= 1
        removed &= m > 0
        m[removed] = 0.0
    labels = np.zeros(grid, np.int32)
    if kind != "cavity":
        labels = _near(dice, place, int(dice.integers(2, 4))).astype(np.int32)
        if dice.random() < 0.4:
            tilt = dice.normal(size=axes)
            labels = ((place - (np.array(grid) - 1) / 2) @ tilt > 0).astype(np.int32)
    held = _held(dice, m > 0, labels)
    y = np.where(held, dice.normal(size=held.shape) * dice.uniform(0, 1.5), 0.0)
    if dice.random() < 0.5:
        y = np.where(held, dice.normal(size=axes) * (labels[..., None] + place[..., :1] % 2), 0.0)
    unit = math.prod(spacing) ** (1 / axes)
    nu = float(dice.choice([0.0, 0.3, 0.45, 0.49]))
    mapped = dice.random() < 0.25
    poisson = dice.uniform(0.0, 0.49, grid).astype(np.float32) if mapped else nu
    soft = float(np.median(m[m > 0])) if (m > 0).any() else 1.0
    return Case(
        kind=kind,
        stiffness=m.astype(np.float32),
        removed=removed,
        labels=labels,
        observed=y * unit,
        held=held,
        poisson=poisson,
        plane="strain" if dice.random() < 0.5 else "stress",
        spacing=spacing,
        gravity=dice.normal(size=axes) * 0.02 * soft / unit,
        pressure=float(dice.normal() * 0.05 * soft) if dice.random() < 0.5 else 0.0,
        fluid=float(dice.uniform(0, 0.05) * soft / unit) if dice.random() < 0.7 else 0.0,
        level=float(dice.uniform(0, 1.3)),
    )


def _near(dice: np.random.Generator, place: Sites, count: int) -> Sites:
    """Return the number of the nearest of some random points, for each site."""
    points = dice.random((count, place.shape[-1])) * place.shape[:-1]
    away = np.linalg.norm(place[..., None, :] - points, axis=-1)
    return np.asarray(away.argmin(axis=-1))


def _held(dice: np.random.Generator, tissue: Flags, labels: npt.NDArray[np.int32]) -> Flags:
    """Return prescribed components; usually each piece of a part has three prescribed sites."""
    axes, sites = tissue.ndim, np.zeros(tissue.shape, np.bool_)
    for axis in range(axes):
        if dice.random() < 0.4:
            sites.swapaxes(0, axis)[dice.choice([0, -1])] = True
    sites |= dice.random(tissue.shape) < dice.choice([0.0, 0.03, 0.15])
    held = np.repeat(sites[..., None], axes, axis=-1)
    if dice.random() < 0.2:
        held &= dice.random(held.shape) < 0.6
    if dice.random() < 0.85:
        piece = around_sites(scipy.ndimage.label(in_elements(tissue))[0], np.maximum)
        for number in np.unique(piece[piece > 0]):
            for label in np.unique(labels[piece == number]):
                at = np.argwhere((piece == number) & (labels == label))
                for site in dice.permutation(at)[: dice.integers(3, 6)]:
                    held[tuple(site)] = True
    # The matrix has no equation for other sites, which follow their tissue.
    return held & around_sites(in_elements(tissue), np.logical_or)[..., None]


def _lame(young: float, nu: float, case: Case) -> tuple[float, float]:
    """Return the first Lame parameter, in plane stress its plane counterpart, and the shear."""
    shear = young / (2 * (1 + nu))
    if case.stiffness.ndim == 2 and case.plane == "stress":
        return young * nu / (1 - nu**2), shear
    return young * nu / ((1 + nu) * (1 - 2 * nu)), shear


def forces_of(case: Case) -> Array:
    """Return the force of weight and of the contents of the cavity at each site.

    The surface of the cavity consists of the faces between elements of tissue and elements with a
    removed corner. The pressure is interpolated between the corners, and two Gauss points along
    each axis integrate its product with the shape functions.
    """
    grid, axes = case.stiffness.shape, case.stiffness.ndim
    force = np.zeros((*grid, axes))
    if not case.removed.any():
        return force
    size = np.array(case.spacing)
    corners = list(itertools.product((0, 1), repeat=axes))
    tissue = case.stiffness > 0
    elements = list(itertools.product(*(range(side - 1) for side in grid)))
    remains, gone = {}, {}
    for at in elements:
        sites = [tuple(np.add(at, corner)) for corner in corners]
        hole = [bool(case.removed[site]) for site in sites]
        body = [bool(tissue[site]) for site in sites]
        remains[at] = all(body)
        gone[at] = any(hole) and all(a or b for a, b in zip(hole, body, strict=True))
        if remains[at]:
            for site in sites:
                force[site] += case.gravity * size.prod() / 2**axes
    faces = []
    for at in elements:
        for axis, side in itertools.product(range(axes), (0, 1)):
            beside = list(at)
            beside[axis] += 2 * side - 1
            if remains[at] and gone.get(tuple(beside), False):
                ends = [corner for corner in corners if corner[axis] == side]
                faces.append((axis, 1 - 2 * side, [tuple(np.add(at, end)) for end in ends]))
    if not faces:
        return force
    down = case.gravity / np.linalg.norm(case.gravity)
    heights = {site: -float(down @ (site * size)) for *_, sites in faces for site in sites}
    low, high = min(heights.values()), max(heights.values())
    surface = low + case.level * (high - low)
    gauss = [0.5 - 12**-0.5, 0.5 + 12**-0.5]
    for axis, inwards, sites in faces:
        presses = [case.pressure + case.fluid * max(0.0, surface - heights[at]) for at in sites]
        area = size.prod() / size[axis]
        ends = list(itertools.product((0, 1), repeat=axes - 1))
        for point in itertools.product(gauss, repeat=axes - 1):
            shares = [
                math.prod(x if end else 1 - x for x, end in zip(point, corner, strict=True))
                for corner in ends
            ]
            there = sum(share * p for share, p in zip(shares, presses, strict=True))
            for site, share in zip(sites, shares, strict=True):
                force[(*site, axis)] += inwards * there * share * area / 2 ** (axes - 1)
    return force


def dense_solution(case: Case, tilt: float = 0.0, number: int = 0) -> tuple[Array, float]:
    """Return the field of a dense system and its least eigenvalue, for a diagonal of 1.

    Parameters
    ----------
    case : Case
    tilt : float
        Standard deviation of a random tilt of the normals of interfaces, in degrees.
    number : int
        Seed of the tilt.

    Returns
    -------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement in pixels; nan if the system cannot be solved in double precision.
    least : float
    """
    m, axes = case.stiffness.astype(np.float64), case.stiffness.ndim
    grid, tissue = m.shape, case.stiffness > 0
    sites = np.arange(m.size).reshape(grid)
    corners = np.array(list(itertools.product((0, 1), repeat=axes)))
    firsts = np.argwhere(np.ones([side - 1 for side in grid], np.bool_))
    around = sites[tuple(np.moveaxis(firsts[:, None] + corners, -1, 0))]
    around = around[tissue.ravel()[around].all(axis=1)]
    parts = np.unique(case.labels[tissue]) if case.kind != "cavity" else np.zeros(1, np.int32)
    owner = np.full(m.size, -1)
    for part, label in enumerate(parts):
        owner[(tissue & (case.labels == label)).ravel()] = part
    full = axes == 2 and case.plane == "stress"
    volume, shear = (
        each.reshape(axes * 2**axes, -1) for each in element_matrices(case.spacing, full=full)
    )
    node = np.full((len(parts), m.size), -1)
    for part in range(len(parts)):
        for element in around:
            if (owner[element] == part).any():
                node[part, element] = 0
    node[node == 0] = np.arange(np.count_nonzero(node == 0))
    size = axes * (int(node.max()) + 1)
    matrix, load = np.zeros((size, size)), np.zeros(size)
    nu = np.broadcast_to(np.asarray(case.poisson, np.float64), grid)
    for part in range(len(parts)):
        ratios = _extended(nu, (owner == part).reshape(grid))
        for element in around:
            own = owner[element] == part
            if own.any():
                young = float(m.ravel()[element][own].sum() / len(element))
                both = _lame(young, float(ratios[element].mean()), case)
                dofs = (axes * node[part, element][:, None] + np.arange(axes)).ravel()
                matrix[np.ix_(dofs, dofs)] += both[0] * volume + both[1] * shear
    for first, second, normal, strength in _pairs(case, owner.reshape(grid), node, tilt, number):
        dofs = np.concatenate([axes * first + np.arange(axes), axes * second + np.arange(axes)])
        gap = np.concatenate([normal, -normal])
        matrix[np.ix_(dofs, dofs)] += strength * np.outer(gap, gap)
    force, fixed, values = forces_of(case), np.zeros(size, np.bool_), np.zeros(size)
    at = np.flatnonzero(owner >= 0)
    at = at[node[owner[at], at] >= 0]
    mine = axes * node[owner[at], at][:, None] + np.arange(axes)
    load[mine] = force.reshape(-1, axes)[at]
    fixed[mine] = case.held.reshape(-1, axes)[at]
    given = case.observed.astype(np.float32).astype(np.float64).reshape(-1, axes)
    values[mine] = np.where(fixed[mine], given[at], 0.0)
    free = ~fixed
    right = (load - matrix @ values)[free]
    inner = matrix[np.ix_(free, free)]
    least = 1.0
    if len(inner):
        root = np.sqrt(np.diag(inner))
        inner = inner / root[:, None] / root
        least = float(scipy.linalg.eigvalsh(inner, subset_by_index=[0, 0])[0])
        if not right.any():
            values[free] = 0.0  # nothing drives the tissue, even if nothing holds it
        elif least > UNRESOLVED:
            values[free] = np.linalg.solve(inner, right / root) / root
        else:
            values[free] = np.nan
    field = np.where(case.held, given.reshape(case.observed.shape), 0.0).reshape(-1, axes)
    field[at] = values[mine]
    return field.reshape(case.observed.shape) / case.unit, least


def _extended(values: Array, own: Flags) -> Array:
    """Return values of a part's sites, flattened; other sites have the mean of those around."""
    found = np.where(own, values, 0.0)
    for at in np.argwhere(~own):
        near = tuple(slice(max(i - 1, 0), i + 2) for i in at)
        if own[near].any():
            found[tuple(at)] = values[near][own[near]].mean()
    return found.ravel()


def _pairs(
    case: Case, owner: Sites, node: Sites, tilt: float, number: int
) -> list[tuple[int, int, Array, float]]:
    """Return the two nodes, the normal and the strength of each connection between parts."""
    axes, m = case.stiffness.ndim, case.stiffness.astype(np.float64)
    dice = np.random.default_rng(number)
    found = []
    for one, two in itertools.combinations(range(len(node)), 2):
        at, pairs, strengths = [], [], []
        for copied, home in ((one, two), (two, one)):
            for site in np.argwhere(owner == home):
                flat = int(np.ravel_multi_index(tuple(site), owner.shape))
                if node[copied, flat] < 0:
                    continue
                near = tuple(slice(max(i - 1, 0), i + 2) for i in site)
                soft = min(float(m[near][owner[near] == part].max()) for part in (one, two))
                at.append(site)
                pairs.append((int(node[home, flat]), int(node[copied, flat])))
                strengths.append(100.0 * soft * case.unit ** (axes - 2))
        if at:
            normals = interface_normals(owner == one, owner == two, np.array(at), case.spacing)
            normals = normals + math.radians(tilt) * dice.normal(size=normals.shape)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            for pair, normal, strength in zip(pairs, normals, strengths, strict=True):
                found.append((*pair, normal, strength))
    return found


def judge(seed: int, number: int) -> Verdict:
    """Solve a random problem and compare it with the dense solution."""
    case = random_case(seed, number)
    axes = case.stiffness.ndim
    exact, least = dense_solution(case)
    if np.abs(exact).max() > _MOTION:  # False if the field is unknown
        share = _MOTION / float(np.abs(exact).max())
        case, exact = case.scaled(share), share * exact
    prior = ElasticPrior(case.poisson, plane=case.plane)
    verdict = Verdict(number, case.kind, axes, _RIGHT, math.nan, math.nan, least)
    try:
        solution = solve(case.problem(), prior, backend="cpu")
    except (ProblemError, ConvergenceError) as refusal:
        outcome = _REFUSED if least > SINGULAR else _SINGULAR
        if outcome == _REFUSED and _depends_on_normals(case, exact):
            outcome = _NEARLY
        return replace(verdict, outcome=outcome, remark=str(refusal))
    except Exception as crash:  # noqa: BLE001  any other error is a failure
        return replace(verdict, outcome=_WRONG, remark=repr(crash))
    if not np.isfinite(exact).all():
        return replace(verdict, outcome=_FREE)
    whole = around_sites(in_elements(case.stiffness), np.logical_or)
    error = float(np.abs(solution.displacement / case.unit - exact)[whole].max())
    assert solution.convergence is not None
    reported = float(solution.convergence.error)
    right = error <= LARGEST and error <= REPORTED * reported + ROUNDED
    return replace(verdict, outcome=_RIGHT if right else _WRONG, error=error, reported=reported)


def _depends_on_normals(case: Case, exact: Array) -> bool:
    """Return whether small tilts of the normals change the field as much as its own size."""
    if case.kind == "cavity":
        return False
    scale = float(np.abs(exact).max())
    changes = []
    for number in range(TILTS):
        tilted, least = dense_solution(case, TILT, number)
        changes.append(math.inf if least <= SINGULAR else float(np.abs(tilted - exact).max()))
    return max(changes) > UNDETERMINED * max(scale, 1e-9)


def report(verdicts: list[Verdict], worst: int = 10) -> str:
    """Return a table of the outcomes, and the failed and least accurate problems."""
    lines = [
        "| problems | number | " + " | ".join(_OUTCOMES) + " | largest error |",
        "| --- " * (len(_OUTCOMES) + 3) + "|",
    ]
    for kind, axes in itertools.product((*_KINDS, None), (2, 3)):
        mine = [v for v in verdicts if v.axes == axes and kind in (None, v.kind)]
        counts = Counter(v.outcome for v in mine)
        errors = [v.error for v in mine if v.outcome in (_RIGHT, _WRONG)]
        name = f"{kind or 'all'}, {'images' if axes == 2 else 'volumes'}"
        numbers = " | ".join(str(counts[outcome]) for outcome in _OUTCOMES)
        lines.append(f"| {name} | {len(mine)} | {numbers} | {max(errors, default=0):.1e} px |")
    failed = [v for v in verdicts if v.failed or v.outcome == _FREE]
    solved = sorted((v for v in verdicts if v.outcome == _RIGHT), key=lambda v: -v.error)
    lines += ["", f"{len(verdicts)} problems, {sum(v.failed for v in verdicts)} failures."]
    for name, some in (("Failures:", failed), ("Largest errors:", solved[:worst])):
        lines += ["", name] if some else []
        for v in some:
            lines.append(
                f"--only {v.number}: {v.outcome}, {v.kind}, error {v.error:.1e}, reported "
                f"{v.reported:.1e}, least eigenvalue {v.least:.1e} {v.remark}".rstrip()
            )
    return "\n".join(lines)


def _judged(which: tuple[int, int]) -> Verdict:
    return judge(*which)


def main(argv: list[str] | None = None) -> int:
    """Run the campaign; return 1 if a problem failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--problems", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this time")
    parser.add_argument("--only", type=int, help="number of a single problem to run again")
    given = parser.parse_args(argv)
    if given.only is not None:
        numbers = range(given.only, given.only + 1)
    else:
        numbers = range(given.first, given.first + given.problems)
    begun, verdicts = time.monotonic(), []
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for verdict in pool.imap(_judged, [(given.seed, number) for number in numbers]):
            verdicts.append(verdict)
            if verdict.failed:
                print(verdict, file=sys.stderr, flush=True)
            if time.monotonic() - begun > 60 * given.minutes:
                break
            if len(verdicts) % 100 == 0:
                print(f"{len(verdicts)}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
    print(report(verdicts))
    return int(any(verdict.failed for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
