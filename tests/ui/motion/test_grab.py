"""Tests of pulling tissue with mouse and keyboard, in a window and without one."""

import numpy as np
import pytest
from npe2 import PluginManager
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from scipy import ndimage

from napari_hmrf.layers.compat import drawn_node, text_of
from napari_hmrf.layers.label_colours import DRAWN
from napari_hmrf.layers.metadata import METADATA, TISSUE, layer_metadata
from napari_hmrf.study import drag_preview
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.drawing import Arrow, Drawing
from tests.support.docks import dock_in
from tests.support.long_work import long_work
from tests.support.person import CTRL, SHIFT, by_name, only
from tests.support.pulling import pull
from tests.support.screen import Cell, Screen
from tests.support.timeouts import LONG_MS

#: Omits napari's controls of layers, which have no effect on these tests.
bare = pytest.mark.usefixtures("without_controls")


@bare
def test_tissue_follows_the_mouse_on_the_canvas_and_space_moves_the_view(pulling, settle, qtbot):
    person, widget = pulling
    still = by_name(person.viewer, "MR deformed, elastic").data.copy()
    corner = person.where(0, 0)
    seen, drawn = [], []
    widget.deformation_changed.connect(seen.append)
    widget.result_drawn.connect(drawn.append)
    person.press(30, 30)
    for step in range(1, 5):
        person.move(30 + step / 2, 30 + step)
        qtbot.waitUntil(lambda step=step: len(seen) >= step, timeout=LONG_MS)
    assert widget.session.drawing_in_progress, "the drag ended before the button was released"
    moved = by_name(person.viewer, "MR deformed, elastic").data
    assert (moved != still).mean() > 0.05
    person.release(32, 34)
    settle(widget)
    assert person.where(0, 0) == corner, "the drag moved the view"
    arrow = only(widget)
    assert arrow.at == pytest.approx((30, 30), abs=0.6)
    assert arrow.by == pytest.approx((2, 4), abs=0.6)
    field = seen[-1].solution.displacement
    at = tuple(round(along) for along in arrow.at)
    assert field[at] == pytest.approx(arrow.by, abs=0.02)
    assert not field[0].any(), "the edge moved"
    assert 0.2 < np.linalg.norm(field[20, 20]) < 4
    assert np.array_equal(drawn[-1].solution.displacement, field)
    layer = person.viewer.layers.selection.active
    assert layer.name == "Motion"
    assert by_name(person.viewer, "MR arrows, elastic").metadata[METADATA]["solution"] is not None
    assert widget.session.next_undo.word == "pulled tissue"
    assert not layer.mouse_pan
    QTest.keyPress(person.canvas, Qt.Key.Key_Space)
    assert layer.mouse_pan
    person.drag((50, 50), (54, 54))
    QTest.keyRelease(person.canvas, Qt.Key.Key_Space)
    assert person.where(0, 0) != corner, "the view did not move"
    assert not layer.mouse_pan
    assert len(widget.drawing.marks) == 1
    assert layer.cursor == "circle"
    assert layer.cursor_size == pytest.approx(2 * widget.fields.radius.value)


