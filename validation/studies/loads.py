"""Loads and removed tissue beside CalculiX, closed forms and refined grids."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf import (
    BoundaryRule,
    Cavity,
    ElasticPrior,
    Grid,
    Motion,
    Multigrid,
    Problem,
    Study,
    Tissue,
    build_problem,
    solve,
)
from napari_hmrf.loads import Loads, growth, pressure, reactions, traction, weight
from napari_hmrf.solver.model_names import Plane
from validation.oracles import calculix
from validation.oracles.parts import pressure_of
from validation.study import Options, Results, Table, Target, order, study

Float64Array = npt.NDArray[np.float64]
POISSON = 0.3
#: Cases for the comparison with CalculiX: name, axes, plane and Poisson's ratio.
CALCULIX: tuple[tuple[str, int, Plane, float], ...] = (
    ("plane stress, CPE4 with textbook constants", 2, "stress", POISSON),
    ("plane strain, nu 0, CPE4", 2, "strain", 0.0),
    ("plane strain, CPE4", 2, "strain", POISSON),
    ("volume, nu 0, C3D8", 3, "strain", 0.0),
    ("volume, C3D8", 3, "strain", POISSON),
)
#: Cases in which CalculiX has other elements: their change of volume is not that of the middle.
OTHER_ELEMENTS = ("plane strain, CPE4", "volume, C3D8")
#: Largest accepted difference from CalculiX, in pixels or voxels.
_LARGEST = 0.01


def _with_calculix(options: Options) -> Iterator[tuple[str, int, int, Plane, float]]:
    """Yield name, size, axes, plane and Poisson's ratio, if CalculiX is installed."""
    if calculix.is_missing():
        return
    sizes = options.choose((96, 24), (24, 10))
    for name, axes, plane, nu in CALCULIX:
        yield name, sizes[axes - 2], axes, plane, nu


class Loaded(NamedTuple):
    """Tissue that is fixed at its first sites, with growth, weight and pressure.

    The pressure is one number, or a number for each site; a face then bears the mean of its
    corners.
    """

    stiffness: Float64Array
    strain: Float64Array
    pull: tuple[float, ...]
    surface: npt.NDArray[np.bool_]
    amount: float | Float64Array
    spacing: tuple[float, ...]

    @property
    def problem(self) -> Problem:
        """Problem of this package for the case."""
        m, c = self.stiffness, np.zeros((*self.stiffness.shape, self.stiffness.ndim))
        c[0] = 1
        loads = growth(self.strain) + weight(m, self.pull, spacing=self.spacing)
        loads += pressure(m, self.surface, self.amount, spacing=self.spacing)
        return Problem(observed=0 * c, confidence=c, stiffness=m, spacing=self.spacing, loads=loads)


def loaded_tissue(size: int, axes: int) -> Loaded:
    """Return blocks of random stiffness around a hole, where a disc or ball grows."""
    rng, shape = np.random.default_rng(5), (size,) * axes
    blocks = math.ceil(size / 8)
    m = np.kron(10 ** rng.random((blocks,) * axes), np.ones((8,) * axes))
    m = m[tuple(slice(size) for _ in shape)].copy()
    places = np.stack(np.indices(shape), axis=-1)
    hole = (np.abs(places - 0.6 * size) < size / 8).all(axis=-1)
    ball = np.linalg.norm(places - 0.3 * size, axis=-1) < size / 6
    m[hole] = 0
    spacing = (1.0, 1.3, 0.8)[:axes]
    pull = tuple(0.4 / size**2 * each for each in (1.0, -1.5, 0.5)[:axes])
    return Loaded(m, 0.15 * ball, pull, np.ones(shape, bool), 0.1, spacing)


def _load_targets(results: Results) -> Iterator[Target]:
    for name, row in results.items():
        if name not in OTHER_ELEMENTS:
            claim = f"loads to CalculiX, {name}: largest difference in px"
            yield Target(claim, float(row[3].removesuffix(" px")), _LARGEST)


_LOAD_TITLES = ("case", "pixels along a side", "displacement", "largest difference")
_LOAD_TITLES += ("imbalance of forces",)


@study(
    "loads.calculix",
    lambda options: {case[0]: case for case in _with_calculix(options)},
    _LOAD_TITLES,
    targets=_load_targets,
    page="loads.md",
)
def loads_beside_calculix(case: tuple[str, int, int, Plane, float]) -> list[Any]:
    """Compare growth, weight and pressure with CalculiX."""
    name, size, axes, plane, nu = case
    off, most, unbalanced = loaded(loaded_tissue(size, axes), plane, nu)
    return [name, f"{size}", f"{most:.2f} px", f"{off:.1e} px", f"{unbalanced:.1e}"]


