"""Studies of volumes: painted rules, drawn marks and their display."""

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import (
    ArgumentError,
    Arrow,
    BoundaryRule,
    Drawing,
    Grid,
    Landmark,
    Material,
    Motion,
    ProblemError,
    Stroke,
    Study,
    Tissue,
    solve_study,
)
from napari_hmrf.layers.arrow_layer import arrow_lines
from napari_hmrf.layers.paint_layer import painted_marks
from napari_hmrf.study.ground import Ground, build_problem
from napari_hmrf.study.study import Pictures
from napari_hmrf.tissue import boundary_images
from napari_hmrf.tissue.drawing import Canvas, Rendering

SHAPE, SPACING = (12, 16, 14), (2.0, 1.0, 1.5)


def block(**parts):
    return Study(Grid(SHAPE, SPACING, "mm"), Tissue(stiffness=np.ones(SHAPE)), **parts)


def ball(radius, shape=SHAPE, spacing=SPACING):
    middle = [(size - 1) / 2 for size in shape]
    at = np.indices(shape).T - middle
    return (np.linalg.norm(at * spacing, axis=-1) <= radius).T


def test_a_pulled_ball_of_tissue_moves_to_the_arrow_head():
    pull = Arrow(at=(6, 8, 7), by=(1.0, 0.5, -1.5), radius=2.5)
    study = block(motion=Motion(hold_edge=True, drawing=Drawing((pull,))))
    stated = build_problem(study)
    moved = solve_study(study).displacement
    held = (stated.problem.observed == pull.by).all(axis=-1)
    away = np.linalg.norm((np.argwhere(held) - pull.at) * SPACING, axis=1)
    assert away.max() <= 2.5
    assert (
        held.sum()
        == (np.linalg.norm((np.indices(SHAPE).T - pull.at) * SPACING, axis=-1) <= 2.5).sum()
    )
    assert moved[6, 8, 7] == pytest.approx(pull.by, abs=1e-4)
    assert not moved[0].any()
    assert not moved[:, :, -1].any()


def test_a_landmark_in_a_volume_pulls_tissue_to_its_target():
    mark = Landmark((6, 8, 7), (7, 8, 5), radius=2)
    moved = solve_study(block(motion=Motion(True, drawing=Drawing((mark,))))).displacement
    assert moved[6, 8, 7] == pytest.approx((2.0, 0, -3.0), abs=1e-4)


def test_a_stroke_in_a_volume_is_a_tube():
    stroke = Stroke("pin", (((2, 8, 3), (9, 8, 3)),), radius=2.0)
    canvas = Drawing((stroke,)).render(Canvas.blank(SHAPE, SPACING))
    held = canvas.confidence.all(axis=-1)
    assert held[2:10, 8, 3].all()
    assert not held[0].any()
    assert held[5, 6, 3]
    assert held[5, 10, 3]
    assert not held[5, 5, 3]
    assert held[5, 8, 4]
    assert not held[5, 8, 5]


def test_an_arrow_in_a_volume_can_prescribe_a_single_component():
    pull = Arrow((6, 8, 7), (1.0, 2.0, 3.0), 2, components="row")
    canvas = Drawing((pull,)).render(Canvas.blank(SHAPE, SPACING))
    assert canvas.observed[6, 8, 7].tolist() == [0, 2, 0]
    assert canvas.confidence[6, 8, 7].tolist() == [0, 1, 0]


def test_an_edit_in_a_volume_redraws_only_its_bounding_box():
    rendering = Rendering(Canvas.blank(SHAPE, SPACING))
    first, second = (Arrow((at, at, at), (1, 0, 0), 1.5) for at in (3, 8))
    rendering.show(Drawing((first,)))
    box = rendering.show(Drawing((first, second)))
    assert [side.stop - side.start for side in box] == [1, 3, 3]
    drawn = Drawing((first, second)).render(Canvas.blank(SHAPE, SPACING))
    assert all(
        np.array_equal(*each) for each in zip(rendering.canvas.images, drawn.images, strict=True)
    )


def test_marks_of_two_and_three_axes_are_rejected():
    with pytest.raises(ArgumentError, match="must all be"):
        Arrow((1, 2, 3), (1, 0), 2)
    with pytest.raises(ArgumentError, match="must all be"):
        Stroke("pin", (((1, 2), (1, 2, 3)),), 2)


def test_a_painted_shell_expands_along_its_normal():
    shape = (24, 24, 24)
    shell = ball(8, shape, (1, 1, 1)) & ~ball(6, shape, (1, 1, 1))
    y, c = boundary_images(
        shell.astype(np.uint8), [BoundaryRule(1, "expand", amount=2.0)], spacing=1
    )
    at = np.argwhere(shell) - 11.5
    radial = at / np.linalg.norm(at, axis=1, keepdims=True)
    apart = np.linalg.norm(y[shell] / 2 - radial, axis=1)
    assert apart.max() < 0.15
    assert (c[shell] == 1).all()
    assert not c[~shell].any()


def test_the_rim_of_a_full_ball_expands_and_its_inside_is_free():
    full = ball(8, (24, 24, 24), (1, 1, 1))
    y, c = boundary_images(
        full.astype(np.uint8), [BoundaryRule(1, "expand", amount=2.0)], spacing=1
    )
    assert not c[11:13, 11:13, 11:13].any()
    assert np.linalg.norm(y[11, 11, 4]) == pytest.approx(2)