@bare
def test_marks_have_a_dark_outline_and_fade_while_the_mouse_is_outside_the_canvas(
    open_window, settle
):
    person, widget = open_window(np.full((64, 64), 255, np.uint8))
    viewer = person.viewer
    pull(widget, settle)
    person.drag((44, 40), (44, 45))
    settle(widget)
    widget.tool = "pin"
    person.paint((20, 20), (20, 26))
    settle(widget)
    names = "Motion", "Motion, painted"

    def opacities():
        return [drawn_node(viewer, by_name(viewer, name)).opacity for name in names]

    viewer.mouse_over_canvas = True
    assert opacities() == [1, 1]
    viewer.mouse_over_canvas = False  # as napari does when the mouse leaves
    assert opacities() == pytest.approx([0.2, 0.2])
    assert [by_name(viewer, name).opacity for name in names] == [1, 1], "a setting was changed"
    widget.undo()
    settle(widget)
    widget.redo()
    settle(widget)
    assert opacities() == pytest.approx([0.2, 0.2]), "new layers of marks do not fade"
    viewer.mouse_over_canvas = True
    assert opacities() == [1, 1]
    mesh, one = drawn_node(viewer, by_name(viewer, "Motion")), np.zeros((3, 4), np.float32)
    assert mesh._build_color_transform(one) is mesh._build_color_transform(one + 1), (
        "each drag compiles the program of the arrows again"
    )
    person.key(Qt.Key.Key_Escape)
    person.key(Qt.Key.Key_G)
    settle(widget)
    for layer in viewer.layers:
        layer.visible = layer.name in ("MR", "Motion")
    shot = viewer.screenshot(canvas_only=True, flash=False)[..., :3].astype(int)
    blue = np.abs(shot - 255 * np.array(DRAWN[:3])).max(axis=-1) < 30
    near = ndimage.binary_dilation(blue, iterations=3) & ~blue
    assert (shot[near].max(axis=-1) < 100).mean() > 0.2, "bright tissue touches the arrow"


def test_the_distance_of_a_drag_is_shown_until_its_result_is_drawn(open_beside, settle):
    person, widget = open_beside(scale=(0.5, 0.5), units=("mm", "mm"))
    screen = Screen(pull(widget, settle))
    person.press(15, 15)
    assert "Pulling" not in screen.words
    person.move(15, 16)
    settle(widget)
    assert "Pulling 1 mm" in screen.words
    person.move(16.5, 17)
    settle(widget)
    assert "Pulling 2.5 mm" in screen.words
    person.release(16.5, 17)
    settle(widget)
    assert "100 %: tissue moved up to 2.5 mm" in screen.words
    person.press(16.5, 17)
    person.move(18, 19)
    settle(widget)
    assert "Pulling 5 mm" in screen.words
    assert "moved up to" not in screen.words
    person.key(Qt.Key.Key_Escape)
    assert "moved up to 2.5 mm" in screen.words
    assert "Pulling" not in screen.words


def test_an_arrow_is_dragged_by_its_head_or_its_base(pulling_beside, settle):
    person, widget = pulling_beside
    person.drag((30, 30), (34, 34), (36, 36))
    settle(widget)
    person.drag((36, 36), (36, 40))
    assert only(widget).by == pytest.approx((6, 10), abs=0.8)
    person.drag((30, 30), (28, 30))
    assert only(widget).at == pytest.approx((28, 30), abs=0.6)
    assert only(widget).by == pytest.approx((8, 10), abs=0.8)


def test_a_drag_on_moved_tissue_pulls_the_displayed_tissue(pulling_beside, settle):
    person, widget = pulling_beside
    person.drag((30, 30), (36, 36))
    settle(widget)
    person.drag((40, 44), (40, 44))
    settle(widget)
    held = widget.drawing.marks[1]
    assert held.at[0] < 39.5, "the arrow does not start at the origin of the tissue, further up"
    assert np.add(held.at, held.by) == pytest.approx((40, 44), abs=0.6)
    assert widget.session.next_undo.word == "held tissue"


def test_a_click_beside_the_fixed_edge_moves_no_tissue(pulling_beside, settle):
    person, widget = pulling_beside
    person.drag((30, 14), (30, 22))
    settle(widget)
    before = widget.solution.displacement
    person.key(Qt.Key.Key_Escape)  # so that the new radius does not change the arrow
    widget.fields.radius.value = 8.0
    place = 30, 6 + before[30, 6, 1]
    person.drag(place, place)
    settle(widget)
    held = widget.drawing.marks[1]
    assert np.ptp(before[26:35, 0:11, 1]) > 2, "the tissue at the edge moves as a block"
    assert widget.solution.displacement == pytest.approx(before, abs=0.03)
    assert "folds" not in widget.warning
    widget.fields.confidence.value = 0.9
    assert widget.drawing.marks[1].motion == held.motion
    person.drag(place, (32, place[1]))
    assert widget.drawing.marks[1].motion is None, "a dragged patch does not move as a block"


