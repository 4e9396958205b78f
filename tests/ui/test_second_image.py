"""Tests of the comparison with a second image and of landmark residuals."""

import re

import numpy as np
import pytest
from napari.layers import Image
from qtpy.QtWidgets import QTableWidget

from napari_hmrf import Arrow, Drawing, Landmark
from napari_hmrf.contributions import phantom_layers, volume_layers
from napari_hmrf.data import head_phantom
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.ui.result.landmark_table import INVALID
from tests.support.docks import open_sample
from tests.support.screen import Cell, Screen, head

SHAPE = (48, 56)
SIZE = (0.5, 0.8)
WHERE = np.array([[12.0, 14.0], [30.0, 20.0], [24.0, 40.0]])
BY = np.array([[0.0, 2.0], [2.0, 1.0], [-1.0, 1.0]])


@pytest.fixture
def compared(frame, wait_for):
    """Return a viewer with two images of one tissue and points on both, the dock and the images."""
    viewer, dock = frame.viewer, frame.open()
    place = {"scale": SIZE, "units": ("mm", "mm")}
    rows, cols = np.indices(SHAPE)
    pixels = (120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8)
    before = viewer.add_image(pixels, name="before", **place)
    after = viewer.add_image(np.roll(pixels, 2, axis=1), name="after", visible=False, **place)
    viewer.add_points(WHERE, name="is", **place)
    viewer.add_points(WHERE + BY, name="ought", **place)
    dock.image, dock.in_colours = before, True
    dock.compare_with = None
    wait_for(lambda: not dock.busy)
    return viewer, dock, before, after


def rms(lengths):
    return float(np.sqrt(np.mean(np.square(lengths))))


def numbers(said):
    before, now, count = re.search(
        r": (\S+) mm apart before, (\S+) now \(RMS of (\d)\)", said
    ).groups()
    return float(before), float(now), int(count)


def test_imported_landmarks_reach_their_targets_and_have_residuals(compared, wait_for):
    viewer, dock, _, _ = compared
    screen = Screen(dock)
    screen.choose("is")
    dock.take_landmarks(viewer.layers["is"], viewer.layers["ought"])
    wait_for(lambda: "apart before" in dock.residual)
    wait_for(lambda: not dock.busy)
    before, now, count = numbers(dock.residual)
    assert count == 3
    assert before == pytest.approx(rms(np.linalg.norm(BY * SIZE, axis=1)), rel=1e-2)
    assert now < 0.01
    assert dock.residual in screen.words
    assert (viewer.layers["is"].features["residual (mm)"] < 0.01).all()


def test_residuals_are_updated_if_points_move(compared, wait_for):
    viewer, dock, _, _ = compared
    Screen(dock).choose("is")
    dock.take_landmarks(viewer.layers["is"], viewer.layers["ought"])
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    further = WHERE + BY + np.array([[0, 10], [0, 0], [0, 0]])
    viewer.layers["ought"].data = further
    left = viewer.layers["is"].features["residual (mm)"].to_numpy()
    np.testing.assert_allclose(left, [8.0, 0, 0], atol=0.02)
    viewer.layers["ought"].data = further[:2]
    assert dock.residual.startswith("Landmarks of the drawing: "), "unpaired points are compared"
    assert "residual (mm)" not in viewer.layers["is"].features


def test_a_second_image_is_displayed_before_the_first_motion_and_after_its_undo(compared, wait_for):
    viewer, dock, before, after = compared
    dock.start()
    wait_for(lambda: not dock.busy)
    dock.compare_with = after
    shown = viewer.layers["before deformed, elastic"]
    for _ in range(2):
        assert viewer.layers.index(after) > viewer.layers.index(shown)
        assert [each.colormap.name for each in (before, shown, after)] == [
            "magenta", "magenta", "green"
        ]  # fmt: skip
        dock.drawing = Drawing((Arrow(at=(20, 20), by=(0, 2), radius=4.0),))
        wait_for(lambda: dock.solution is not None and not dock.busy)
        dock.undo()
        wait_for(lambda: not dock.busy)
    dock.compare_with = None
    assert {before.colormap.name, shown.colormap.name} == {"gray"}