def test_an_open_sheet_has_no_outside_in_a_volume():
    sheet = np.zeros((24, 24, 24), np.uint8)
    sheet[11:13] = 1
    with pytest.raises(ProblemError, match="open sheet"):
        boundary_images(sheet, [BoundaryRule(1, "expand", amount=2.0)], spacing=1)


def test_a_rule_with_two_components_fixes_the_plane_component():
    painted = ball(4).astype(np.uint8)
    rule = BoundaryRule(1, "move", vector=(1, 2), confidence=(0.5, 1))
    y, c = boundary_images(painted, [rule], spacing=SPACING)
    assert y[6, 8, 7].tolist() == [0, 1, 2]
    assert c[6, 8, 7].tolist() == [1, 0.5, 1]
    y, _ = boundary_images(painted, [BoundaryRule(1, "move", vector=(3, 1, 2))], spacing=SPACING)
    assert y[6, 8, 7].tolist() == [3, 1, 2]


def test_the_air_around_a_head_is_softer_than_tissue_and_its_holes_are_tissue():
    head = np.where(ball(6), 100, 0).astype(np.uint8)
    head[6, 8, 7] = 0
    study = Study(Grid(SHAPE, SPACING), pictures=Pictures(image=head))
    ground = Ground.of(study)
    assert np.array_equal(ground.body, ball(6))
    assert ground.stiffness[0, 0, 0] == pytest.approx(0.01)


def test_the_outer_edge_of_a_volume_is_fixed_and_the_rims_of_holes_are_free():
    labels = ball(6).astype(int)
    labels[6, 8, 7] = 0
    rows = (Material(0, "air", 0.0), Material(1, "brain", 3.0))
    study = Study(Grid(SHAPE, SPACING), Tissue(labels, rows), Motion(hold_edge=True))
    held = Ground.of(study).base.confidence.any(axis=-1)
    corners = np.ones((3, 3, 3), bool)  # of elements, which are missing beside void
    np.testing.assert_array_equal(held, ball(6) & ~ndimage.binary_erosion(ball(6), corners))


def test_the_displacement_does_not_depend_on_the_order_of_the_axes():
    fields = []
    for order in ((0, 1, 2), (2, 0, 1)):
        shape = tuple(SHAPE[axis] for axis in order)
        spacing = tuple(SPACING[axis] for axis in order)
        at, by = (6.0, 8.0, 7.0), (0.0, 1.0, 0.5)
        pull = Arrow(tuple(at[a] for a in order), tuple(by[a] for a in order), 2.5)
        study = Study(
            Grid(shape, spacing),
            Tissue(stiffness=np.ones(shape)),
            Motion(True, drawing=Drawing((pull,))),
        )
        moved = solve_study(study).displacement
        back = np.argsort(order)
        fields.append(moved.transpose(*back, 3)[..., back])
    assert np.abs(fields[0] - fields[1]).max() < 0.01


def test_a_pull_in_a_volume_is_drawn_as_a_circle_in_each_slice_of_its_ball():
    pull = Arrow((6, 8, 7), (0.0, 2.0, 0.0), 3.0)
    lines, _ = arrow_lines(Drawing((pull,)), SPACING)
    at = lines[:, 0] * SPACING
    head = np.array(pull.head(SPACING)) * SPACING
    away = np.linalg.norm(at - head, axis=1)
    on_ball = np.isclose(away, 3.0)
    assert sorted({*lines[on_ball, 0, 0].tolist()}) == [5, 6, 7]
    assert (lines[on_ball, 1, 0] == 0).all()
    shaft = (lines[:, 0] == pull.at).all(axis=1)
    assert lines[shaft, 1].tolist() == [[0, 2, 0]]


def test_the_arrow_of_a_pull_perpendicular_to_the_slices_leaves_its_slice():
    pull = Arrow((6, 8, 7), (4.0, 0.0, 0.0), 3.0)
    lines, _ = arrow_lines(Drawing((pull,)), SPACING)
    shaft = (lines[:, 0] == pull.at).all(axis=1)
    assert lines[shaft, 1].tolist() == [[2, 0, 0]]
    lines, _ = arrow_lines(Drawing((pull,)), SPACING, across=1)
    circles = lines[np.isclose(lines[:, 1, 1], 0)]
    assert {6, 8, 10} <= {*circles[:, 0, 1].tolist()}, (
        "circles should be in slices perpendicular to the second axis"
    )


def test_a_stroke_in_a_volume_is_drawn_in_each_slice_it_covers():
    stroke = Stroke("pin", (((2, 8, 3), (9, 8, 3)),), radius=2.0)
    canvas = Drawing((stroke,)).render(Canvas.blank(SHAPE, SPACING))
    lines, colours = painted_marks(canvas)
    assert {*range(2, 10)} <= {*lines[:, 0, 0].tolist()}
    assert len(lines) == len(colours)
    assert not lines[:, 1, 0].any()
    push = Stroke("move", (((6, 8, 7),),), radius=3.0, by=(1.0, 2.0, 0.0))
    lines, _ = painted_marks(Drawing((push,)).render(Canvas.blank(SHAPE, SPACING)))
    assert lines[np.abs(lines[:, 1]).max(axis=1).argmax(), 1].tolist() == [0, 2, 0]
