"""Loads: comparison with CalculiX's growth, weight and pressure, and with closed forms."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from napari_hmrf.loads import Loads, growth, pressure, reactions, traction, weight
from report.page import Section, Settings, Target
from validation.oracles import calculix

Float64Array = npt.NDArray[np.float64]
POISSON = 0.3
#: Cases for the comparison with CalculiX: name, axes, plane and Poisson's ratio.
CALCULIX = (
    ("plane stress, CPE4 with textbook constants", 2, "stress", POISSON),
    ("plane strain, nu 0, CPE4", 2, "strain", 0.0),
    ("plane strain, CPE4", 2, "strain", POISSON),
    ("volume, nu 0, C3D8", 3, "strain", 0.0),
    ("volume, C3D8", 3, "strain", POISSON),
)


class Case(NamedTuple):
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


def tissue(size: int, axes: int) -> Case:
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
    return Case(m, 0.15 * ball, pull, np.ones(shape, bool), 0.1, spacing)


def section(settings: Settings) -> Section:
    """Return the section with CalculiX, annulus, disc, and equilibrium of forces."""
    page = Section("Loads")
    _calculix(page, settings)
    _closed_forms(page, settings)
    return page


def _calculix(page: Section, settings: Settings) -> None:
    if not calculix.is_there():
        page.missing("CalculiX", calculix.HOW)
        return
    rows = []
    sizes = settings.choose(96, 24), settings.choose(24, 10)
    for name, axes, plane, nu in CALCULIX:
        size = sizes[axes - 2]
        off, most, unbalanced = to_calculix(tissue(size, axes), plane, nu)
        rows.append([name, f"{size}", f"{most:.2f} px", f"{off:.1e} px", f"{unbalanced:.1e}"])
        if (plane, nu) != ("strain", POISSON):  # CalculiX uses other elements for this case
            claim = f"loads to CalculiX, {name}: largest difference in px"
            page.targets.append(Target(claim, off, 0.01))
    page.say(
        """**Question.** Does tissue under growth, weight and pressure move as in CalculiX? Blocks
        have random stiffness, up to ten times as stiff, in oblong pixels, and are held along one
        edge. A disc (a ball) grows by 15 %, all tissue is heavy, and the whole surface is
        pressed, including that of a square hole. CalculiX represents growth as thermal
        expansion, weight as gravity, and pressure as loads on the faces of its elements: its
        loads are independent of this package. The last column is the imbalance of forces and
        reactions, relative to the forces."""
    )
    page.table(["case", "pixels along a side", "moves by", "largest difference", "balance"], rows)
    page.say(
        f"""**Conclusion.** In plane stress the elements are the same, and so is the field; the
        same holds for a Poisson's ratio of 0. With {POISSON} in plane strain and in volumes, the
        change of volume is computed at the middle of the element, which keeps nearly
        incompressible tissue from locking; CalculiX does not do this. It is a choice of element,
        which matters at corners where stiffness jumps, and does not concern the loads."""
    )


def to_calculix(case: Case, plane: str, nu: float) -> tuple[float, float, float]:
    """Return the largest difference and motion, in pixels, and the relative imbalance."""
    prior = ElasticPrior(nu, plane="stress" if plane == "stress" else "strain")
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


def _closed_forms(page: Section, settings: Settings) -> None:
    sizes = settings.choose((16, 32, 64, 128), (16, 32))
    rows, orders = [], []
    for plane in ("stress", "strain"):
        errors = [annulus(size, plane) for size in sizes]
        order = math.log(errors[0] / errors[-1]) / math.log(sizes[-1] / sizes[0])
        orders.append(order)
        rows.append([f"annulus, plane {plane}", *(f"{e:.1e}" for e in errors), f"{order:.2f}"])
    discs = []
    for plane in ("stress", "strain"):
        errors = [disc(size, plane) for size in sizes]
        order = math.log(errors[0] / errors[-1]) / math.log(sizes[-1] / sizes[0])
        discs.append(order)
        rows.append([f"disc, plane {plane}", *(f"{e:.1e}" for e in errors), f"{order:.2f}"])
    rings = [round_ring(size) for size in sizes]
    order = math.log(rings[0] / rings[-1]) / math.log(sizes[-1] / sizes[0])
    rows.append(["annulus of round edges", *(f"{e:.1e}" for e in rings), f"{order:.2f}"])
    page.say(
        """**Question.** How fast does the error fall with the pixel size? *Annulus*: Lame's field
        of a ring under inner pressure, cut out along pixels, with the ring's stress on its
        edges. *Disc*: Eshelby's field of a disc that grows in a matrix of the same material,
        with each pixel weighted by the part of it inside the disc; a tenth of the image at its
        edge is left out. *Annulus of round edges*: the ring itself under pressure, with
        staircase edges; sites near the edges are excluded. Errors are relative to the field's
        rms."""
    )
    page.table(["case", *(f"{size} px" for size in sizes), "observed order"], rows)
    page.say(
        """**Conclusion.** Second order, as bilinear elements should be. Where a round surface is
        a staircase of pixels it is first order, for any load: this is an error of the image, not
        of the solver."""
    )
    page.targets.append(Target("annulus under pressure: order", min(orders), 1.9, at_least=True))
    page.targets.append(Target("disc that grows: order", min(discs), 1.7, at_least=True))


def lame(at: Float64Array, plane: str, inner: float, outer: float) -> tuple[Float64Array, ...]:
    """Return displacement and stress of a ring of modulus 1 under an inner pressure of 0.1."""
    square = np.maximum((at**2).sum(axis=-1), inner**2 / 4)
    even = 0.1 * inner**2 / (outer**2 - inner**2)
    uneven = even * outer**2 / square
    bulk = 1 - POISSON if plane == "stress" else (1 + POISSON) * (1 - 2 * POISSON)
    out = at / np.sqrt(square)[..., None]
    turned = np.eye(2) - 2 * out[..., :, None] * out[..., None, :]
    stress = even * np.eye(2) + uneven[..., None, None] * turned
    return at * (bulk * even + (1 + POISSON) * uneven)[..., None], stress


def annulus(size: int, plane: str) -> float:
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
    plane: str,
    step: float,
    inside: npt.NDArray[np.bool_],
) -> float:
    c, middle = np.zeros_like(exact), len(m) // 2
    c[middle, :, 0] = c[:, middle, 1] = 1
    problem = Problem(observed=0 * c, confidence=c, stiffness=m, spacing=(step, step), loads=loads)
    return _apart(problem, exact, plane, inside)


def disc(size: int, plane: str, radius: float = 0.4, strain: float = 0.1) -> float:
    """Return the error of a growing disc with the exact displacement prescribed around it."""
    step, parts = 2 / size, 8
    at = (np.moveaxis(np.indices((size + 1,) * 2), 0, -1) - size / 2) * step
    fine = (np.arange((size + 1) * parts) + 0.5) / parts - 0.5 - size / 2
    share = np.add.outer((fine * step) ** 2, (fine * step) ** 2) < radius**2
    share = share.reshape(size + 1, parts, size + 1, parts).mean(axis=(1, 3))
    r = np.linalg.norm(at, axis=-1)
    rate = (1 + POISSON) / 2 / (1 if plane == "stress" else 1 - POISSON)
    exact = at * (rate * strain * (radius / np.maximum(r, radius)) ** 2)[..., None]
    c = np.repeat((r > 0.9)[..., None], 2, axis=-1)
    loads = growth(strain * share)
    problem = Problem(
        observed=exact, confidence=c, stiffness=np.ones(r.shape), spacing=(step, step), loads=loads
    )
    return _apart(problem, exact, plane, (r < 0.9) & (np.abs(r - radius) > 0.1))


def _apart(
    problem: Problem, exact: Float64Array, plane: str, inside: npt.NDArray[np.bool_]
) -> float:
    prior = ElasticPrior(POISSON, plane="stress" if plane == "stress" else "strain")
    found = solve(problem, prior, optimizer=Multigrid(1e-6), backend="cpu").displacement
    return float(np.linalg.norm((found - exact)[inside]) / np.linalg.norm(exact[inside]))