def test_the_second_image_is_shown_alone_while_its_button_is_pressed(compared, wait_for):
    viewer, dock, before, after = compared
    screen, dock.compare_with = Screen(dock), after
    screen.tick("both in colours", on=False)
    after.visible = False
    dock.drawing = Drawing((Arrow(at=(20, 20), by=(0, 2), radius=4.0),))
    wait_for(lambda: dock.solution is not None and not dock.busy)
    seen = [layer for layer in viewer.layers if layer.visible]
    screen.hold("Show it (press)")
    assert [each for each in viewer.layers if each.visible and isinstance(each, Image)] == [after]
    assert (after.colormap.name, before.colormap.name) == ("gray", "gray")
    screen.let_go("Show it (press)")
    assert [layer for layer in viewer.layers if layer.visible] == seen


def test_landmarks_that_are_not_observed_have_residuals_of_the_field(compared, wait_for):
    viewer, dock, _, _ = compared
    Screen(dock).choose("is")
    dock.drawing = Drawing((Arrow(at=tuple(WHERE[0]), by=tuple(BY[0] * SIZE), radius=2.0),))
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    left = viewer.layers["is"].features["residual (mm)"].to_numpy()
    d = dock.solution.displacement
    at = WHERE.astype(int)
    wanted = np.linalg.norm(BY * SIZE - d[tuple(at.T)], axis=1)
    np.testing.assert_allclose(left, wanted, atol=1e-3)
    assert left[0] < 0.01 < left[1:].min()
    assert numbers(dock.residual)[1] == pytest.approx(rms(left), rel=1e-2)


def test_choosing_the_target_layer_as_source_swaps_the_layers(compared):
    viewer, dock, *_ = compared
    pair = dock._form.motion.landmarks
    there, ought = viewer.layers["is"], viewer.layers["ought"]
    pair.sources.value = there
    assert pair.targets.value is ought, "the only other layer was not selected"
    pair.sources.value = ought
    assert (pair.sources.value, pair.targets.value) == (ought, there)
    third = viewer.add_points(WHERE, name="third")
    assert pair.targets.offered == [there, third], "the source layer is offered as target"
    pair.sources.value = there
    assert pair.targets.value is None, "one of two possible targets was selected"


def test_two_layers_of_points_are_chosen_once_as_landmarks(compared):
    viewer, dock, *_ = compared
    pair = dock._form.motion.landmarks
    assert pair.pair == (viewer.layers["is"], viewer.layers["ought"])
    pair.sources.value = None
    pair.targets.value = None
    viewer.layers["is"].name = "was"
    assert pair.pair == (None, None), "a cleared choice was chosen again"
    first = viewer.layers[-2]
    viewer.layers.remove("ought")
    third = viewer.add_points(WHERE[:-1], name="third")
    assert pair.pair == (None, None), "layers with different numbers of points were chosen"
    third.add(WHERE[-1])
    assert pair.pair == (first, third)


def test_the_distance_of_each_landmark_is_listed_in_a_table(compared, wait_for):
    _, dock, _, _ = compared
    dock.drawing = Drawing((Arrow(at=tuple(WHERE[0]), by=tuple(BY[0] * SIZE), radius=2.0),))
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    Screen(dock).entry("More", "Landmarks ...").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    cells = [
        [table.item(row, column).text() for column in range(3)] for row in range(table.rowCount())
    ]
    before = np.linalg.norm(BY * SIZE, axis=1)
    assert [row[:2] for row in cells] == [[str(at), f"{before[at]:.3g}"] for at in range(len(BY))]
    assert float(cells[0][2]) < 0.01 < float(cells[1][2])


def test_a_standard_deviation_is_typed_into_the_table_of_landmarks(compared, wait_for):
    _, dock, _, _ = compared
    dock._form.motion.landmarks.sources.value = None
    marks = [Landmark((20, at), (24.0, at), 2.0) for at in (20, 40)]
    dock.drawing = Drawing(marks)
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    Screen(dock).entry("More", "Landmarks ...").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    assert [head(table, column) for column in range(4)] == [
        "landmark", "before (mm)", "now (mm)", "± (mm)"
    ]  # fmt: skip
    sd, now = Cell(table, 1, 3), Cell(table, 1, 2)
    assert (sd.text(), now.can_be_typed()) == ("0", False)
    assert float(now.text()) < 0.01
    sd.write("±1,5")
    assert [mark.sd for mark in dock.drawing.marks] == [0, 1.5]
    wait_for(lambda: float(now.text()) > 0.1 and not dock.busy)
    assert sd.text() == "1.5"
    assert float(Cell(table, 0, 2).text()) < 0.01
    for text in ("wide", "1e9"):
        sd.write(text)
        assert sd.text() == "1.5"
        assert dock.status == INVALID.format(50.82, "mm"), "the diagonal of the image"
        dock.show_message("")
    dock.undo()
    assert [mark.sd for mark in dock.drawing.marks] == [0, 0]
    wait_for(lambda: sd.text() == "0" and float(now.text()) < 0.01 and not dock.busy)


