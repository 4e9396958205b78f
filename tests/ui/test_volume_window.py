"""Tests of pulling a volume in its slices, in a window and without one."""

import threading

import numpy as np
import pytest
from napari.layers import Vectors
from qtpy.QtWidgets import QFileDialog, QPushButton, QTableWidget

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.layers.metadata import METADATA, TISSUE, layer_metadata, metadata_of
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.drawing import Arrow, Drawing
from tests.support.person import by_name, only
from tests.support.pulling import pull_volume
from tests.support.screen import Screen
from tests.support.timeouts import LONG, LONG_MS

#: Kinds of result layers that are shown in the tests of extents.
EVERYTHING = {"image", "magnitude"}
SHAPE, SCALE = (24, 32, 32), (1.5, 1.0, 1.0)
#: World coordinate of the middle slice.
MIDDLE = 12 * SCALE[0]

pytestmark = pytest.mark.usefixtures("without_controls")


def blocks():
    """Return a volume of bright and dark blocks."""
    planes, rows, cols = np.indices(SHAPE)
    return (120 + 60 * ((planes // 4 + rows // 4 + cols // 4) % 2)).astype(np.uint8)


@pytest.fixture
def volume_beside(open_beside, settle):
    """Return a simulated user at a slice of a volume without a window, and the dock."""
    return pull_volume(*open_beside(blocks(), scale=SCALE), settle, depth=MIDDLE)


def go_to(person, number):
    person.viewer.dims.set_point(0, number * SCALE[0])


def test_a_slice_is_deformed_until_the_whole_volume_is_chosen(volume_beside, settle):
    person, widget = volume_beside
    assert widget.study.grid.shape == SHAPE
    widget.undo()
    settle(widget)
    assert widget.extent == "slice"
    assert widget.study.grid.shape == SHAPE[1:]
    widget.image = person.viewer.add_image(np.zeros((8, 9)), name="flat")
    assert not widget._form.extent.visible, "an image without slices offers the volume"


def test_a_pull_in_a_slice_moves_neighbouring_slices(volume_beside, settle, qtbot):
    person, widget = volume_beside
    seen = []
    widget.deformation_changed.connect(seen.append)
    person.press(16, 16)
    person.move(18, 19)
    qtbot.waitUntil(lambda: bool(seen), timeout=LONG_MS)
    preview = seen[-1]
    assert preview.preview is not None
    assert preview.image.shape == SHAPE[1:]
    picture = by_name(person.viewer, "MR deformed, elastic")
    still = by_name(person.viewer, "MR").data
    assert widget.session.drawing_in_progress
    qtbot.waitUntil(lambda: (picture.data[12] != still[12]).mean() > 0.02, timeout=LONG_MS)
    assert np.array_equal(picture.data[5], still[5]), "a hidden slice was updated during the drag"
    person.move(19, 20)
    person.release(19, 20)
    settle(widget)
    arrow = only(widget)
    assert arrow.at == pytest.approx((12, 16, 16), abs=0.6)
    assert arrow.by == pytest.approx((0, 3, 4), abs=0.6)
    field = widget.solution.displacement
    assert field.shape == (*SHAPE, 3)
    assert field[12, 16, 16] == pytest.approx(arrow.by, abs=0.05)
    assert 0.2 < field[14, 16, 16, 2] < arrow.by[2]
    assert not field[0].any(), "the edge moves"
    assert picture.data.shape == SHAPE
    changed = (picture.data != still).any(axis=(1, 2))
    assert changed[9:16].all()
    assert not changed[0]
    assert picture.scale.tolist() == list(SCALE)


def test_a_drag_continues_on_another_slice(volume_beside, settle):
    person, widget = volume_beside
    person.press(16, 16)
    person.move(17, 17)
    go_to(person, 14)
    person.move(18, 16)
    person.release(18, 16)
    settle(widget)
    assert only(widget).by == pytest.approx((2 * SCALE[0], 2, 0), abs=0.6)
    assert widget.solution.displacement[12, 16, 16, 0] == pytest.approx(3, abs=0.05)


def test_a_pull_in_a_coronal_slice_moves_tissue_in_that_plane(volume_beside, settle):
    person, widget = volume_beside
    person.viewer.dims.order = (1, 0, 2)
    person.viewer.dims.set_point(1, 16)
    person.viewer.reset_view()
    settle(widget)
    person.drag((18, 16), (20, 17), (22, 18))
    settle(widget)
    arrow = only(widget)
    assert arrow.at == pytest.approx((12, 16, 16), abs=0.8)
    assert arrow.by == pytest.approx((4, 0, 2), abs=0.8)
    assert widget.solution.displacement[12, 16, 16] == pytest.approx(arrow.by, abs=0.1)


def test_the_marks_of_a_slice_are_offered_to_its_volume_and_back(volume_beside, settle):
    person, widget = volume_beside
    screen = Screen(widget)
    screen.choose("this slice")
    settle(widget)
    person.drag((16, 16), (18, 19))
    settle(widget)
    on_slice = widget.drawing
    screen.choose("the whole volume")
    settle(widget)
    assert not widget.drawing.marks, "a slice and its volume have one drawing"
    assert "1 mark is drawn on slice 12 alone." in screen.words
    screen.press("Carry over")
    settle(widget)
    assert only(widget).at == pytest.approx((12, 16, 16), abs=0.6)
    assert only(widget).by == (0, *on_slice.marks[0].by)
    assert widget.solution.displacement.shape == (*SHAPE, 3)
    assert "alone" not in screen.words, "the question is still open"
    widget.undo()
    assert not widget.drawing.marks
    widget.redo()
    person.drag((8, 8), (9, 9))
    go_to(person, 14)
    settle(widget)
    person.drag((24, 24), (25, 25))
    go_to(person, 12)
    settle(widget)
    screen.choose("this slice")
    settle(widget)
    assert widget.drawing == on_slice
    assert "1 mark of the volume is drawn on this slice." in screen.words
    assert "1 mark on other slices stays with the volume." in screen.words
    screen.press("Keep there")
    assert widget.status == "1 mark stays with the volume."
    assert widget.drawing == on_slice


def test_marks_of_a_volume_on_other_slices_are_reported(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (18, 18))
    go_to(person, 5)
    settle(widget)
    Screen(widget).choose("this slice")
    settle(widget)
    assert "1 mark of the volume is on other slices, and stays with the volume." in widget.status


def test_a_brush_paints_a_ball_in_a_volume(volume_beside, settle):
    person, widget = volume_beside
    widget.tool = "pin"
    widget.fields.radius.value = 4.0
    person.drag((16, 16), (16, 20))
    settle(widget)
    stroke = only(widget)
    assert {point[0] for line in stroke.lines for point in line} == {12.0}
    painted = by_name(person.viewer, "Motion, painted").data
    assert painted[12, 16, 16]
    assert painted[14, 16, 18]
    assert not painted[15, 16, 18]
    widget.tool = "pull"
    person.drag((24, 24), (26, 24))
    settle(widget)
    assert widget.solution.displacement[12, 16, 18] == pytest.approx((0, 0, 0), abs=1e-3)


def test_tissue_painted_in_a_volume_sets_the_stiffness(volume_beside, settle):
    person, widget = volume_beside
    labels = np.ones(SHAPE, int)
    labels[10:15, 12:20, 20:28] = 2
    rows = (Material(1, "soft", 1.0), Material(2, "stiff", 1000.0))
    person.viewer.add_labels(
        labels, name="Tissue", scale=SCALE, metadata=layer_metadata(TISSUE, rows)
    )
    settle(widget)
    assert widget.tissue is by_name(person.viewer, "Tissue")
    person.viewer.layers.selection = {by_name(person.viewer, "MR")}
    Screen(widget).press("Pull")
    settle(widget)
    person.drag((16, 12), (16, 15))
    settle(widget)
    field = widget.solution.displacement[10:15, 12:20, 20:28]
    assert np.ptp(field[..., 2]) < 0.1, "the stiff inclusion is deformed"


def test_the_slider_shows_a_part_of_the_motion_of_a_volume(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (16, 22))
    settle(widget)
    whole = by_name(person.viewer, "MR deformed, elastic").data.copy()
    widget.percent = 0
    settle(widget)
    picture = by_name(person.viewer, "MR deformed, elastic").data
    assert np.array_equal(picture[12], by_name(person.viewer, "MR").data[12])
    widget.percent = 100
    settle(widget)
    assert np.array_equal(by_name(person.viewer, "MR deformed, elastic").data[12], whole[12])


def test_overlays_of_a_volume_are_volumes(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (16, 22))
    settle(widget)
    for overlay in ("magnitude", "jacobian", "equivalent"):
        widget.overlay = overlay
        settle(widget)
        over = [
            each
            for each in person.viewer.layers
            if each.name.startswith("MR ") and "elastic" in each.name
        ]
        assert any(each.data.shape == SHAPE and each.data.dtype.kind == "f" for each in over)
    widget.overlay = "nothing"


def test_folds_and_only_folds_are_blue_in_a_3d_view_of_strain(open_window, settle):
    planes, rows, cols = np.indices(SHAPE)
    is_brain = ((planes - 12) / 10) ** 2 + ((rows - 16) / 13) ** 2 + ((cols - 16) / 13) ** 2 < 1
    brain = is_brain * (100 + 20 * (rows % 3)).astype(np.uint8)
    person, widget = open_window(brain, is_small=True, scale=SCALE)
    pull_volume(person, widget, settle, ndisplay=3)
    widget.drawing = Drawing((Arrow((12, 16, 16), (0, 0, 8.0), 2.0),))
    for overlay in ("equivalent", "jacobian"):
        widget.overlay = overlay
        settle(widget)
        for layer in person.viewer.layers:
            layer.visible = layer.visible and not isinstance(layer, Vectors)
        (layer,) = [each for each in person.viewer.layers if "; blue: folded" in each.name]
        layer.colorbar.visible = False
        folds = layer.data <= 0 if overlay == "jacobian" else np.isinf(layer.data)
        ends = np.argwhere(folds)[:, None] + np.array([[0, 0, 0], [-1, -1, -1], [1, 1, 1]]) / 2
        places = [person.where(*at) for at in (ends * SCALE).reshape(-1, 3)]
        ratio = person.canvas.devicePixelRatioF()
        x, y = (ratio * np.array([(at.x(), at.y()) for at in places])).astype(int).T
        shot = person.viewer.screenshot(canvas_only=True, flash=False)[..., :3].astype(int)
        is_blue = shot[..., 2] > shot[..., :2].max(axis=-1) + 100
        assert is_blue[y[::3], x[::3]].all(), "strain hides a fold"
        is_blue[y.min() - 3 : y.max() + 4, x.min() - 3 : x.max() + 4] = False
        assert not is_blue.any(), "tissue without folds is blue"


def test_measurements_of_a_volume_have_columns_for_voxels_and_volumes(
    volume_beside, settle, tmp_path, monkeypatch
):
    person, widget = volume_beside
    person.drag((16, 16), (18, 19))
    settle(widget)
    screen, path = Screen(widget), tmp_path / "table.csv"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    screen.entry("More", "Measurements").trigger()
    (table,) = widget.native.window().findChildren(QTableWidget, "measurements")
    heads = [table.horizontalHeaderItem(at).text() for at in range(table.columnCount())]
    unit = widget.study.grid.unit
    assert heads[2:4] == [f"volume ({'px' if unit == 'pixel' else unit}³)", "volume change (%)"]
    assert "folds (voxels)" in heads
    table.window().findChild(QPushButton).click()
    table.window().close()
    assert path.read_text().startswith("label,name,voxels,volume,volume_change_percent")


def test_the_status_bar_reads_three_components_in_a_volume(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (16, 22))
    settle(widget)
    probe = widget.at((12 * SCALE[0], 16, 21))
    assert probe.site == pytest.approx((12, 16, 16), abs=2)
    assert len(probe.displacement) == 3


def test_a_study_of_a_volume_is_saved_and_opened_again(volume_beside, settle, tmp_path):
    person, widget = volume_beside
    person.drag((16, 16), (16, 20))
    settle(widget)
    drawing = widget.drawing
    path = widget.save_study(tmp_path / "pulled.study")
    widget.open_study(path)
    settle(widget)
    assert widget.extent == "volume"
    assert widget.drawing == drawing
    assert widget.study.grid.shape == SHAPE


def test_the_warning_button_shows_the_slice_with_the_most_folds(volume_beside, settle):
    person, widget = volume_beside
    order = (2, 0, 1)
    dims = person.viewer.dims
    go_to(person, 6)
    person.drag((16, 8), (16, 30))
    settle(widget)
    go_to(person, 20)
    dims.order = order
    settle(widget)
    Screen(widget).button("⚠").click()
    settle(widget)
    marked = by_name(person.viewer, "MR folds, elastic").data
    across = order[0]
    most = marked.sum(axis=tuple(axis for axis in range(3) if axis != across))
    seen = round(dims.point[across] / (SCALE[across]))
    assert most[seen] == most.max() > 0
    assert widget.status.endswith(f"slice with the most such voxels: slice {seen}.")
    assert widget.status.startswith(widget.warning)


def test_deform_solves_a_volume_with_a_cold_start(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (16, 20))
    settle(widget)
    before = widget.solution.displacement
    widget.deform()
    settle(widget)
    assert np.abs(widget.solution.displacement - before).max() < 0.02
    known = by_name(person.viewer, "MR arrows, elastic").metadata[METADATA]
    assert known["slice"] == ""


def test_a_new_drag_does_not_wait_for_the_solve_of_a_volume(volume_beside, settle, qtbot):
    person, widget = volume_beside
    person.drag((16, 16), (18, 18))
    settle(widget)
    widget.deform()
    seen = []
    widget.deformation_changed.connect(seen.append)
    person.press(8, 8)
    person.move(9, 9)
    qtbot.waitUntil(lambda: any(each.preview is not None for each in seen), timeout=LONG_MS)
    person.move(10, 10)
    person.release(10, 10)
    settle(widget)
    assert len(widget.drawing.marks) == 2
    assert widget.solution.displacement.shape == (*SHAPE, 3)


@pytest.fixture
def both_extents(volume_beside, settle):
    """Return a volume with a result whose middle slice has a result, too, and is chosen."""
    person, widget = volume_beside
    person.drag((16, 16), (18, 18))
    widget.overlay = "magnitude"
    settle(widget)
    Screen(widget).choose("this slice")
    settle(widget)
    assert visible_slices(person.viewer) <= {"slice 12"}, (
        "the result of the volume is displayed for its slice"
    )
    assert widget.result is None
    person.drag((12, 12), (12, 15))
    settle(widget)
    return person, widget


def visible_slices(viewer):
    """Return the slices of visible results, with "" for the volume."""
    made = [layer for layer in viewer.layers if layer.visible and "source" in metadata_of(layer)]
    return {metadata_of(layer)["slice"] for layer in made}


def visible_kinds(viewer):
    """Return the kinds of visible result layers."""
    return {metadata_of(layer).get("kind") for layer in viewer.layers if layer.visible} & {
        *EVERYTHING
    }


def test_the_result_of_the_chosen_extent_is_displayed(both_extents, settle):
    person, widget = both_extents
    viewer = person.viewer
    for extent, where in (("slice", "slice 12"), ("volume", ""), ("slice", "slice 12")):
        widget.extent = extent
        settle(widget)
        assert visible_slices(viewer) == {where}
        assert visible_kinds(viewer) == EVERYTHING
        assert metadata_of(widget.result)["slice"] == where
        widget.before = True
        assert visible_slices(viewer) == set()
        widget.before = False
        widget.percent = 50
        settle(widget)
        assert visible_slices(viewer) == {where}
    widget.undo()
    settle(widget)
    assert visible_slices(viewer) == {""}
    assert visible_kinds(viewer) == EVERYTHING


def test_selecting_the_arrows_of_another_extent_does_not_show_its_result(both_extents, settle):
    person, widget = both_extents
    viewer = person.viewer
    held = {
        metadata_of(each)["slice"]: each for each in viewer.layers if "answer" in metadata_of(each)
    }
    viewer.layers.selection.active = held[""]
    settle(widget)
    assert metadata_of(widget.result)["slice"] == "slice 12"
    assert visible_slices(viewer) == {"slice 12"}


@pytest.fixture
def cancelled(volume_beside, settle, qtbot):
    """Return a function that drags in a volume and cancels the solve after the release."""
    person, widget = volume_beside

    def cancel():
        seen, go_on = [], threading.Event()
        widget.deformation_changed.connect(seen.append)
        person.press(16, 16)
        person.move(19, 19)
        qtbot.waitUntil(lambda: bool(seen), timeout=LONG_MS)
        assert seen[-1].preview is not None
        compute_thread.submit(lambda: go_on.wait(LONG))
        person.release(19, 19)
        button = Screen(widget).button("Cancel")
        qtbot.waitUntil(button.isEnabled, timeout=LONG_MS)
        button.click()
        go_on.set()
        settle(widget)

    return person, widget, cancel


def test_a_cancelled_solve_of_a_volume_restores_the_last_result(cancelled, settle):
    person, widget, cancel = cancelled
    person.drag((10, 10), (11, 12))
    widget.overlay = "magnitude"
    settle(widget)
    picture = by_name(person.viewer, "MR deformed, elastic")
    before = picture.data.copy()
    cancel()
    assert np.array_equal(picture.data, before)
    assert visible_kinds(person.viewer) == EVERYTHING
    assert metadata_of(picture)["inputs_changed"]
    assert len(widget.drawing.marks) == 2
    assert widget.status.startswith("Cancelled")
    assert "do not include the last edits" in widget.status
    person.drag((20, 20), (21, 21))
    settle(widget)
    assert len(widget.drawing.marks) == 3
    assert not metadata_of(picture)["inputs_changed"]
    assert not np.array_equal(picture.data, before)


def test_a_cancelled_first_pull_of_a_volume_shows_no_result(cancelled, settle):
    person, widget, cancel = cancelled
    cancel()
    assert visible_kinds(person.viewer) == set()
    person.drag((20, 20), (21, 21))
    settle(widget)
    assert len(widget.drawing.marks) == 2
    assert visible_kinds(person.viewer) == {"image"}


def test_the_status_bar_reads_no_earlier_result_during_a_drag_in_a_volume(
    volume_beside, settle, qtbot
):
    person, widget = volume_beside
    viewer, seen = person.viewer, []
    person.drag((16, 16), (18, 18))
    settle(widget)
    viewer.mouse_over_canvas = True
    viewer.status = "Here"
    assert "moved" in viewer.status
    widget.deformation_changed.connect(seen.append)
    person.press(8, 8)
    person.move(11, 11)
    qtbot.waitUntil(lambda: bool(seen), timeout=LONG_MS)
    assert widget.at(viewer.cursor.position) is None
    assert "moved" not in str(viewer.status)
    person.release(11, 11)
    settle(widget)
    assert widget.at(viewer.cursor.position).displacement[1:] == pytest.approx((3, 3), abs=0.3)
    viewer.status = "There"
    assert "moved" in viewer.status
