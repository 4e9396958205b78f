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
from napari_hmrf.fields import write_movie
from napari_hmrf.io.fields import export_field
from napari_hmrf.loads import reactions
from napari_hmrf.results.measurement import measure
from napari_hmrf.tissue import lookup_tissue, materials_by_name

SHAPE = 6, 7
GRID = Grid(SHAPE, (1.0, 1.0))
ONES = np.ones(SHAPE)
PULL = Arrow((3, 3), (0, 1), 1)


@pytest.fixture(scope="module")
def solution():
    return solve(phantom("expansion", size=16).problem, backend="cpu")


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("stiffness", lambda: Tissue(stiffness=ONES.tolist())),
        ("labels", lambda: Tissue(labels=[[1, 1]])),
        ("materials", lambda: Tissue(materials=Material(1, "a", 2))),
        ("curve", lambda: Tissue(curve=abs)),
        ("maps", lambda: Tissue.from_maps([ONES])),
        ("drawing", lambda: Motion(drawing=[PULL])),
        ("hold_edge", lambda: Motion(Drawing())),
        ("rules", lambda: Motion(rules=BoundaryRule(1, "fixed"))),
        ("observed", lambda: Motion(observed=[[0]], confidence=[[0]])),
        ("weight", lambda: Motion(weight=3)),
        ("image", lambda: Pictures(image=[[1, 2]])),
        ("grid", lambda: Study(SHAPE)),
        ("tissue", lambda: Study(GRID, ONES)),
        ("motion", lambda: Study(GRID, motion=Drawing())),
        ("pictures", lambda: Study(GRID, pictures=ONES)),
        ("prior", lambda: Study(GRID, prior="elastic")),
        ("optimizer", lambda: Study(GRID, optimizer="icm")),
        ("unit", lambda: Grid(SHAPE, (1, 1), None)),
        ("names", lambda: materials_by_name(["bone"])),
        ("names", lambda: materials_by_name({"bone": 1})),
        ("name", lambda: lookup_tissue(3)),
        ("study", lambda: write_study("a.study", ONES)),
        ("solution", lambda: write_study("a.study", Study(GRID), ONES)),
        ("solution", lambda: export_field("a.mha", ONES)),
        ("solution", lambda: write_movie("a.gif", ONES, ONES)),
        ("problem", lambda: reactions(Study(GRID), ONES)),
        ("cases", lambda: solve_cases("cases.csv", "out")),
        ("stated", lambda: solve_study(Study(GRID), stated=3)),
    ],
)
def test_an_argument_of_a_wrong_type_is_refused_by_name(name, call):
    with pytest.raises(ArgumentError, match=rf"^{name}\b"):
        call()


def test_a_wrong_argument_besides_a_solution_is_refused_by_name(solution):
    with pytest.raises(ArgumentError, match=r"^names"):
        measure(solution, np.ones((16, 16), int), names=["bone"])
    with pytest.raises(ArgumentError, match=r"^solution"):
        reactions(phantom("expansion", size=16).problem, ONES)
    with pytest.raises(ArgumentError, match=r"^grid"):
        export_field("a.mha", solution, grid=(16, 16))


@pytest.mark.parametrize("call", [solve_study, build_problem])
def test_a_problem_in_place_of_a_study_is_refused_with_a_hint_to_solve(call):
    problem = Problem(
        observed=np.zeros((*SHAPE, 2)), confidence=np.ones((*SHAPE, 2)), stiffness=ONES
    )
    with pytest.raises(ArgumentError, match=r"^study .* solve\(problem\)"):
        call(problem)
    with pytest.raises(ArgumentError, match=r"^study"):
        call(ONES)


@pytest.mark.parametrize(
    ("shape", "spacing", "field"),
    [
        (64, (1, 1), "grid"),
        (ONES, (1, 1), "grid"),
        ((6, 7, 8, 9), (1, 1), "grid"),
        ((6, 0), (1, 1), "grid"),
        (SHAPE, "mm", "spacing"),
        (SHAPE, (1, 1, 1), "spacing"),
        (SHAPE, (1, -1), "spacing"),
    ],
)
def test_a_grid_with_an_invalid_shape_or_spacing_is_refused(shape, spacing, field):
    with pytest.raises(ProblemError) as refused:
        Grid(shape, spacing)
    assert refused.value.field == field


def test_a_grid_accepts_any_sequence_as_shape_and_one_number_as_spacing():
    made = Grid(np.array(SHAPE), 2)
    assert made == Grid(SHAPE, (2.0, 2.0))
    assert Study(made, Tissue(stiffness=ONES)).grid.shape == SHAPE


@pytest.mark.parametrize(
    ("shape", "mark"),
    [
        (SHAPE, Arrow((1, 3, 3), (0, 0, 1), 1)),
        ((5, *SHAPE), PULL),
        (SHAPE, Landmark((1, 3, 3), (1, 3, 4), 1)),
        (SHAPE, Stroke("pin", (((1, 3, 3),),), 1)),
    ],
)
def test_a_mark_with_another_number_of_axes_than_the_grid_is_refused(shape, mark):
    grid = Grid(shape, (1.0,) * len(shape))
    with pytest.raises(ProblemError) as refused:
        solve_study(Study(grid, motion=Motion(drawing=Drawing((mark,)))))
    assert refused.value.field == "drawing"


def test_lists_of_rows_are_converted_to_tuples():
    tissue = Tissue(materials=[Material(1, "brain", 3.0)])
    motion = Motion(rules=[BoundaryRule(1, "fixed")], weight=[0, 1])
    assert (type(tissue.materials), type(motion.rules), motion.weight) == (tuple, tuple, (0.0, 1.0))
