"""Tests of landmarks from layers of points and lines, alone or on top of paint."""

import numpy as np
import pytest
from napari.layers import Image, Labels, Points, Shapes

from napari_hmrf import ElasticPrior, Multigrid, ProblemError, solve
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing
from tests.support.screen import Screen
from tests.support.study_reader import read_layers
from tests.support.windowless import Touch

SHAPE = (40, 48)
SIZE = (0.5, 2.0)
MATERIALS = (Material(0, "air", 0.0), Material(1, "gel", 20.0))
RULES = (BoundaryRule(1, "fixed"),)


def request(where, should, boundary=None, radius=None, confidence=1.0, points=None, **place):
    """Return a request for a block of gel in air with points, in pixels unless placed elsewhere."""
    points = place if points is None else points
    pair = (
        Points(np.array(where, dtype=float), name="is", size=1, **points),
        Points(np.array(should, dtype=float), name="ought", size=1, **points),
    )
    return request_with_landmarks(*pair, boundary, radius=radius, confidence=confidence, **place)


def request_with_landmarks(where, should, boundary=None, radius=None, confidence=1.0, **place):
    """Return a request for a block of gel in air with the landmarks of layers."""
    tissue = np.zeros(SHAPE, np.uint8)
    tissue[4:-4, 4:-4] = 1
    image = Image(np.zeros(SHAPE), name="MR", **place)
    how = {"radius": radius, "confidence": confidence}
    marks = read_landmarks(where, should, frame_of(image), SHAPE, **how)
    tissue = Labels(tissue, name="Tissue", **place)
    return Request(
        tissue=tissue,
        boundary=boundary,
        image=image,
        materials=MATERIALS,
        rules=RULES,
        drawing=Drawing(marks),
    )


def moved(wanted):
    inputs = read_layers(wanted)
    prior = ElasticPrior(0.4)
    return inputs, solve(
        inputs.problem, prior, optimizer=Multigrid(1e-3), backend="cpu"
    ).displacement


def test_tissue_at_a_landmark_moves_to_its_target():
    inputs, d = moved(request([[12, 12], [30, 36]], [[15, 11], [30, 36]], scale=SIZE))
    np.testing.assert_allclose(d[12, 12], (3 * 0.5, -1 * 2.0), atol=1e-3)
    np.testing.assert_allclose(d[30, 36], 0, atol=1e-3)
    assert 0.1 < d[20, 22, 0] < 1.4, "tissue between the landmarks does not move a part of the way"
    assert not any("ignored" in note for note in inputs.notes)


def test_points_with_another_scale_are_read_at_their_world_position():
    seen = {"scale": (0.25, 0.25), "translate": (1.0, 2.0)}
    at = [((12 * 0.5) - 1) / 0.25, ((12 * 2.0) - 2) / 0.25]
    inputs = read_layers(request([at], [[at[0] + 6, at[1] - 8]], points=seen, scale=SIZE))
    np.testing.assert_allclose(inputs.problem.observed[12, 12], (1.5, -2.0), atol=1e-6)
    assert (inputs.problem.confidence[12, 12] == 1).all()


def test_landmarks_replace_paint_only_in_their_patches():
    painted = np.zeros(SHAPE, np.uint8)
    painted[4:-4, 4:12] = 1
    boundary = Labels(painted, name="Boundary")
    problem = read_layers(request([[20, 8]], [[22, 8]], boundary, radius=2.0)).problem
    np.testing.assert_array_equal(problem.observed[20, 8], (2, 0))
    np.testing.assert_array_equal(problem.observed[10, 8], (0, 0))
    assert (problem.confidence[10, 8] == 1).all()
    assert not problem.confidence[20, 30].any()


def test_paint_is_optional_with_landmarks():
    blank = Labels(np.zeros(SHAPE, np.uint8), name="Boundary")
    with_blank = read_layers(request([[20, 8]], [[22, 8]], blank)).problem
    without = read_layers(request([[20, 8]], [[22, 8]])).problem
    np.testing.assert_array_equal(with_blank.observed, without.observed)
    np.testing.assert_array_equal(with_blank.confidence, without.confidence)
    assert without.confidence.any()


def test_a_landmark_has_its_confidence():
    problem = read_layers(request([[20, 8]], [[22, 8]], confidence=0.25)).problem
    assert problem.confidence.max() == 0.25


@pytest.mark.parametrize(
    ("where", "should", "words"),
    [
        ([[20, 20]], [[22, 20], [3, 3]], "'ought' has 2 points, but 'is' has 1"),
        ([[20, 60]], [[22, 20]], "'is' has point 0 outside the image"),
        ([[20, 20], [20.2, 20]], [[22, 20], [30, 20]], "'is' has points 0 and 1 in one pixel"),
    ],
)
def test_unusable_points_are_refused_with_layer_and_number(where, should, words):
    with pytest.raises(ProblemError, match=words):
        read_layers(request(where, should, radius=2.0))


def test_a_landmark_beside_the_tissue_moves_the_tissue_in_its_patch():
    problem = read_layers(request([[20, 3]], [[20, 1]], radius=3.0)).problem
    np.testing.assert_array_equal(problem.observed[20, 5], (0, -2))


def test_a_target_outside_the_image_is_accepted():
    pair = (Points([[20, 20]], name="is"), Points([[20, 70]], name="ought"))
    (mark,) = read_landmarks(*pair, frame_of(Image(np.zeros(SHAPE))), SHAPE)
    assert mark.target == (20, 70)


