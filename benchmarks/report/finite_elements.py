"""Comparison with finite elements: scikit-fem, and CalculiX if it is installed."""

from __future__ import annotations

import numpy as np
from paper import PHANTOMS

from napari_hmrf import ConvergenceError, ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from napari_hmrf.solver.priors.elastic import Plane
from report.page import Section, Settings, Target
from report.pictures import draw_differences, draw_grid, new_figure, save
from validation.oracles import calculix
from validation.oracles.elasticity import direct_solution
from validation.oracles.paper import solve_exactly

POISSON = 0.3
TISSUES: tuple[tuple[float, Plane], ...] = (
    (0.0, "stress"),
    (0.45, "stress"),
    (0.499, "stress"),
    (0.45, "strain"),
    (0.499, "strain"),
)
SAME_ENERGY = 0.005  # px, distance from a direct solve of the same energy
OTHER_PROGRAM = (
    0.01  # px, distance from another program, or of the paper's prior from its direct solve
)


def section(settings: Settings) -> Section:
    """Return the section with figures 4 and 5, and a table of distances between fields."""
    page = Section("Finite elements")
    size = settings.choose(300, 32)
    page.say(
        f"""**Question.** How far are both priors from finite elements, and finite elements from
        each other, at {size} x {size} and Poisson's ratio {POISSON}? RMSD inside the body, in
        pixels. scikit-fem's field is a sparse direct solve in float64, with elements that
        scikit-fem integrates. CalculiX reads ABAQUS decks. Its CPS3 and CPS4R are the elements
        of the paper's figure 5. These and its CPS4 expand to bricks whose stress across the
        plane vanishes only weakly. So the textbook's plane stress is run as plane strain (CPE4)
        with nu / (1 + nu), which is the same equation for displacement-only data and one
        Poisson's ratio."""
    )
    rows = []
    for name in PHANTOMS:
        rows += _compare(page, settings, name, phantom(name, size).problem)
    page.table(["phantom", "field", "to scikit-fem's", "to the elastic prior's"], rows)
    if not calculix.is_there():
        page.missing("CalculiX", calculix.HOW)
    page.say(
        """**Conclusion.** The elastic prior on pixels *is* the finite-element method with pixels
        as its mesh; two other programs agree to all digits that matter. This checks the program,
        not elasticity: another element (CPS3, CPS4R) changes the answer more than any solver
        does. The paper's converged prior is tenths of a pixel away, because compressed tissue
        does not bulge in it; figure 5 shows where. The paper's "x" and "y" are col and row here."""
    )
    _many_materials(page, settings)
    return page


def _compare(page: Section, settings: Settings, name: str, problem: Problem) -> list[list[object]]:
    prior = ElasticPrior(poisson=POISSON)
    truth = direct_solution(problem, prior)
    elastic = solve(problem, prior, optimizer=Multigrid(0.01), backend="cpu").displacement
    paper = solve(problem, SeilerPrior(), optimizer=Multigrid(0.01), backend="cpu").displacement
    off = rmsd(paper, solve_exactly(problem, "centred"), problem.tissue)
    page.targets.append(Target(f"{name}, centred to direct: RMSD in px", off, OTHER_PROGRAM))
    fields = {"elastic prior": elastic, "the paper's prior, converged": paper}
    off = rmsd(elastic, truth, problem.tissue)
    page.targets.append(Target(f"{name}, elastic to direct: RMSD in px", off, SAME_ENERGY))
    if calculix.is_there():
        book = calculix.textbook_plane_stress(problem, POISSON)
        fields["CalculiX, textbook plane stress"] = book
        off = rmsd(elastic, book, problem.tissue)
        page.targets.append(Target(f"{name}, elastic to CalculiX: RMSD in px", off, OTHER_PROGRAM))
        for element in ("CPS4", "CPS4R", "CPS3"):
            field = calculix.solve(problem, element, POISSON)
            fields[f"CalculiX, {element}"] = field
    _figure_4(page, settings, name, problem, fields, truth)
    _figure_5(page, settings, name, problem, {"elastic": elastic, "paper's prior": paper}, truth)
    inside = problem.tissue
    return [
        [name, title, *(f"{rmsd(field, other, inside):.5f} px" for other in (truth, elastic))]
        for title, field in fields.items()
    ]


def _figure_4(page, settings, name, problem, fields, truth) -> None:
    shown = {
        "the paper's prior, converged": fields["the paper's prior, converged"],
        "elastic prior": fields["elastic prior"],
        "scikit-fem": truth,
    }
    if (other := "CalculiX, CPS4R") in fields:
        shown[other] = fields[other]
    figure = new_figure(4.2 * len(shown), 4.4)
    for axes, (title, field) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        draw_grid(axes, field, problem.tissue)
        axes.set_title(title)
    path = save(figure, settings, f"{name}-grids")
    page.picture(path, f"{name}: deformation grids, as in figure 4")


def _figure_5(page, settings, name, problem, fields, truth) -> None:
    figure = new_figure(12, 7)
    for axes_row, (title, field) in zip(figure.subplots(2, 3), fields.items(), strict=True):
        shown = draw_differences(axes_row, field, truth, problem.tissue)
        figure.colorbar(shown, ax=axes_row, label="px")
        for axes, what in zip(axes_row, ("magnitude", "x (col)", "y (row)"), strict=True):
            axes.set_title(f"{title}: {what}")
    path = save(figure, settings, f"{name}-differences")
    page.picture(path, f"{name}: difference to scikit-fem, as in figure 5")


def _many_materials(page: Section, settings: Settings) -> None:
    """Add a table for ratios of stiffness from 1 to 1e6 and Poisson's ratios from 0 to 0.499."""
    size = settings.choose(96, 32)
    base = phantom("mass-effect", size).problem
    rows, worst = [], 0.0
    for ratio in (1.0, 1e2, 1e4, 1e6):
        stiffness = np.where(base.stiffness == 40, ratio, np.where(base.stiffness > 0, 1.0, 0.0))
        problem = Problem(observed=base.observed, confidence=base.confidence, stiffness=stiffness)
        row: list[object] = [f"{ratio:.0e}"]
        for poisson, plane in TISSUES:
            prior = ElasticPrior(poisson, plane=plane)
            try:
                found = solve(problem, prior, optimizer=Multigrid(0.005), backend="cpu")
            except ConvergenceError:
                row.append("refused")
                continue
            off = rmsd(found.displacement, direct_solution(problem, prior), problem.tissue)
            row.append(f"{off:.1e} px, {found.iterations} cycles")
            worst = max(worst, off)
        rows.append(row)
    page.say(
        f"""**Question.** Does the solver work for any tissue? The tumour of the mass-effect
        phantom at {size} x {size} becomes ever stiffer, for Poisson's ratios up to nearly
        incompressible: RMSD to the direct solve, at a tolerance of 0.005 px."""
    )
    page.table(
        ["stiffness ratio", *(f"plane {plane}, {poisson}" for poisson, plane in TISSUES)], rows
    )
    page.say(
        """**Conclusion.** *Refused* is an error instead of a field: the combination is beyond
        single precision, and the solver says so."""
    )
    page.targets.append(Target("any stiffness and Poisson's ratio: RMSD in px", worst, SAME_ENERGY))
