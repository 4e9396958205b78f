"""Landmarks as the boundary: two Points layers say how tissue moves, alone or on top of paint."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import dock_in, quick
from napari.layers import Image, Labels, Points, Shapes
from person import CTRL, SHIFT, Person
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from screen import Screen
from study_reader import read_layers

from napari_hmrf import ElasticPrior, Multigrid, ProblemError, solve
from napari_hmrf.layers.landmarks import LandmarkLayers
from napari_hmrf.layers.read import Request
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.ui.soft_tissue import SoftTissue

SHAPE = (40, 48)
SIZE = (0.5, 2.0)
MATERIALS = (Material(0, "air", 0.0), Material(1, "gel", 20.0))
RULES = (BoundaryRule(1, "fixed"),)


def request(where, should, boundary=None, radius=None, confidence=1.0, points=None, **place):
    """A block of gel in air, with points given in pixels of the image unless placed elsewhere."""
    tissue = np.zeros(SHAPE, np.uint8)
    tissue[4:-4, 4:-4] = 1
    points = place if points is None else points
    pair = (
        Points(np.array(where, dtype=float), name="is", size=1, **points),
        Points(np.array(should, dtype=float), name="ought", size=1, **points),
    )
    return Request(
        Labels(tissue, name="Tissue", **place),
        boundary,
        Image(np.zeros(SHAPE), name="MR", **place),
        MATERIALS,
        RULES,
        landmarks=LandmarkLayers(*pair, radius, confidence),
    )


def moved(wanted):
    inputs = read_layers(wanted)
    prior = ElasticPrior(0.4)
    return inputs, solve(
        inputs.problem, prior, optimizer=Multigrid(1e-3), backend="cpu"
    ).displacement


def test_tissue_at_a_landmark_goes_where_the_landmark_should_be():
    inputs, d = moved(request([[12, 12], [30, 36]], [[15, 11], [30, 36]], scale=SIZE))
    np.testing.assert_allclose(d[12, 12], (3 * 0.5, -1 * 2.0), atol=1e-3)
    np.testing.assert_allclose(d[30, 36], 0, atol=1e-3)
    assert 0.1 < d[20, 22, 0] < 1.4, "what lies between them goes part of the way"
    assert inputs.ignored == 0


def test_points_of_another_scale_and_place_count_where_they_are_seen():
    seen = {"scale": (0.25, 0.25), "translate": (1.0, 2.0)}
    at = [((12 * 0.5) - 1) / 0.25, ((12 * 2.0) - 2) / 0.25]
    inputs = read_layers(request([at], [[at[0] + 6, at[1] - 8]], points=seen, scale=SIZE))
    np.testing.assert_allclose(inputs.problem.observed[12, 12], (1.5, -2.0), atol=1e-6)
    assert (inputs.problem.confidence[12, 12] == 1).all()


def test_landmarks_count_on_top_of_paint_and_paint_around_them():
    painted = np.zeros(SHAPE, np.uint8)
    painted[4:-4, 4:12] = 1
    boundary = Labels(painted, name="Boundary")
    problem = read_layers(request([[20, 8]], [[22, 8]], boundary, radius=2.0)).problem
    np.testing.assert_array_equal(problem.observed[20, 8], (2, 0))
    np.testing.assert_array_equal(problem.observed[10, 8], (0, 0))
    assert (problem.confidence[10, 8] == 1).all()
    assert not problem.confidence[20, 30].any()


def test_paint_may_be_missing_where_there_are_landmarks():
    blank = Labels(np.zeros(SHAPE, np.uint8), name="Boundary")
    with_blank = read_layers(request([[20, 8]], [[22, 8]], blank)).problem
    without = read_layers(request([[20, 8]], [[22, 8]])).problem
    np.testing.assert_array_equal(with_blank.observed, without.observed)
    np.testing.assert_array_equal(with_blank.confidence, without.confidence)
    assert without.confidence.any()


def test_a_doubted_landmark_has_that_confidence():
    problem = read_layers(request([[20, 8]], [[22, 8]], confidence=0.25)).problem
    assert problem.confidence.max() == 0.25


@pytest.mark.parametrize(
    ("where", "should", "words"),
    [
        ([[20, 20], [1, 1]], [[22, 20], [2, 2]], "'is' has point 1 where there is no tissue"),
        ([[20, 20]], [[22, 20], [3, 3]], "'ought' has 2 points, but 'is' has 1"),
        ([[20, 60]], [[22, 20]], "'is' has point 0 outside the image"),
        ([[20, 20], [20.2, 20]], [[22, 20], [30, 20]], "'is' has points 0 and 1 in one pixel"),
    ],
)
def test_points_that_say_nothing_clear_are_refused_by_layer_and_number(where, should, words):
    with pytest.raises(ProblemError, match=words) as caught:
        read_layers(request(where, should, radius=2.0))
    assert "Points layer" in str(caught.value) or "points, 2-D" in str(caught.value)


def test_a_landmark_just_beside_the_tissue_takes_what_its_patch_reaches():
    problem = read_layers(request([[20, 3]], [[20, 1]], radius=3.0)).problem
    np.testing.assert_array_equal(problem.observed[20, 5], (0, -2))


def test_a_place_beyond_the_image_is_said_and_not_refused():
    notes = read_layers(request([[20, 20]], [[20, 70]])).notes
    assert "point 0 of 'ought' lies outside the image" in notes


def test_a_confidence_of_zero_is_refused_by_the_layer():
    with pytest.raises(ProblemError, match="'is' has a mark with a confidence of 0"):
        read_layers(request([[20, 20]], [[22, 20]], confidence=0.0))


def test_a_landmark_that_is_given_twice_leaves_its_neighbours_their_tissue():
    where = [[12, 12], [12, 16], [12, 12]]
    should = [[14, 12], [12, 19], [14, 12]]
    marks = read_layers(request(where, should, radius=9.0)).problem
    np.testing.assert_array_equal(marks.observed[12, 16], (0, 3))
    np.testing.assert_array_equal(marks.observed[12, 12], (2, 0))


# Before a window


def with_points(dock, small_sample):
    """A dock beside a small sample and two layers of points."""
    viewer = dock._viewer
    small_sample(viewer)
    where = viewer.add_points([[8.0, 8.0], [14.0, 15.0]], name="is", size=1)
    should = viewer.add_points([[10.0, 8.0], [14.0, 15.0]], name="ought", size=1)
    return dock, where, should


@pytest.fixture
def chosen(widget, small_sample):
    """A dock beside a viewer without a window."""
    return with_points(widget, small_sample)


@pytest.fixture
def chosen_in_window(docked, small_sample):
    """A dock in a real window."""
    return with_points(docked, small_sample)


def menus(widget):
    return widget._form.motion.boundary.landmarks


def test_the_menus_appear_with_points_and_know_the_other_layer(chosen):
    widget, where, should = chosen
    found = menus(widget)
    assert [layer.name for layer in found.where.offered] == ["is", "ought"]
    assert widget.landmarks is None, "points may be of something else"
    found.where.value = where
    assert (widget.landmarks.where, widget.landmarks.should) == (where, should)
    widget._viewer.layers.remove(should)
    assert found.should.value is None
    widget.deform()
    assert "only 'is' is chosen: choose another Points layer as 'should be at'" in widget.status


def test_a_radius_is_typed_as_slowly_as_one_likes(chosen, wait_for):
    widget, where, should = chosen
    widget.landmarks = (where, should)
    widget.live = True
    wait_for(lambda: not widget.busy)
    field = menus(widget).radius.native
    field.selectAll()
    for letter in "12.5":
        QTest.keyClicks(field, letter)
        wait_for(lambda: not widget.busy)
    assert (field.text(), menus(widget).radius.value) == ("12.5", 12.5)


def test_without_points_there_are_no_menus_for_them(make_napari_viewer, wait_for):
    viewer = make_napari_viewer(show=True)
    widget = dock_in(viewer)
    wait_for(widget.native.isVisible)
    assert not menus(widget).native.isVisible()
    viewer.add_points([[1.0, 2.0]])
    wait_for(menus(widget).native.isVisible)
    assert not menus(widget).radius.native.isVisible(), "nothing is chosen yet"


def test_points_alone_are_boundary_enough(chosen, run):
    widget, where, should = chosen
    widget.boundary = None
    widget.landmarks = LandmarkLayers(where, should, 1.5)
    assert widget.invitation == "Press Deform."
    widget.model = "elastic"
    assert run(widget) is not None, widget.status
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.05)
    np.testing.assert_allclose(widget.solution.displacement[14, 15], (0, 0), atol=0.05)


def test_landmarks_alone_need_neither_layers_nor_paint(widget, run):
    viewer = widget._viewer
    widget.image = viewer.add_image(np.full((20, 24), 100, np.uint8), name="MR")
    where = viewer.add_points([[8.0, 8.0], [14.0, 15.0]], name="is", size=1)
    should = viewer.add_points([[10.0, 8.0], [14.0, 15.0]], name="ought", size=1)
    widget.landmarks = LandmarkLayers(where, should, 1.5)
    widget.settings = replace(widget.settings, sweeps=30)
    assert run(widget) is not None, widget.status
    np.testing.assert_allclose(widget.solution.displacement[8, 8], (2, 0), atol=0.1)


@pytest.mark.parametrize(
    ("kept", "advice"),
    [
        (False, "Let the landmarks move it less, or give them a larger radius."),
        (True, "over a wider boundary, or by landmarks of a larger radius."),
    ],
)
def test_tissue_that_landmarks_fold_is_to_be_moved_over_a_larger_radius(chosen, run, kept, advice):
    widget, where, should = chosen
    where.data, should.data = [[8.0, 8.0], [14.0, 8.0]], [[16.0, 9.0], [7.0, 8.0]]
    widget.landmarks = LandmarkLayers(where, should, 1.5)
    if not kept:
        widget.boundary = None
    run(widget)
    assert advice in widget.warning


def test_a_missing_partner_is_said_while_points_are_clicked(chosen, wait_for):
    widget, where, should = chosen
    widget.landmarks = (where, should)
    where.add([5.0, 5.0])
    wait_for(lambda: "'ought' has 2 points, but 'is' has 3" in widget.status)
    should.add([6.0, 6.0])
    wait_for(lambda: widget.status == "Press Deform.")


def test_the_tissue_follows_a_point_that_is_dragged(chosen, run, wait_for):
    widget, where, should = chosen
    widget.landmarks = LandmarkLayers(where, should, 1.5)
    widget.model = "elastic"
    run(widget)
    widget.live = True
    should.selected_data = {0}
    should._move({0}, (10.0, 8.0))  # as the mouse does: taken hold of, and moved
    should._move({0}, (10.0, 10.0))
    wait_for(lambda: abs(widget.solution.displacement[8, 8, 1] - 2) < 0.1)
    assert should.data[0, 1] == 10.0


def test_without_live_mode_a_moved_point_outdates_the_result(chosen, run, wait_for):
    widget, where, should = chosen
    widget.landmarks = (where, should)
    run(widget)
    assert widget.status.startswith("Tissue moved up to")
    should.data = should.data + 1
    wait_for(lambda: widget.status.startswith("Changed since the last result"))


def test_a_closed_dock_hears_its_landmarks_no_more_and_the_next_does(chosen_in_window, wait_for):
    widget, where, should = chosen_in_window
    widget.landmarks = (where, should)
    viewer = widget._viewer
    viewer.window.remove_dock_widget(widget.native)
    said, again = widget.status, SoftTissue(viewer)
    viewer.window.add_dock_widget(again)
    again.landmarks = (where, should)
    wait_for(lambda: not again.busy)
    where.add([5.0, 5.0])
    wait_for(lambda: "'ought' has 2 points, but 'is' has 3" in again.status)
    assert widget.status == said


def test_a_process_that_ends_with_its_window_open_ends_quietly(chosen_in_window, monkeypatch):
    widget, where, should = chosen_in_window
    widget.landmarks = (where, should)

    class Gone:
        def __getattr__(self, name):
            raise RuntimeError("wrapped C/C++ object of type QTimer has been deleted")

    monkeypatch.setattr(widget._steps, "_resting", Gone())
    widget._life.end(closed=False)
    assert widget.away


def test_moved_added_and_removed_points_are_taken_back_in_their_order(chosen, wait_for):
    widget, where, should = chosen
    undo = widget._form.footer.steps.undo
    widget.landmarks = (where, should)
    for column in (8.5, 9.0, 10.0):  # one drag
        should._move({0}, (10.0, column))
    wait_for(lambda: undo.enabled)
    assert "moved points of 'ought'" in undo.tooltip
    moved = should.data.copy()
    where.add([5.0, 5.0])
    should.features = {"name": ["tip", "root"]}
    should.size = [2, 3]
    should.remove([0])
    assert "removed a point from 'ought'" in undo.tooltip
    widget.undo()
    np.testing.assert_array_equal(should.data, moved)
    np.testing.assert_array_equal(should.size, [2, 3])
    assert list(should.features["name"]) == ["tip", "root"], "what is known of each is back, too"
    widget.undo()
    assert len(where.data) == 2
    widget.undo()
    np.testing.assert_array_equal(should.data, [[10, 8], [14, 15]])
    assert not undo.enabled
    widget.redo()
    np.testing.assert_array_equal(should.data, moved)
    assert "moved points of 'ought'" in widget.status


def test_points_that_are_no_landmarks_any_more_stay_as_they_are(chosen, wait_for):
    widget, where, should = chosen
    undo = widget._form.footer.steps.undo
    widget.landmarks = (where, should)
    for column in (8.5, 9.0):
        should._move({0}, (10.0, column))
    wait_for(lambda: undo.enabled)
    widget.landmarks = None
    assert not undo.enabled
    should.add(np.full((20, 2), 3.0))
    there = should.data.copy()
    widget.undo()
    np.testing.assert_array_equal(should.data, there)
    widget.landmarks = (where, should)
    assert not undo.enabled
    should.remove([5])
    widget.undo()
    np.testing.assert_array_equal(should.data, there)


def test_points_that_are_no_landmarks_are_nothing_to_be_undone(chosen):
    widget, where, should = chosen
    should.add([3.0, 3.0])
    widget.landmarks = (where, should)
    widget.landmarks = None
    should.add([4.0, 4.0])
    assert not widget._form.footer.steps.undo.enabled


def test_a_point_dragged_by_the_mouse_is_followed_and_taken_back_by_one_key(
    make_napari_viewer, small_sample, run, wait_for, qtbot, at_rest
):
    viewer = make_napari_viewer(show=True)
    widget = dock_in(viewer)
    quick(widget)
    small_sample(viewer)
    where = viewer.add_points([[8.0, 8.0]], name="is", size=1)
    should = viewer.add_points([[10.0, 8.0]], name="ought", size=1)
    widget.landmarks = LandmarkLayers(where, should, 1.5)
    widget.model = "elastic"
    run(widget)
    widget.live = True
    undo = Screen(widget).button("Undo")
    viewer.layers.selection.active = should
    should.mode = "select"
    person = Person(viewer, qtbot)
    at_rest()
    person.paint((10, 8), (10.5, 9), (11, 10), (11, 11))
    assert should.data[0] == pytest.approx((11, 11), abs=0.3), should.data
    to = should.data[0] - where.data[0]
    wait_for(lambda: np.abs(widget.solution.displacement[8, 8] - to).max() < 0.1)
    wait_for(lambda: undo.isEnabled())
    person.key(Qt.Key.Key_Z, CTRL)
    np.testing.assert_array_equal(should.data, [[10, 8]])
    assert not undo.isEnabled(), "a drag is one step"
    wait_for(lambda: abs(widget.solution.displacement[8, 8] - (2, 0)).max() < 0.1)


# Lines


def lines(*shapes, name="drawn", **place):
    layer = Shapes(name=name, ndim=2, **place)
    for kind, places in shapes:
        layer.add(np.array(places, dtype=float), shape_type=kind)
    return layer


def of_lines(layer, radius=2.0, **place):
    pair = LandmarkLayers(layer, radius=radius)
    return replace(request([[1, 1]], [[1, 1]], **place), landmarks=pair)


def test_a_line_leads_tissue_from_its_start_to_its_end_and_a_path_to_its_last_place():
    drawn = lines(
        ("line", [(12, 12), (15, 11)]), ("path", [(30, 36), (31, 30), (28, 36)]), scale=SIZE
    )
    problem = read_layers(of_lines(drawn, scale=SIZE)).problem
    np.testing.assert_allclose(problem.observed[12, 12], (1.5, -2), atol=1e-6)
    np.testing.assert_allclose(problem.observed[30, 36], (-1, 0), atol=1e-6)


@pytest.mark.parametrize(
    ("shapes", "words"),
    [
        ([], "'drawn' has no lines. Draw some"),
        ([("ellipse", [(9, 9), (9, 15), (15, 15), (15, 9)])], "'drawn' has shape 0, an ellipse"),
        (
            [("line", [(20, 20), (22, 20)]), ("line", [(0, 0), (9, 9)])],
            "line 1, which begins where there",
        ),
        ([("line", [(20, 60), (22, 20)])], "'drawn' has line 0, which begins outside the image"),
        (
            [("line", [(20, 20), (22, 20)]), ("line", [(20, 20), (25, 20)])],
            "lines 0 and 1, which begin in one pixel",
        ),
    ],
)
def test_shapes_that_lead_nowhere_are_refused_by_layer_and_number(shapes, words):
    with pytest.raises(ProblemError, match=words):
        read_layers(of_lines(lines(*shapes)))


def test_lines_are_chosen_alone_and_followed(docked, small_sample, run, wait_for):
    viewer = docked._viewer
    small_sample(viewer)
    drawn = viewer.add_layer(lines(("line", [(8, 8), (10, 8)])))
    docked._form.motion.boundary.landmarks.where.value = drawn
    assert docked.landmarks == LandmarkLayers(drawn)
    assert not menus(docked).should.visible
    docked.model = "elastic"
    docked.landmarks = LandmarkLayers(drawn, radius=1.5)
    run(docked)
    np.testing.assert_allclose(docked.solution.displacement[8, 8], (2, 0), atol=0.05)
    docked.live = True
    drawn.data = [np.array([(8.0, 8.0), (8.0, 11.0)])]
    wait_for(lambda: abs(docked.solution.displacement[8, 8, 1] - 3) < 0.1)


def test_lines_that_were_drawn_moved_and_removed_are_taken_back_in_their_order(
    make_napari_viewer, small_sample, wait_for, qtbot, at_rest
):
    viewer = make_napari_viewer(show=True)
    widget = dock_in(viewer)
    quick(widget)
    small_sample(viewer)
    drawn = viewer.add_layer(lines(("path", [(8, 8), (9, 9), (10, 8)])))
    drawn.edge_color, drawn.edge_width = "red", 0.5
    menus(widget).where.value = drawn
    undo = widget._form.footer.steps.undo
    viewer.layers.selection.active = drawn
    drawn.mode = "add_line"
    person = Person(viewer, qtbot)
    at_rest()
    person.paint((14, 8), (14, 10), (14, 13))
    assert len(drawn.data) == 2
    wait_for(lambda: undo.enabled)
    assert "added a line to 'drawn'" in undo.tooltip
    both = [line.copy() for line in drawn.data]
    np.testing.assert_allclose(both[1], [(14, 8), (14, 13)], atol=0.3)
    wait_for(lambda: widget.history.edits.in_progress is None)
    drawn.data = [both[0] + 1, both[1]]
    wait_for(lambda: "moved lines" in undo.tooltip)
    drawn.selected_data = {0}
    drawn.remove_selected()
    assert "removed a line" in undo.tooltip
    for held in ([both[0] + 1, both[1]], both, both[:1]):
        person.key(Qt.Key.Key_Z, CTRL)
        assert len(drawn.data) == len(held)
        for line, there in zip(drawn.data, held, strict=True):
            np.testing.assert_array_equal(line, there)
        assert drawn.shape_type[0] == "path"
        assert list(drawn.edge_color[0]) == [1, 0, 0, 1]
        assert drawn.edge_width[0] == 0.5
    assert not undo.enabled, "what was drawn by one drag is one step"
    assert widget.status == "Took back: added a line to 'drawn'."
    person.key(Qt.Key.Key_Z, CTRL | SHIFT)
    np.testing.assert_array_equal(drawn.data[1], both[1])
