"""Tests of drawing on a volume in napari's 3-D view."""

import re
from itertools import count

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QToolButton

from napari_hmrf import Arrow, Drawing
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.results.tissue_point import rounded
from tests.support.person import only
from tests.support.pulling import pull_volume
from tests.support.screen import Screen
from tests.support.timeouts import LONG_MS

SHAPE, SCALE = (20, 24, 28), (2.0, 1.0, 1.0)
MIDDLE = (19.0, 11.5, 13.5)
#: First and last plane of the head.
TOP, BOTTOM = 3, 16

pytestmark = pytest.mark.usefixtures("without_controls")


def head():
    """Return a bright block in a dark volume."""
    image = np.zeros(SHAPE, np.uint8)
    image[TOP : BOTTOM + 1, 4:20, 4:24] = 120 + np.indices((14, 16, 20)).sum(axis=0)
    return image


@pytest.fixture
def beside(open_beside, settle):
    """Return a simulated pointer at a volume in a 3-D view without a window, and the dock."""
    return pull_volume(*open_beside(head(), scale=SCALE), settle, ndisplay=3)


def depth_in(status):
    """Return the first coordinate of the place that a status text names."""
    return float(re.search(r"\| +at \[(-?[\d.]+), ", str(status))[1])


def tools(widget):
    return [each for each in widget.native.findChildren(QToolButton) if each.text() == "Pull"]


def test_a_press_grabs_the_first_tissue_on_the_line_of_sight(beside):
    person, widget = beside
    person.press(*MIDDLE)
    assert only(widget).at == pytest.approx((TOP, 11.5, 13.5), abs=0.6)
    person.release(*MIDDLE)
    person.ahead = (-1.0, 0.0, 0.0)
    person.press(MIDDLE[0], 16.0, 8.0)
    last = widget.drawing.marks[-1]
    assert last.at == pytest.approx((BOTTOM, 16, 8), abs=0.6)


def test_a_press_on_a_surface_passes_darker_tissue_in_front_of_it(beside):
    person, widget = beside
    layer = person.viewer.layers["MR"]
    layer.data[:8][layer.data[:8] > 0] //= 2
    layer.rendering, layer.iso_threshold = "iso", 100
    person.viewer.layers["MR deformed, elastic"].data = layer.data
    person.press(*MIDDLE)
    assert only(widget).at == pytest.approx((8, 11.5, 13.5), abs=0.6)


def test_a_press_on_a_surface_leaves_a_mark_behind_it_alone(beside):
    person, widget = beside
    layer = person.viewer.layers["MR"]
    layer.rendering, layer.iso_threshold = "iso", 100
    widget.drawing = Drawing((Arrow((12.0, 11.5, 13.5), (0, 1, 0), 2.0),))
    person.press(*MIDDLE)
    mark, pulled = widget.drawing.marks
    assert mark.at == (12.0, 11.5, 13.5)
    assert pulled.at == pytest.approx((TOP, 11.5, 13.5), abs=0.6)
    person.release(*MIDDLE)
    layer.rendering = "mip"
    widget.drawing = Drawing((mark,))
    person.press(*MIDDLE)
    assert len(widget.drawing.marks) == 1, "a mark that is seen through the volume is grabbed"


def test_a_drag_moves_tissue_parallel_to_the_screen(beside, settle):
    person, widget = beside
    person.drag(MIDDLE, (MIDDLE[0] + 5, 13.5, 14.5))
    settle(widget)
    arrow = only(widget)
    assert arrow.by == pytest.approx((0, 2, 1))
    at = tuple(round(each) for each in arrow.at)
    assert widget.solution.displacement[at] == pytest.approx(arrow.by, abs=0.05)


@pytest.mark.filterwarnings("ignore:Non-orthogonal slicing:UserWarning")  # in the 2-D view
def test_the_line_of_sight_includes_the_rotation_of_the_layer(open_beside, settle):
    person, widget = open_beside(head(), scale=SCALE, rotate=(-70.0, 10, 0))
    pull_volume(person, widget, settle, ndisplay=3)
    layer = person.viewer.layers["MR"]
    target, ahead = np.array([TOP - 0.5, 10, 12]), np.array([1.0, 0.0, 0.0])
    world = np.array([layer.data_to_world(each) for each in (target, target + ahead)])
    person.ahead = (world[1] - world[0]) / np.linalg.norm(world[1] - world[0])
    person.press(*(world[0] + 4 * np.array(person.ahead)))
    assert only(widget).at == pytest.approx(target, abs=0.6)


