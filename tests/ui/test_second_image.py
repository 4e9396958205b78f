"""A second image lies over the one that moves, and landmarks say how far apart they still are."""

import re

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf import Arrow, Drawing, Landmark
from napari_hmrf.contributions import phantom_layers, volume_layers
from napari_hmrf.data import head_phantom
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.docks import open_sample
from tests.support.screen import Screen

SHAPE = (48, 56)
SIZE = (0.5, 0.8)
WHERE = np.array([[12.0, 14.0], [30.0, 20.0], [24.0, 40.0]])
BY = np.array([[0.0, 2.0], [2.0, 1.0], [-1.0, 1.0]])


@pytest.fixture
def compared(qtbot, wait_for):
    """A dock beside two images of one tissue, with points on both."""
    viewer = ViewerModel()
    place = {"scale": SIZE, "units": ("mm", "mm")}
    rows, cols = np.indices(SHAPE)
    pixels = (120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8)
    before = viewer.add_image(pixels, name="before", **place)
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    after = viewer.add_image(np.roll(pixels, 2, axis=1), name="after", visible=False, **place)
    viewer.add_points(WHERE, name="is", **place)
    viewer.add_points(WHERE + BY, name="ought", **place)
    dock.image = before
    wait_for(lambda: not dock.busy)
    return viewer, dock, before, after


def rms(lengths):
    return float(np.sqrt(np.mean(np.square(lengths))))


def numbers(said):
    before, now, count = re.search(
        r": (\S+) mm apart before, (\S+) now \(RMS of (\d)\)", said
    ).groups()
    return float(before), float(now), int(count)


def test_taken_landmarks_are_where_they_belong_and_each_says_how_far_it_is(compared, wait_for):
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


def test_landmarks_that_are_taken_back_leave_no_numbers_and_nothing_to_compare_with(
    compared, wait_for
):
    viewer, dock, _, _ = compared
    Screen(dock).choose("is")
    dock.take_landmarks(viewer.layers["is"], viewer.layers["ought"])
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    dock.undo()
    wait_for(lambda: not dock.residual and not dock.busy)
    assert "residual (mm)" not in viewer.layers["is"].features
    dock._form.result.reference.reset_choices()
    assert dock._form.result.reference.offered == [], "the result is none any more"
    dock.redo()
    wait_for(lambda: "apart before" in dock.residual)


def test_points_that_are_moved_are_measured_anew(compared, wait_for):
    viewer, dock, _, _ = compared
    Screen(dock).choose("is")
    dock.take_landmarks(viewer.layers["is"], viewer.layers["ought"])
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    further = WHERE + BY + np.array([[0, 10], [0, 0], [0, 0]])
    viewer.layers["ought"].data = further
    left = viewer.layers["is"].features["residual (mm)"].to_numpy()
    np.testing.assert_allclose(left, [8.0, 0, 0], atol=0.02)
    viewer.layers["ought"].data = further[:2]
    assert not dock.residual, "they are no pairs any more"
    assert "residual (mm)" not in viewer.layers["is"].features


def test_a_second_image_is_seen_although_nothing_moves_yet_and_when_nothing_does_again(
    compared, wait_for
):
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


def test_landmarks_that_the_field_does_not_know_test_it(compared, wait_for):
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


def test_a_layer_that_is_chosen_for_both_ends_of_landmarks_changes_places(compared):
    viewer, dock, *_ = compared
    pair = dock._form.motion.boundary.landmarks
    there, ought = viewer.layers["is"], viewer.layers["ought"]
    pair.sources.value = there
    assert pair.targets.value is ought, "the only other one"
    pair.sources.value = ought
    assert (pair.sources.value, pair.targets.value) == (ought, there)
    third = viewer.add_points(WHERE, name="third")
    assert pair.targets.offered == [there, third], "the same one is not offered"
    pair.sources.value = there
    assert pair.targets.value is None, "of two others nobody knows which"


def test_landmarks_that_were_clicked_are_measured_where_no_layer_is_chosen(compared, wait_for):
    _, dock, _, _ = compared
    dock.drawing = Drawing((Landmark((20, 20), (22.0, 20.0), 2.0),))
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    before, now, count = numbers(dock.residual)
    assert (before, count) == (1.0, 1)
    assert now < 0.01


def test_the_second_image_is_seen_over_the_moved_first_until_it_is_compared_no_more(
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
    assert len(pictures) == 2, "as it was, and as it has moved"
    assert all(viewer.layers.index(each) < viewer.layers.index(after) for each in pictures)
    dock.drawing = Drawing((Arrow(at=(24, 28), by=(0.0, -2.0), radius=2.0),))
    wait_for(lambda: not dock.busy)
    assert after.colormap.name == "green"
    dock.compare_with = None
    assert [(each.colormap.name, each.blending, each.visible) for each in (before, after)] == looks
    assert {each.colormap.name for each in pictures} == {"gray"}


def test_what_cannot_be_compared_is_not_offered_and_an_image_may_go(compared, wait_for):
    viewer, dock, before, after = compared
    dock.compare_with = after
    viewer.layers.remove(after)
    assert dock.compare_with is None
    assert before.colormap.name == "gray"
    wait_for(lambda: not dock.busy)
    assert dock.image is before


def test_an_image_that_is_left_has_its_colours_back_and_its_landmarks_are_said_no_more(
    compared, wait_for
):
    viewer, dock, before, after = compared
    dock.drawing = Drawing((Landmark((20, 20), (22.0, 20.0), 2.0),))
    dock.compare_with = after
    wait_for(lambda: "apart before" in dock.residual and not dock.busy)
    third = viewer.add_image(before.data, name="third", scale=SIZE, units=("mm", "mm"))
    dock.image = third
    wait_for(lambda: not dock.busy)
    assert (before.colormap.name, third.colormap.name) == ("gray", "gray")
    assert dock.compare_with is None, "each image is compared with what was chosen for it"
    assert dock.residual == ""
    dock.image = before
    wait_for(lambda: not dock.busy)
    assert dock.compare_with is after
    assert (before.colormap.name, third.colormap.name) == ("magenta", "gray")
    assert "apart before" in dock.residual


def test_landmarks_of_one_image_measure_no_result_of_another(frame, settle):
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
