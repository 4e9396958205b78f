"""Random problems that tests, benchmarks and studies share.

A function of random problems draws from a generator of NumPy, so a problem depends only on its
seed; `dice_of` returns the generator of a problem of a campaign. A function that takes a number
also chooses the grid by it. Tissue, void, observations, displacements, pixels and priors are drawn
by the same functions in images and volumes, and in problems with cavities and sliding parts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.ndimage as ndi

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Problem, SeilerPrior
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import around_sites, in_elements, sites_of_elements
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import Loads, cavity, growth, weight
from napari_hmrf.solver.uncertain_landmarks import interpolated
from napari_hmrf.solver.unconnected import scraps
from napari_hmrf.tissue import SlidingParts
from validation.bodies import Array, Dice, Flags, Shape, dice_of, offsets, turned
from validation.oracles.elasticity import rigid_sites
from validation.oracles.large_motion import displaced_corners, smallest_jacobians

Labels = npt.NDArray[np.int32]
Prior = ElasticPrior | SeilerPrior

#: Inputs of elastic tissue, each of which combines with each other.
INPUTS = (
    "rigid",
    "sliding",
    "slip",
    "precision",
    "landmarks",
    "drift",
    "growth",
    "forces",
    "cavity",
    "followers",
)
#: Largest side of an image and of a volume, and range of sides with cavities or parts, in sites.
LARGEST, SIDES_OF_PARTS = {2: 64, 3: 13}, {2: (4, 17), 3: (3, 7)}
#: Range of sides of problems that combine inputs, whose references take longest.
SIDES_OF_COMBINATIONS = {2: (4, 13), 3: (3, 6)}
#: Number of decades of the largest contrast of stiffness, and of that with cavities or parts.
DECADES, DECADES_OF_PARTS = {2: 7.0, 3: 6.0}, 3.0
# Range of decades of the unit of stiffness; units and pixel sizes are arbitrary.
_UNITS = (-3.0, 6.0)
# Kinds of priors of images, volumes, and tissue with cavities or parts, and their shares.
_PRIORS = ("stress", "strain", "centred", "blanket")
_IMAGES, _VOLUMES, _PARTS = (0.3, 0.3, 0.2, 0.2), (0.0, 0.65, 0.35, 0.0), (0.5, 0.5, 0.0, 0.0)
# Kinds of void, their shares, and shares with cavities or parts, where specks make pieces of parts
# that touch at corners.
_VOIDS = ("none", "holes", "around", "specks", "gaps")
_SPECKS = (0.0, 0.0, 0.0, 1.0, 0.0)
_USUAL_VOIDS, _VOIDS_OF_PARTS = (0.55, 0.13, 0.14, 0.08, 0.1), (0.4, 0.1, 0.05, 0.35, 0.1)
# Least Jacobian of a map from which targets of large motion are sampled.
_LEAST = 0.2
# Sides and spacing of tissue with sliding parts, and of tissue with random tensors.
_GRIDS_OF_PARTS: tuple[tuple[Shape, tuple[float, ...]], ...] = (
    ((30, 40), (1.0, 1.0)),
    ((28, 24), (1.0, 2.0)),
    ((11, 12, 13), (1.0, 1.0, 1.0)),
    ((12, 10, 9), (2.0, 1.0, 1.5)),
)
_GRIDS_OF_DATA: tuple[tuple[Shape, tuple[float, ...]], ...] = (
    ((40, 50), (1.0, 1.0)),
    ((48, 36), (1.0, 2.0)),
    ((13, 14, 15), (1.0, 1.0, 1.0)),
    ((10, 14, 12), (2.0, 1.0, 1.5)),
)
# Sides and spacing of tissue with a dense posterior.
_SMALL_GRIDS: tuple[tuple[Shape, tuple[float, ...]], ...] = (
    ((14, 14), (1.0, 1.0)),
    ((14, 14), (1.0, 3.0)),
    ((6, 6, 6), (1.0, 1.0, 1.0)),
    ((6, 6, 6), (2.0, 1.0, 1.0)),
)
# Kinds of edits and their shares.
_EDITS = {
    "pull": 0.14,
    "move": 0.3,
    "let go": 0.05,
    "confidence": 0.07,
    "stiffness": 0.08,
    "penalty": 0.05,
    "poisson": 0.04,
    "remove": 0.06,
    "add": 0.04,
    "growth": 0.06,
    "undo": 0.11,
}


@dataclass(frozen=True, eq=False)
class Contents:
    """Removed tissue, what fills it, and the weight of the other tissue.

    Attributes
    ----------
    removed : ndarray of bool, shape (H, W) or (D, H, W)
    gravity : ndarray, shape (2,) or (3,)
        Weight of the tissue per volume.
    pressure, fluid, level : float
        As for `cavity`; the fluid presses downwards, along gravity.
    """

    removed: Flags
    gravity: Array
    pressure: float
    fluid: float
    level: float

    def scaled(self, share: float) -> Contents:
        """Return the contents with all forces multiplied by a number."""
        forces = (share * each for each in (self.gravity, self.pressure, self.fluid))
        return Contents(self.removed, *forces, self.level)

    def loads(self, stiffness: npt.NDArray[Any], spacing: tuple[float, ...]) -> Loads:
        """Return the loads of the package."""
        down = self.gravity / np.linalg.norm(self.gravity)
        return weight(stiffness, self.gravity, spacing=spacing) + cavity(
            stiffness,
            self.removed,
            spacing=spacing,
            pressure=self.pressure,
            fluid=self.fluid * down,
            level=self.level,
        )


@dataclass(frozen=True, eq=False)
class RandomProblem:
    """Problem, prior and tolerance, and their kinds.

    Attributes
    ----------
    kinds : dict of str to str
        Kinds of energy, tissue, void, observed sites, displacement and contrast.
    arguments : dict
        Arguments of `Problem`, which may refuse them.
    prior : ElasticPrior or SeilerPrior
    tolerance : float
        Tolerance of `Multigrid`, in pixels.
    contents : Contents, optional
        Loads of a cavity.
    loads : Loads, optional
        Other loads.
    """

    kinds: dict[str, str]
    arguments: dict[str, Any]
    prior: Prior
    tolerance: float
    contents: Contents | None = None
    loads: Loads | None = None

    @cached_property
    def problem(self) -> Problem:
        """Problem as accepted by the package."""
        loads = self.loads
        if self.contents is not None:
            own = self.contents.loads(self.arguments["stiffness"], self.arguments["spacing"])
            loads = own if loads is None else own + loads
        return Problem(**self.arguments, loads=loads)

    def scaled(self, share: float) -> RandomProblem:
        """Return the problem with all motion and all loads multiplied by a number."""
        arguments = self.arguments | {"observed": share * self.arguments["observed"]}
        marks, loads = self.arguments.get("landmarks"), self.loads
        if marks is not None:
            targets = marks.points + share * (marks.targets - marks.points)
            arguments["landmarks"] = Landmarks(
                marks.points, targets, sd=marks.sd, scale=marks.scale, drift=marks.drift
            )
        contents = None if self.contents is None else self.contents.scaled(share)
        if loads is not None:
            parts = (None if each is None else share * each for each in (loads.growth, loads.force))
            loads = Loads(**dict(zip(("growth", "force"), parts, strict=True)))
        return replace(self, arguments=arguments, contents=contents, loads=loads)

    def __str__(self) -> str:
        """Return a description in one line."""
        size = " x ".join(map(str, self.arguments["stiffness"].shape))
        spacing = self.arguments["spacing"]
        longest = max(spacing) / min(spacing)
        pixel = "" if longest == 1 else f", pixels {longest:.2g} times as long as wide"
        poisson = getattr(self.prior, "poisson", None)
        nu = "" if poisson is None else f", nu {np.ravel(poisson)[0]:.3g}"
        nu += " and other" if isinstance(poisson, np.ndarray) else ""
        held = "" if self.prior.penalty in (None, math.inf) else f", K {self.prior.penalty:.2g}"
        kinds = ", ".join(f"{name} {kind}" for name, kind in self.kinds.items())
        return f"{size}{pixel}, {kinds}{nu}{held}, tolerance {self.tolerance:g}"


def random_problem(dice: Dice, axes: int = 2) -> RandomProblem:
    """Return an image or a volume: typical problems of users, and unusual problems."""
    shape = _shape(dice, axes, LARGEST[axes])
    return _drawn(dice, shape, DECADES[axes], _IMAGES if axes == 2 else _VOLUMES)


def random_parts(dice: Dice, axes: int, has_cavity: bool, has_parts: bool) -> RandomProblem:
    """Return a small problem with a loaded cavity, parts that slide along each other, or both."""
    while True:
        shape = tuple(map(int, dice.integers(*SIDES_OF_PARTS[axes], axes)))
        made = _drawn(dice, shape, DECADES_OF_PARTS, _PARTS, has_cavity, has_parts)
        tissue = made.arguments["stiffness"] > 0
        parts = made.arguments.get("sliding")
        slides = parts is not None and len(np.unique(parts.labels[tissue])) > 1
        empties = made.contents is not None and made.contents.removed.any()
        is_held = made.arguments["confidence"].any()
        if is_held and slides == has_parts and empties == has_cavity:
            return made


def random_combination(dice: Dice, axes: int, inputs: frozenset[str]) -> RandomProblem:
    """Return a small problem with some of the inputs `INPUTS` of elastic tissue."""
    while True:
        shape = tuple(map(int, dice.integers(*SIDES_OF_COMBINATIONS[axes], axes)))
        has = {each: each in inputs for each in INPUTS}
        made = _drawn(
            dice,
            shape,
            DECADES_OF_PARTS,
            _PARTS,
            has["cavity"],
            has["sliding"],
            has_followers=has["followers"],
        )
        m, y, c = (made.arguments[name].copy() for name in ("stiffness", "observed", "confidence"))
        spacing, soft, prior = made.arguments["spacing"], m.max(), made.prior
        unit = math.prod(spacing) ** (1 / axes)
        if has["slip"]:
            prior = replace(prior, penalty=_penalty(dice))
            if c.max() == 1 and dice.random() < 0.8:
                c = np.where(c > 0, dice.choice([0.02, 0.2, 0.5, 0.9, 1.0], c.shape), 0)
        else:
            c = np.where(c > 0, 1.0, 0.0)
        if has["rigid"]:
            bodies = _with_bodies(dice, m)
            if not bodies.any():
                continue
            _observe_bodies(dice, bodies, y, c, spacing, may_slip=has["slip"])
        if not in_elements(m).any():
            continue
        if has["followers"]:
            orphans = (m > 0) & ~sites_of_elements(m > 0)
            if not orphans.any():
                continue
            # The reference does not know which part's sites they follow, and certain observations
            # that they pass on to a body would change its shape.
            if has["sliding"] or (has["rigid"] and not has["slip"]):
                c[orphans] = 0
        if not c.any() and not inputs & {"precision", "landmarks", "drift"}:
            continue
        given = {"stiffness": m, "observed": y, "confidence": c}
        if has["precision"]:
            strength = soft * unit ** (axes - 2) * 10 ** dice.uniform(-2, 2)
            precision = random_tensors(dice, shape, axes, strength, dice.choice([0.1, 0.5]))
            precision[~sites_of_elements(m > 0)] = 0
            given["precision"] = precision
        elements = np.argwhere(in_elements(m))
        if has["landmarks"] or has["drift"]:
            if len(elements) <= 4:
                continue
            points = dice.choice(elements, 12) + dice.random((12, axes))
            strain, noise = dice.normal(size=(axes, axes)), dice.normal(size=points.shape)
            targets = points + points @ (0.05 * strain) + 0.2 * noise
            sd = 10 ** dice.uniform(-2, 0.5)
            given["landmarks"] = Landmarks(points, targets, sd=sd, drift=has["drift"])
        loads = None
        if has["forces"]:
            size = soft * unit ** (axes - 1)
            force = 0.02 * size * dice.normal(size=y.shape) * sites_of_elements(m > 0)[..., None]
            loads = Loads(force=force * (dice.random(shape) < 0.2)[..., None])
        if has["growth"]:
            own = growth(0.1 * dice.random(shape) * np.isfinite(m))
            loads = own if loads is None else loads + own
        kinds = {"inputs": ", ".join(each for each in INPUTS if has[each])} | made.kinds
        drawn = replace(
            made, kinds=kinds, arguments=made.arguments | given, prior=prior, loads=loads
        )
        try:
            drawn.problem  # noqa: B018  it is made once, and kept
        except ProblemError:
            continue  # some displacements are too large
        return drawn


def _penalty(dice: Dice) -> float | None:
    return None if dice.random() < 0.7 else float(10 ** dice.uniform(-2, 1))


def _with_bodies(dice: Dice, m: npt.NDArray[np.float32]) -> Labels:
    """Make some tissue rigid, in place, and return the numbers of the bodies; 0 elsewhere."""
    rigid = smooth_noise(dice, m.shape, dice.uniform(0.6, 2)) > dice.uniform(0.7, 0.95)
    m[rigid & (m > 0)] = np.inf
    return np.asarray(ndi.label(rigid_sites(m), np.ones((3,) * m.ndim))[0])


def _observe_bodies(
    dice: Dice, bodies: Labels, y: Array, c: Array, spacing: tuple[float, ...], *, may_slip: bool
) -> None:
    """Draw the observations of rigid bodies, in place; at most one site of each is certain.

    Where observations may slip, those of some bodies agree with a rigid motion.
    """
    shape, axes = bodies.shape, bodies.ndim
    for number in range(1, int(bodies.max()) + 1):
        body = bodies == number
        seen = (c > 0) & body[..., None]
        kind = dice.choice(["free", "slips", "one certain site"], p=[0.3, 0.5, 0.2])
        if kind == "free" or not may_slip:
            c[seen] = 0
        else:
            c[seen] = np.minimum(c[seen], dice.choice([0.9, 0.05]))
            if dice.random() < 0.3:  # observe more of the body
                c[body & (dice.random(shape) < 0.5)] = float(dice.choice([0.05, 0.3, 0.7]))
        if kind == "one certain site":
            c[tuple(dice.choice(np.argwhere(body)))] = 1
        if may_slip and kind != "free" and dice.random() < 0.5:
            turn = dice.normal(size=(axes, axes)) * 0.2 * (dice.random() < 0.5)
            places = np.moveaxis(offsets(shape, np.argwhere(body).mean(axis=0)), 0, -1)
            moved = places * spacing @ (turn - turn.T)
            y[body] = (moved + dice.normal(size=axes) * math.prod(spacing) ** (1 / axes))[body]


def _drawn(
    dice: Dice,
    shape: Shape,
    decades: float,
    priors: tuple[float, ...],
    has_cavity: bool = False,
    has_parts: bool = False,
    has_followers: bool = False,
) -> RandomProblem:
    """Return a problem, which may lack parts, a cavity or sites that follow their neighbours."""
    axes, spacing = len(shape), _spacing(dice, len(shape))
    unit = math.prod(spacing) ** (1 / axes)
    tissue, relative = _stiffness(dice, shape, decades)
    is_small = decades == DECADES_OF_PARTS
    voids = _SPECKS if has_followers else _VOIDS_OF_PARTS if is_small else _USUAL_VOIDS
    void, empty = _void(dice, shape, voids)
    m = np.where(empty, 0.0, relative * 10 ** dice.uniform(*_UNITS)).astype(np.float32)
    contents, labels = None, None
    if has_cavity:
        contents = _contents(dice, m, unit)
        m[contents.removed] = 0
        if not m.any():
            m[...] = 1
    if has_parts:
        labels = _labels(dice, shape)
    pieces = _pieces(m > 0, labels) if is_small else ndi.label(m > 0)[0]
    # In small problems, every piece of a part has sites that hold it, so that most are unique.
    seen, observed = _observed(dice, m > 0, pieces, 3 if is_small else axes)
    if (
        is_small and not has_followers
    ):  # elsewhere, sites follow their tissue, and a dense system has no equation
        observed &= (pieces > 0)[..., None]
    moved, y = _displacement(dice, shape, observed.any(axis=-1))
    if labels is not None and dice.random() < 0.5:
        y = dice.normal(size=axes) * (labels[..., None] + np.indices(shape)[0][..., None] % 2)
    # Limit displacements to less than half the image, because `Problem` refuses much larger ones.
    across = math.hypot(*(side * size for side, size in zip(shape, spacing, strict=True)))
    y *= min(10 ** dice.uniform(-1, 0.9) * unit, 0.4 * across) / max(float(np.abs(y).max()), 1e-9)
    c = np.where(observed, _confidence(dice, observed.shape), 0.0)
    prior, energy = _prior(dice, shape, priors)
    if axes == 3 and isinstance(prior, SeilerPrior):
        c = 1.0 * observed  # weak observations slip, but the reference for volumes holds them
    tolerance = float(dice.choice([1e-3, 1e-2, 1e-4], p=[0.8, 0.1, 0.1]))
    body = m[m > 0]
    decade = math.floor(math.log10(body.max() / body.min()))
    if axes == 3 and not is_small and isinstance(prior, ElasticPrior) and dice.random() < 0.3:
        rigid = smooth_noise(dice, shape, dice.uniform(0.6, 3)) > dice.uniform(0.8, 0.98)
        m[rigid & (m > 0) & ~observed.any(axis=-1)] = np.inf
    given = {"observed": y, "confidence": c, "stiffness": m, "spacing": spacing}
    if labels is not None:
        given["sliding"] = SlidingParts(labels)
    kinds = {
        "energy": energy,
        "contrast": "uniform" if body.max() == body.min() else f"1e{decade}",
        "tissue": f"{tissue}, rigid" if np.isinf(m).any() else tissue,
        "void": void if empty.any() else "none",
        "observations": seen,
        "displacement": moved,
    }
    return RandomProblem(kinds, given, prior, tolerance, contents)


def _shape(dice: Dice, axes: int, largest: int) -> Shape:
    kind = dice.choice(["any", "strip", "large", "tiny"], p=[0.6, 0.2, 0.08, 0.12])
    if kind == "strip":
        thin = [int(dice.integers(1, 5)) for _ in range(axes - 1)]
        sides = [*thin, int(dice.integers(largest // 8, largest + 1))]
        dice.shuffle(sides)
    elif kind == "large":
        sides = list(dice.integers(largest * 5 // 8, largest + 1, axes))
    elif kind == "tiny":
        sides = list(dice.integers(1, 6, axes))
    else:
        sides = [int(2 ** dice.uniform(1, math.log2(largest))) for _ in range(axes)]
    shape = tuple(map(int, sides))
    return shape if math.prod(shape) > 1 else (2,) * axes


def _spacing(dice: Dice, axes: int) -> tuple[float, ...]:
    """Return the sides of a pixel, in any unit; half of the pixels are squares."""
    ratio = 1.0 if dice.random() < 0.5 else 10 ** dice.uniform(-1, 1)
    size = 1.0 if dice.random() < 0.5 else 10 ** dice.uniform(-2, 2)
    if ratio == 1:
        return (size,) * axes
    sides = [size * math.sqrt(ratio), size / math.sqrt(ratio)]
    if axes == 3:
        sides.insert(int(dice.integers(3)), size)
    return tuple(sides)


def smooth_noise(dice: Dice, shape: Shape, width: float) -> Array:
    """Return smooth noise, evenly distributed from 0 to 1."""
    values = ndi.gaussian_filter(dice.normal(size=shape), width, mode="reflect")
    made = np.empty(values.size)
    made[np.argsort(values, axis=None)] = np.linspace(0, 1, values.size)
    return made.reshape(shape)


def _stiffness(dice: Dice, shape: Shape, decades: float) -> tuple[str, Array]:
    """Return the kind of stiffness, and stiffness from 1 to a random contrast."""
    contrast = 10 ** dice.uniform(0, decades)
    places = np.indices(shape)
    kind = str(
        dice.choice(
            ["uniform", "blobs", "white", "smooth", "layers", "fibres", "board", "mixed"],
            p=[0.12, 0.22, 0.1, 0.08, 0.12, 0.16, 0.1, 0.1],
        )
    )
    if kind == "uniform":
        share = np.zeros(shape)
    elif kind == "blobs":
        share = 1.0 * (smooth_noise(dice, shape, dice.uniform(0.6, 6)) > dice.uniform(0.15, 0.85))
    elif kind == "white":
        share = dice.random(shape)
    elif kind == "smooth":
        share = smooth_noise(dice, shape, dice.uniform(2, 8))
    elif kind == "layers":
        along = [*places, places.sum(axis=0)][dice.integers(len(shape) + 1)]
        levels = dice.integers(2, 5)
        share = (along // dice.integers(1, 9)) % levels / (levels - 1)
    elif kind == "fibres":
        share = _fibres(dice, shape)
    elif kind == "board":
        size = dice.integers(1, 5)
        share = 1.0 * ((places // size).sum(axis=0) % 2)
    else:
        share = np.round(smooth_noise(dice, shape, dice.uniform(0.6, 4)) * 3) / 3
    if dice.random() < 0.3:
        share = 1 - share
    return kind, np.asarray(contrast**share)


def _fibres(dice: Dice, shape: Shape) -> Array:
    """Return a mask of a few straight lines in an image, or sheets in a volume."""
    share, axes = np.zeros(shape), len(shape)
    for _ in range(dice.integers(1, 7)):
        turn, place = dice.uniform(0, math.pi), dice.random(axes) * shape
        normal = np.array([math.cos(turn), math.sin(turn)])
        if axes == 3:
            tilt = dice.uniform(0, math.pi)
            normal = np.array([math.cos(tilt), *(math.sin(tilt) * normal)])
        off = sum(each * size for each, size in zip(offsets(shape, place), normal, strict=True))
        share[np.abs(off) < dice.choice([0.5, 1.0, 1.5])] = 1
    return share


def _ball(dice: Dice, shape: Shape, least: float, most: float, place: Any = None) -> Flags:
    """Return the mask of a disc or a ball with a random radius, at a random place by default."""
    place = dice.random(len(shape)) * shape if place is None else place
    return np.asarray(np.linalg.norm(offsets(shape, place), axis=0) < dice.uniform(least, most))


def _beyond_ellipse(shape: Shape, size: float) -> Flags:
    """Return the mask of sites outside an ellipse of the proportions of the grid."""
    middle, sides = (np.array(shape) - 1) / 2, np.reshape(shape, (-1,) + (1,) * len(shape))
    return np.asarray(((offsets(shape, middle) / sides) ** 2).sum(axis=0) > size)


def _void(dice: Dice, shape: Shape, shares: tuple[float, ...]) -> tuple[str, Flags]:
    kind = str(dice.choice(_VOIDS, p=shares))
    empty = np.zeros(shape, dtype=bool)
    if kind == "holes":
        empty = smooth_noise(dice, shape, dice.uniform(0.6, 4)) < dice.uniform(0.05, 0.4)
    elif kind == "around":
        empty = _beyond_ellipse(shape, dice.uniform(0.18, 0.35))
    elif kind == "specks":
        empty = dice.random(shape) < dice.uniform(0.01, 0.2)
    elif kind == "gaps":
        empty = _fibres(dice, shape) > 0
    if empty.all():
        empty[...] = False
    return kind, empty


def _contents(dice: Dice, m: npt.NDArray[np.float32], unit: float) -> Contents:
    """Return an ellipsoid of tissue to be removed, and random weight, pressure and fluid."""
    axes, sides = m.ndim, np.array(m.shape)
    middle = dice.uniform(0.2, 0.8, axes) * (sides - 1)
    radii = dice.uniform(0.1, 0.35, axes) * sides + 0.4
    inside = ((offsets(m.shape, middle) / radii.reshape(-1, *(1,) * axes)) ** 2).sum(axis=0) <= 1
    soft = float(np.median(m[m > 0]))
    return Contents(
        removed=inside & (m > 0),
        gravity=dice.normal(size=axes) * 0.02 * soft / unit,
        pressure=float(dice.normal() * 0.05 * soft) if dice.random() < 0.5 else 0.0,
        fluid=float(dice.uniform(0, 0.05) * soft / unit) if dice.random() < 0.7 else 0.0,
        level=float(dice.uniform(0, 1.3)),
    )


def _labels(dice: Dice, shape: Shape) -> Labels:
    """Return labels of two or three parts, between straight or bent interfaces."""
    if dice.random() < 0.4:
        middle, tilt = (np.array(shape) - 1) / 2, dice.normal(size=len(shape))
        return np.asarray(np.tensordot(tilt, offsets(shape, middle), 1) > 0, np.int32)
    return _nearest(dice, shape, int(dice.integers(2, 4)))


def _nearest(dice: Dice, shape: Shape, count: int) -> Labels:
    """Return the number of the nearest of some random points at each site."""
    points = dice.random((count, len(shape))) * shape
    away = [np.linalg.norm(offsets(shape, point), axis=0) for point in points]
    return np.argmin(away, axis=0).astype(np.int32)


def _pieces(tissue: Flags, labels: Labels | None) -> Labels:
    """Return numbers of the pieces of each part; 0 at sites without an element."""
    of_elements = around_sites(ndi.label(in_elements(tissue))[0], np.maximum)
    several = of_elements if labels is None else of_elements * (labels.max() + 1) + labels
    numbers = np.unique(np.where(of_elements > 0, several, 0), return_inverse=True)[1]
    return numbers.reshape(tissue.shape).astype(np.int32)


def _observed(dice: Dice, tissue: Flags, pieces: Labels, least: int) -> tuple[str, Flags]:
    """Return the kind and the mask of observed components, at least one of them in tissue.

    In most problems, all components of at least `least` sites of each piece are observed.
    """
    shape, axes = tissue.shape, tissue.ndim
    kind = str(
        dice.choice(
            ["edges", "patches", "pixels", "random", "outline", "everywhere"],
            p=[0.3, 0.2, 0.15, 0.2, 0.12, 0.03],
        )
    )
    sites = np.zeros(shape, dtype=bool)
    if kind == "edges":
        for edge in dice.permutation(2 * axes)[: dice.integers(1, 2 * axes + 1)]:
            sites.swapaxes(0, edge // 2)[-(edge % 2)] = True
    elif kind == "patches":
        for _ in range(dice.integers(1, 7)):
            sites |= _ball(dice, shape, 0.8, 1 + 0.2 * max(shape))
    elif kind == "pixels":
        at = np.argwhere(tissue)
        sites[tuple(at[dice.integers(len(at), size=dice.integers(1, 11))].T)] = True
    elif kind == "random":
        sites = dice.random(shape) < 10 ** dice.uniform(-2, -0.2)
    elif kind == "outline":
        sites = tissue & ~ndi.binary_erosion(tissue)
    else:
        sites[...] = True
    observed = np.repeat(sites[..., None], axes, axis=-1)
    how = dice.choice(["both", "one", "either"], p=[0.6, 0.15, 0.25])
    if how == "one":
        observed[..., dice.integers(axes)] = False
    elif how == "either":
        observed &= dice.random(observed.shape) < dice.uniform(0.3, 0.9)
    if dice.random() < 0.85:
        _hold_pieces(dice, pieces, observed, least)
    if not (observed & tissue[..., None]).any():
        observed[tuple(dice.choice(np.argwhere(tissue)))] = True
    return kind, observed


def _hold_pieces(dice: Dice, pieces: Labels, observed: Flags, least: int) -> None:
    """Observe `least` sites or one more of each piece with fewer observed sites, in place."""
    full = observed.all(axis=-1)
    for number in range(1, int(pieces.max(initial=0)) + 1):
        at = np.argwhere(pieces == number)
        if (full & (pieces == number)).sum() < least:
            for site in at[dice.permutation(len(at))[: dice.integers(least, least + 2)]]:
                observed[tuple(site)] = True


def _displacement(dice: Dice, shape: Shape, sites: Flags) -> tuple[str, Array]:
    """Return the kind of displacement, and a displacement of arbitrary size."""
    grid, axes = np.indices(shape) / max(shape), len(shape)
    kind = str(dice.choice(["smooth", "random", "pushed", "bent"], p=[0.3, 0.25, 0.3, 0.15]))
    if kind == "smooth":
        matrix, shift = dice.normal(size=(axes, axes)), dice.normal(size=axes)
        y = np.moveaxis(np.tensordot(matrix, grid - 0.5, 1), 0, -1) + 0.3 * shift
    elif kind == "random":
        y = dice.normal(size=(*shape, axes))
    elif kind == "bent":
        waves = [smooth_noise(dice, shape, max(shape) / 4) - 0.5 for _ in range(axes)]
        y = np.stack(waves, axis=-1)
    else:
        pieces, count = ndi.label(sites)
        pushes = dice.normal(size=(count + 1, axes)) * (dice.random((count + 1, 1)) < 0.6)
        if count == 1:
            steps = np.arange(max(shape) + 1)
            pushes = dice.normal(size=(len(steps), axes)) * (steps > 1)[:, None]
            pieces = np.indices(shape)[int(np.argmax(shape))] // max(1, max(shape) // 3)
        y = pushes[pieces]
    return kind, np.array(y, dtype=np.float64)


def _confidence(dice: Dice, shape: Shape) -> Array:
    kind = dice.choice(["full", "any", "steps", "wide"], p=[0.5, 0.25, 0.15, 0.1])
    if kind == "full":
        return np.ones(shape)
    if kind == "steps":
        return dice.choice([0.25, 0.5, 1.0], shape)
    if kind == "wide":
        return np.asarray(10 ** dice.uniform(-3, 0, shape))
    return 1 - dice.random(shape)


def _prior(dice: Dice, shape: Shape, shares: tuple[float, ...]) -> tuple[Prior, str]:
    """Return a prior and its name; observations slip in images only."""
    kind = str(dice.choice(_PRIORS, p=shares))
    may_slip = shares == _IMAGES
    penalty = (
        None if dice.random() < (0.45 if may_slip else 1) else float(10 ** dice.uniform(-3, 4))
    )
    how = "held" if penalty is None else "slips"
    if kind in ("centred", "blanket"):
        return SeilerPrior(penalty=penalty, conditional=kind), f"{kind}, {how}"
    nu = dice.choice([0.0, 0.3, 0.45, 0.49, 0.499, dice.uniform(0, 0.499)])
    poisson = float(nu)
    if dice.random() < 0.25:
        other = dice.uniform(0, 0.499)
        share = smooth_noise(dice, shape, dice.uniform(0.6, 5))
        share = share if dice.random() < 0.5 else 1.0 * (share > 0.5)
        # Round as `ElasticPrior` does, because it stores a map in single precision.
        poisson = np.clip(nu + share * (other - nu), 0, 0.499).astype(np.float32)
    return ElasticPrior(poisson, plane=kind, penalty=penalty or math.inf), f"elastic {kind}, {how}"


class State(NamedTuple):
    """Problem and prior."""

    problem: Problem
    prior: Prior


def tissue_with_parts(
    number: int,
    *,
    is_loaded: bool | None = None,
    has_hole: bool = False,
    has_bodies: bool = False,
    has_landmarks: bool = False,
    has_drift: bool = False,
) -> State:
    """Return two to four parts that slide along each other, with a precision.

    Parameters
    ----------
    number : int
        Number of the problem, which selects its grid and its number of parts, too.
    is_loaded : bool, optional
        True for growth and forces; by default, every third problem has them.
    has_hole : bool
        True for a hole in the tissue.
    has_bodies : bool
        True for rigid bodies, in which nothing is prescribed; every other one is at an interface.
    has_landmarks, has_drift : bool
        True for twelve uncertain landmarks, and for a drift that is estimated with them.
    """
    dice = dice_of(number)
    grid, spacing = _GRIDS_OF_PARTS[number % 4]
    axes, count = len(grid), 2 + number % 3
    labels = _nearest(dice, grid, count)
    y = dice.normal(size=(*grid, axes))
    c = np.repeat((dice.random(grid) < 0.2)[..., None], axes, axis=-1)
    force, strain = dice.normal(size=y.shape), 0.05 * dice.random(grid)
    m = (10.0 ** dice.uniform(0, 2, count))[labels] * dice.uniform(1, 2, grid)
    if has_hole:
        m[(slice(6, 9),) * axes] = 0
    precision = dice.random(grid) * (dice.random(grid) < 0.1)
    poisson = dice.uniform(0.2, 0.45, grid) if number % 2 else 0.3
    marks = None
    if has_bodies:
        at_interface = ndi.maximum_filter(labels, 3) > ndi.minimum_filter(labels, 3)
        middles = [
            dice.permutation(np.argwhere((m > 0) & (at_interface == bool(body % 2))))[0]
            for body in range(2)
        ]
        away = np.stack([np.linalg.norm(offsets(grid, middle), axis=0) for middle in middles])
        c[away.min(axis=0) < 5.5] = False
        m[(away.min(axis=0) < 2.5) & (m > 0)] = np.inf
    # The references leave out the forces on tissue in no element, which its neighbours take.
    loads = Loads(force=force * sites_of_elements(m > 0)[..., None], growth=strain * np.isfinite(m))
    if has_landmarks or has_drift:
        elements = dice.permutation(np.argwhere(in_elements(m)))[:12]
        points = elements + dice.random(elements.shape)
        targets = points + dice.normal(size=points.shape)
        sd = 10 ** dice.uniform(-2, 0.5, len(points))
        marks = Landmarks(points, targets, sd=sd, scale=StrainScale(0.1), drift=has_drift)
    problem = Problem(
        observed=y,
        confidence=c.astype(float),
        stiffness=m,
        spacing=spacing,
        loads=loads if (number % 3 == 0 if is_loaded is None else is_loaded) else None,
        precision=precision,
        landmarks=marks,
        sliding=SlidingParts(labels),
    )
    return State(problem, ElasticPrior(poisson))


def random_tensors(
    dice: Dice, grid: Shape, rank: int, strength: float = 1.0, share: float = 1.0
) -> Array:
    """Return tensors of a precision of a given rank at a share of the sites."""
    axes = len(grid)
    factors = dice.normal(size=(*grid, axes, rank))
    tensors = strength * factors @ factors.swapaxes(-1, -2)
    tensors[dice.random(grid) > share] = 0
    return np.asarray(tensors)


def tissue_with_data(
    dice: Dice,
    grid: Shape,
    spacing: tuple[float, ...],
    precision: Array,
    contrast: float,
    *,
    is_held: bool | None = None,
    has_landmarks: bool | None = None,
) -> Problem:
    """Return random tissue with a hole, random observations and their precision.

    Parameters
    ----------
    dice : Generator
    grid, spacing : tuple
    precision : ndarray, shape (*grid, axes, axes)
    contrast : float
        Ratio of the largest to the smallest stiffness.
    is_held, has_landmarks : bool, optional
        True for a held edge, and for eight landmarks near a corner; each is drawn by default.
    """
    axes = len(grid)
    y, c = dice.normal(size=(*grid, axes)), np.zeros((*grid, axes))
    if dice.random() < 0.5 if is_held is None else is_held:
        c[0] = 1
    m = contrast ** dice.random(grid)
    m[(slice(6, 9),) * axes] = 0
    marks = None
    if dice.random() < 0.5 if has_landmarks is None else has_landmarks:
        points = dice.random((8, axes)) * 4
        moved = points + dice.normal(size=points.shape)
        marks = Landmarks(points, moved, sd=10 ** dice.uniform(-2, 1))
    return Problem(
        observed=y, confidence=c, stiffness=m, spacing=spacing, precision=precision, landmarks=marks
    )


def random_data(number: int) -> tuple[dict[str, str], Problem]:
    """Return the kinds and the problem of random tensors, perhaps with landmarks."""
    dice = dice_of(number)
    grid, spacing = _GRIDS_OF_DATA[number % 4]
    rank, share = int(dice.integers(1, len(grid) + 1)), float(dice.choice([1.0, 0.3, 0.05]))
    contrast, strength = 10 ** dice.uniform(0, 4), 10 ** dice.uniform(-3, 4)
    tensors = random_tensors(dice, grid, rank, strength, share)
    problem = tissue_with_data(dice, grid, spacing, tensors, contrast)
    kinds = {
        "grid": " x ".join(map(str, grid)),
        "rank": f"{rank} of {len(grid)}",
        "observed": f"{share:.0%}",
        "strength": f"1e{math.floor(math.log10(strength))}",
        "contrast": f"1e{math.floor(math.log10(contrast))}",
        "landmarks": "none" if problem.landmarks is None else "some",
    }
    return kinds, problem


def small_tissue_with_data(number: int, scale: StrainScale) -> Problem:
    """Return tissue with a dense posterior: held tissue, random tensors or landmarks.

    Parameters
    ----------
    number : int
        Number of the problem, which selects its grid, its contrast and its kind.
    scale : StrainScale
        Scale of the strain to which the precision of the data is relative.
    """
    dice = dice_of(number)
    grid, spacing = _SMALL_GRIDS[number % 4]
    axes, contrast = len(grid), (1.0, 1e3)[number // 4 % 2]
    m, c = contrast ** dice.random(grid), np.zeros((*grid, axes))
    kind = ("held", "tensors", "landmarks")[number // 8 % 3]
    precision, marks = None, None
    if kind != "landmarks":
        m[(slice(2, 4),) * axes] = 0
        c[0] = 1
    if kind == "tensors":
        precision = random_tensors(dice, grid, axes, share=0.1)
        precision *= scale.energy(m, spacing) / 0.3**2
    if kind == "landmarks":
        points = dice.random((8, axes)) * (np.array(grid) - 1)
        marks = Landmarks(points, points, sd=10 ** dice.uniform(-1, 0.5), scale=scale)
    return Problem(
        observed=0 * c,
        confidence=c,
        stiffness=m,
        spacing=spacing,
        precision=precision,
        landmarks=marks,
    )


def tissue_with_gaps(seed: int, axes: int = 2, sides: tuple[int, int] = (16, 50)) -> Problem:
    """Return smoothed noise with gaps, necks and flaps, held at one side and moved at the other.

    Parameters
    ----------
    seed : int
    axes : int
        2 for an image, 3 for a volume.
    sides : tuple of int
        Smallest side, and one more than the largest.
    """
    random = dice_of(seed)
    shape = tuple(random.integers(*sides, axes))
    width = (1.5, 4) if axes == 2 else (1.0, 2.5)
    noise = ndi.gaussian_filter(random.normal(size=shape), random.uniform(*width))
    m = np.where(noise > 0.3 * random.uniform(0, 0.3), 0.0, 1.0)
    y, c = np.zeros((2, *shape, axes))
    c[0] = c[-1] = 1
    y[-1] = 2 * random.normal(size=axes)
    held = sites_of_elements(m > 0)
    problem = Problem(observed=y, confidence=c * held[..., None], stiffness=m * held)
    return problem.with_rest(scraps(problem.tissue, problem.known))


def mild_tissue(dice: Dice) -> State:
    """Return a body of mild tissue with prescribed edges, as in typical use."""
    shape = tuple(dice.integers(16, 81, 2))
    m = 10 ** (dice.uniform(0, 2) * (smooth_noise(dice, shape, dice.uniform(1, 6)) > dice.random()))
    if dice.random() < 0.3:
        m[smooth_noise(dice, shape, dice.uniform(2, 6)) < dice.uniform(0.02, 0.2)] = 0
    y, c = np.zeros((2, *shape, 2))
    for edge in dice.permutation(4)[: dice.integers(1, 5)]:
        c.swapaxes(0, edge // 2)[-(edge % 2)] = 1
    c[m == 0] = 0
    spacing = (1.0, 1.0) if dice.random() < 0.6 else tuple(dice.uniform(0.5, 2, 2))
    nu, plane = float(dice.choice([0.0, 0.3, 0.45, 0.49])), str(dice.choice(["stress", "strain"]))
    penalty = math.inf if dice.random() < 0.6 else float(10 ** dice.uniform(-2, 2))
    prior: Prior = ElasticPrior(nu, plane=plane, penalty=penalty)
    if dice.random() < 0.25:
        prior = SeilerPrior(conditional=str(dice.choice(["centred", "blanket"])))
    return State(Problem(observed=y, confidence=c, stiffness=m, spacing=spacing), prior)


def edits_of(start: State, dice: Dice) -> Iterator[tuple[str, State]]:
    """Yield the kind of each edit and the state after it; the first has the kind "begin"."""
    state = start
    history, patch = [state], np.zeros(state.problem.shape, dtype=bool)
    pull = np.zeros(2)
    yield "begin", state
    for _ in range(int(dice.integers(3, 12))):
        kind = str(dice.choice([*_EDITS], p=[*_EDITS.values()]))
        if kind == "undo":
            back = int(dice.integers(1, 4))
            state = history[-1 - min(back, len(history) - 1)]
        else:
            if kind == "pull" or not patch.any():
                patch, pull = _patch(dice, state.problem), dice.normal(size=2)
                pull *= 10 ** dice.uniform(-1.5, 0.7)
            elif kind == "move":
                pull = pull + dice.normal(size=2) * 10 ** dice.uniform(-2, 0)
            state = _edited(kind, state, patch, pull, dice)
        history.append(state)
        yield kind, state


def _patch(dice: Dice, problem: Problem) -> Flags:
    """Return the mask of a disc around a random tissue site."""
    at = dice.choice(np.argwhere(problem.tissue))
    return _ball(dice, problem.shape, 0.5, 1 + max(problem.shape) / 8, at)


def _edited(kind: str, state: State, patch: Flags, pull: Array, dice: Dice) -> State:
    """Return the state after an edit."""
    problem, prior = state
    loads = problem.loads
    y, c, m = (
        np.array(each, dtype=np.float64)
        for each in (problem.observed, problem.confidence, problem.stiffness)
    )
    if kind in ("pull", "move"):
        y[patch] = pull * problem.unit
        c[patch] = 1
    elif kind == "let go":
        c[patch] = 0
    elif kind == "confidence":
        c[patch] = dice.uniform(0.01, 1)
    elif kind == "stiffness":
        m[patch] *= 10 ** dice.uniform(-2, 2)
    elif kind == "penalty":
        prior = replace(prior, penalty=float(10 ** dice.uniform(-2, 3)))
    elif kind in ("remove", "add"):
        place = _patch(dice, problem)
        m[place] = 0 if kind == "remove" else np.where(m > 0, m, np.median(m[m > 0]))[place]
    elif isinstance(prior, ElasticPrior) and kind == "growth":
        place = np.where(_patch(dice, problem), dice.uniform(-0.2, 0.3), 0)
        loads = growth(place) if loads is None else loads + growth(place)
    elif isinstance(prior, ElasticPrior):
        prior = replace(prior, poisson=float(dice.choice([0.0, 0.3, 0.45, 0.49])))
    given = {"observed": y, "confidence": c, "stiffness": m, "spacing": problem.spacing}
    return State(Problem(**given, loads=loads), prior)


class LargeMotion(NamedTuple):
    """Problem of large motion, its prior, and the kind of its targets.

    Targets of the kind "known map" are sampled from a map without folds.
    """

    problem: Problem
    prior: NeoHookeanPrior
    kind: str


def random_large_motion(dice: Dice, axes: int, known: bool) -> LargeMotion:
    """Return an image or a volume with targets; if `known`, those of a map without folds."""
    shape = tuple(map(int, dice.integers(*((12, 49) if axes == 2 else (8, 19)), axes)))
    spacing, most = (1.0,) * axes, 4 - axes  # decades of 2
    if dice.random() < 0.5:  # oblong pixels, in any unit
        spacing = tuple(map(float, 2 ** dice.uniform(-most, most, axes)))
    m = _large_tissue(dice, shape, known)
    tissue, rigid, size = m > 0, np.isinf(m), min(shape)
    c, y = np.zeros((2, *shape, axes))
    c[..., 0, :] = 1
    if dice.random() < 0.5:
        c[~_inner(shape, 1)] = 1
    c[~tissue] = 0
    kinds = ["drag", "rim", "none", "landmarks", *(["bend"] if axes == 2 else [])]
    kind = str(dice.choice(kinds))
    at = _targets(dice, shape, kind) & tissue & ~rigid
    if known:
        held = c.any(axis=-1) | at
        y[held] = _smooth_map(dice, shape)[held]
    elif kind == "drag":
        y[at] = dice.normal(size=axes) * size / 6 * dice.choice([1, 1, 8 / axes])
    elif kind == "rim" and at.any():
        sites = np.argwhere(at)
        y[at] = (sites - sites.mean(axis=0)) * dice.uniform(-0.5, 2 - axes / 4)
    elif kind == "bend":
        y[at] = turned(*shape, float(dice.uniform(20, 90)))[at[:, -1]]
    else:
        y[at] = dice.normal(size=(int(at.sum()), axes)) * (4 - axes)
    moves, sides = y * np.array(spacing), np.array(shape) * spacing
    # Targets far beyond the image are refused.
    farthest = float(np.linalg.norm(moves, axis=-1).max())
    moves *= min(1.0, 1.99 * float(np.linalg.norm(sides)) / max(farthest, 1e-9))
    penalty = math.inf
    c[at] = 1
    if not known and not rigid.any() and dice.random() < 0.3:
        penalty = float(10 ** dice.uniform(-2, 1))
        c[at] = dice.uniform(0.3, 1)
    prior = NeoHookeanPrior(
        float(dice.choice([0.0, 0.3, 0.45, 0.49])),
        plane="stress" if axes == 2 and dice.random() < 0.5 else "strain",
        penalty=penalty,
    )
    loads = None
    if dice.random() < 0.4:  # a disc of half to four times its length, or a ball of twice
        strain = dice.uniform(-0.5, 7 - 2 * axes if dice.random() < 0.5 else 0.5)
        along = dice.normal(size=axes) if dice.random() < 0.2 else None
        loads = growth(strain * (_ball(dice, shape, 2, size / 2) & ~rigid), along=along)
    problem = Problem(observed=moves, confidence=c, stiffness=m, spacing=spacing, loads=loads)
    return LargeMotion(problem, prior, "known map" if known else kind)


def random_large_parts(number: int) -> LargeMotion:
    """Return two or three parts that slide along each other by several pixels.

    Every third problem is a volume. A part turns, shifts and grows in the tissue around it, or
    slides on other tissue along a straight or curved interface by 10 to 30 % of its size. A third
    of the problems has loads, and some have a precision or landmarks.
    """
    dice = dice_of(number)
    axes, kind = 3 if number % 3 == 2 else 2, ("inclusion", "layers", "regions")[number // 3 % 3]
    least = 12 if axes == 2 else 10 if kind == "inclusion" else 7
    shape = tuple(map(int, dice.integers(least, 19 if axes == 2 else least + 3, axes)))
    spacing = tuple(map(float, 2 ** dice.uniform(-1, 1) * 2 ** dice.uniform(-0.3, 0.3, axes)))
    middle = np.array(shape) / 2 - 0.5 + dice.uniform(-0.5, 0.5, axes)
    place = np.moveaxis(np.indices(shape), 0, -1) - middle
    edge = ~_inner(shape, 1)
    if kind == "inclusion":
        radii = min(shape) * dice.uniform(0.28 if axes == 2 else 0.32, 0.36, axes)
        away = np.linalg.norm(place / radii, axis=-1)
        labels, driven = (away < 1).astype(int), away < 0.55
    else:
        if kind == "layers":
            bend = dice.choice([0.0, dice.uniform(-1, 1)]) / max(shape)
            height = place[..., 0] + bend * place[..., 1] ** 2
            labels = (height > dice.uniform(-1, 1)).astype(int)
        else:
            labels = _nearest(dice, shape, int(dice.integers(2, 4)))
        driven = np.zeros(shape, np.bool_)
        driven[-1], edge = True, np.zeros(shape, np.bool_)
        edge[0] = True
    most = (40 if kind == "inclusion" else 10) / (axes - 1)
    skew = dice.normal(size=(axes, axes))
    skew -= skew.T
    angle = math.radians(dice.uniform(0, most))
    turn = scipy.linalg.expm(angle * skew / np.linalg.norm(skew) * math.sqrt(2))
    stretch = dice.uniform(0.95, 1.15) if kind == "inclusion" else 1.0
    shift = dice.normal(size=axes) * (0.3 if kind == "inclusion" else 0.03 * min(shape))
    if kind == "layers":
        shift[1] = dice.choice([-1, 1]) * dice.uniform(0.1, 0.3) * shape[1]
    y = np.zeros((*shape, axes))
    y[driven] = (stretch * place @ turn.T - place + shift)[driven] * min(spacing)
    c = np.repeat((driven | edge)[..., None], axes, axis=-1).astype(float)
    m = (10 ** dice.uniform(0, 1, labels.max() + 1))[labels] * dice.uniform(1, 1.5, shape)
    m *= 10 ** dice.uniform(-2, 2)
    loads = precision = marks = None
    if dice.random() < 0.3:
        unit = float(np.median(m)) * math.prod(spacing) ** (1 - 1 / axes)
        force = 0.03 / axes**2 * unit * dice.normal(size=y.shape)
        loads = Loads(growth=dice.uniform(-0.1, 0.2) * (labels == 1), force=force)
    if dice.random() < 0.3:
        unit = math.prod(spacing) ** (1 - 2 / axes)
        precision = 0.1 * float(m.max()) * unit * dice.random(shape) * (dice.random(shape) < 0.1)
    if dice.random() < 0.3:
        elements = np.argwhere(in_elements(m))
        at = elements[dice.integers(len(elements), size=4)]
        points = at + dice.random((4, axes))
        targets = points + 0.3 * dice.normal(size=points.shape)
        marks = Landmarks(points, targets, sd=min(spacing), scale=StrainScale(0.1))
    prior = _large_prior(dice)
    problem = Problem(
        observed=y,
        confidence=c,
        stiffness=m,
        spacing=spacing,
        loads=loads,
        precision=precision,
        landmarks=marks,
        sliding=SlidingParts(labels, strength=float(10 ** dice.uniform(1, 3))),
    )
    return LargeMotion(problem, prior, kind)


def _large_prior(dice: Dice) -> NeoHookeanPrior:
    """Return large motion with a random Poisson's ratio, in plane stress or strain."""
    ratio = float(dice.choice([0.0, 0.3, 0.45]))
    return NeoHookeanPrior(ratio, plane="stress" if dice.random() < 0.5 else "strain")


