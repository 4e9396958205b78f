"""Tests of the image that a new dock selects if there are several."""

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf.layers.image_choice import image_covering, image_in_front
from napari_hmrf.ui.motion.motion_messages import START
from tests.support.docks import quick

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
    viewer.layers.remove(upper)
    viewer.add_image(LARGER, rgb=True, name="new")
    assert dock.status.startswith("'new' covers the image")


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