def test_a_press_grabs_tissue_on_the_cut_plane(beside, settle):
    person, widget = beside
    layer = person.viewer.layers["MR"]
    layer.depiction, layer.plane.position, layer.plane.normal = "plane", (9, 12, 14), (1, 0.5, 0)
    seen = []
    widget.deformation_changed.connect(seen.append)
    person.press(MIDDLE[0], 16.0, 13.5)
    assert only(widget).at == pytest.approx((7, 16, 13.5))
    person.move(MIDDLE[0], 18.0, 15.5)
    settle(widget)
    preview = seen[-1].preview
    assert preview.cut.normal == pytest.approx(np.array([1, 0.5, 0]) / np.hypot(1, 0.5))
    picture = person.viewer.layers["MR deformed, elastic"]
    changed = np.argwhere(picture.data != layer.data)
    assert len(changed)
    away = (changed - (9, 12, 14)) @ preview.cut.normal
    assert np.abs(away).max() <= 1.5
    assert picture.plane.position == layer.plane.position
    person.release(MIDDLE[0], 18.0, 15.5)
    settle(widget)
    away = (np.argwhere(picture.data != layer.data) - (9, 12, 14)) @ preview.cut.normal
    assert np.abs(away).max() > 2, "the volume is not deformed after the drag"


def test_the_wheel_and_the_keys_move_dragged_tissue_in_depth(beside, settle):
    person, widget = beside
    person.press(*MIDDLE)
    person.wheel(2)
    settle(widget)
    assert "Pulling 2 px" in Screen(widget).words
    person.key(Qt.Key.Key_Down)
    person.move(MIDDLE[0], 12.5, 13.5)
    assert not person.viewer.layers["Motion"].mouse_zoom
    person.release(MIDDLE[0], 12.5, 13.5)
    settle(widget)
    assert only(widget).by == pytest.approx((1, 1, 0))
    assert person.viewer.layers["Motion"].mouse_zoom
    person.wheel(3)
    assert only(widget).by == pytest.approx((1, 1, 0)), "the wheel moves tissue without a drag"
    widget.undo()
    assert not widget.drawing.marks, "a drag with turns of the wheel is several undo steps"


def test_the_end_of_an_arrow_can_be_grabbed_again(beside, settle):
    person, widget = beside
    person.drag(MIDDLE, (MIDDLE[0], 13.5, 13.5))
    settle(widget)
    person.drag((MIDDLE[0], 13.5, 13.5), (MIDDLE[0], 13.5, 16.5))
    assert only(widget).by == pytest.approx((0, 2, 3))


def test_a_drag_beside_the_tissue_turns_the_view(beside):
    person, widget = beside
    motion = person.viewer.layers["Motion"]
    person.press(MIDDLE[0], 1.0, 1.0)
    assert motion.mouse_pan
    person.release(MIDDLE[0], 8.0, 8.0)
    assert not widget.drawing.marks
    person.drag(MIDDLE, (MIDDLE[0], 13.5, 13.5))
    assert not motion.mouse_pan
    assert only(widget).by == pytest.approx((0, 2, 0))


def test_a_stroke_follows_the_surface(beside, settle):
    person, widget = beside
    widget.tool = "pin"
    person.drag(MIDDLE, (30.0, 16.0, 13.5), (50.0, 16.0, 20.0))
    settle(widget)
    (line,) = only(widget).lines
    assert len(line) > 1
    assert np.array(line)[:, 0] == pytest.approx(TOP, abs=0.6)


def test_the_picture_is_coarse_during_a_drag_of_a_large_volume(beside, settle, monkeypatch):
    monkeypatch.setattr("napari_hmrf.study.drag_preview.PREVIEW_SITES", 3000)
    person, widget = beside
    layer = person.viewer.layers["MR"]
    person.press(*MIDDLE)
    person.move(MIDDLE[0], 14.5, 13.5)
    settle(widget)
    picture = person.viewer.layers["MR deformed, elastic"]
    assert picture.data.shape == (10, 12, 14)
    assert picture.scale == pytest.approx(np.array(SCALE) * 2)
    assert (picture.data != layer.data[::2, ::2, ::2]).any()
    person.move(MIDDLE[0], 15.5, 13.5)
    person.release(MIDDLE[0], 15.5, 13.5)
    settle(widget)
    assert picture.data.shape == SHAPE
    assert picture.scale == pytest.approx(SCALE)


def test_only_the_deformed_volume_is_visible_in_the_3d_view(beside, settle):
    person, widget = beside
    layer = person.viewer.layers["MR"]
    person.drag(MIDDLE, (MIDDLE[0], 13.5, 13.5))
    settle(widget)
    assert not layer.visible
    widget.before = True
    assert layer.visible, "the undeformed image is hidden while it is compared"
    widget.before = False
    assert not layer.visible
    picture = person.viewer.layers["MR deformed, elastic"]
    picture.rendering = "iso"
    assert layer.rendering == "iso"
    person.viewer.dims.ndisplay = 2
    assert layer.visible