def loaded(case: Loaded, plane: Plane, nu: float) -> tuple[float, float, float]:
    """Return the largest difference and motion, in pixels, and the relative imbalance."""
    prior = ElasticPrior(nu, plane=plane)
    problem, axes = case.problem, case.stiffness.ndim
    found = solve(problem, prior, optimizer=Multigrid(1e-5), backend="cpu")
    theirs = calculix.loaded_field(
        case.stiffness,
        case.spacing,
        nu,
        stress=plane == "stress",
        strain=case.strain,
        pull=case.pull,
        surface=case.surface,
        pressure=case.amount,
    )
    off = float(np.abs(found.displacement - theirs)[problem.tissue].max())
    holds = reactions(problem, found).reshape(-1, axes).sum(axis=0)
    loads = problem.loads
    given = np.zeros(axes)
    if loads is not None and loads.force is not None:
        given = loads.force.reshape(-1, axes).sum(axis=0, dtype=np.float64)
    unbalanced = float(np.abs(holds + given).max() / np.abs(given).max())
    return off / problem.unit, float(np.abs(theirs).max()) / problem.unit, unbalanced


# Closed forms.


def lame(at: Float64Array, plane: Plane, inner: float, outer: float) -> tuple[Float64Array, ...]:
    """Return displacement and stress of a ring of modulus 1 under an inner pressure of 0.1."""
    square = np.maximum((at**2).sum(axis=-1), inner**2 / 4)
    even = 0.1 * inner**2 / (outer**2 - inner**2)
    uneven = even * outer**2 / square
    bulk = 1 - POISSON if plane == "stress" else (1 + POISSON) * (1 - 2 * POISSON)
    out = at / np.sqrt(square)[..., None]
    turned = np.eye(2) - 2 * out[..., :, None] * out[..., None, :]
    stress = even * np.eye(2) + uneven[..., None, None] * turned
    return at * (bulk * even + (1 + POISSON) * uneven)[..., None], stress


def annulus(size: int, plane: Plane) -> float:
    """Return the error of a square part of the ring with a square hole."""
    step = 1.4 / size
    at = (np.moveaxis(np.indices((size + 1,) * 2), 0, -1) - size / 2) * step
    exact, stress = lame(at, plane, 0.3, 1.0)
    m = np.where((np.abs(at) < 0.35 - step / 2).all(axis=-1), 0.0, 1.0)
    loads, low, high = Loads(), size // 4, 3 * size // 4
    for axis, (edge, outward) in itertools.product(
        (0, 1), ((0, -1), (size, 1), (low, 1), (high, -1))
    ):
        face = np.zeros(m.shape, bool)
        along = slice(None) if edge in (0, size) else slice(low, high + 1)
        np.moveaxis(face, axis, 0)[edge, along] = True
        loads += traction(m, face, outward * stress[..., axis], spacing=(step, step))
    return _error(exact, m, loads, plane, step, m > 0)


def round_ring(size: int) -> float:
    """Return the error of a ring of the elements whose middle is inside it."""
    step, inner, outer = 2 / size, 0.35, 0.9
    at = (np.moveaxis(np.indices((size + 1,) * 2), 0, -1) - size / 2) * step
    middle = np.hypot(*((np.indices((size, size)) - (size - 1) / 2) * step))
    elements = np.pad((middle > inner) & (middle < outer), 1)
    m = np.zeros(at.shape[:2])
    for i, j in itertools.product((0, 1), repeat=2):
        m[elements[i : i + size + 1, j : j + size + 1]] = 1
    exact, _ = lame(at, "stress", inner, outer)
    r = np.linalg.norm(at, axis=-1)
    loads = pressure(m, r < (inner + outer) / 2, 0.1, spacing=(step, step))
    inside = (m > 0) & (r > inner + 0.1) & (r < outer - 0.1)
    return _error(exact, m, loads, "stress", step, inside)


def _error(
    exact: Float64Array,
    m: Float64Array,
    loads: Loads,
    plane: Plane,
    step: float,
    inside: npt.NDArray[np.bool_],
) -> float:
    c, middle = np.zeros_like(exact), len(m) // 2
    c[middle, :, 0] = c[:, middle, 1] = 1
    problem = Problem(observed=0 * c, confidence=c, stiffness=m, spacing=(step, step), loads=loads)
    return _apart(problem, exact, plane, inside)


