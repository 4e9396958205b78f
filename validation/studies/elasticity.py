"""Linear elasticity beside finite elements, CalculiX and closed forms, in images and volumes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf import ConvergenceError, ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from napari_hmrf.solver.model_names import Plane
from validation.bodies import OBLONG, bar, random_block
from validation.oracles import calculix
from validation.oracles.elasticity import direct_solution
from validation.oracles.paper import solve_exactly
from validation.studies.paper import PHANTOMS, bar_strain_ratio, ratio_of_halves
from validation.study import (
    COLOURS,
    Options,
    Results,
    Table,
    Target,
    draw_differences,
    draw_grid,
    new_figure,
    order,
    save,
    study,
)

Float64Array = npt.NDArray[np.float64]
POISSON = 0.3
#: Largest RMSD from a direct solve of the same energy, and from another program, in pixels.
SAME_ENERGY, OTHER_PROGRAM = 0.005, 0.01
#: Largest error of a patch test, in pixels.
PATCH = 1e-4


def _solved(problem: Problem, prior: Any, tolerance: float) -> Any:
    return solve(problem, prior, optimizer=Multigrid(tolerance), backend="cpu")


# Finite elements.


class Fields(NamedTuple):
    """Fields of a phantom by title, that of scikit-fem, and its tissue.

    `apart` is the RMSD of the paper's prior from its direct solution, in pixels.
    """

    by_title: dict[str, Any]
    truth: Float64Array
    tissue: npt.NDArray[np.bool_]
    apart: float


def phantoms(options: Options) -> dict[str, Problem]:
    """Return the phantoms of the paper at one size."""
    size = options.sizes_or((300,), (32,))[0]
    return {name: phantom(name, size).problem for name in PHANTOMS}


def _field_rows(results: Results) -> Iterator[list[str]]:
    for name, found in results.items():
        others = found.truth, found.by_title["elastic prior"]
        for title, field in found.by_title.items():
            apart = (f"{rmsd(field, other, found.tissue):.5f} px" for other in others)
            yield [name, title, *apart]


def _field_targets(results: Results) -> Iterator[Target]:
    for name, found in results.items():
        elastic = found.by_title["elastic prior"]
        yield Target(f"{name}, centred to direct: RMSD in px", found.apart, OTHER_PROGRAM)
        off = rmsd(elastic, found.truth, found.tissue)
        yield Target(f"{name}, elastic to direct: RMSD in px", off, SAME_ENERGY)
        if (book := found.by_title.get("CalculiX, textbook plane stress")) is not None:
            off = rmsd(elastic, book, found.tissue)
            yield Target(f"{name}, elastic to CalculiX: RMSD in px", off, OTHER_PROGRAM)


def _draw_fields(results: Results, folder: Path) -> None:
    """Draw figures 4 and 5 of the paper."""
    for name, found in results.items():
        titles = ("the paper's prior, converged", "elastic prior", "CalculiX, CPS4R")
        shown = {title: found.by_title[title] for title in titles if title in found.by_title}
        shown["scikit-fem"] = found.truth
        figure = new_figure(4.2 * len(shown), 4.4)
        for axes, (title, field) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
            draw_grid(axes, field, found.tissue)
            axes.set_title(title)
        save(figure, folder, f"{name}-grids")
        figure = new_figure(12, 7)
        pair = {"elastic": "elastic prior", "paper's prior": "the paper's prior, converged"}
        for axes_row, (title, key) in zip(figure.subplots(2, 3), pair.items(), strict=True):
            last = draw_differences(axes_row, found.by_title[key], found.truth, found.tissue)
            figure.colorbar(last, ax=axes_row, label="px")
            for axes, what in zip(axes_row, ("magnitude", "x (col)", "y (row)"), strict=True):
                axes.set_title(f"{title}: {what}")
        save(figure, folder, f"{name}-differences")


_FIELD_TITLES = ("phantom", "field", "RMSD from scikit-fem", "RMSD from the elastic prior")


@study(
    "elasticity.fields",
    phantoms,
    _FIELD_TITLES,
    rows=_field_rows,
    targets=_field_targets,
    draw=_draw_fields,
)
def compare_fields(problem: Problem) -> Fields:
    """Compare both priors with scikit-fem and, if it is installed, CalculiX."""
    prior = ElasticPrior(poisson=POISSON)
    paper = _solved(problem, SeilerPrior(), 0.01).displacement
    fields = {
        "elastic prior": _solved(problem, prior, 0.01).displacement,
        "the paper's prior, converged": paper,
    }
    if not calculix.is_missing():
        book = calculix.textbook_plane_stress(problem, POISSON)
        fields["CalculiX, textbook plane stress"] = book
        for element in ("CPS4", "CPS4R", "CPS3"):
            fields[f"CalculiX, {element}"] = calculix.solve(problem, element, POISSON)
    apart = rmsd(paper, solve_exactly(problem, "centred"), problem.tissue)
    return Fields(fields, direct_solution(problem, prior), problem.tissue, apart)


TISSUES: tuple[tuple[float, Plane], ...] = (
    (0.0, "stress"),
    (0.45, "stress"),
    (0.499, "stress"),
    (0.45, "strain"),
    (0.499, "strain"),
)


def stiff_tumours(options: Options) -> dict[str, Problem]:
    """Return a phantom whose tumour is up to a million times as stiff as other tissue."""
    base = phantom("mass-effect", options.sizes_or((96,), (32,))[0]).problem
    cases = {}
    for ratio in (1.0, 1e2, 1e4, 1e6):
        m = np.where(base.stiffness == 40, ratio, np.where(base.stiffness > 0, 1.0, 0.0))
        problem = Problem(observed=base.observed, confidence=base.confidence, stiffness=m)
        cases[f"{ratio:.0e}"] = problem
    return cases


def _worst_material(results: Results) -> list[Target]:
    worst = max(off for found in results.values() for off, _ in found if off is not None)
    return [Target("any stiffness and Poisson's ratio: RMSD in px", worst, SAME_ENERGY)]


def _material_rows(results: Results) -> Iterator[list[str]]:
    for ratio, found in results.items():
        cells = ("refused" if off is None else f"{off:.1e} px, {n} cycles" for off, n in found)
        yield [ratio, *cells]


_MATERIAL_TITLES = ["stiffness ratio", *(f"plane {plane}, {nu}" for nu, plane in TISSUES)]


@study(
    "elasticity.materials",
    stiff_tumours,
    _MATERIAL_TITLES,
    rows=_material_rows,
    targets=_worst_material,
)
def any_material(problem: Problem) -> list[tuple[float | None, int]]:
    """Compare any stiffness and Poisson's ratio with direct solves, at 0.005 px."""
    found: list[tuple[float | None, int]] = []
    for poisson, plane in TISSUES:
        prior = ElasticPrior(poisson, plane=plane)
        try:
            solution = _solved(problem, prior, 0.005)
        except ConvergenceError:
            found.append((None, 0))
            continue
        off = rmsd(solution.displacement, direct_solution(problem, prior), problem.tissue)
        found.append((off, solution.iterations))
    return found