def test_a_duplicate_landmark_does_not_shrink_its_neighbours():
    where = [[12, 12], [12, 16], [12, 12]]
    should = [[14, 12], [12, 19], [14, 12]]
    marks = read_layers(request(where, should, radius=9.0)).problem
    np.testing.assert_array_equal(marks.observed[12, 16], (0, 3))
    np.testing.assert_array_equal(marks.observed[12, 12], (2, 0))


# In the dock


@pytest.fixture
def chosen(widget, small_sample):
    """Return a dock beside a small sample and two layers of points."""
    viewer = widget._viewer
    small_sample(viewer)
    where = viewer.add_points([[8.0, 8.0], [14.0, 15.0]], name="is", size=1)
    should = viewer.add_points([[10.0, 8.0], [14.0, 15.0]], name="ought", size=1)
    return widget, where, should


def menus(widget):
    return widget._form.motion.landmarks


def test_menus_for_landmarks_appear_and_select_the_other_layer_of_points(chosen):
    widget, where, should = chosen
    found = menus(widget)
    assert [layer.name for layer in found.sources.offered] == ["is", "ought"]
    assert not widget.drawing.marks, "points became marks without a choice"
    found.sources.value = where
    assert found.targets.value is should
    widget._viewer.layers.remove(should)
    assert found.targets.value is None
    found.take_button.changed.emit(True)
    assert "'is' contains positions without targets. Choose another Points layer" in widget.status


def test_menus_for_landmarks_are_hidden_without_points(widget):
    widget.tool = "landmark"
    assert not menus(widget).native.isVisibleTo(widget.native)
    widget._viewer.add_points([[1.0, 2.0]])
    assert menus(widget).native.isVisibleTo(widget.native)
    assert not menus(widget).take_button.enabled, "the button is enabled without a choice"
    widget.tool = "pull"
    assert not menus(widget).native.isVisibleTo(widget.native)


def test_points_replace_a_boundary_layer(chosen, run):
    widget, where, should = chosen
    widget.boundary = None
    widget.take_landmarks(where, should, radius=1.5)
    assert run(widget) is not None, widget.status
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.05)
    np.testing.assert_allclose(widget.solution.displacement[14, 15], (0, 0), atol=0.05)


def test_landmarks_require_neither_layers_nor_paint(widget, run):
    viewer = widget._viewer
    widget.image = viewer.add_image(np.full((20, 24), 100, np.uint8), name="MR")
    where = viewer.add_points([[8.0, 8.0], [14.0, 15.0]], name="is", size=1)
    should = viewer.add_points([[10.0, 8.0], [14.0, 15.0]], name="ought", size=1)
    widget.take_landmarks(where, should, radius=1.5)
    assert run(widget) is not None, widget.status
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.1)


def test_imported_landmarks_are_undone_changed_and_imported_again(chosen, settle):
    widget, where, should = chosen
    widget.live = True
    own = Arrow((4, 16), (1, 0), 1.0)
    widget.drawing = Drawing((own,))
    widget.take_landmarks(where, should, radius=1.5)
    settle(widget)
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.05)
    assert len(widget.drawing.marks) == 3
    should.data = [[10.0, 9.0], [14.0, 15.0]]
    widget.take_landmarks(where, should, radius=1.5)
    assert len(widget.drawing.marks) == 3, "the earlier landmarks were not replaced"
    settle(widget)
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 1), atol=0.05)
    widget.undo()
    widget.undo()
    assert widget.drawing.marks == (own,)
    assert widget.status == "Undid: added landmarks from 'is'."


def test_imported_landmarks_are_dragged(chosen, settle):
    widget, where, _ = chosen
    widget.model = "elastic"
    menus(widget).sources.value = where
    screen = Screen(widget)
    screen.press("Use as landmarks")
    screen.press("Landmark")
    settle(widget)
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.05)
    Touch(widget._viewer).drag((10, 8), (10, 11))
    settle(widget)
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 3), atol=0.3)


# Lines


def lines(*shapes, name="drawn", **place):
    layer = Shapes(name=name, ndim=2, **place)
    for kind, places in shapes:
        layer.add(np.array(places, dtype=float), shape_type=kind)
    return layer


def request_with_lines(layer, radius=2.0, **place):
    return request_with_landmarks(layer, None, radius=radius, **place)


def test_a_line_or_path_moves_tissue_from_its_start_to_its_end():
    drawn = lines(
        ("line", [(12, 12), (15, 11)]), ("path", [(30, 36), (31, 30), (28, 36)]), scale=SIZE
    )
    problem = read_layers(request_with_lines(drawn, scale=SIZE)).problem
    np.testing.assert_allclose(problem.observed[12, 12], (1.5, -2), atol=1e-6)
    np.testing.assert_allclose(problem.observed[30, 36], (-1, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("shapes", "words"),
    [
        ([], "'drawn' has no lines on this slice"),
        ([("ellipse", [(9, 9), (9, 15), (15, 15), (15, 9)])], "'drawn' has shape 0 .ellipse."),
        ([("line", [(20, 60), (22, 20)])], "'drawn' has line 0 outside the image"),
        (
            [("line", [(20, 20), (22, 20)]), ("line", [(20, 20), (25, 20)])],
            "lines 0 and 1 in one pixel",
        ),
    ],
)
def test_unusable_shapes_are_refused_with_layer_and_number(shapes, words):
    with pytest.raises(ProblemError, match=words):
        read_layers(request_with_lines(lines(*shapes)))


def test_lines_are_imported_without_a_second_layer(widget, small_sample, run):
    viewer = widget._viewer
    small_sample(viewer)
    drawn = viewer.add_layer(lines(("line", [(8, 8), (10, 8)])))
    widget.model = "elastic"
    menus(widget).sources.value = drawn
    assert not menus(widget).targets.visible
    assert run(widget) is not None, widget.status
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.1)