def test_a_pull_into_held_tissue_reports_folds_and_their_cause(pulling_beside, settle):
    person, widget = pulling_beside
    widget.unfolds = False
    person.drag((30, 36))
    settle(widget)
    person.drag((30, 30), (30, 42))
    settle(widget)
    assert "folds: show" in Screen(widget).button("⚠").text()
    assert "tissue that is held or moved in two different ways touches" in widget.warning
    assert widget.warning.count("folds over itself") == 1
    widget.undo()
    person.drag((30, 18), (30, 21))
    settle(widget)
    assert not widget.warning


def test_a_large_image_has_larger_pixels_during_a_drag(pulling_beside, settle, monkeypatch):
    person, widget = pulling_beside
    monkeypatch.setattr(drag_preview, "_IMAGES", {"elastic": (0, 500)})
    monkeypatch.setattr(drag_preview, "_PICTURE", 1100)
    picture = by_name(person.viewer, "MR deformed, elastic")
    before, extent = picture.data, picture.extent.world
    person.press(30, 30)
    for col in (33, 36):
        person.move(30, col)
        settle(widget)
        assert picture.data.shape == (32, 32)
        assert picture.scale == pytest.approx((2, 2))
        assert np.abs(picture.extent.world - extent).max() <= 1
        assert (picture.data != before[::2, ::2]).mean() > 0.05
    person.release(30, 36)
    settle(widget)
    assert picture.data.shape == (64, 64)
    assert picture.scale == pytest.approx((1, 1))
    assert widget.solution.displacement[30, 30] == pytest.approx((0, 6), abs=0.02)


def test_escape_cancels_a_drag(pulling_beside):
    person, widget = pulling_beside
    person.press(30, 30)
    person.move(35, 35)
    assert widget.drawing.marks
    person.key(Qt.Key.Key_Escape)
    person.move(40, 40)
    person.release(40, 40)
    assert (widget.drawing, widget.session.next_undo) == (Drawing(), None)
    assert widget.status == "Cancelled; the drawing is unchanged."


def test_activating_another_layer_pauses_the_tool(pulling_beside):
    person, widget = pulling_beside
    person.viewer.layers.selection.active = by_name(person.viewer, "MR")
    assert not widget.active
    assert not Screen(widget).button("Pull").isChecked()
    assert "To continue drawing" in widget.status
    person.drag((30, 30), (34, 34))
    assert not widget.drawing.marks
    Screen(widget).press("Pull")
    assert widget.active


def test_an_active_labels_layer_has_its_own_undo(pulling_beside):
    person, widget = pulling_beside
    person.drag((30, 30), (34, 34))
    labels = person.viewer.add_labels(np.zeros((64, 64), np.uint8), name="paint")
    labels.paint((10, 10), 3)
    assert labels.data.any()
    person.key(Qt.Key.Key_Z, CTRL)
    assert not labels.data.any()
    assert widget.drawing.marks, "undo of the labels removed a mark"
    person.viewer.layers.selection.active = by_name(person.viewer, "MR")
    person.key(Qt.Key.Key_Z, CTRL)
    assert not widget.drawing.marks, "undo with an active image did not remove the mark"


def test_fields_change_the_selected_arrow_and_new_arrows(pulling_beside, settle):
    person, widget = pulling_beside
    fields, screen = widget.fields, Screen(widget)
    fields.components.value = "row"
    person.drag((30, 30), (34, 36))
    assert only(widget).by == pytest.approx((4, 0), abs=0.6)
    fields.radius.value = 6.0
    fields.confidence.value = 0.5
    assert (only(widget).radius, only(widget).confidence) == (6.0, 0.5)
    screen.press("Undo")
    assert only(widget).confidence == 1.0
    settle(widget)
    person.drag((10, 10), (10, 10))
    assert widget.drawing.marks[1].radius == 6.0
    screen.entry("Clear", "Remove all").trigger()
    assert widget.drawing == Drawing()
    assert not screen.entry("Clear", "Remove all").isEnabled()