# Closed forms in images.


class Exact(NamedTuple):
    """Problem and its exact field (H, W, 2), in pixels, with a mask of the free sites."""

    problem: Problem
    field: Float64Array
    inside: npt.NDArray[np.bool_]

    @property
    def size(self) -> float:
        """Root mean square of the exact field at the free sites."""
        return rmsd(self.field, 0 * self.field, self.inside)


def patch(size: int) -> Exact:
    """Return a uniform strain that is prescribed on the border of the image."""
    i, j = np.mgrid[:size, :size] - (size - 1) / 2
    exact = np.stack([0.02 * i - 0.01 * j, 0.03 * j + 0.015 * i], axis=-1)
    inside = np.zeros((size, size), dtype=bool)
    inside[1:-1, 1:-1] = True
    return _held_outside(exact, inside, np.ones((size, size)))


def stretched_bar(size: int, ratio: float = 5.0) -> Exact:
    """Return a bar of two halves in series under tension, without Poisson effect.

    The strain of each half is proportional to 1 / stiffness. Young's modulus of an element is the
    mean over its sites. The interface is between two columns of sites, so the column of elements
    across it has the mean modulus. The exact field is that of this bar with three moduli.
    """
    stiffness = np.where(np.arange(size) < size // 2, ratio, 1.0)
    element = (stiffness[:-1] + stiffness[1:]) / 2
    along = np.concatenate([[0.0], np.cumsum(1 / element)])
    along *= 0.05 * size / along[-1]
    exact = np.zeros((max(8, size // 8), size, 2))
    exact[..., 1] = along
    inside = np.zeros(exact.shape[:2], dtype=bool)
    inside[:, 1:-1] = True
    problem = bar(len(exact), size, (0.0, along[-1]), stiffness)
    return Exact(problem, exact, inside)


def sharp_bar(size: int, ratio: float = 5.0) -> Float64Array:
    """Return the field of `stretched_bar` for a sharp interface half-way between two columns."""
    at = np.arange(size, dtype=float)
    middle = size // 2 - 0.5
    along = np.minimum(at, middle) / ratio + np.maximum(at - middle, 0)
    exact = np.zeros((max(8, size // 8), size, 2))
    exact[..., 1] = along * 0.05 * size / along[-1]
    return exact


def annulus(size: int) -> Exact:
    """Return Lame's ring: u_r = A r + B / r for any stiffness and Poisson's ratio.

    The edge of a ring of pixels is a staircase. The exact field is prescribed at all sites on and
    beyond the true edges, with tissue on both sides, so that only the interior has an error.
    """
    row, col, r = _polar(size)
    inner, outer = 0.3, 0.9
    radial = 0.05 * (r + 0.16 / np.maximum(r, 0.1)) * size / 2
    exact = _radial(radial, row, col, r)
    return _held_outside(exact, (r > inner) & (r < outer), np.ones((size, size)))


def inclusion(size: int, ratio: float = 5.0) -> Exact:
    """Return a stiff disc in a disc with a rim that moves outwards (plane stress).

    The field is u_r = C r inside and A r + B / r outside; displacement and radial stress are
    continuous at the interface. The rim is prescribed as in `annulus`, but the interface is a
    staircase of pixels.
    """
    row, col, r = _polar(size)
    inner, outer = 0.4, 0.9
    # In units of the soft disc's modulus: sigma_rr = (E / (1 - nu)) A - (E / (1 + nu)) B / r^2.
    bulk, shear = 1 / (1 - POISSON), 1 / (1 + POISSON)
    # C = A + B / a^2, ratio bulk C = bulk A - shear B / a^2, A b + B / b = rim.
    share = -(ratio - 1) * bulk / (ratio * bulk + shear)  # B / a^2 over A
    far = 0.05 * outer / (outer + share * inner**2 / outer)
    near = far * (1 + share)
    outside = far * (r + share * inner**2 / np.maximum(r, 0.1))
    radial = np.where(r < inner, near * r, outside) * size / 2
    stiffness = np.where(r < inner, ratio, 1.0)
    return _held_outside(_radial(radial, row, col, r), r < outer, stiffness)


def _polar(size: int) -> tuple[Float64Array, Float64Array, Float64Array]:
    row, col = (np.mgrid[:size, :size] - (size - 1) / 2) / (size / 2)
    return row, col, np.hypot(row, col)


def _radial(radial: Float64Array, row: Float64Array, col: Float64Array, r: Float64Array):
    safe = np.maximum(r, 1e-9)
    return np.stack([radial * row / safe, radial * col / safe], axis=-1)


def _held_outside(exact: Float64Array, inside: npt.NDArray[np.bool_], m: npt.ArrayLike) -> Exact:
    c = np.repeat(~inside[..., None], 2, axis=-1).astype(float)
    return Exact(Problem(observed=exact, confidence=c, stiffness=m), exact, inside)


def _patch_target(results: Results) -> list[Target]:
    ((_, row),) = results.items()
    return [Target(f"patch test at {row[0]}: largest error in px", float(row[1]), PATCH)]


@study(
    "elasticity.patch",
    lambda options: {"patch": options.sizes_or((1200,), (96,))[0]},
    ("patch test at", "largest error, px", "cycles", "displacement up to, px"),
    targets=_patch_target,
)
def patch_test(size: int) -> list[Any]:
    """Prescribe a uniform strain on the border of an image, and find its error inside."""
    case = patch(size)
    found = _solved(case.problem, ElasticPrior(POISSON), PATCH / 10)
    off = float(np.abs(found.displacement - case.field)[case.inside].max())
    return [size, f"{off:.3g}", found.iterations, f"{np.abs(case.field).max():.0f}"]


_BAR_TITLES = ("length", "elastic prior", "shift by the interface")
_BAR_TITLES += ("paper's prior, centred", "paper's prior, blanket")


def _bar_rows(results: Results) -> Iterator[list[str]]:
    for size, (ratio, off, *readings) in results.items():
        yield [f"{size} px", f"{ratio:.3f}", f"{off:.3f} px", *(f"{r:.2f}" for r in readings)]


def _bar_target(results: Results) -> list[Target]:
    ratio = list(results.values())[-1][0]
    return [Target("bar: error of the strain ratio", abs(ratio / 5.0 - 1), 0.01)]


@study(
    "elasticity.bar",
    lambda options: {str(n): n for n in options.sizes_or((16, 64, 256, 1024), (16, 64))},
    _BAR_TITLES,
    rows=_bar_rows,
    targets=_bar_target,
)
def strain_ratio(size: int) -> list[float]:
    """Compare the strains of a bar whose halves have stiffness ratio 5."""
    case = stretched_bar(size)
    along = _solved(case.problem, ElasticPrior(poisson=0.0), 0.001).displacement[0, :, 1]
    off = rmsd(sharp_bar(size), case.field, case.inside)
    readings = [bar_strain_ratio(size, 5.0, reading) for reading in ("centred", "blanket")]
    return [ratio_of_halves(along), off, *readings]


CIRCLES: dict[str, Callable[[int], Exact]] = {"annulus": annulus, "inclusion, 5 times": inclusion}
KINDS = ("discretisation", "algebraic", "model")


def _circle_tables(results: Results) -> list[Table]:
    sizes = list(next(iter(results.values())))
    rows = []
    for name, found in results.items():
        for kind, values in zip(KINDS, zip(*found.values(), strict=True), strict=True):
            cells = (f"{value:.1e}" for value in values)
            rows.append([name, kind, *cells, f"{order(values, sizes):.2f}"])
    titles = ["case", "error", *(f"{size} px" for size in sizes), "observed order"]
    return [Table(titles, lambda _: rows)]


def _annulus_target(results: Results) -> Iterator[Target]:
    if found := results.get("annulus"):
        exponent = order([values[0] for values in found.values()], list(found))
        yield Target("annulus: observed order", exponent, 1.8, at_least=True)


def _draw_circles(results: Results, folder: Path) -> None:
    figure = new_figure(10, 4)
    for axes, (name, found) in zip(figure.subplots(1, 2), results.items(), strict=False):
        sizes = list(found)
        errors = dict(zip(KINDS, zip(*found.values(), strict=True), strict=True))
        for (kind, values), colour in zip(errors.items(), COLOURS, strict=False):
            axes.loglog(sizes, values, "o-", color=colour, label=kind)
        second = [errors[KINDS[0]][0] * (sizes[0] / n) ** 2 for n in sizes]
        axes.loglog(sizes, second, ":", color="0.5", label="second order")
        axes.set_title(name)
        axes.set_xlabel("pixels along a side")
        axes.grid(alpha=0.3, which="both")
        axes.legend()
    save(figure, folder, "analytic")


@study(
    "elasticity.analytic",
    lambda options: {
        name: [(n, make(n)) for n in options.sizes_or((32, 64, 128, 256), (16, 32))]
        for name, make in CIRCLES.items()
    },
    _circle_tables,
    targets=_annulus_target,
    draw=_draw_circles,
)
def separate_errors(cases: list[tuple[int, Exact]]) -> dict[int, tuple[float, ...]]:
    """Separate three errors of fields in closed form, relative to their rms, by size.

    Discretisation: a direct solve relative to the exact field. Algebraic: Multigrid relative to
    the direct solve of the same energy. Model: the paper's converged prior relative to the exact
    field.
    """
    prior, errors = ElasticPrior(POISSON), {}
    for size, case in cases:
        direct = direct_solution(case.problem, prior)
        found = _solved(case.problem, prior, 0.01).displacement
        paper = solve_exactly(case.problem, "centred")
        pairs = ((direct, case.field), (found, direct), (paper, case.field))
        errors[size] = tuple(rmsd(*pair, case.inside) / case.size for pair in pairs)
    return errors


# Volumes.


def _volume_targets(results: Results) -> Iterator[Target]:
    bounds = {
        "volume to a direct solve: largest error in voxels": 1e-3,
        "volume, assembly to CalculiX C3D8, in voxels": 1e-5,
        "volume, patch test: largest error in voxels": 1e-4,
    }
    for rows in results.values():
        yield from (
            Target(row[0], float(row[1]), bounds[row[0]]) for row in rows if row[0] in bounds
        )


@study(
    "volumes.errors",
    lambda options: {
        "random stiffness": (_to_elements, options.sizes_or((20,), (8,))[0]),
        "patch test": (_patch_of_volume, (24, 20, 28)),
    },
    ("comparison", "largest difference, voxels", "cycles"),
    targets=_volume_targets,
    page="volumes.md",
)
def volume_errors(case: tuple[Callable[[Any], Any], Any]) -> list[Any]:
    """Compare volumes with finite elements, CalculiX and a uniform strain."""
    measure, argument = case
    return list(measure(argument))


def _to_elements(size: int) -> Iterator[list[Any]]:
    problem, prior = random_block(size, 100.0, (1.0, 0.5, -0.3)), ElasticPrior(POISSON)
    direct = direct_solution(problem, prior)
    found = _solved(problem, prior, 1e-3)
    off = _apart(found.displacement, direct, problem)
    claim = "volume to a direct solve: largest error in voxels"
    yield [claim, f"{off:.3g}", found.iterations]
    if calculix.is_missing():
        return
    locking = direct_solution(problem, prior, locking=True)
    theirs = calculix.solve(problem, "C3D8", POISSON)
    claim = "volume, assembly to CalculiX C3D8, in voxels"
    yield [claim, f"{_apart(theirs, locking, problem):.3g}", None]
    yield ["elements with full and reduced integration", _apart(direct, locking, problem), None]


def _patch_of_volume(shape: tuple[int, ...]) -> Iterator[list[Any]]:
    places = np.moveaxis(np.indices(shape), 0, -1) * OBLONG
    strain = np.array([[0.02, -0.01, 0.03], [0.03, 0.015, 0.01], [-0.02, 0.01, 0.01]])
    c = np.ones((*shape, 3))
    c[1:-1, 1:-1, 1:-1] = 0
    exact = places @ strain.T
    problem = Problem(observed=exact, confidence=c, stiffness=np.ones(shape), spacing=OBLONG)
    found = _solved(problem, ElasticPrior(0.45), 1e-5)
    off = _apart(found.displacement, exact, problem)
    yield ["volume, patch test: largest error in voxels", f"{off:.3g}", found.iterations]


def _sphere_tables(results: Results) -> list[Table]:
    titles = ["rms error", *(f"{size} voxels" for size in results)]
    return [Table(titles, lambda _: [["", *(f"{each:.1e}" for each in results.values())]])]


def _sphere_target(results: Results) -> list[Target]:
    exponent = order(list(results.values()), [int(size) for size in results])
    return [Target("hollow sphere: observed order", exponent, 1.7, at_least=True)]


@study(
    "volumes.sphere",
    lambda options: {str(n): n for n in options.sizes_or((24, 40, 64), (16, 24))},
    _sphere_tables,
    targets=_sphere_target,
    page="volumes.md",
)
def hollow_sphere(size: int) -> float:
    """Compare with Lame's hollow sphere, in units of half a side."""
    places = np.moveaxis((np.indices((size,) * 3) - (size - 1) / 2) / (size / 2), 0, -1)
    r = np.linalg.norm(places, axis=-1)
    tissue = (r > 0.3) & (r < 0.97)
    skins = tissue & ((r < 0.45) | (r > 0.82))
    exact = 0.05 * (1 + 0.1 / np.maximum(r, 0.1) ** 3)[..., None] * places
    c = np.repeat(skins[..., None], 3, axis=-1).astype(float)
    problem = Problem(
        observed=exact, confidence=c, stiffness=tissue.astype(float), spacing=(2 / size,) * 3
    )
    found = _solved(problem, ElasticPrior(POISSON), 1e-4)
    return rmsd(found.displacement, exact, tissue & ~skins)


def _apart(one: npt.ArrayLike, other: npt.ArrayLike, problem: Problem) -> float:
    """Return the largest difference, in voxels."""
    return float(np.abs(np.asarray(one) - np.asarray(other)).max()) / problem.unit
