"""Tests of the image that a new dock selects if there are several."""

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf.layers.image_choice import image_covering, image_in_front
from napari_hmrf.ui.forms import Section
from napari_hmrf.ui.messages import NEW_IMAGE, SECOND
from napari_hmrf.ui.motion.motion_messages import START
from tests.support.docks import open_sample, quick

GREY = (np.indices((20, 24)).sum(axis=0) % 5 * 50).astype(np.uint8)
LARGER = np.full((64, 48, 3), 200, np.uint8)


@pytest.fixture
def two_images(frame, small_sample):
    """Return a viewer with a painted sample behind a larger image, and both images."""
    lower, *_ = small_sample(frame.viewer)
    return frame.viewer, lower, frame.viewer.add_image(LARGER, name="astronaut", rgb=True)


def test_a_new_dock_selects_the_image_that_is_selected_or_the_topmost_visible_image(small_sample):
    viewer = ViewerModel()
    lower, *_ = small_sample(viewer)
    upper = viewer.add_image(LARGER, name="astronaut", rgb=True)
    images = [lower, upper]
    assert image_in_front(viewer, images, []) is upper
    viewer.layers.selection = {lower}
    assert image_in_front(viewer, images, []) is lower
    viewer.layers.selection = {viewer.layers["Boundary"]}
    upper.visible = False
    assert image_in_front(viewer, images, []) is lower
    upper.visible = True
    viewer.layers.selection = {upper}
    assert image_in_front(viewer, images, [lower]) is lower, "the edited image was not selected"


@pytest.mark.parametrize("is_open_before", [True, False])
def test_of_two_scans_the_earlier_is_deformed_and_the_later_is_the_second_image(
    frame, at_rest, is_open_before
):
    dock = frame.open() if is_open_before else None
    earlier, later = (frame.viewer.add_image(GREY + each, name=f"scan {each}") for each in (0, 1))
    dock = quick(dock or frame.open())
    at_rest()
    assert (dock.image, dock.compare_with) == (earlier, later)
    assert [layer.visible for layer in (earlier, later)] == [True, False], "one covers the other"
    assert dock.status == SECOND.format("scan 0", "scan 1")
    (section,) = (each for each in dock.native.findChildren(Section) if "register" in each.text())
    assert section.isExpanded()
    third = frame.viewer.add_image(GREY, name="scan 3")
    assert (dock.image, dock.compare_with) == (earlier, later)
    frame.viewer.layers.remove(third)
    dock.compare_with = None
    frame.viewer.add_labels(GREY, name="labels")
    assert dock.compare_with is None, "a cleared choice was chosen again"
    frame.viewer.layers.remove(earlier)
    assert (dock.image, later.visible) == (later, True)


def test_a_sample_and_an_image_of_another_size_are_no_second_images(frame):
    dock = quick(frame.open())
    first = frame.viewer.add_image(GREY, name="scan")
    larger = frame.viewer.add_image(LARGER[..., 0], name="larger")
    assert (dock.image, dock.compare_with) == (larger, None)
    frame.viewer.layers.remove(larger)
    assert dock.image is first
    sample, *_ = open_sample(frame.viewer, [(GREY, {"name": "sample"}, "image")])
    assert (dock.image, dock.compare_with) == (sample, None)
    assert sample.visible


def test_a_new_dock_selects_the_image_with_a_result(frame, small_sample, run, settle):
    first = quick(frame.open())
    lower, *_ = small_sample(frame.viewer)
    run(first)
    frame.close(first)
    frame.viewer.add_image(LARGER, name="astronaut", rgb=True)
    second = frame.open()
    assert second.image is lower
    settle(second)
    assert second.solution is not None


def test_the_message_about_a_covered_image_follows_visibility_and_order(frame, two_images):
    viewer, lower, upper = two_images
    dock = frame.open()
    dock.image = lower
    dock.show_message("")
    for shown in (False, True):
        upper.visible = shown
        assert dock.status.startswith(f"'{upper.name}' covers the image") == shown
    viewer.layers.move(viewer.layers.index(lower), len(viewer.layers))
    assert dock.status == START


def test_a_new_image_that_covers_the_image_in_use_becomes_the_image(frame):
    dock = quick(frame.open())
    open_sample(frame.viewer, [(GREY, {"name": "scan"}, "image")])
    dock.plane = "strain"
    new, *_ = open_sample(frame.viewer, [(GREY, {"name": "sample"}, "image")])
    assert (dock.image, dock.compare_with) == (new, None)
    assert dock.status == NEW_IMAGE.format("sample", "scan")
    photograph = frame.viewer.add_image(LARGER, rgb=True, name="new")
    assert dock.image is photograph
    patch = frame.viewer.add_image(GREY, name="patch")
    assert patch.visible
    assert dock.image is photograph, "a small image covers only a part"


@pytest.mark.parametrize(
    "look",
    [
        {"opacity": 0.5},
        {"blending": "additive"},
        {"translate": (0, 5)},
        {"rotate": 10},
        {"visible": False},
    ],
)
def test_an_image_is_not_covered_if_a_part_of_it_is_visible(look):
    viewer = ViewerModel()
    image = viewer.add_image(GREY)
    over = viewer.add_image(LARGER, rgb=True)
    assert image_covering(viewer, image) is over
    viewer.layers.remove(over)
    viewer.add_image(LARGER, rgb=True, **look)
    assert image_covering(viewer, image) is None


def test_covered_tissue_cannot_be_pulled(pulling_beside):
    person, widget = pulling_beside
    patch = np.full((20, 64), 200, np.uint8)
    person.viewer.add_image(patch, name="strip", translate=(40, 0))
    person.viewer.layers.selection.active = person.viewer.layers["Motion"]
    person.drag((50, 30), (54, 34))
    assert widget.status == "'strip' covers the image: hide 'strip', or choose it as the image."
    assert not widget.drawing.marks
    person.drag((20, 30), (24, 34))
    assert len(widget.drawing.marks) == 1
    person.viewer.layers["strip"].visible = False
    person.drag((50, 30), (54, 34))
    assert len(widget.drawing.marks) == 2