def random_large_data(number: int) -> LargeMotion:
    """Return an image or a volume in large motion, whose data are samples of a map without folds.

    A third of the problems has a precision, a third has landmarks, and a third has both beside
    prescribed sites, forces and growth, half of them with rigid tissue. Data alone hold the tissue
    of half of the others.
    """
    dice = dice_of(number)
    axes, kind = 2 + number % 2, ("precision", "landmarks", "both")[number // 2 % 3]
    shape = tuple(map(int, dice.integers(*((10, 17) if axes == 2 else (5, 8)), axes)))
    spacing = tuple(map(float, 2 ** dice.uniform(-1, 1, axes)))
    m = 10 ** dice.uniform(-2, 2) * 10 ** (dice.uniform(0, 1) * dice.random(shape))
    if dice.random() < 0.3:
        m[_ball(dice, shape, 1, min(shape) / 3)] = 0
        m[~sites_of_elements(m)] = 0  # such sites have no elements of their own
    motion = dice.uniform(0.2, 0.9 if axes == 2 else 0.5) * _smooth_map(dice, shape)
    y, c = motion * np.array(spacing), np.zeros((*shape, axes))
    loads = None
    if kind == "both" or dice.random() < 0.5:
        c[0] = m[0, ..., None] > 0
    if kind == "both":
        centre = dice.uniform(0.35, 0.5, axes) * shape
        ball = _ball(dice, shape, 1, min(shape) / 3, centre)
        if number // 6 % 2:
            m[ball & _inner(shape, 2) & (m > 0)] = np.inf
        unit = float(np.median(m[(m > 0) & (m < np.inf)])) * math.prod(spacing) ** (1 - 1 / axes)
        forces = 0.04 / axes**2 * unit * dice.normal(size=y.shape) * (m > 0)[..., None]
        # Elements of rigid tissue do not grow.
        beside = ndi.binary_dilation(np.isinf(m), np.ones((3,) * axes))
        strain = dice.uniform(-0.15, 0.3) * (_ball(dice, shape, 1.5, min(shape) / 3) & ~beside)
        loads = Loads(growth=strain, force=forces)
    precision, marks, soft = None, None, (m > 0) & (m < np.inf)
    if kind != "landmarks":
        rank, share = int(dice.integers(1, axes + 1)), float(dice.choice([1.0, 0.3]))
        # Strong data would strain the stiff tissue of which rigid tissue is the limit.
        most = 2.5 if soft.sum() == (m > 0).sum() else 0.5
        strength = 10 ** dice.uniform(-2, most) * float(m[soft].max())
        precision = random_tensors(dice, shape, rank, strength, share)
        y = y + dice.normal(size=y.shape) * 0.03 * min(spacing) * (c == 0)
    if kind != "precision":
        elements = np.argwhere(in_elements(m))
        at = elements[dice.integers(len(elements), size=8)]
        points = at + dice.random((8, axes))
        targets = points + interpolated(motion, points) + 0.03 * dice.normal(size=points.shape)
        scale = StrainScale(0.1, extent=float(np.mean(spacing) * min(shape) / 2))
        marks = Landmarks(points, targets, sd=min(spacing) * 10 ** dice.uniform(-2, 1), scale=scale)
    prior = _large_prior(dice)
    problem = Problem(
        observed=y,
        confidence=c,
        stiffness=m,
        spacing=spacing,
        loads=loads,
        precision=precision,
        landmarks=marks,
    )
    return LargeMotion(problem, prior, f"{kind}, {'image' if axes == 2 else 'volume'}")


def _inner(shape: Shape, margin: int) -> Flags:
    """Return the mask of sites that are farther than `margin` from the nearest face."""
    inner = np.zeros(shape, np.bool_)
    inner[(slice(margin, -margin),) * len(shape)] = True
    return inner


def _large_tissue(dice: Dice, shape: Shape, known: bool) -> Array:
    """Return stiffness of several values, with holes, a border of air and rigid bodies."""
    m, size, axes = np.ones(shape), min(shape), len(shape)
    decades = dice.choice([1.0, 3.0, 6.0 - axes])
    for _ in range(int(dice.integers(0, 4))):
        m[_ball(dice, shape, 2, max(shape) / 3)] = 10 ** dice.uniform(0, decades)
    if dice.random() < 0.4:
        for _ in range(int(dice.integers(1, 4))):
            m[_ball(dice, shape, 1, size / 5)] = 0
    if dice.random() < 0.2:
        m[_beyond_ellipse(shape, dice.uniform(0.25, 0.4))] = 0
    if not known and dice.random() < 0.35:
        m[_ball(dice, shape, 1.5, size / 5) & _inner(shape, axes - 1) & (m > 0)] = np.inf
    return m


def _targets(dice: Dice, shape: Shape, kind: str) -> Flags:
    """Return the mask of the sites with a target."""
    at = np.zeros(shape, np.bool_)
    if kind in ("drag", "rim"):
        centre = dice.uniform(1 / 3, 2 / 3, len(shape)) * shape
        ball = _ball(dice, shape, 2, max(min(shape) / 6, 3), centre)
        return ball if kind == "drag" else ball & ~ndi.binary_erosion(ball)
    if kind == "bend":
        at[:, -1] = True
    elif kind == "landmarks":
        count = int(dice.integers(2, 10))
        at[tuple(dice.integers(2, side - 2, count) for side in shape)] = True
    return at


def _smooth_map(dice: Dice, shape: Shape) -> Array:
    """Return a map of waves, in pixels, scaled down until it has no folds."""
    waves, size = np.zeros((*shape, len(shape))), min(shape)
    for _ in range(4):
        k, phase = dice.uniform(-6, 6, len(shape)) / size, dice.uniform(0, 6)
        wave = np.sin(np.tensordot(k, np.indices(shape), 1) + phase)
        waves += dice.normal(size=len(shape)) * wave[..., None]
    strength = size / 4
    while smallest_jacobians(displaced_corners(strength * waves), 5).min() < _LEAST:
        strength *= 0.9
    return strength * waves
