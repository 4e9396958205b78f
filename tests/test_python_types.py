"""Tests of errors for arguments of a wrong type, which name the argument and the right type."""

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    Arrow,
    BoundaryRule,
    Drawing,
    Grid,
    Landmark,
    Material,
    Motion,
    Pictures,
    Problem,
    ProblemError,
    Stroke,
    Study,
    Tissue,
    build_problem,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.cases import solve_cases
from napari_hmrf.data import phantom
from napari_hmrf.field.measurement import measure
from napari_hmrf.fields import write_movie
from napari_hmrf.io.fields import export_field
from napari_hmrf.loads import reactions
from napari_hmrf.tissue import lookup_tissue, materials_by_name

SHAPE = 6, 7
GRID = Grid(SHAPE, (1.0, 1.0))
ONES = np.ones(SHAPE)
PULL = Arrow((3, 3), (0, 1), 1)


@pytest.fixture(scope="module")
def solution():
    return solve(phantom("expansion", size=16).problem, backend="cpu")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: Tissue(stiffness=ONES.tolist()),
            r"stiffness must be an array, such as np.array\(",
        ),
        (lambda: Tissue(labels=[[1, 1]]), "labels must be an array"),
        (lambda: Tissue(materials=Material(1, "a", 2)), "materials must be a tuple of Material"),
        (lambda: Tissue(curve=abs), "curve must be a StiffnessCurve"),
        (lambda: Tissue.from_maps([ONES]), "maps must be a mapping of names to maps"),
        (lambda: Motion(drawing=[PULL]), r"drawing must be a Drawing, such as Drawing\(\(Arrow"),
        (lambda: Motion(Drawing()), "hold_edge must be True or False, not Drawing"),
        (lambda: Motion(rules=BoundaryRule(1, "fixed")), "rules must be a tuple of BoundaryRule"),
        (lambda: Motion(observed=[[0]], confidence=[[0]]), "observed must be an array"),
        (lambda: Motion(weight=3), "weight must be a finite number along each axis"),
        (lambda: Pictures(image=[[1, 2]]), "image must be an array"),
        (lambda: Study(SHAPE), r"grid must be a Grid, such as Grid\(image.shape"),
        (lambda: Study(GRID, ONES), r"tissue must be a Tissue, such as Tissue\(stiffness="),
        (lambda: Study(GRID, motion=Drawing()), r"motion must be a Motion, .*, not Drawing\(empty"),
        (lambda: Study(GRID, pictures=ONES), r"pictures must be a Pictures, such as Pictures\(im"),
        (lambda: Study(GRID, prior="elastic"), "prior must be a SeilerPrior, ElasticPrior or Neo"),
        (lambda: Study(GRID, optimizer="icm"), "optimizer must be an ICM or Multigrid"),
        (lambda: Grid(SHAPE, (1, 1), None), 'unit must be a str, such as "mm", not None'),
        (lambda: materials_by_name(["bone"]), "names must be a mapping of labels to names"),
        (lambda: materials_by_name({"bone": 1}), "names must be a mapping of labels to names"),
        (lambda: lookup_tissue(3), 'name must be a str, such as "liver", not 3'),
        (lambda: write_study("a.study", ONES), "study must be a Study"),
        (lambda: write_study("a.study", Study(GRID), ONES), "solution must be a Solution"),
        (lambda: export_field("a.mha", ONES), r"solution is an array\. .* write_field\(path"),
        (lambda: export_field("a.mha", Study(GRID)), "solution must be a Solution"),
        (lambda: write_movie("a.gif", ONES, ONES), "solution must be a Solution"),
        (lambda: reactions(Study(GRID), ONES), "problem must be a Problem, such as Problem"),
        (lambda: solve_cases("cases.csv", "out"), r"cases must be a tuple of NamedCase, .*read_c"),
        (lambda: solve_study(Study(GRID), stated=3), "stated must be a Statement, such as build_p"),
    ],
)
def test_an_argument_of_a_wrong_type_is_refused_by_name(call, said):
    with pytest.raises(ArgumentError, match=said):
        call()


def test_a_wrong_argument_besides_a_solution_is_refused_by_name(solution):
    with pytest.raises(ArgumentError, match="names must be a mapping of labels to names, such as"):
        measure(solution, np.ones((16, 16), int), names=["bone"])
    with pytest.raises(ArgumentError, match="solution must be a Solution"):
        reactions(phantom("expansion", size=16).problem, ONES)
    with pytest.raises(ArgumentError, match=r"grid must be a Grid, .*, not \(16, 16\)"):
        export_field("a.mha", solution, grid=(16, 16))


@pytest.mark.parametrize("call", [solve_study, build_problem])
def test_a_problem_in_place_of_a_study_is_refused_with_a_hint_to_solve(call):
    problem = Problem(np.zeros((*SHAPE, 2)), np.ones((*SHAPE, 2)), ONES)
    with pytest.raises(ArgumentError, match=r"study is a Problem\. Call solve\(problem\)"):
        call(problem)
    with pytest.raises(ArgumentError, match="study must be a Study"):
        call(ONES)


@pytest.mark.parametrize(
    ("shape", "spacing", "said"),
    [
        (64, (1, 1), r"grid: has shape 64\. Pass the number of pixels along each axis"),
        (ONES, (1, 1), "grid: has shape array"),
        ((6, 7, 8, 9), (1, 1), "grid: has shape"),
        ((6, 0), (1, 1), r"grid: has shape \(6, 0\)"),
        (SHAPE, "mm", r"spacing: is 'mm'\. \w+ 2 positive, finite pixel sizes"),
        (SHAPE, (1, 1, 1), "spacing: is"),
        (SHAPE, (1, -1), "spacing: is"),
    ],
)
def test_a_grid_with_an_invalid_shape_or_spacing_is_refused(shape, spacing, said):
    with pytest.raises(ProblemError, match=said):
        Grid(shape, spacing)


def test_a_grid_accepts_any_sequence_as_shape_and_one_number_as_spacing():
    made = Grid(np.array(SHAPE), 2)
    assert made == Grid(SHAPE, (2.0, 2.0))
    assert Study(made, Tissue(stiffness=ONES)).grid.shape == SHAPE


@pytest.mark.parametrize(
    ("shape", "mark", "said"),
    [
        (SHAPE, Arrow((1, 3, 3), (0, 0, 1), 1), r"the Arrow at \(1.0, 3.0, 3.0\), with 3 axes"),
        ((5, *SHAPE), PULL, r"with 2 axes, but the grid has 3\. .* as \(plane, row, col\)"),
        (SHAPE, Landmark((1, 3, 3), (1, 3, 4), 1), r"the Landmark .* as \(row, col\)"),
        (SHAPE, Stroke("pin", (((1, 3, 3),),), 1), "the Stroke at"),
    ],
)
def test_a_mark_with_another_number_of_axes_than_the_grid_is_refused(shape, mark, said):
    grid = Grid(shape, (1.0,) * len(shape))
    with pytest.raises(ProblemError, match=f"drawing: has .*{said}"):
        solve_study(Study(grid, motion=Motion(drawing=Drawing((mark,)))))


def test_lists_of_rows_are_converted_to_tuples():
    tissue = Tissue(materials=[Material(1, "brain", 3.0)])
    motion = Motion(rules=[BoundaryRule(1, "fixed")], weight=[0, 1])
    assert (type(tissue.materials), type(motion.rules), motion.weight) == (tuple, tuple, (0.0, 1.0))