def test_the_motion_layer_removed_during_a_drag_is_restored(pulling_beside, settle):
    person, widget = pulling_beside
    person.press(30, 30)
    person.move(34, 34)
    person.viewer.layers.remove("Motion")
    person.move(40, 40)
    person.release(40, 40)
    assert only(widget).by == pytest.approx((4, 4), abs=0.6)
    assert not widget.session.drawing_in_progress
    assert not widget.active
    assert "was deleted" in widget.status
    settle(widget)
    Screen(widget).press("Pull")
    assert len(by_name(person.viewer, "Motion").data) > 10


def test_removing_the_image_ends_a_drag(pulling_beside, at_rest):
    person, widget = pulling_beside
    person.press(30, 30)
    person.move(34, 34)
    person.viewer.layers.remove("MR")
    person.move(40, 40)
    person.release(40, 40)
    at_rest()
    assert widget.image is None
    assert not widget.drawing.marks
    assert widget.status.startswith("'MR' was deleted. Its drawing is kept")
    assert "Motion" not in person.viewer.layers, "no dock would respond to it"
    assert not Screen(widget).button("Undo").isEnabled()


def test_renaming_or_removing_result_layers_does_not_interrupt_a_drag(
    pulling_beside, settle, wait_for
):
    person, widget = pulling_beside
    person.press(30, 30)
    person.move(32, 32)
    wait_for(lambda: not widget.busy)
    by_name(person.viewer, "MR").name = "T1"
    by_name(person.viewer, "Motion").name = "mine"
    person.viewer.layers.remove("MR deformed, elastic")
    person.move(34, 34)
    person.release(34, 34)
    settle(widget)
    assert only(widget).by == pytest.approx((4, 4), abs=0.6)
    assert "T1 deformed, elastic" in person.viewer.layers, (
        "the result was not made again with the new name"
    )
    assert by_name(person.viewer, "mine") is person.viewer.layers.selection.active


