"""Engine with coarse previews: a slice of a volume or an image, then the full result."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, label

from napari_hmrf import Arrow, Drawing, Grid, Motion, Study, Tissue, solve_study, warp
from napari_hmrf.field.frame import Frame
from napari_hmrf.solver import live_solver
from napari_hmrf.study.coarse_grid import CoarseGrid, Preview
from napari_hmrf.study.engine import Engine
from napari_hmrf.study.ground import build_problem
from napari_hmrf.study.models import optimizer_of, prior_of
from napari_hmrf.study.study import Pictures
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.tissue.drawing import Landmark, Stroke

SHAPE, SPACING = (20, 24, 22), (1.5, 1.0, 1.0)
PULL = Arrow((10, 12, 11), (0.0, 2.0, 1.0), 3)


def a_study(*marks):
    image = np.random.default_rng(3).integers(0, 255, SHAPE).astype(np.uint8)
    return Study(
        Grid(SHAPE, SPACING),
        Tissue(stiffness=np.ones(SHAPE)),
        Motion(hold_edge=True, drawing=Drawing(marks or (PULL,))),
        pictures=Pictures(image=image),
    )


def results_of(*asked):
    """Return the results of an engine for pairs of a study and a preview or None."""
    delivered, found = [], []
    engine = Engine(delivered.append, "a test")
    try:
        for study, preview in asked:
            engine.submit(study, preview=preview)
            assert engine.live.wait(60)
            found.append(delivered[-1])
    finally:
        engine.close()
    return found


@pytest.mark.parametrize("view", [{"axis": 0, "number": 10}, {"axis": 2, "number": 11}, {}])
def test_a_preview_of_a_volume_does_not_show_removed_tissue(view):
    hole = Stroke("remove", (((10.0, 12.0, 11.0),),), radius=5.0)
    study = replace(a_study(hole), pictures=Pictures(image=np.full(SHAPE, 200, np.uint8)))
    image = study.pictures.image.copy()
    image[0, 0, 0] = 3  # the lowest value, which blank pixels have
    study = replace(study, pictures=Pictures(image=image))
    preview, final = results_of((study, Preview(CoarseGrid(2), **view)), (study, None))
    middle = {0: (12, 11), 2: (10, 12)}.get(view.get("axis"), (5, 6, 5))
    assert preview.image[middle] == 3
    assert preview.image[tuple(at + 4 for at in middle)] == 200 or not view
    assert final.image[10, 12, 11] == 3
    assert final.solution.removed[10, 12, 11]
    assert not final.solution.tissue[10, 12, 11]


def test_a_volume_in_large_motion_is_shown_on_its_way(monkeypatch):
    monkeypatch.setattr(live_solver, "FIRST_PICTURE", 0.0)
    study = replace(
        a_study(Arrow((10, 12, 11), (0.0, 5.0, 3.0), 3)),
        prior=prior_of("large motion"),
        optimizer=optimizer_of("large motion"),
    )
    delivered = []
    engine = Engine(delivered.append, "a test")
    try:
        engine.submit(study)
        assert engine.live.wait(60)
    finally:
        engine.close()
    first, *_, last = (each.solution.displacement for each in delivered)
    assert np.abs(first).max() < np.abs(last).max()


def test_a_coarse_grid_samples_sites_at_a_constant_step():
    study = CoarseGrid(4).study(a_study())
    assert study.grid.shape == (5, 6, 6)
    assert study.grid.spacing == (6.0, 4.0, 4.0)
    assert study.pictures.image[2, 1, 5] == a_study().pictures.image[8, 4, 20]
    assert study.motion.drawing.marks[0].at == (2.5, 3, 2.75)
    assert study.motion.drawing.marks[0].by == PULL.by


def test_a_coarse_grid_of_a_placed_volume_has_a_place_of_its_own():
    study = a_study()
    place = Frame.at(SPACING, ("mm",) * 3, volume=True)
    placed = replace(study, grid=Grid(SHAPE, SPACING, unit="mm", place=place))
    coarse = CoarseGrid(4).study(placed).grid
    assert coarse.place.spacing == coarse.spacing == (6.0, 4.0, 4.0)
    first = np.array([0, 0, 0, 1])
    assert np.array_equal(coarse.place.matrix @ first, place.matrix @ first)


@pytest.mark.parametrize(
    "step", [3, *(pytest.param(step, marks=pytest.mark.campaign) for step in (2, 4))]
)
def test_a_thin_closed_shell_stays_closed_on_a_coarse_grid(step):
    away = np.linalg.norm(np.indices((40, 40, 40)) - 19.3, axis=0)
    inside = away < 15
    shell = inside & ~binary_erosion(inside, np.ones((3, 3, 3)))
    grid = Grid(shell.shape, (1.0,) * 3)
    rules = (BoundaryRule(2, "expand", amount=2.0),)
    study = Study(
        grid, Tissue(stiffness=np.ones(shell.shape)), Motion(labels=2 * shell, rules=rules)
    )
    coarse = CoarseGrid(step).study(study).motion.labels
    assert label(coarse == 0)[1] == 2, "the shell should separate its inside from its outside"
    build_problem(CoarseGrid(step).study(study))  # an open sheet would raise an error


def test_marks_keep_their_position_on_a_coarse_grid():
    marks = (
        Landmark((4, 8, 12), (8, 8, 12), 2),
        Stroke("pin", (((4, 8, 12), (8, 8, 12)),), 2),
    )
    landmark, stroke = CoarseGrid(4).drawing(Drawing(marks)).marks
    assert (landmark.source, landmark.target) == ((1, 2, 3), (2, 2, 3))
    assert stroke.lines == (((1, 2, 3), (2, 2, 3)),)


@pytest.mark.parametrize("sites", [100, 1000, 5000, 10**6])
def test_a_coarse_grid_is_the_finest_within_a_limit_of_sites(sites):
    grid = CoarseGrid.of_at_most(sites, SHAPE)
    assert np.prod([-(-size // grid.step) for size in SHAPE]) <= sites
    finer = CoarseGrid(max(grid.step - 1, 1))
    assert grid.step == 1 or np.prod([-(-size // finer.step) for size in SHAPE]) > sites


@pytest.mark.parametrize(
    "axis", [1, *(pytest.param(axis, marks=pytest.mark.campaign) for axis in (0, 2))]
)
def test_the_preview_of_a_drag_approximates_the_final_result(axis):
    study = a_study()
    number = round(PULL.at[axis])
    preview, whole = results_of((study, Preview(CoarseGrid(2), axis, number)), (study, None))
    assert preview.error is None
    assert preview.solution.displacement.shape == (10, 12, 11, 3)
    exact = whole.solution.displacement
    near = preview.solution.displacement - exact[::2, ::2, ::2]
    assert np.sqrt(np.mean(near**2)) < 0.5 * np.sqrt(np.mean(exact**2))
    assert preview.image.shape == tuple(np.delete(SHAPE, axis))
    # The pulled point reaches its target in both results.
    for moved in (preview, whole):
        assert moved.moved_positions(np.array([PULL.at]))[0] == pytest.approx(
            (10, 14, 12), abs=0.05
        )
        assert moved.origin_of((10, 14, 12)) == pytest.approx(PULL.at, abs=0.1)


def test_the_preview_of_a_slice_at_full_resolution_matches_the_volume():
    study = a_study()
    preview, whole = results_of((study, Preview(CoarseGrid(1), 0, 10)), (study, None))
    apart = np.abs(preview.image.astype(int) - whole.image[10])
    assert apart.max() <= 1  # both solves have a tolerance of 0.01 voxels


def test_the_engine_warps_a_volume_like_warp():
    study = a_study()
    (whole,) = results_of((study, None))
    solution = solve_study(study)
    image = warp(
        study.pictures.image, solution.displacement, spacing=SPACING, tissue=solution.tissue
    )
    assert np.abs(whole.image.astype(int) - image).max() <= 2


def test_a_preview_without_prescribed_motion_has_no_error():
    (still,) = results_of(
        (a_study(Stroke("free", (((1, 1, 1),),), 2)), Preview(CoarseGrid(2), 1, 7))
    )
    assert still.error is None


@pytest.mark.parametrize(
    ("model", "preview"),
    [
        ("large motion", Preview(CoarseGrid(3))),
        ("elastic", Preview(CoarseGrid(3))),
        ("elastic", Preview(CoarseGrid(4), pixel=2)),
    ],
)
def test_the_coarse_preview_of_an_image_approximates_the_final_image(model, preview):
    shape = (60, 80)
    rows, cols = np.indices(shape)
    smooth = (127 + 120 * np.sin(rows / 7) * np.cos(cols / 9)).astype(np.uint8)
    study = Study(
        Grid(shape, (0.5, 0.5), "mm"),
        Tissue(stiffness=np.ones(shape)),
        Motion(hold_edge=True, drawing=Drawing((Arrow((30, 40), (0.0, 4.0), 4),))),
        model=model,
        pictures=Pictures(image=smooth),
    )
    coarse, whole = results_of((study, preview), (study, None))
    assert coarse.error is None
    assert whole.image.shape == shape
    every = (slice(None, None, preview.pixel),) * 2
    apart, moved = (
        np.abs(each.astype(int) - whole.image[every]).mean()
        for each in (coarse.image, smooth[every])
    )
    assert apart < 0.2 * moved
    assert coarse.moved_positions(np.array([(30.0, 40.0)]))[0] == pytest.approx((30, 48), abs=0.1)


def test_a_preview_weighs_an_uncertain_landmark_like_the_full_grid():
    mark = Landmark((10.2, 12.4, 11.3), (10.2, 15.4, 11.3), 3.0, sd=0.05)
    study, at = a_study(mark), np.array([mark.source])
    coarse, fine = results_of((study, Preview(CoarseGrid(2))), (study, None))
    reached = [each.solution.at(at / each.grid.step)[0, 1] for each in (coarse, fine)]
    assert coarse.error is None
    assert reached == pytest.approx([reached[1]] * 2, rel=0.35)
    assert reached[1] > 0.5
    assert coarse.stated.problem.landmarks.sd[0] == pytest.approx(0.05)


def test_only_the_folds_of_a_solution_are_counted_not_those_of_its_preview(monkeypatch):
    monkeypatch.setattr(live_solver, "PATIENCE", 0.0)
    pull = Arrow((20.0, 20.0), (0.0, 16.0), 3.0)
    motion = Motion(hold_edge=True, drawing=Drawing((pull,)))
    study = Study(Grid((40, 40), (1.0, 1.0)), Tissue(stiffness=np.ones((40, 40))), motion)
    delivered = []
    engine = Engine(delivered.append, "a test")
    try:
        engine.submit(study, counts_folds=True)
        assert engine.live.wait(60)
    finally:
        engine.close()
    first, *_, last = delivered
    assert first.solution.count_folds() > 0
    assert first.folds == 0
    assert last.folds == last.solution.count_folds() > 0