def test_imported_landmarks_keep_the_standard_deviations_of_their_layer(compared, wait_for):
    viewer, dock, _, _ = compared
    viewer.layers["ought"].features = {"sd": [0, 2, 0.5]}
    Screen(dock).choose("is")
    Screen(dock).press("Use as landmarks")
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    assert [mark.sd for mark in dock.drawing.marks] == [0, 2, 0.5]
    left = viewer.layers["is"].features["residual (mm)"].to_numpy()
    assert left[0] < 0.01 < left[2] < left[1]
    Screen(dock).entry("More", "Landmarks ...").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    assert [Cell(table, row, 3).text() for row in range(3)] == ["0", "2", "0.5"]
    Cell(table, 0, 3).write("1")
    assert [mark.sd for mark in dock.drawing.marks] == [1, 2, 0.5]
    Screen(dock).press("Use as landmarks")
    assert [mark.sd for mark in dock.drawing.marks] == [0, 2, 0.5], "an edited landmark was kept"
    wait_for(lambda: not dock.busy)


def test_landmarks_taken_again_keep_their_uncertainty_and_have_the_radius_of_the_tool(
    compared, wait_for
):
    viewer, dock, _, _ = compared
    dock.fields.radius.value = 1.25
    Screen(dock).choose("is")
    Screen(dock).press("Use as landmarks")
    assert {mark.radius for mark in dock.drawing.marks} == {1.25}
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    Screen(dock).entry("More", "Landmarks ...").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    Cell(table, 1, 3).write("1.5")
    viewer.layers["ought"].data = WHERE + 1.5 * BY
    Screen(dock).press("Use as landmarks")
    assert [mark.sd for mark in dock.drawing.marks] == [0, 1.5, 0]
    wait_for(lambda: not dock.busy)


def test_landmarks_of_the_drawing_are_listed_if_the_layers_have_no_valid_pairs(compared, wait_for):
    viewer, dock, _, _ = compared
    Screen(dock).choose("is")
    Screen(dock).press("Use as landmarks")
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    Screen(dock).entry("More", "Landmarks ...").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    viewer.layers["is"].add([5.0, 5.0])
    Screen(dock).press("Use as landmarks")
    assert "'ought' has 3 points, but 'is' has 4" in dock.status
    assert numbers(dock.residual)[2] == table.rowCount() == len(dock.drawing.marks) == 3


def test_distances_are_those_of_the_last_result_after_a_refused_edit(compared, wait_for):
    _, dock, _, _ = compared
    dock._form.motion.landmarks.sources.value = None
    dock._form.motion.switches.hold_edge.value = False
    dock.drawing = Drawing([Landmark((20, at), (24.0, at), 2.0, sd=1.0) for at in (20, 40)])
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    Screen(dock).entry("More", "Landmarks ...").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    dock._form.model.in_detail.drift.value = True
    wait_for(lambda: "cannot determine a drift" in dock.status)
    assert dock.residual.startswith("Landmarks in the last result, before the refused edit: ")
    assert head(table, 2) == "last result (mm)"
    dock.undo()
    wait_for(lambda: dock.residual.startswith("Landmarks: ") and not dock.busy)
    assert head(table, 2) == "now (mm)"


def test_drawn_landmarks_have_residuals_without_a_layer_of_points(compared, wait_for):
    _, dock, _, _ = compared
    dock._form.motion.landmarks.sources.value = None
    dock.drawing = Drawing((Landmark((20, 20), (22.0, 20.0), 2.0),))
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    before, now, count = numbers(dock.residual)
    assert (before, count) == (1.0, 1)
    assert now < 0.01


