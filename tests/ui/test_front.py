"""Tests of the image that a new dock selects if there are several."""

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.motion.motion_messages import START
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.docks import quick

GREY = (np.indices((20, 24)).sum(axis=0) % 5 * 50).astype(np.uint8)
LARGER = np.full((64, 48, 3), 200, np.uint8)


@pytest.fixture
def two_images(small_sample):
    """Return a viewer with a painted sample behind a larger image, and both images."""
    viewer = ViewerModel()
    lower, *_ = small_sample(viewer)
    return viewer, lower, viewer.add_image(LARGER, name="astronaut", rgb=True)


@pytest.fixture
def open_dock(qtbot):
    """Return a function that opens the dock beside a viewer without a window."""

    def dock(viewer):
        found = SoftTissue(viewer)
        qtbot.addWidget(found.native)
        return found

    return dock


def test_a_dock_selects_the_image_that_is_selected_in_the_viewer(open_dock, two_images):
    viewer, lower, upper = two_images
    dock = open_dock(viewer)
    assert dock.image is upper
    assert (dock.tissue, dock.boundary) == (None, None), (
        "the layers of the other image were selected"
    )
    viewer.layers.selection = {lower}
    dock = open_dock(viewer)
    assert dock.image is lower
    assert (dock.tissue.name, dock.image.name) == ("Tissue", "MR")


def test_a_dock_selects_the_topmost_visible_image_if_none_is_selected(open_dock, two_images):
    viewer, lower, upper = two_images
    viewer.layers.selection = {viewer.layers["Boundary"]}
    assert open_dock(viewer).image is upper
    upper.visible = False
    assert open_dock(viewer).image is lower


def test_a_later_selection_in_the_viewer_does_not_change_the_image(open_dock, two_images):
    viewer, lower, upper = two_images
    dock = open_dock(viewer)
    viewer.layers.selection = {lower}
    assert dock.image is upper


def test_a_new_dock_selects_the_image_with_a_drawing(open_dock, two_images):
    viewer, lower, _ = two_images
    viewer.layers.selection = {lower}
    first = open_dock(viewer)
    first.start()
    first.drawing = Drawing((Arrow((10, 12), (10, 14), 4.0),))
    viewer.layers.selection = {viewer.layers["astronaut"]}
    assert open_dock(viewer).image is lower


def test_a_new_dock_selects_the_image_with_a_result(frame, small_sample, run, settle):
    lower, *_ = small_sample(frame.viewer)
    first = quick(frame.open())
    run(first)
    frame.close(first)
    frame.viewer.add_image(LARGER, name="astronaut", rgb=True)
    second = frame.open()
    assert second.image is lower
    settle(second)
    assert second.solution is not None


def test_a_message_reports_a_covered_image(open_dock, two_images, settle):
    viewer, lower, upper = two_images
    said = "'astronaut' covers the image: hide 'astronaut', or choose it as the image."
    dock = open_dock(viewer)
    assert dock.status == START
    upper.visible = False
    viewer.layers.selection = {lower}
    dock = open_dock(viewer)
    assert dock.status == START
    upper.visible = True
    dock.start()
    settle(dock)
    assert dock.status.startswith(said)


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
def test_a_partly_visible_image_is_not_reported_as_covered(open_dock, two_images, look):
    viewer, lower, upper = two_images
    viewer.layers.remove(upper)
    viewer.add_image(LARGER, rgb=True, **look)
    viewer.layers.selection = {lower}
    assert open_dock(viewer).status == START


def test_the_message_about_a_covered_image_follows_visibility_and_order(open_dock, two_images):
    viewer, lower, upper = two_images
    dock = open_dock(viewer)
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