def disc(
    size: int, plane: Plane = "strain", axes: int = 2, radius: float = 0.4, strain: float = 0.1
) -> float:
    """Return the error of a growing disc or ball with the exact displacement around it."""
    step, parts = 2 / size, 8
    at = (np.moveaxis(np.indices((size + 1,) * axes), 0, -1) - size / 2) * step
    fine = (np.arange((size + 1) * parts) + 0.5) / parts - 0.5 - size / 2
    inside = sum(np.ix_(*[(fine * step) ** 2] * axes)) < radius**2
    share = inside.reshape((size + 1, parts) * axes).mean(axis=tuple(range(1, 2 * axes, 2)))
    r = np.linalg.norm(at, axis=-1)
    rate = (1 + POISSON) / 2 if plane == "stress" else (1 + POISSON) / (1 - POISSON) / axes
    exact = at * (rate * strain * (radius / np.maximum(r, radius)) ** axes)[..., None]
    problem = Problem(
        observed=exact,
        confidence=np.repeat((r > 0.9)[..., None], axes, axis=-1),
        stiffness=np.ones(r.shape),
        spacing=(step,) * axes,
        loads=growth(strain * share),
    )
    return _apart(problem, exact, plane, (r < 0.9) & (np.abs(r - radius) > 0.1))


def _apart(
    problem: Problem, exact: Float64Array, plane: Plane, inside: npt.NDArray[np.bool_]
) -> float:
    prior = ElasticPrior(POISSON, plane=plane)
    found = solve(problem, prior, optimizer=Multigrid(1e-6), backend="cpu").displacement
    return float(np.linalg.norm((found - exact)[inside]) / np.linalg.norm(exact[inside]))


FORMS: dict[str, Callable[[int], float]] = {
    "annulus, plane stress": partial(annulus, plane="stress"),
    "annulus, plane strain": partial(annulus, plane="strain"),
    "disc, plane stress": partial(disc, plane="stress"),
    "disc, plane strain": partial(disc, plane="strain"),
    "annulus of round edges": round_ring,
}


def _form_tables(results: Results) -> list[Table]:
    sizes = list(next(iter(results.values())))
    rows = [
        [name, *(f"{each:.1e}" for each in errors.values()), f"{_order(errors):.2f}"]
        for name, errors in results.items()
    ]
    return [Table(["case", *(f"{n} px" for n in sizes), "observed order"], lambda _: rows)]


def _order(errors: dict[int, float]) -> float:
    return order(list(errors.values()), list(errors))


def _form_targets(results: Results) -> Iterator[Target]:
    for start, claim, bound in (
        ("annulus, plane", "annulus under pressure: order", 1.9),
        ("disc, plane", "disc that grows: order", 1.7),
    ):
        orders = [_order(found) for name, found in results.items() if name.startswith(start)]
        if orders:
            yield Target(claim, min(orders), bound, at_least=True)


@study(
    "loads.closed-forms",
    lambda options: {
        name: (form, options.sizes_or((16, 32, 64, 128), (16, 32))) for name, form in FORMS.items()
    },
    _form_tables,
    targets=_form_targets,
    page="loads.md",
)
def closed_forms(case: tuple[Callable[[int], float], list[int]]) -> dict[int, float]:
    """Compare with fields in closed form, relative to their rms, by size."""
    form, sizes = case
    return {size: form(size) for size in sizes}


# Removed tissue.

#: Contents of the cavity: pressure, fluid relative to the weight of the tissue, and level.
CONTENTS = {
    "nothing": (0.0, 0.0, 1.0),
    "pressure": (0.05, 0.0, 1.0),
    "fluid, 60 %": (0.0, 1.5, 0.6),
    "fluid, full": (0.0, 1.0, 1.0),
}
#: Stiffness of the gel, in kPa, its weight and the weight of water, in kPa / mm, and its width.
_GEL, _WEIGHT, _WATER, _SIDE = 3.0, 0.0103, 0.00981, 60.0


def _resection_targets(results: Results) -> Iterator[Target]:
    for name, row in results.items():
        if not name.startswith(OTHER_ELEMENTS):
            claim = f"resection to CalculiX, {name}: largest difference in px"
            yield Target(claim, float(row[4].removesuffix(" px")), _LARGEST)


@study(
    "resection.calculix",
    lambda options: {
        f"{case[0]}, {contents}": (case, contents)
        for case in _with_calculix(options)
        for contents in CONTENTS
        if case[0] != "plane strain, CPE4"
    },
    ("case", "cavity", "pixels along a side", "displacement", "largest difference"),
    targets=_resection_targets,
    page="resection.md",
)
def resection_beside_calculix(case: tuple[Any, str]) -> list[Any]:
    """Compare tissue around a cavity with CalculiX."""
    (name, size, axes, plane, nu), contents = case
    off, most = resected(size, axes, plane, nu, contents)
    return [name, contents, f"{size}", f"{most:.2f} px", f"{off:.1e} px"]