def test_the_second_image_is_overlaid_on_the_moved_image_until_the_comparison_ends(
    compared, wait_for
):
    viewer, dock, before, after = compared
    looks = [(each.colormap.name, each.blending, each.visible) for each in (before, after)]
    dock.drawing = Drawing((Arrow(at=(24, 28), by=(0.0, 2.0), radius=2.0),))
    dock.compare_with = after
    wait_for(lambda: dock.solution is not None and not dock.busy)
    assert (after.colormap.name, after.blending, after.visible) == ("green", "additive", True)
    shown = [each for each in viewer.layers if each.name.startswith("before") and each.visible]
    pictures = [each for each in shown if hasattr(each, "colormap")]
    assert {each.colormap.name for each in pictures} == {"magenta"}
    assert len(pictures) == 2, "the original or the moved image is not displayed"
    assert all(viewer.layers.index(each) < viewer.layers.index(after) for each in pictures)
    dock.drawing = Drawing((Arrow(at=(24, 28), by=(0.0, -2.0), radius=2.0),))
    wait_for(lambda: not dock.busy)
    assert after.colormap.name == "green"
    dock.compare_with = None
    assert [(each.colormap.name, each.blending, each.visible) for each in (before, after)] == looks
    assert {each.colormap.name for each in pictures} == {"gray"}


def test_a_second_image_hidden_by_the_user_stays_hidden_below_new_results(compared, wait_for):
    viewer, dock, _, after = compared
    order = [layer.name for layer in viewer.layers]
    dock.compare_with = after
    after.visible = False
    dock.drawing = Drawing((Arrow(at=(24, 28), by=(0.0, 2.0), radius=2.0),))
    wait_for(lambda: dock.solution is not None and not dock.busy)
    assert not after.visible
    top = viewer.add_image(np.zeros(SHAPE), name="top", visible=False)
    viewer.layers.move(viewer.layers.index(top), 0)
    dock.compare_with = None
    assert [layer.name for layer in viewer.layers if layer.name in order] == order
    assert not after.visible


def test_removing_the_second_image_does_not_end_a_solve(compared, wait_for):
    viewer, dock, _, after = compared
    dock.compare_with = after
    dock.drawing = Drawing((Arrow(at=(24, 28), by=(0.0, 2.0), radius=2.0),))
    wait_for(lambda: not dock.busy)
    finished = []
    dock.finished.connect(finished.append)
    dock.deform()
    viewer.layers.remove(after)
    wait_for(lambda: bool(finished))
    assert finished[0] is not None


def test_a_removed_second_image_ends_the_comparison(compared, wait_for):
    viewer, dock, before, after = compared
    dock.compare_with = after
    viewer.layers.remove(after)
    assert dock.compare_with is None
    assert before.colormap.name == "gray"
    wait_for(lambda: not dock.busy)
    assert dock.image is before


def test_a_removed_image_ends_the_comparison(compared, wait_for):
    """A study opened next would be compared with nothing, in one colour."""
    viewer, dock, before, after = compared
    dock.compare_with = after
    wait_for(lambda: not dock.busy)
    assert dock.in_colours
    viewer.layers.remove(before)
    assert not dock.in_colours
    wait_for(lambda: not dock.busy)
    assert after.colormap.name == "gray"


def test_choosing_another_image_restores_colours_and_hides_residuals(compared, wait_for):
    viewer, dock, before, after = compared
    dock.drawing = Drawing((Landmark((20, 20), (22.0, 20.0), 2.0),))
    dock.compare_with = after
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    third = viewer.add_image(before.data, name="third", scale=SIZE, units=("mm", "mm"))
    dock.image = third
    wait_for(lambda: not dock.busy)
    assert (before.colormap.name, third.colormap.name) == ("gray", "gray")
    assert dock.compare_with is None, "the second image of the other image was selected"
    assert dock.residual == ""
    dock.image = before
    wait_for(lambda: not dock.busy)
    assert dock.compare_with is after
    assert (before.colormap.name, third.colormap.name) == ("magenta", "gray")
    assert "apart before" in dock.residual


def test_landmarks_of_one_image_are_not_compared_with_a_result_of_another_image(frame, settle):
    viewer = frame.viewer
    head = open_sample(viewer, volume_layers(head_phantom(24)))
    dock = frame.open()
    settle(dock)
    dock.drawing = Drawing((Landmark((12, 12, 12), (12, 13, 12), 4.0),))
    settle(dock)
    assert "apart before" in dock.residual
    flat = open_sample(viewer, phantom_layers(phantom("expansion", 32)))
    settle(dock)
    for image, said in ((flat[0], False), (head[0], True), (flat[0], False)):
        dock.image = image
        settle(dock)
        assert ("apart before" in dock.residual) is said
        assert image.visible
