"""Of several images the dock takes the one that somebody looks at."""

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
def two(small_sample):
    """A viewer with a painted sample, and a larger image before it."""
    viewer = ViewerModel()
    lower, *_ = small_sample(viewer)
    return viewer, lower, viewer.add_image(LARGER, name="astronaut", rgb=True)


@pytest.fixture
def opened(qtbot):
    """Open the dock beside a viewer without a window."""

    def dock(viewer):
        found = SoftTissue(viewer)
        qtbot.addWidget(found.native)
        return found

    return dock


def test_a_dock_takes_the_image_that_is_selected(opened, two):
    viewer, lower, upper = two
    dock = opened(viewer)
    assert dock.image is upper
    assert (dock.tissue, dock.boundary) == (None, None), "what is painted on the other stays its"
    viewer.layers.selection = {lower}
    dock = opened(viewer)
    assert dock.image is lower
    assert (dock.tissue.name, dock.image.name) == ("Tissue", "MR")


def test_a_dock_takes_the_topmost_image_that_is_seen_if_none_is_selected(opened, two):
    viewer, lower, upper = two
    viewer.layers.selection = {viewer.layers["Boundary"]}
    assert opened(viewer).image is upper
    upper.visible = False
    assert opened(viewer).image is lower


def test_a_choice_stays_when_another_image_is_selected(opened, two):
    viewer, lower, upper = two
    dock = opened(viewer)
    viewer.layers.selection = {lower}
    assert dock.image is upper


def test_a_dock_goes_on_with_the_image_that_is_drawn_on(opened, two):
    viewer, lower, _ = two
    viewer.layers.selection = {lower}
    first = opened(viewer)
    first.start()
    first.drawing = Drawing((Arrow((10, 12), (10, 14), 4.0),))
    viewer.layers.selection = {viewer.layers["astronaut"]}
    assert opened(viewer).image is lower


def test_a_dock_goes_on_with_the_image_that_was_deformed(frame, small_sample, run, settle):
    lower, *_ = small_sample(frame.viewer)
    first = quick(frame.open())
    run(first)
    frame.close(first)
    frame.viewer.add_image(LARGER, name="astronaut", rgb=True)
    second = frame.open()
    assert second.image is lower
    settle(second)
    assert second.solution is not None


def test_an_image_that_is_covered_is_spoken_of(opened, two, settle):
    viewer, lower, upper = two
    said = "'astronaut' covers the image: hide 'astronaut', or choose it as the image."
    dock = opened(viewer)
    assert dock.status == START
    upper.visible = False
    viewer.layers.selection = {lower}
    dock = opened(viewer)
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
def test_an_image_of_which_something_is_seen_is_not_covered(opened, two, look):
    viewer, lower, upper = two
    viewer.layers.remove(upper)
    viewer.add_image(LARGER, rgb=True, **look)
    viewer.layers.selection = {lower}
    assert opened(viewer).status == START


def test_what_is_said_of_a_cover_follows_the_eye(opened, two):
    viewer, lower, upper = two
    dock = opened(viewer)
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


def test_where_another_image_lies_on_top_nothing_is_taken_hold_of(pulling_beside):
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