def resected(size: int, axes: int, plane: Plane, nu: float, contents: str) -> tuple[float, float]:
    """Return the largest difference and the largest displacement, in pixels."""
    case = loaded_tissue(size, axes)
    whole = np.where(case.stiffness > 0, case.stiffness, 20.0)
    spacing, shape = case.spacing, whole.shape
    places = np.moveaxis(np.indices(shape), 0, -1)
    hole = np.linalg.norm((places - 0.55 * size) / (1.0, 0.7, 0.8)[:axes], axis=-1) < size / 4
    inner, relative, level = CONTENTS[contents]
    heaviness = math.hypot(*case.pull)
    labels = np.where(hole, 1, 0)
    labels[0] = 2
    motion = Motion(
        labels=labels,
        rules=(BoundaryRule(1, "remove"), BoundaryRule(2, "fixed")),
        weight=case.pull,
        cavity=Cavity(inner, relative * heaviness, level),
    )
    prior = ElasticPrior(nu, plane=plane)
    study = Study(Grid(shape, spacing), Tissue(stiffness=whole), motion, prior=prior)
    problem = build_problem(study).problem
    found = solve(problem, prior, optimizer=Multigrid(1e-5), backend="cpu")

    # The surface and the pressure of CalculiX, from the geometry alone.
    near = scipy.ndimage.binary_dilation(hole, np.ones((3,) * axes)) & ~hole
    depth = places * spacing @ np.array(case.pull) / heaviness
    presses = pressure_of(motion.cavity, -depth, -depth[near])
    theirs = calculix.loaded_field(
        np.where(hole, 0.0, whole),
        spacing,
        nu,
        stress=plane == "stress",
        strain=np.zeros(shape),
        pull=case.pull,
        surface=near,
        pressure=presses,
    )
    off = float(np.abs(found.displacement - theirs)[problem.tissue].max())
    return off / problem.unit, float(np.abs(theirs).max()) / problem.unit


class Gel(NamedTuple):
    """Block of gel on grids of several sizes, and on the finest grid."""

    axes: int
    contents: str
    counts: tuple[int, ...]
    finest: int


def gels(options: Options) -> Iterator[tuple[str, Gel]]:
    """Yield blocks of gel in images and volumes, with an empty cavity and with water."""
    counts = {2: options.choose((20, 40, 80, 160), (20, 40)), 3: options.choose((10, 20), (10,))}
    finest = {2: options.choose(640, 80), 3: options.choose(80, 20)}
    for axes, contents in itertools.product((2, 3), ("nothing", "fluid, 60 %")):
        yield f"{axes}-D, {contents}", Gel(axes, contents, counts[axes], finest[axes])


def _gel_targets(results: Results) -> Iterator[Target]:
    for name, row in results.items():
        if row[-1]:
            claim = f"gel block, {name}: order"
            yield Target(claim, float(row[-1]), 1.2, at_least=True)


@study(
    "resection.gel",
    gels,
    ("", "cavity", "displacement", *(f"grid {n + 1}" for n in range(4)), "order"),
    targets=_gel_targets,
    page="resection.md",
)
def refined_gel(case: Gel) -> list[Any]:
    """Compare a block of gel with the field of a finer grid, as rms errors in mm."""
    known = gel_block(case.finest, case.axes, case.contents)
    errors = []
    for count in case.counts:
        found = gel_block(count, case.axes, case.contents)
        every = (slice(None, None, case.finest // count),) * case.axes
        errors.append(float(np.sqrt(np.nanmean((found - known[every]) ** 2))))
    cells = [f"{error:.1e}" for error in errors] + [""] * (4 - len(errors))
    exponent = f"{order(errors, case.counts):.2f}" if len(errors) > 1 else ""
    moves = f"{np.nanmax(np.abs(known)):.2f} mm"
    return [f"{case.axes}-D", case.contents, moves, *cells, exponent]


def gel_block(count: int, axes: int, contents: str) -> Float64Array:
    """Return the displacement of a block of gel on a table, in mm; NaN in the cavity.

    Parameters
    ----------
    count : int
        Number of elements along a side, a multiple of 10.
    axes : int
    contents : str
        Contents of the cavity, as in `CONTENTS`.
    """
    shape, step = (count + 1,) * axes, _SIDE / count
    places = np.moveaxis(np.indices(shape), 0, -1) / count
    hole = ((places > 0.3 + 1e-9) & (places < 0.6 - 1e-9)).all(axis=-1)
    labels = np.where(hole, 1, 0)
    labels[-1] = 2
    _, relative, level = CONTENTS[contents]
    motion = Motion(
        labels=labels,
        rules=(BoundaryRule(1, "remove"), BoundaryRule(2, "fixed")),
        weight=(_WEIGHT, *(0.0,) * (axes - 1)),
        cavity=Cavity(fluid=_WATER if relative else 0.0, level=level),
    )
    tissue = Tissue(stiffness=np.full(shape, _GEL), unit="kPa")
    prior = ElasticPrior(0.45, plane="strain")
    stated = build_problem(Study(Grid(shape, step, "mm"), tissue, motion, prior=prior))
    found = solve(stated.problem, prior, optimizer=Multigrid(1e-5), backend="cpu")
    return np.where(hole[..., None], np.nan, found.displacement)