def test_another_image_on_the_same_pixels_has_its_own_result(pulling_beside, settle):
    person, widget = pulling_beside
    person.drag((30, 30), (33, 33))
    settle(widget)
    moved = by_name(person.viewer, "MR deformed, elastic")
    before = moved.data.copy()
    dark = (by_name(person.viewer, "MR").data // 8).astype(np.uint8)
    other = person.viewer.add_image(dark, name="CT", colormap="magma", contrast_limits=(0, 30))
    widget.image = other
    settle(widget)
    widget.start()
    person.drag((20, 20), (22, 22))
    settle(widget)
    shown = by_name(person.viewer, "CT deformed, elastic")
    assert shown.metadata[METADATA]["source"] == "CT"
    assert (shown.colormap.name, shown.contrast_limits) == ("magma", [0, 30])
    shown.gamma = 0.7
    person.drag((40, 40), (42, 42))
    settle(widget)
    assert shown.gamma == 0.7, "the user's gamma was reset"
    assert np.array_equal(moved.data, before), "the result of the other image changed"


def test_each_slice_has_its_own_drawing(open_beside, settle, at_rest):
    stack = np.random.default_rng(0).integers(50, 200, (3, 48, 64)).astype(np.uint8)
    person, widget = open_beside(stack, scale=(5, 1, 1))
    viewer = person.viewer
    viewer.dims.set_current_step(0, 1)
    widget.start()
    settle(widget)
    person.press(20, 30)
    person.move(24, 30)
    viewer.dims.set_current_step(0, 2)
    person.move(30, 30)
    person.release(30, 30)
    settle(widget)
    assert not widget.drawing.marks, "the drawing of another slice is shown"
    assert by_name(viewer, "Motion").data.shape[0] == 0
    here = by_name(viewer, "MR deformed, elastic (slice 2)").metadata[METADATA]["slice"]
    assert by_name(viewer, "Motion").metadata[METADATA]["slice"] == here
    viewer.dims.set_current_step(0, 1)
    settle(widget)
    assert only(widget).by == pytest.approx((4, 0), abs=0.6), "the drag continued on another slice"
    assert (by_name(viewer, "Motion").data[:, 0, 0] == 1).all()
    assert by_name(viewer, "MR deformed, elastic (slice 1)").data.shape == (1, 48, 64)
    assert "MR deformed, elastic (slice 2)" not in viewer.layers, (
        "a slice without motion has a result"
    )
    how = widget.status
    viewer.dims.ndisplay = 3
    at_rest()
    assert "only on a whole volume" in widget.status
    viewer.dims.ndisplay = 2
    settle(widget)
    assert (widget.status, len(widget.drawing.marks)) == (how, 1)


def test_the_tool_is_restored_after_three_dimensional_display_without_a_drawing(
    pulling_beside, qtbot, at_rest
):
    person, widget = pulling_beside
    person.viewer.dims.ndisplay = 3
    at_rest()
    assert "only in the 2D view" in widget.status
    person.viewer.dims.ndisplay = 2
    qtbot.waitUntil(lambda: widget.active, timeout=LONG_MS)


def test_void_cannot_be_pulled(open_beside, settle):
    person, widget = open_beside()
    labels = np.zeros((64, 64), np.uint8)
    labels[10:50, 10:50] = 1
    materials = (Material(0, "air", 0.0), Material(1, "gel", 20.0))
    person.viewer.add_labels(labels, name="T", metadata=layer_metadata(TISSUE, materials, "kPa"))
    assert widget.tissue is by_name(person.viewer, "T")
    assert widget.start()
    settle(widget)
    person.drag((58, 58), (50, 50))
    assert not widget.drawing.marks
    assert "no tissue" in widget.status
    person.drag((30, 30), (33, 30))
    settle(widget)
    assert only(widget).by[0] == pytest.approx(3, abs=0.6)


@bare
def test_closing_a_window_during_a_drag_raises_no_error(pulling, at_rest):
    person, _ = pulling
    person.press(30, 30)
    person.move(34, 34)
    person.viewer.close()
    at_rest()


@bare
def test_closing_the_dock_during_a_solve_removes_its_layers_and_a_new_dock_restores_them(
    pulling, settle, at_rest
):
    person, widget = pulling
    layers, window = person.viewer.layers, person.viewer.window
    widget.tool = "pin"
    person.paint((20, 20), (20, 26))
    settle(widget)
    told = []
    widget.deformation_changed.connect(told.append)
    with long_work():
        widget.tool = "pull"
        person.drag((40, 30), (44, 34))
        drawn = widget.drawing
        window.remove_dock_widget(widget.native)
        assert not {"Motion", "Motion, painted"} & {layer.name for layer in layers}
        assert not text_of(person.viewer).visible
        at_rest(thread=False)
    at_rest()
    person.key(Qt.Key.Key_Z, CTRL)
    again = dock_in(person.viewer)
    assert again is not widget
    if not again.active:
        assert again.start()
    settle(again)
    assert again.drawing == drawn
    assert len(drawn.marks) == 2
    assert len(by_name(person.viewer, "Motion").data) > 10
    names = [layer.name for layer in layers]
    assert sum("deformed" in name for name in names) == 1
    assert not any("[1]" in name for name in names)
    person.key(Qt.Key.Key_Z, CTRL)
    assert len(again.drawing.marks) == 1
    assert not told, "the closed dock followed an edit"


def test_a_script_draws_without_a_mouse(open_beside, settle):
    person, widget = open_beside()
    seen = []
    widget.deformation_changed.connect(seen.append)
    assert widget.start()
    widget.drawing = Drawing((Arrow((30, 30), (3, -3), 5.0),))
    settle(widget)
    assert seen[-1].solution.displacement[30, 30] == pytest.approx((3, -3), abs=0.02)
    kept = by_name(person.viewer, "Motion").metadata[METADATA]["drawing"]
    assert kept == widget.drawing
    solution = by_name(person.viewer, "MR arrows, elastic").metadata[METADATA]["solution"]
    assert Drawing.from_dict(solution.frame["drawing"]) == widget.drawing


def test_a_sample_selects_its_tissue_and_hides_its_paint(open_beside, settle):
    person, widget = open_beside()
    person.viewer.layers.clear()
    PluginManager.instance().discover()  # A window discovers plugins at its start.
    person.viewer.open_sample("napari-hmrf", "mass-effect")
    layers = person.viewer.layers
    assert (widget.image, widget.tissue) == (layers["Brain"], layers["Tissue"])
    assert widget.start()
    assert not layers["Tissue"].visible
    assert not layers["Boundary"].visible
    settle(widget)
    assert "Tissue hidden while pulling: 'Tissue', 'Boundary'." in widget.status
    widget.boundary = layers["Boundary"]
    settle(widget)
    painted = layers["Boundary"].data == 2
    seen = []
    widget.deformation_changed.connect(seen.append)
    widget.drawing = Drawing((Arrow((60, 100), (2, 0), 8.0),))
    settle(widget)
    field = seen[-1].solution.displacement
    assert field[60, 100] == pytest.approx((2, 0), abs=0.02)
    assert np.linalg.norm(field[painted], axis=-1).min() > 1, "the painted boundary does not move"


def test_each_tool_has_a_button_a_key_and_a_name_on_the_canvas(pulling_beside, settle):
    person, widget = pulling_beside
    screen, badge = Screen(widget), text_of(person.viewer)
    assert (widget.tool, badge.text, badge.visible) == ("pull", "Pull: drag tissue here", True)
    screen.press("Hold")
    assert (widget.tool, badge.text) == ("pin", "Hold")
    assert screen.button("Hold").isChecked()
    assert not screen.button("Pull").isChecked()
    person.key(Qt.Key.Key_L)
    assert (widget.tool, badge.text) == ("landmark", "Landmark")
    person.key(Qt.Key.Key_M)
    assert widget.fields.by_row.native.isVisibleTo(widget.native)
    assert not widget.fields.amount.native.isVisibleTo(widget.native)
    widget.stop()
    assert not badge.visible
    with pytest.raises(ValueError, match="unknown tool 'saw'"):
        widget.tool = "saw"


def test_undo_of_an_edit_on_another_slice_shows_that_slice(open_beside, settle):
    stack = np.random.default_rng(0).integers(50, 200, (3, 48, 64)).astype(np.uint8)
    person, widget = open_beside(stack, scale=(5, 1, 1))
    viewer = person.viewer
    viewer.dims.set_current_step(0, 1)
    widget.start()
    settle(widget)
    person.drag((20, 30), (24, 30))
    viewer.dims.set_current_step(0, 2)
    settle(widget)
    person.drag((20, 40), (20, 44))
    settle(widget)
    person.key(Qt.Key.Key_Z, CTRL)
    assert not widget.drawing.marks
    assert Screen(widget).button("Undo").toolTip() == "Undo: pulled tissue (Ctrl+Z)"
    person.key(Qt.Key.Key_Z, CTRL)
    settle(widget)
    assert viewer.dims.current_step[0] == 1, "the slice of the edit is not displayed"
    assert not widget.drawing.marks
    assert widget.status == "Undid: pulled tissue."
    assert not Screen(widget).button("Undo").isEnabled()
    person.key(Qt.Key.Key_Z, CTRL | SHIFT)
    assert only(widget).by == pytest.approx((4, 0), abs=0.6)
    person.key(Qt.Key.Key_Z, CTRL | SHIFT)
    settle(widget)
    assert viewer.dims.current_step[0] == 2
    assert only(widget).by == pytest.approx((0, 4), abs=0.6)


@bare
def test_undo_keys_work_on_the_canvas_in_the_dock_and_in_its_fields(pulling, small_sample):
    person, widget = pulling
    labels = person.viewer.add_labels(np.zeros((64, 64), np.uint8), name="paint")
    person.viewer.layers.selection.active = by_name(person.viewer, "Motion")
    person.drag((30, 30), (34, 34))
    drawn = widget.drawing
    person.key(Qt.Key.Key_Z, CTRL)
    assert widget.drawing == Drawing()
    person.key(Qt.Key.Key_Z, CTRL | SHIFT)
    assert widget.drawing == drawn
    labels.paint((10, 10), 3)
    person.viewer.layers.selection.active = labels
    box = Screen(widget).button("Pull")
    box.setFocus()
    QTest.keyClick(box, Qt.Key.Key_Z, CTRL)
    assert widget.drawing == Drawing()
    assert labels.data.any(), "undo removed paint of napari"
    QTest.keyClick(box, Qt.Key.Key_Z, CTRL | SHIFT)
    assert widget.drawing == drawn
    person.viewer.layers.selection.active = by_name(person.viewer, "Motion")
    field = widget.fields.radius.native
    person.pick(34, 34)
    before = widget.drawing
    field.setFocus()
    QTest.keyClicks(field, "1")
    QTest.keyClick(field, Qt.Key.Key_Z, CTRL)
    assert widget.drawing == before, "undo of the text changed the drawing"
    QTest.keyClick(field, Qt.Key.Key_Return)
    accepted = widget.drawing
    QTest.keyClick(field, Qt.Key.Key_Z, CTRL)
    assert widget.drawing != accepted
    small_sample(person.viewer, (64, 64))
    widget.tissue = by_name(person.viewer, "Tissue")
    materials, table = widget.materials, widget._form.tissue.table
    Cell(table, 1, 2).write("33")
    QTest.keyClick(table, Qt.Key.Key_Z, CTRL)
    assert widget.materials == materials
    QTest.keyClick(table, Qt.Key.Key_Z, CTRL | SHIFT)
    assert widget.materials[1].stiffness == 33
    person.key(Qt.Key.Key_Y, CTRL)
    assert person.viewer.dims.ndisplay == 3, "a key of napari has another action"
    person.viewer.dims.ndisplay = 2


@bare
def test_keys_of_tools_work_after_a_choice_from_a_menu(pulling, settle):
    person, widget = pulling
    person.drag((30, 30), (34, 34))
    settle(widget)
    window, radius = widget.native.window().windowHandle(), widget.fields.radius
    widget.make_layers()
    assert widget.start()
    settle(widget)
    for entry in ("grid", "moves"):
        person.key(Qt.Key.Key_BracketLeft)
        Screen(widget).pick(entry)
        settle(widget)
        before = radius.value
        QTest.keyClick(window, Qt.Key.Key_BracketRight)
        assert radius.value > before, entry
    assert widget.overlay == "grid"
    assert widget.rules[0].action == "move"
    QTest.keyClick(window, Qt.Key.Key_M)
    assert widget.tool == "move"


@pytest.mark.usefixtures("new_dock")
def test_the_drawing_is_scaled_with_a_new_unit_of_the_image(pulling_beside, settle):
    person, widget = pulling_beside
    person.drag((30, 30), (32, 32))
    settle(widget)
    image = widget.image
    image.scale = (0.5, 0.5)
    image.units = ("mm", "mm")
    settle(widget)
    for name in ("Motion", "MR deformed, elastic", "MR arrows, elastic"):
        layer = by_name(person.viewer, name)
        assert layer.units == image.units
        np.testing.assert_array_equal(layer.scale, image.scale)
    assert "mm" in widget.fields.radius.label


def test_a_drag_may_start_at_any_edge_of_the_image(pulling_beside, settle):
    person, widget = pulling_beside
    widget.hold_edge = False
    widget.fields.radius.value = 12.0
    rows, cols = widget.image.data.shape
    for place in ((3, 30), (30, cols - 4), (rows - 4, 3)):
        settle(widget)
        before = len(widget.drawing.marks)
        person.press(*place)
        person.move(place[0] + 1.5, place[1] + 3)
        settle(widget)
        person.release(place[0] + 3, place[1] + 6)
        assert len(widget.drawing.marks) == before + 1
        assert widget.drawing.marks[-1].by == pytest.approx((3, 6), abs=0.8)
        widget.clear()


def test_the_edge_of_the_tissue_is_fixed_unless_the_option_is_off(pulling_beside, settle):
    _, widget = pulling_beside
    widget.drawing = Drawing((Arrow((32, 40), (0, 4), 4.0), Arrow((10, 10), (0, 0), 2.0)))
    settle(widget)
    assert np.abs(widget.solution.displacement[32, -1]).max() < 1e-6
    Screen(widget).tick("Fix outer edge", False)
    settle(widget)
    assert widget.solution.displacement[32, -1, 1] > 1


def test_air_cannot_be_pulled_and_does_not_fold(open_beside, settle):
    rows, cols = np.indices((96, 96))
    noise = np.random.default_rng(0).integers(0, 6, (96, 96))
    disc = np.hypot(rows - 48, cols - 48) < 26
    person, widget = open_beside((noise + 150 * disc).astype(np.uint8))
    assert widget.start()
    settle(widget)
    person.drag((10, 48), (20, 48))
    assert widget.status == "There is no tissue at this point."
    assert not widget.drawing.marks
    widget.hold_edge = False
    # Air is compressed between the body and the image edge without a warning.
    widget.drawing = Drawing((Arrow((48, 48), (0, 30), 20.0), Arrow((90, 90), (0, 0), 2.0)))
    settle(widget)
    assert "folds" not in widget.warning
    solution = by_name(person.viewer, "MR arrows, elastic").metadata[METADATA]["solution"]
    assert np.array_equal(solution.tissue, disc)
    assert not solution.displacement[~disc].any()


def test_a_message_about_three_dimensions_is_cleared_in_two_dimensions(
    open_beside, at_rest, settle
):
    person, widget = open_beside()
    settle(widget)
    person.viewer.dims.ndisplay = 3
    assert not widget.start()
    assert "only in the 2D view" in widget.status
    person.viewer.dims.ndisplay = 2
    at_rest()
    assert widget.status == widget.invitation
    assert "rag tissue" in widget.status


def test_the_status_tells_whether_the_tool_is_active(pulling_beside, settle):
    person, widget = pulling_beside
    how = widget.status
    person.drag((30, 30), (34, 34))
    settle(widget)
    layers = person.viewer.layers
    layers.selection.active = layers["MR"]
    assert "To continue drawing" in widget.status
    person.key(Qt.Key.Key_Z, CTRL)
    assert widget.status.startswith("Undid: pulled tissue. To continue drawing")
    layers.selection.active = layers["Motion"]
    layers.selection.active = layers["MR"]
    assert widget.status.startswith("To continue drawing")
    layers.selection.active = layers["Motion"]
    assert (widget.active, widget.status) == (True, how)
    layers["Motion"].visible = False
    person.drag((20, 20), (22, 22))
    assert "click the eye icon of the layer 'Motion'" in widget.status


def test_a_warning_reports_air_labelled_as_tissue(open_beside, settle):
    rows, cols = np.indices((64, 64))
    disc = np.hypot(rows - 32, cols - 32) < 18
    person, widget = open_beside((150 * disc).astype(np.uint8))
    widget.without_border = False
    labels = person.viewer.add_labels(np.zeros((64, 64), np.uint8), name="T")
    labels.metadata.update(layer_metadata(TISSUE, (Material(0, "unpainted", 1.0),), "kPa"))
    for tissue, speaks in ((labels, True), (None, False)):
        widget.tissue = tissue
        assert widget.start()
        widget.drawing = Drawing((Arrow((32, 32), (3, -3), 5.0),))
        settle(widget)
        assert ("dark surroundings" in widget.warning) == speaks
