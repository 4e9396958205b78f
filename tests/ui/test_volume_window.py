"""A volume is pulled in a slice with the mouse, in a real window and without one, and follows."""

import threading

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QFileDialog, QPushButton, QTableWidget

from napari_hmrf.fields import count_folds
from napari_hmrf.layers.metadata import METADATA, TISSUE, layer_metadata, metadata_of
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.ui.messages import MEANWHILE
from tests.support.person import CTRL, by_name, only
from tests.support.screen import Screen
from tests.support.timeouts import LONG, LONG_MS

#: What is seen of a result in the tests of extents.
EVERYTHING = {"image", "arrows", "magnitude"}
SHAPE, SCALE = (24, 32, 32), (1.5, 1.0, 1.0)

pytestmark = pytest.mark.usefixtures("without_controls")


def blocks():
    """A volume of bright and dark blocks."""
    planes, rows, cols = np.indices(SHAPE)
    return (120 + 60 * ((planes // 4 + rows // 4 + cols // 4) % 2)).astype(np.uint8)


@pytest.fixture
def in_the_middle(settle):
    """Have somebody look at the middle slice of a volume, with *Pull* in the hand."""

    def looking(person, widget):
        person.viewer.dims.set_point(0, 12 * SCALE[0])
        Screen(widget).choose("the whole volume")
        settle(widget)
        if not widget.active:
            Screen(widget).press("Pull")
        settle(widget)
        return person, widget

    return looking


@pytest.fixture
def volume(open_window, in_the_middle):
    """Somebody before a window that shows a slice of a volume."""
    return in_the_middle(*open_window(blocks(), scale=SCALE))


@pytest.fixture
def volume_beside(open_beside, in_the_middle):
    """The same without a window."""
    return in_the_middle(*open_beside(blocks(), scale=SCALE))


def go_to(person, number):
    person.viewer.dims.set_point(0, number * SCALE[0])


def test_a_slice_is_deformed_until_the_whole_volume_is_chosen(volume_beside, settle):
    _, widget = volume_beside
    assert widget.study.grid.shape == SHAPE
    widget.undo()
    settle(widget)
    assert widget.extent == "slice"
    assert widget.study.grid.shape == SHAPE[1:]


def test_an_image_without_slices_offers_no_volume(open_beside):
    _, widget = open_beside()
    assert not widget._form.extent.visible


def test_a_pull_in_a_slice_moves_the_slices_beside_it(volume, settle, qtbot):
    person, widget = volume
    seen = []
    widget.deformation_changed.connect(seen.append)
    person.press(16, 16)
    person.move(18, 19)
    qtbot.waitUntil(lambda: bool(seen), timeout=LONG_MS)
    preview = seen[-1]
    assert preview.preview is not None
    assert preview.image.shape == SHAPE[1:]
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
    assert not field[0].any(), "the edge is held"
    picture = by_name(person.viewer, "MR deformed, elastic")
    still = by_name(person.viewer, "MR").data
    assert picture.data.shape == SHAPE
    changed = (picture.data != still).any(axis=(1, 2))
    assert changed[9:16].all()
    assert not changed[0]
    assert picture.scale.tolist() == list(SCALE)


def test_while_a_hand_pulls_the_slice_that_is_seen_follows(volume, settle, qtbot):
    person, widget = volume
    seen = []
    widget.deformation_changed.connect(seen.append)
    person.press(16, 16)
    for step in range(1, 4):
        before = len(seen)
        person.move(16 + step, 16 + step)
        qtbot.waitUntil(lambda before=before: len(seen) > before, timeout=LONG_MS)
    picture = by_name(person.viewer, "MR deformed, elastic")
    still = by_name(person.viewer, "MR").data
    assert widget.study_model.drawing_in_progress
    assert (picture.data[12] != still[12]).mean() > 0.02
    assert np.array_equal(picture.data[5], still[5]), "what is not seen waits"
    person.release(19, 19)
    settle(widget)
    assert not np.array_equal(picture.data[11], still[11])


def test_what_is_held_goes_along_to_another_slice(volume_beside, settle):
    person, widget = volume_beside
    person.press(16, 16)
    person.move(17, 17)
    go_to(person, 14)
    person.move(18, 16)
    person.release(18, 16)
    settle(widget)
    assert only(widget).by == pytest.approx((2 * SCALE[0], 2, 0), abs=0.6)
    assert widget.solution.displacement[12, 16, 16, 0] == pytest.approx(3, abs=0.05)


def test_a_pull_in_a_slice_across_another_axis(volume_beside, settle):
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


def test_pulls_of_a_slice_and_of_the_volume_are_two_drawings(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (18, 18))
    settle(widget)
    Screen(widget).choose("this slice")
    settle(widget)
    assert not widget.drawing.marks
    Screen(widget).choose("the whole volume")
    settle(widget)
    assert only(widget).by == pytest.approx((0, 2, 2), abs=0.6)


def test_undo_takes_a_pull_of_a_volume_back(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (18, 18))
    settle(widget)
    person.key(Qt.Key.Key_Z, CTRL)
    settle(widget)
    assert not widget.drawing.marks
    picture = by_name(person.viewer, "MR deformed, elastic")
    assert not picture.visible or np.array_equal(picture.data, by_name(person.viewer, "MR").data)


def test_a_brush_paints_a_ball(volume, settle):
    person, widget = volume
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


def test_tissue_painted_in_a_volume_says_how_stiff_it_is(volume_beside, settle):
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
    assert np.ptp(field[..., 2]) < 0.1, "what is stiff keeps its shape"


def test_the_slider_shows_a_volume_on_its_way(volume_beside, settle):
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


def test_what_lies_over_a_volume_is_a_volume(volume, settle):
    person, widget = volume
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


def test_measurements_of_a_volume_are_called_so_and_saved_so(
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
    assert heads[-1] == "folds (voxels)"
    table.window().findChild(QPushButton).click()
    table.window().close()
    assert path.read_text().startswith("label,name,voxels,volume,volume_change_percent")


def test_the_readout_in_a_volume_names_all_three_ways(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (16, 22))
    settle(widget)
    probe = widget.at((12 * SCALE[0], 16, 21))
    assert probe.site == pytest.approx((12, 16, 16), abs=2)
    assert len(probe.displacement) == 3


def test_a_volume_is_saved_and_opened_again(volume_beside, settle, tmp_path):
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


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_the_chip_goes_to_the_slice_in_which_most_of_it_folds(volume_beside, settle, order):
    person, widget = volume_beside
    dims = person.viewer.dims
    go_to(person, 6)
    person.drag((16, 8), (16, 30))
    settle(widget)
    go_to(person, 20)
    dims.order = order
    settle(widget)
    solution = widget.solution
    number = count_folds(solution.displacement, spacing=solution.spacing, tissue=solution.tissue)
    Screen(widget).button(f"⚠  Folds at {number} voxels: show where").click()
    settle(widget)
    marked = by_name(person.viewer, "MR folds, elastic").data
    across = order[0]
    most = marked.sum(axis=tuple(axis for axis in range(3) if axis != across))
    seen = round(dims.point[across] / (SCALE[across]))
    assert most[seen] == most.max() > 0
    assert widget.status.endswith(f"slice with the most such voxels: slice {seen}.")
    assert widget.status.startswith(widget.warning)


def test_deform_solves_a_volume_from_nothing(volume_beside, settle):
    person, widget = volume_beside
    person.drag((16, 16), (16, 20))
    settle(widget)
    before = widget.solution.displacement
    widget.deform()
    settle(widget)
    assert np.abs(widget.solution.displacement - before).max() < 0.02
    known = by_name(person.viewer, "MR arrows, elastic").metadata[METADATA]
    assert known["slice"] == ""


def test_a_hand_that_pulls_again_waits_for_no_volume(volume_beside, settle, qtbot):
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
    """A volume with a result, as is its middle slice, which is worked on."""
    person, widget = volume_beside
    person.drag((16, 16), (18, 18))
    widget.overlay = "magnitude"
    settle(widget)
    Screen(widget).choose("this slice")
    settle(widget)
    assert seen_of(person.viewer) <= {"slice 12"}, "nothing of it has moved"
    assert widget.result is None
    person.drag((12, 12), (12, 15))
    settle(widget)
    return person, widget


def seen_of(viewer):
    """The slices of the results of which anything is seen, "" for the volume."""
    made = [layer for layer in viewer.layers if layer.visible and "source" in metadata_of(layer)]
    return {metadata_of(layer)["slice"] for layer in made}


def kinds_seen(viewer):
    """What is seen of results."""
    return {metadata_of(layer).get("kind") for layer in viewer.layers if layer.visible} & {
        *EVERYTHING
    }


def test_of_a_volume_and_its_slice_the_result_that_is_worked_on_is_seen(both_extents, settle):
    person, widget = both_extents
    viewer = person.viewer
    for extent, where in (("slice", "slice 12"), ("volume", ""), ("slice", "slice 12")):
        widget.extent = extent
        settle(widget)
        assert seen_of(viewer) == {where}
        assert kinds_seen(viewer) == EVERYTHING
        assert metadata_of(widget.result)["slice"] == where
        widget.before = True
        assert seen_of(viewer) == set()
        widget.before = False
        widget.percent = 50
        settle(widget)
        assert seen_of(viewer) == {where}
    widget.undo()
    settle(widget)
    assert seen_of(viewer) == {""}
    assert kinds_seen(viewer) == EVERYTHING


def test_a_result_that_is_not_worked_on_is_not_shown_by_its_arrows(both_extents, settle):
    person, widget = both_extents
    viewer = person.viewer
    held = {
        metadata_of(each)["slice"]: each for each in viewer.layers if "answer" in metadata_of(each)
    }
    viewer.layers.selection.active = held[""]
    settle(widget)
    assert metadata_of(widget.result)["slice"] == "slice 12"
    assert seen_of(viewer) == {"slice 12"}


def test_what_is_seen_while_one_paints_is_the_image_as_it_was(both_extents, settle):
    person, widget = both_extents
    viewer = person.viewer
    widget.make_layers()
    settle(widget)
    widget.hand_brush(widget.boundary)
    assert seen_of(viewer) == set()
    assert widget.status == MEANWHILE


@pytest.fixture
def cancelled(volume_beside, settle, qtbot):
    """Have a volume be dragged, and cancelled as it follows what was let go."""
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


def test_a_volume_that_is_cancelled_is_seen_as_it_came_to_rest_last(cancelled, settle):
    person, widget, cancel = cancelled
    person.drag((10, 10), (11, 12))
    widget.overlay = "magnitude"
    settle(widget)
    picture = by_name(person.viewer, "MR deformed, elastic")
    before = picture.data.copy()
    cancel()
    assert np.array_equal(picture.data, before)
    assert kinds_seen(person.viewer) == EVERYTHING
    assert metadata_of(picture)["inputs_changed"]
    assert len(widget.drawing.marks) == 2
    assert widget.status.startswith("Cancelled")
    assert "do not include the last edits" in widget.status
    person.drag((20, 20), (21, 21))
    settle(widget)
    assert len(widget.drawing.marks) == 3
    assert not metadata_of(picture)["inputs_changed"]
    assert not np.array_equal(picture.data, before)


def test_a_volume_whose_first_pull_is_cancelled_is_seen_as_it_was(cancelled, settle):
    person, widget, cancel = cancelled
    cancel()
    assert kinds_seen(person.viewer) == set()
    person.drag((20, 20), (21, 21))
    settle(widget)
    assert len(widget.drawing.marks) == 2
    assert kinds_seen(person.viewer) == {"image", "arrows"}


def test_while_a_volume_is_dragged_nothing_is_said_of_an_earlier_result(
    volume_beside, settle, qtbot
):
    person, widget = volume_beside
    viewer, seen = person.viewer, []
    person.drag((16, 16), (18, 18))
    settle(widget)
    viewer.mouse_over_canvas = True
    viewer.status = "Here"
    assert "moves" in viewer.status
    widget.deformation_changed.connect(seen.append)
    person.press(8, 8)
    person.move(11, 11)
    qtbot.waitUntil(lambda: bool(seen), timeout=LONG_MS)
    assert widget.at(viewer.cursor.position) is None
    assert "moves" not in str(viewer.status)
    person.release(11, 11)
    settle(widget)
    assert widget.at(viewer.cursor.position).displacement[1:] == pytest.approx((3, 3), abs=0.3)
    viewer.status = "There"
    assert "moves" in viewer.status
