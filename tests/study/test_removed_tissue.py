"""Tissue that is removed: its picture, the load on the cavity, and the motion of what remains."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    Arrow,
    BoundaryRule,
    Cavity,
    Drawing,
    ElasticPrior,
    Grid,
    Motion,
    NeoHookeanPrior,
    Pictures,
    Problem,
    ProblemError,
    SeilerPrior,
    Solution,
    Stroke,
    Study,
    Tissue,
    read_study,
    replay,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.loads import cavity, weight
from napari_hmrf.results.animation import Motion as Animation
from napari_hmrf.study.ground import build_problem

SPACING = (0.5, 0.8)
SHAPE = (32, 40)
ROWS, COLS = np.indices(SHAPE)
DISC = np.hypot(ROWS - 16, COLS - 20) < 6
DOWN = (0.01, 0.0)
REMOVE = (BoundaryRule(1, "remove"),)


def study(removed=DISC, stiffness=None, **motion):
    """Return a block of 2 kPa that is held at its edge, without the tissue of a mask."""
    shape = removed.shape
    tissue = Tissue(stiffness=np.full(shape, 2.0) if stiffness is None else stiffness, unit="kPa")
    settings = {"hold_edge": True, "labels": removed.astype(int), "rules": REMOVE, **motion}
    return Study(Grid(shape, SPACING[: len(shape) - 2] + SPACING, "mm"), tissue, Motion(**settings))


def elements_without(mask):
    """Return the number of elements that have a removed corner."""
    kept = ~mask
    for axis in range(mask.ndim):
        first, last = np.arange(mask.shape[axis] - 1), np.arange(1, mask.shape[axis])
        kept = kept.take(first, axis) & kept.take(last, axis)
    return int((~kept).sum())


# Forces on the surface of a cavity


@pytest.mark.parametrize("down", [(0.2, -0.1), (-0.2, 0.1, 0.3)])
def test_a_full_cavity_bears_the_weight_of_its_fluid(down):
    shape, spacing = (24, 17, 19)[-len(down) :], (0.5, 1.3, 0.8)[-len(down) :]
    middle = [size / 2 for size in shape]
    away = np.linalg.norm(np.moveaxis(np.indices(shape), 0, -1) - middle, axis=-1)
    hole = away < 5
    loads = cavity(np.ones(shape), hole, spacing=spacing, fluid=down)
    volume = elements_without(hole) * np.prod(spacing)
    total = loads.force.reshape(-1, len(down)).sum(axis=0)
    np.testing.assert_allclose(total, volume * np.array(down), atol=1e-5 * volume)


def test_a_half_full_cavity_is_loaded_below_the_level_only():
    hole = np.zeros((16, 12), bool)
    hole[5:10, 4:7] = True  # its surface has the rows 4 to 10 and the columns 3 to 7
    force = cavity(np.ones(hole.shape), hole, spacing=(2, 1), fluid=(0.1, 0), level=0.5).force
    assert not force[:7].any()
    # The floor bears the depth of 6 mm on 4 mm, and a wall half of this depth on 6 mm.
    assert force[10, :, 0].sum() == pytest.approx(0.1 * 6 * 4)
    assert force[:, 3, 1].sum() == pytest.approx(-0.1 * 6 * 6 / 2)
    np.testing.assert_allclose(force[:, 3, 1], -force[:, 7, 1])
    # Moment of the triangular pressure about the level: two thirds of the depth.
    depth = 2 * (np.arange(16) - 7)
    assert (depth * force[:, 7, 1]).sum() == pytest.approx(0.1 * 6 * 6 / 2 * 4)


def test_fluid_loads_only_the_faces_of_removed_tissue():
    hole = np.zeros((9, 9), bool)
    hole[:4, 3:6] = True  # opens at the edge of the image
    force = cavity(np.ones(hole.shape), hole, spacing=1, pressure=0.5).force
    assert force[4, :, 0].sum() == pytest.approx(0.5 * 4)
    assert not force[:, [0, -1]].any()
    assert not force[-1].any()


@pytest.mark.parametrize("axes", [2, 3])
def test_removed_tissue_contributes_neither_stiffness_nor_weight(axes):
    hole = DISC if axes == 2 else np.stack([0 * DISC, 0 * DISC, DISC, DISC, 0 * DISC, 0 * DISC]) > 0
    down = (0.0,) * (axes - 2) + DOWN
    soft, stiff = (np.where(hole, e, 2.0) for e in (0.1, 500.0))
    one, other = (solve_study(study(hole, each, weight=down)) for each in (soft, stiff))
    np.testing.assert_array_equal(one.displacement, other.displacement)
    assert not one.tissue[hole].any()
    np.testing.assert_array_equal(one.removed, hole)
    m = np.where(hole, 0, 2.0)
    stated = build_problem(study(hole, soft, weight=down)).problem
    spacing = study(hole).grid.spacing
    np.testing.assert_array_equal(
        stated.loads.force, weight(m, down, spacing=spacing).force.astype(np.float32)
    )


# Motion of the remaining tissue


@pytest.mark.parametrize("prior", [ElasticPrior(0.4), NeoHookeanPrior(0.4)])
def test_a_symmetric_cavity_under_pressure_stays_symmetric(prior):
    row, col = np.indices((33, 41))
    hole = np.hypot(row - 16, col - 20) < 7
    pressed = replace(study(hole, cavity=Cavity(pressure=0.2)), prior=prior)
    moved = solve_study(pressed).displacement
    assert moved[16, 30, 1] > 0.1  # the wall moves outwards
    np.testing.assert_allclose(moved[:, ::-1, 1], -moved[..., 1], atol=3e-3)
    np.testing.assert_allclose(moved[::-1, :, 0], -moved[..., 0], atol=3e-3)


def test_fluid_keeps_the_roof_of_a_cavity_from_nothing_but_loads_its_floor():
    empty, half, full = (
        solve_study(study(weight=DOWN, cavity=load)).displacement[..., 0]
        for load in (Cavity(), Cavity(fluid=0.01, level=0.5), Cavity(fluid=0.01))
    )
    roof, floor = (9, 20), (23, 20)
    assert empty[roof] > empty[floor] > 0  # the roof sinks into the cavity
    assert full[floor] > half[floor] > empty[floor]
    closing = [each[roof] - each[floor] for each in (empty, half, full)]
    assert closing[0] > closing[1] > closing[2]


def test_suction_closes_a_cavity():
    moved = solve_study(study(cavity=Cavity(pressure=-0.1))).displacement
    assert moved[9, 20, 0] > 0.01
    assert moved[23, 20, 0] < -0.01


def test_a_brush_removes_the_same_tissue_as_a_label():
    stroke = Stroke("remove", (((16.0, 20.0),),), radius=3.0)
    size = np.hypot((ROWS - 16) * 0.5, (COLS - 20) * 0.8)
    painted = study(labels=None, drawing=Drawing((stroke,)), weight=DOWN)
    labelled = study(size <= 3.0, weight=DOWN)
    np.testing.assert_array_equal(
        solve_study(painted).displacement, solve_study(labelled).displacement
    )


def test_tissue_painted_into_a_cavity_fills_it():
    spot = (((16.0, 20.0),),)
    marks = (Stroke("remove", spot, 3.0), Stroke("tissue", spot, 3.0, label=1))
    filled = study(labels=None, drawing=Drawing(marks), weight=DOWN)
    solution = solve_study(filled)
    assert solution.removed is None
    assert solution.tissue.all()


# Pictures


def test_removed_tissue_vanishes_from_pictures_as_soon_as_the_tissue_moves():
    image = np.where(DISC, 200, 100).astype(np.uint8)
    sunk = solve_study(study(weight=(0.05, 0.0)))
    assert sunk.displacement[9, 20, 0] > 0.2
    animation = Animation(sunk, image, np.where(DISC, 7, 3))

    def at(fraction):
        return compute_thread.result_of(lambda: animation.at(fraction), "test")

    np.testing.assert_array_equal(at(0).image, image)
    np.testing.assert_array_equal(at(0).overlay == 7, DISC)
    first, last = at(0.01).image, at(1).image
    # An image has no value for "no tissue" but its lowest value.
    assert set(np.unique(first[DISC])) <= {100}
    assert not (at(0.01).overlay == 7).any()
    np.testing.assert_array_equal(last, sunk.warp(image, fill=100))
    assert sunk.warp(image)[16, 20] == 0
    # The cavity becomes smaller: its roof sinks by more than its floor.
    assert (sunk.warp(image) < 50).sum() < (first[DISC] < 101).sum()


def test_a_removal_without_any_load_moves_nothing_and_says_so():
    solution = solve_study(study())
    assert not solution.displacement.any()
    assert any("nothing acts" in note for note in solution.notes)


# Inputs


def test_a_removal_survives_a_file_round_trip(tmp_path):
    given = study(weight=DOWN, cavity=Cavity(0.01, 0.02, 0.5))
    solution = solve_study(given)
    path = write_study(tmp_path / "removed", given, solution)
    back = read_study(path)
    assert back.study.motion.cavity == given.motion.cavity
    np.testing.assert_array_equal(back.solution.removed, DISC)
    np.testing.assert_array_equal(replay(path).displacement, solution.displacement)
    again = Solution.read(solution.write(tmp_path / "field.npz"))
    np.testing.assert_array_equal(again.removed, DISC)


def test_removed_tissue_is_not_held():
    held = Arrow((16.0, 20.0), (0.0, 1.0), radius=1.0)
    solution = solve_study(study(weight=DOWN, drawing=Drawing((held,))))
    assert not solution.displacement[DISC].any()
    assert any("removed tissue are also held or moved" in note for note in solution.notes)


def test_the_paper_model_removes_tissue_but_has_no_pressure():
    pull = Drawing((Arrow((8.0, 20.0), (1.0, 0.0), radius=1.0),))
    paper = replace(study(drawing=pull), prior=SeilerPrior())
    assert not solve_study(paper).tissue[DISC].any()
    pressed = replace(paper, motion=replace(paper.motion, cavity=Cavity(pressure=0.1)))
    with pytest.raises(ProblemError, match="'cavity' has forces"):
        solve_study(pressed)


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ({"labels": np.ones(SHAPE, int)}, "removes all tissue"),
        ({"cavity": Cavity(fluid=0.01)}, "no direction of gravity"),
    ],
)
def test_a_removal_that_cannot_be_solved_is_rejected(motion, words):
    with pytest.raises(ProblemError, match=words):
        solve_study(study(**motion))


def test_removing_all_that_holds_heavy_tissue_is_rejected():
    labels = np.zeros(SHAPE, int)
    labels[-4:] = 1
    block = study(labels=labels, hold_edge=False, weight=DOWN)
    table = Stroke("pin", (((31.0, 0.0), (31.0, 39.0)),), radius=0.1)
    with pytest.raises(ProblemError, match="all tissue that is held"):
        solve_study(replace(block, motion=replace(block.motion, drawing=Drawing((table,)))))


@pytest.mark.parametrize("wrong", [{"pressure": np.nan}, {"fluid": -1}, {"level": -0.1}])
def test_an_invalid_load_on_a_cavity_is_rejected(wrong):
    (name,) = wrong
    with pytest.raises(ArgumentError, match=name):
        Cavity(**wrong)


def test_a_load_without_a_cavity_is_reported():
    block = study(labels=None, weight=DOWN, cavity=Cavity(pressure=0.1))
    assert any("no tissue is removed" in note for note in solve_study(block).notes)


def test_a_removal_equals_a_problem_without_the_tissue():
    m = np.where(DISC, 0, 2.0)
    given = study(weight=DOWN, cavity=Cavity(0.02, 0.01, 0.7))
    stated = build_problem(given).problem
    loads = weight(m, DOWN, spacing=SPACING) + cavity(
        m, DISC, spacing=SPACING, pressure=0.02, fluid=DOWN, level=0.7
    )
    known = Problem(
        observed=stated.observed,
        confidence=stated.confidence,
        stiffness=m,
        spacing=SPACING,
        loads=loads,
    )
    np.testing.assert_allclose(
        solve_study(given).displacement,
        solve(known, ElasticPrior(0.45)).displacement,
        atol=1e-5,
    )


def test_pictures_of_a_study_do_not_change():
    image = np.where(DISC, 200.0, 100.0)
    given = replace(study(weight=DOWN), pictures=Pictures(image))
    solve_study(given).warp(image)
    np.testing.assert_array_equal(image == 200, DISC)