def test_slices_of_another_study_do_not_show_through_a_volume_in_the_3d_view(beside, settle):
    person, widget = beside
    person.drag(MIDDLE, (MIDDLE[0], 13.5, 13.5))
    settle(widget)
    person.viewer.dims.ndisplay = 2
    other = person.viewer.add_image(np.ones((1, 20, 20)), name="slice of another study")
    person.viewer.dims.ndisplay = 3
    settle(widget)
    assert not other.visible
    person.viewer.dims.ndisplay = 2
    assert other.visible


def test_the_image_is_visible_again_after_the_dock_was_closed_in_the_3d_view(beside, settle):
    person, widget = beside
    layer = person.viewer.layers["MR"]
    person.drag(MIDDLE, (MIDDLE[0], 13.5, 13.5))
    settle(widget)
    assert not layer.visible
    person.frame.close(widget)
    assert layer.visible


def test_the_status_bar_describes_the_visible_surface_in_the_3d_view(beside, settle):
    person, widget = beside
    viewer = person.viewer
    person.drag(MIDDLE, (MIDDLE[0], 13.5, 13.5))
    settle(widget)
    viewer.mouse_over_canvas = True
    moves = np.linalg.norm(widget.solution.displacement, axis=-1)

    def status_at(row, col):
        person.move(MIDDLE[0], row, col)
        return str(viewer.status)

    assert "held in place" in status_at(8, 20), "the surface of the tissue is fixed"
    assert depth_in(viewer.status) == pytest.approx(TOP * SCALE[0], abs=1.2)
    assert "moved 2 px" in status_at(13.5, 13.5), "the status bar describes hidden tissue"
    assert "moved" not in status_at(1, 1)
    person.ahead = -1.0, 0.0, 0.0
    assert "held in place" in status_at(8, 20)
    assert depth_in(viewer.status) == pytest.approx(BOTTOM * SCALE[0], abs=1.2)
    layer = viewer.layers["MR deformed, elastic"]
    layer.depiction, layer.plane.position, layer.plane.normal = "plane", (9, 12, 14), (1, 0.5, 0)
    assert f"moves {rounded(moves[7, 16, 20]):g} px" in status_at(16, 20)
    Screen(widget).choose("this slice")
    settle(widget)
    assert "moves" not in status_at(16, 20), "a hidden slice is described"


def test_tools_are_disabled_with_a_reason_if_a_slice_is_deformed_in_the_3d_view(beside, settle):
    person, widget = beside
    (button,) = tools(widget)
    assert button.isEnabled()
    Screen(widget).choose("this slice")
    settle(widget)
    assert not button.isEnabled()
    assert "whole volume" in button.toolTip()
    assert "only on a whole volume" in widget.status
    assert not widget.start()
    person.viewer.dims.ndisplay = 2
    settle(widget)
    assert button.isEnabled()
    assert "Drag tissue" in button.toolTip()


def test_play_draws_pictures_in_the_3d_view(beside, settle, qtbot):
    person, widget = beside
    person.drag(MIDDLE, (MIDDLE[0], 14.5, 13.5))
    settle(widget)
    picture = person.viewer.layers["MR deformed, elastic"]
    whole, percents = picture.data.copy(), []
    picture.events.data.connect(lambda: percents.append(widget.percent))
    widget.play()
    qtbot.waitUntil(lambda: len(set(percents)) > 2, timeout=LONG_MS)
    widget.pause()
    assert picture.visible
    assert (picture.data != whole).any()


def test_play_explains_that_a_slice_is_hidden_inside_the_volume(open_beside, settle):
    person, widget = open_beside(head(), scale=SCALE)
    person.viewer.dims.set_point(0, MIDDLE[0])
    settle(widget)
    if not widget.active:
        Screen(widget).press("Pull")
    settle(widget)
    person.drag(MIDDLE[1:], (14.5, 13.5))
    settle(widget)
    person.viewer.dims.ndisplay = 3
    settle(widget)
    widget.play()
    widget.pause()
    assert "hidden inside the volume" in widget.status


def test_the_mouse_turns_the_camera_beside_the_tissue_in_a_window(open_window, settle, wait_for):
    window = open_window(head(), is_small=True, scale=SCALE)
    person, widget = pull_volume(*window, settle, ndisplay=3)
    camera = camera_of(person.viewer)
    person.viewer.reset_view()
    before, places = camera.angles, ((MIDDLE[0], 1.0, col) for col in count(2.0, 0.5))
    person.press(*next(places))

    def turned():
        person.canvas._last_time = 0.0  # vispy drops moves in quick succession
        person.move(*next(places))
        return camera.angles != before

    wait_for(turned)
    person.release(*next(places))
    assert not widget.drawing.marks
    camera.angles = before
    person.paint(MIDDLE, (MIDDLE[0], 13.5, 13.5), (MIDDLE[0], 15.5, 16.5))
    settle(widget)
    assert camera.angles == before
    assert only(widget).by == pytest.approx((0, 4, 3), abs=0.3)
