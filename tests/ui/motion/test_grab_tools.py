"""Tests of brushes and landmarks with mouse and keyboard, in a window and without one."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest

from napari_hmrf import Cavity
from napari_hmrf.errors import HmrfError
from napari_hmrf.field.deformation import jacobian_determinant
from napari_hmrf.layers.compat import camera_of, text_of
from napari_hmrf.layers.label_colours import SELECTED
from napari_hmrf.layers.metadata import TISSUE, layer_metadata, metadata_of
from napari_hmrf.layers.paint_layer import number_of
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Stroke
from napari_hmrf.tissue.material_presets import PRESETS
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.motion import pointer
from napari_hmrf.ui.motion.motion_messages import NO_WAY, OPEN, OUTSIDE
from napari_hmrf.ui.motion.tool import Tool
from napari_hmrf.ui.motion.tools import BY_NAME
from tests.support.docks import dock_in, quick
from tests.support.person import CTRL, SHIFT, Person, by_name, only
from tests.support.screen import Screen
from tests.support.timeouts import LONG_MS

PIN, FREE, MOVE, EXPAND = Qt.Key.Key_P, Qt.Key.Key_F, Qt.Key.Key_M, Qt.Key.Key_E
CONFIDENCE, MATERIAL, LANDMARK = Qt.Key.Key_C, Qt.Key.Key_T, Qt.Key.Key_L

#: Omits napari's controls of layers, which `test_grab` tests.
pytestmark = pytest.mark.usefixtures("without_controls")


def displacement(widget):
    """Return the displacement field of the displayed tissue."""
    return widget._pointer.display.moved.solution.displacement


class Notes(Tool):
    """Tool that records pointer positions without drawing a mark."""

    name, title, key, fields, hint = "notes", "Notes", "N", ("softness",), "Click a place."

    @classmethod
    def makes(cls, mark):
        return False

    def press(self, point, reach, settings, origin=None):
        self.places, self.settings = [tuple(map(round, point))], settings
        return "Noted."

    def move(self, point):
        self.places.append(tuple(map(round, point)))

    def cursor(self, settings):
        return None

    def _changed(self, settings):
        return None


def displayed_paint(person):
    """Return the image of painted strokes, or zeros if there is no layer of strokes."""
    layers = person.viewer.layers
    return layers["Motion, painted"].data if "Motion, painted" in layers else np.zeros((64, 64))


def ring(middle, radius, count=16):
    turn = np.linspace(0, 2 * np.pi, count + 1)
    rows, cols = middle[0] + radius * np.sin(turn), middle[1] + radius * np.cos(turn)
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def outward(widget):
    """Return the mean outward displacement of a ring of radius 12 around the centre."""
    places = ring((32, 32), 12)
    moved = [displacement(widget)[round(row), round(col)] for row, col in places]
    normals = (np.array(places) - 32) / 12
    return (np.array(moved) * normals).sum(axis=1).mean()


@pytest.fixture
def brushing_beside(pulling_beside, settle):
    """Return a simulated user and the dock with a narrow brush and a wide patch that is pulled."""
    person, widget = pulling_beside
    widget.drawing = Drawing((Arrow((44, 40), (0, 5), 6.0),))
    widget.fields.radius.value = 3.0
    settle(widget)
    return person, widget


def test_paint_is_displayed_before_the_solve(brushing_beside, busy_thread, qtbot):
    person, _ = brushing_beside
    person.key(PIN)
    person.press(20, 20)
    assert displayed_paint(person)[20, 20] == number_of("pin"), "paint is not displayed at once"
    person.move(20, 36)
    qtbot.waitUntil(lambda: displayed_paint(person)[20, 28] == number_of("pin"), timeout=LONG_MS)
    assert not busy_thread.is_set()
    person.release(20, 36)


def test_pinned_tissue_does_not_move(brushing_beside, settle):
    person, widget = brushing_beside
    before = displacement(widget)[20, 30]
    assert np.linalg.norm(before) > 0.3
    person.key(PIN)
    person.press(20, 20)
    person.move(20, 36)
    person.release(20, 36)
    settle(widget)
    assert displacement(widget)[20, 22:35] == pytest.approx(0, abs=0.02)
    assert displayed_paint(person)[20, 28] == number_of("pin")
    assert displayed_paint(person)[26, 28] == 0
    assert widget.session.next_undo.word == "held tissue"


def test_freed_tissue_is_unconstrained(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(FREE)
    widget.fields.radius.value = 9.0
    person.paint((44, 40), (44, 46))
    settle(widget)
    assert np.abs(displacement(widget)).max() < 0.02, "the arrow still has an effect"
    assert set(np.unique(displayed_paint(person))) == {0, number_of("free")}, (
        "the region is not drawn with stripes"
    )


def test_a_moved_region_moves_tissue_and_is_drawn_at_its_target(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(MOVE)
    widget.fields.by_row.value = -4.0
    person.paint((20, 20), (20, 26))
    settle(widget)
    assert displacement(widget)[20, 22] == pytest.approx((-4, 0), abs=0.02)
    assert displayed_paint(person)[16, 22] == number_of("move")
    assert displayed_paint(person)[22, 22] == 0, "the region is still drawn at its origin"
    widget.fields.by_row.value = 2.0
    settle(widget)
    assert displacement(widget)[20, 22] == pytest.approx((2, 0), abs=0.02), (
        "the field did not change the last stroke"
    )


def test_a_stroke_on_the_surface_lets_tissue_slide(pulling_beside, settle):
    person, widget = pulling_beside
    widget.hold_edge = True
    widget.drawing = Drawing((Arrow((10, 10), (4, 0), 4),))
    person.key(Qt.Key.Key_S)
    widget.fields.radius.value = 2.0
    person.paint((4, 0), (10, 0), (28, 0))
    settle(widget)
    assert widget.drawing.marks[-1].action == "slide"
    slid = displacement(widget)
    assert slid[10, 0, 0] > 1
    assert np.abs(slid[6:28, 0, 1]).max() < 0.05


def test_a_stroke_removes_tissue_in_one_step_and_suction_closes_the_cavity(pulling_beside, settle):
    person, widget = pulling_beside
    widget.hold_edge, widget.drawing, widget.cavity = True, Drawing(), Cavity(pressure=-0.05)
    person.key(Qt.Key.Key_R)
    widget.fields.radius.value = 6.0
    person.paint((32, 28), (32, 36))
    settle(widget)
    (stroke,) = widget.drawing.marks
    assert stroke.action == "remove"
    assert widget.solution.removed[32, 29:36].all()
    assert not widget.solution.tissue[32, 29:36].any()
    assert displacement(widget)[24, 32, 0] > 0.1
    assert displacement(widget)[40, 32, 0] < -0.1
    lines = person.viewer.layers["Motion"]
    starts = lines.data[np.isclose(lines.edge_color, SELECTED).all(axis=1), 0, -2:]
    away = [np.hypot(*(starts - end).T) for end in ((32, 28), (32, 36))]
    on_path = starts[:, 0] == 32
    assert (np.isclose(away, 6.0, atol=0.1).any(axis=0) | on_path).all(), "the paint has moved"
    assert len(starts) > 20


def test_a_ring_expands_or_shrinks(brushing_beside, settle):
    person, widget = brushing_beside
    widget.drawing = Drawing()
    settle(widget)
    person.key(EXPAND)
    widget.fields.amount.value = 2.0
    person.paint(*ring((32, 32), 12))
    settle(widget)
    assert outward(widget) == pytest.approx(2, abs=0.2)
    widget.fields.amount.value = -2.0
    settle(widget)
    assert outward(widget) == pytest.approx(-2, abs=0.2)


def test_a_patch_grows_without_a_tear(pulling_beside, settle):
    person, widget = pulling_beside
    amount = 2.0
    widget.fields.radius.value = 10.0
    person.key(EXPAND)
    widget.fields.amount.value = amount
    person.paint((32, 32), (32, 33))
    settle(widget)
    area = jacobian_determinant(displacement(widget), spacing=1)
    assert area[26:39, 26:40] == pytest.approx((1 + amount / 10) ** 2, rel=0.15)
    assert not widget.warning
    assert displayed_paint(person)[32, 32], "a painted pixel is not displayed"


def test_undo_and_redo_select_a_stroke_and_show_its_settings(pulling_beside, settle):
    person, widget = pulling_beside
    person.key(EXPAND)
    amount = widget.fields.amount
    amount.value = 2.0
    person.paint((32, 32), (32, 33))
    amount.value = -1.5
    person.key(Qt.Key.Key_Z, CTRL)
    assert (only(widget).amount, amount.value) == (2.0, 2.0)
    person.key(Qt.Key.Key_Z, CTRL | SHIFT)
    assert (only(widget).amount, amount.value) == (-1.5, -1.5)
    for _ in range(2):
        person.key(Qt.Key.Key_Z, CTRL)
    assert not widget.drawing.marks
    assert not Screen(widget).entry("Clear", "Remove the selected").isEnabled()
    person.key(Qt.Key.Key_Z, CTRL | SHIFT)
    assert Screen(widget).entry("Clear", "Remove the selected").isEnabled(), (
        "the restored stroke is not selected"
    )
    amount.value = 1.0
    assert only(widget).amount == 1.0, "the field did not change the restored stroke"
    person.key(PIN)
    person.key(Qt.Key.Key_Z, CTRL)
    assert not Screen(widget).entry("Clear", "Remove the selected").isEnabled(), (
        "a stroke of another tool is selected"
    )
    settle(widget)


def test_an_open_line_shows_a_message_while_it_is_painted(pulling_beside, qtbot):
    person, widget = pulling_beside
    person.key(EXPAND)
    widget.fields.radius.value = 1.0
    widget.fields.amount.value = 2.0
    person.press(10, 30)
    said = []
    widget._pointer.message.connect(said.append)
    person.move(40, 30)
    qtbot.waitUntil(lambda: bool(said), timeout=LONG_MS)
    assert (said, widget.status) == ([OPEN], OPEN)
    person.release(40, 30)
    assert "no inside" in widget.status


def test_a_brush_outside_the_image_paints_nothing_and_does_not_change_the_fields(pulling_beside):
    person, widget = pulling_beside
    person.key(MATERIAL)
    person.paint((20, 20), (20, 26))
    before, material = widget.drawing, widget.fields.material
    material.value = 0
    person.paint((-5, 20), (20, 20))
    assert (widget.status, widget.drawing, material.value) == (OUTSIDE, before, 0)


def test_an_unfinished_ring_is_removed_by_delete(pulling_beside, settle):
    person, widget = pulling_beside
    person.key(EXPAND)
    widget.fields.radius.value = 1.0
    person.press(10, 30)
    person.move(40, 30)
    person.key(Qt.Key.Key_Delete)
    person.move(44, 30)
    person.release(44, 30)
    settle(widget)
    assert not widget.drawing.marks
    assert not widget.session.drawing_in_progress
    assert not displayed_paint(person).any()


def test_a_soft_brush_paints_confidence_over_moved_tissue(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(CONFIDENCE)
    fields = widget.fields
    fields.stroke_confidence.value, fields.softness.value, fields.radius.value = 0.0, 1.0, 5.0
    person.paint((44, 45), (44, 45))
    settle(widget)
    stroke = widget.drawing.marks[1]
    assert (stroke.action, stroke.confidence, stroke.softness) == ("confidence", 0.0, 1.0)
    sure = widget.drawing.render(widget._pointer.display.moved.ground.base).confidence[44, 40:46, 0]
    assert sure[0] == pytest.approx(0, abs=0.15)
    assert (np.diff(sure) > 0).all(), "the confidence does not increase with the distance"
    shown = by_name(person.viewer, "Confidence").data
    assert shown[44, 45] == pytest.approx(0, abs=0.2)
    assert len(np.unique(shown[shown < 1].round(3))) > 12, (
        "the displayed confidence has too few values"
    )
    assert not displayed_paint(person).any()


def test_a_stroke_of_confidence_where_nothing_is_held_or_moved_is_reported(brushing_beside, settle):
    person, widget = brushing_beside
    widget.clear()
    person.key(CONFIDENCE)
    person.paint((30, 31), (30, 33))
    settle(widget)
    assert widget.status.startswith("This stroke has no effect: the tissue under it is neither")
    person.key(PIN)
    person.paint((30, 31), (30, 33))
    person.key(CONFIDENCE)
    person.paint((30, 31), (30, 33))
    settle(widget)
    assert "no effect" not in widget.status


def test_stiffness_motion_and_confidence_are_painted_and_shown_as_layers(pulling_beside, settle):
    person, widget = pulling_beside
    viewer, fields = person.viewer, widget.fields
    fields.radius.value = 4.0
    person.key(MATERIAL)
    fields.material.value = 0
    person.paint((50, 10), (50, 20))
    settle(widget)
    assert displayed_paint(person)[50, 15] == number_of("tissue", label=0)
    person.key(MOVE)
    person.paint((30, 28), (30, 34))
    person.paint((30, 31), (26, 31))
    settle(widget)
    assert displayed_paint(person)[26, 31] == number_of("move"), (
        "the stroke is not drawn at its target"
    )
    steps = by_name(viewer, "Motion").data[:, 1]
    assert steps[:, 0].min() == pytest.approx(-4, abs=0.6), (
        "the arrows do not show the displacement"
    )
    assert "Confidence" not in viewer.layers
    person.key(CONFIDENCE)
    fields.stroke_confidence.value = 0.5
    person.paint((26, 31), (26, 31))
    settle(widget)
    confidence = by_name(viewer, "Confidence")
    assert isinstance(confidence, Image)
    assert tuple(confidence.contrast_limits) == (0, 1)
    assert confidence.colorbar.visible
    moved = displacement(widget)[30, 31, 0]
    assert confidence.data[round(30 + moved), 31] == pytest.approx(0.5, abs=0.01)
    assert confidence.data[0, 30] == 1, "the confidence of the fixed edge is not 1"
    assert confidence.data[40, 50] == 0, "an unconstrained site has a confidence"
    assert not confidence.colormap.map([0.0])[0, 3], "a confidence of 0 hides the image"
    names = [layer.name for layer in viewer.layers]
    assert names.index("Confidence") == names.index("Motion, painted") - 1
    Screen(widget).choose("area change")
    settle(widget)
    (overlay,) = (layer for layer in viewer.layers if "area change" in layer.name)
    assert overlay.colorbar.visible
    assert not confidence.visible, "two colour scales are displayed at once"
    Screen(widget).choose("none")
    settle(widget)
    assert confidence.visible


def test_a_mark_of_one_component_is_labelled_on_the_canvas_and_drawn_with_double_arrows(
    pulling_beside, settle
):
    person, widget = pulling_beside
    text, fields = text_of(person.viewer), widget.fields
    fields.components.value = "row"
    assert text.text == "Pull, up and down only"
    person.key(MOVE)
    fields.by_row.value, fields.by_col.value = 2.0, 3.0
    assert text.text == "Push 2 down, up and down only"
    fields.components.value = "col"
    person.key(PIN)
    assert text.text == "Hold, left and right only"
    fields.radius.value = 5.0

    person.paint((20, 20), (20, 40))
    person.key(Qt.Key.Key_Escape)
    settle(widget)
    steps = by_name(person.viewer, "Motion").data[:, 1]
    longest = steps[np.abs(steps).sum(axis=1) > 1]
    assert len(longest), "there are no double arrows"
    assert not longest[:, 0].any(), "a double arrow is not horizontal"
    fields.components.value = "both"
    assert text.text == "Hold"
    widget.clear()
    person.paint((20, 20), (20, 40))
    person.key(Qt.Key.Key_Escape)
    settle(widget)
    assert by_name(person.viewer, "Motion").data[:, 1].all(), "there are no crosses"


def test_the_confidence_layer_moves_with_the_tissue(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(CONFIDENCE)
    widget.fields.stroke_confidence.value, widget.fields.softness.value = 0.6, 0.0
    person.paint((44, 45), (44, 46))
    settle(widget)
    layer = by_name(person.viewer, "Confidence")
    assert layer.data[40, 42] == 1
    arrow, stroke = widget.drawing.marks
    widget.drawing = Drawing((replace(arrow, by=(-4, 2)), stroke))
    settle(widget)
    assert by_name(person.viewer, "Confidence") is layer
    assert layer.data[40, 42] == pytest.approx(0.6)
    assert set(np.unique(layer.data)) == {0, np.float32(0.6), 1}, (
        "confidence values were interpolated"
    )


def test_paint_is_displayed_at_full_motion_and_hidden_at_a_part_of_the_motion(
    brushing_beside, settle
):
    person, widget = brushing_beside
    layers = person.viewer.layers
    person.key(PIN)
    person.paint((20, 20), (20, 26))
    person.key(CONFIDENCE)
    person.paint((44, 45), (44, 46))
    settle(widget)
    paint = layers["Motion, painted"], layers["Confidence"]
    for percent, seen in ((60, False), (100, True), (0, False)):
        widget.percent = percent
        settle(widget)
        assert [each.visible for each in paint] == [seen, seen]
    person.paint((44, 47), (44, 48))
    settle(widget)
    assert [layers[each.name].visible for each in paint] == [True, True], (
        "a new result hides the paint"
    )
    layers["Confidence"].visible = False
    for percent in (50, 100):
        widget.percent = percent
        settle(widget)
    assert [each.visible for each in paint] == [True, False], (
        "the user's choice of visibility was changed"
    )


def test_the_confidence_layer_belongs_to_a_slice_and_is_removed_with_image_or_dock(
    open_beside, settle
):
    stack = np.random.default_rng(0).integers(50, 200, (3, 48, 64)).astype(np.uint8)
    person, widget = open_beside(stack)
    viewer = person.viewer
    viewer.dims.set_current_step(0, 1)
    widget.tool = "confidence"
    widget.start()
    settle(widget)
    marks = Arrow((24, 32), (0, 5), 6.0), Stroke("confidence", (((24, 30),),), 9.0, confidence=0.3)
    widget.drawing = Drawing(marks)
    settle(widget)
    layer = by_name(viewer, "Confidence")
    assert layer.data.shape == (1, 48, 64)
    assert layer.data.max() == 1
    assert layer.data_to_world((0, 0, 0))[0] == 1
    viewer.dims.set_current_step(0, 2)
    settle(widget)
    assert "Confidence" not in viewer.layers, "the confidence of another slice is displayed"
    viewer.dims.set_current_step(0, 1)
    settle(widget)
    by_name(viewer, "Confidence").name = "renamed"  # by a script: the layer list does not show it
    widget.tool = "pull"
    assert "renamed" not in viewer.layers, "no tool and no eye icon hides the confidence"
    widget.tool = "confidence"
    assert "Confidence" in viewer.layers
    viewer.layers.remove("MR")
    settle(widget)
    assert "Confidence" not in viewer.layers


def test_the_confidence_layer_is_not_offered_as_input_and_is_hidden_before_motion(
    brushing_beside, settle
):
    person, widget = brushing_beside
    person.key(CONFIDENCE)
    widget.fields.stroke_confidence.value = 0.4
    person.paint((44, 45), (44, 46))
    settle(widget)
    layer = by_name(person.viewer, "Confidence")
    boundary, form = widget._form.motion.boundary, widget._form
    for choice in (form.image, form.tissue.choice, boundary.choice, boundary.confidence):
        assert layer not in choice.choices
    widget.before = True
    assert not layer.visible
    widget.before = False
    assert layer.visible
    widget.make_layers()
    widget.hand_brush(widget.boundary)
    settle(widget)
    assert "Confidence" not in person.viewer.layers
    widget.start()
    assert by_name(person.viewer, "Confidence").visible


def test_the_confidence_layer_is_shown_only_while_its_brush_draws(brushing_beside, frame, settle):
    person, widget = brushing_beside
    layers = person.viewer.layers
    person.key(CONFIDENCE)
    person.paint((44, 45), (44, 46))
    settle(widget)
    for is_visible in (True, False):
        layers["Motion"].visible = is_visible
        Screen(widget).press("Pull")
        settle(widget)
        assert "Confidence" not in layers
        Screen(widget).press("Confidence")
        assert "Confidence" in layers
    frame.close(widget)
    again = quick(frame.open())
    settle(again)
    assert "Confidence" not in layers


def test_tissue_is_painted_with_presets_if_there_is_no_table(brushing_beside, settle):
    person, widget = brushing_beside
    before = displacement(widget)[44, 14, 1]
    person.key(MATERIAL)
    assert 0 in widget.fields.material.choices, "void is not offered"
    material = widget.fields.material.native
    said = [material.itemText(at) for at in range(material.count())]
    assert said[-1] == "bone or implant (rigid)"
    assert material.currentText() == "stiff (5)", "rigid tissue is the default"
    widget.fields.material.value = 0
    person.paint((30, 22), (36, 22), (42, 22), (48, 22), (54, 22))
    settle(widget)
    after = displacement(widget)
    assert after[44, 14, 1] < 0.8 * before, "the gap transmits motion"
    assert not after[44, 22].any()
    assert widget.session.next_undo.word == "painted tissue"


def test_tissue_is_painted_with_the_table_of_its_layer(open_beside, settle):
    person, widget = open_beside()
    labels = np.ones((64, 64), np.uint8)
    materials = (Material(1, "gel", 1.0), Material(7, "bone", 1000.0))
    person.viewer.add_labels(labels, name="T", metadata=layer_metadata(TISSUE, materials, "kPa"))
    assert widget.start()
    settle(widget)
    person.key(MATERIAL)
    material = widget.fields.material
    assert tuple(material.choices) == (1, 7)
    material.value = 7
    assert text_of(person.viewer).text == "Tissue"
    widget.fields.radius.value = 6.0
    person.paint((32, 20), (32, 32), (32, 44))
    widget.drawing = Drawing((*widget.drawing.marks, Arrow((32, 20), (0, 4), 3.0)))
    settle(widget)
    moved = displacement(widget)
    assert moved[32, 42, 1] > 3.5, "a stiff inclusion is deformed"
    assert (by_name(person.viewer, "T").data == 1).all(), "the layer of labels changed"
    material.value = 1
    assert widget.drawing.marks[0].label == 7, "the menu changed the label of an earlier stroke"
    person.pick(32, 44)
    assert material.value == 7
    material.value = 1
    assert widget.drawing.marks[0].label == 1, (
        "the menu did not change the label of the selected stroke"
    )


def test_a_drag_makes_a_landmark_and_escape_cancels_it(pulling_beside, settle):
    person, widget = pulling_beside
    person.key(LANDMARK)
    person.press(30, 30)
    person.move(34, 32)
    person.key(Qt.Key.Key_Escape)
    person.release(34, 32)
    assert not widget.drawing.marks
    person.drag((30, 30), (34, 32))
    settle(widget)
    mark = only(widget)
    assert isinstance(mark, Landmark)
    assert displacement(widget)[30, 30] == pytest.approx((4, 2), abs=0.6)
    person.paint((34, 32), (36, 32))
    assert only(widget).target == pytest.approx((36, 32), abs=0.6), (
        "the head of the landmark was not dragged"
    )
    person.key(Qt.Key.Key_Delete)
    assert not widget.drawing.marks


def test_a_click_makes_a_fixed_landmark_with_a_message(pulling_beside, settle):
    person, widget = pulling_beside
    person.key(LANDMARK)
    assert "or click a point that must stay" in widget.status
    person.drag((30, 30), (30, 30))
    assert only(widget).source == only(widget).target == (30, 30)
    assert widget.status == NO_WAY
    person.drag((30, 30), (30, 34))
    assert only(widget).target == (30, 34), "the landmark was not dragged to its target"
    assert widget.status != NO_WAY
    settle(widget)
    person.drag((50, 50), (50, 50))
    assert widget.status == NO_WAY, "there is no message for moved tissue"
    person.drag((30, 34), (30, 34))
    assert widget.status != NO_WAY, "a click on an old landmark shows a message"


def test_points_are_added_as_landmarks_to_drawn_landmarks(pulling_beside, settle):
    person, widget = pulling_beside
    viewer = person.viewer
    person.key(LANDMARK)
    person.drag((50, 50), (50, 52))
    settle(widget)
    where = viewer.add_points([[30, 30], [40, 20]], name="is")
    should = viewer.add_points([[33, 30]], name="ought")
    with pytest.raises(HmrfError, match="'ought' has 1 point, but 'is' has 2"):
        widget.take_landmarks(where, should)
    should.add([40, 22])
    widget.take_landmarks(where, should)
    settle(widget)
    assert displacement(widget)[30, 30] == pytest.approx((3, 0), abs=0.02)
    assert displacement(widget)[40, 20] == pytest.approx((0, 2), abs=0.02)
    assert displacement(widget)[50, 50] == pytest.approx((0, 2), abs=0.6)
    should.data = [[34, 30], [40, 22]]
    widget.take_landmarks(where, should)
    settle(widget)
    assert displacement(widget)[30, 30] == pytest.approx((4, 0), abs=0.02)
    assert len(widget.drawing.marks) == 3, "earlier landmarks of the same points were not replaced"


def test_a_first_stroke_has_an_effect_or_shows_a_message(pulling_beside, settle):
    person, widget = pulling_beside
    fields = widget.fields
    person.key(EXPAND)
    assert fields.amount.value == 1.3, "the default amount is not a third of the radius"
    person.key(MOVE)
    person.paint((30, 28), (30, 34))
    assert "Now drag the paint" in widget.status
    fields.by_col.value = 3
    assert fields.words == "Push 3 right"
    settle(widget)
    assert displacement(widget)[30, 31] == pytest.approx((0, 3), abs=0.02), (
        "the region does not move by the displayed amount"
    )


def test_the_status_bar_shows_the_stiffness_of_painted_tissue(widget, small_sample, settle):
    small_sample(widget._viewer, (48, 64))
    widget.model, widget.live = "elastic", True
    settle(widget)
    stiff = replace(widget.materials[1], label=9, name="lump", stiffness=77.0)
    widget.materials = (*widget.materials, stiff)
    lump = Stroke("tissue", (((20, 20), (20, 24)),), 4.0, label=9)
    pull = Arrow((30, 40), (0, 3), 4.0)
    for drawing, said in ((Drawing((lump, pull)), True), (Drawing((pull,)), False)):
        widget.drawing = drawing
        settle(widget)
        line = widget._view.cursor.line_at((20, 22))
        assert ("lump" in line) == said
        assert "stiffness" in line


def test_a_stroke_is_picked_changed_and_removed(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(MOVE)
    widget.fields.by_row.value = -4.0
    person.paint((20, 20), (20, 26))
    settle(widget)
    person.key(Qt.Key.Key_G)
    widget.fields.by_row.value = 1.0
    person.pick(16, 22)
    assert widget.tool == "move", "the stroke was not found at its target"
    assert widget.fields.by_row.value == -4.0
    assert "press Delete to remove it" in widget.status
    person.key(Qt.Key.Key_Delete)
    assert len(widget.drawing.marks) == 1
    person.pick(60, 60)
    assert "There is no mark at this point" in widget.status


def test_a_radius_out_of_the_range_of_the_image_is_replaced_with_a_message(open_beside, settle):
    person, widget = open_beside(scale=(0.1, 0.1), units=("mm", "mm"))
    person.frame.show()
    settle(widget)
    box = widget.fields.radius.native
    for typed, used in (("0.0001", 0.05), ("99999", 6.4), ("3", 3.0)):
        box.selectAll()
        QTest.keyClicks(box, typed)
        QTest.keyClick(box, Qt.Key.Key_Return)
        assert widget.fields.radius.value == used, typed
        assert ("'radius' must be from 0.05 to 6.4 mm" in widget.status) == (typed != "3")
        person.drag((3.0, 3.0), (3.2, 3.2))
        settle(widget)
        assert only(widget).radius == used
        widget.undo()
        settle(widget)


def test_a_mark_with_a_tiny_radius_is_shown_and_changed(pulling_beside, settle):
    person, widget = pulling_beside
    widget.drawing = Drawing((Arrow((30, 30), (2, 0), 1e-6),))
    settle(widget)
    person.pick(32, 30)
    widget.fields.confidence.value = 0.5
    settle(widget)
    assert (only(widget).confidence, only(widget).radius) == (0.5, 0.5)


def test_the_wheel_grows_and_shrinks_tissue_in_one_undo_step(pulling_beside, settle):
    person, widget = pulling_beside
    person.key(EXPAND)
    widget.fields.radius.value = 8.0
    for notches in (1, 1, 1, -1):
        person.turn_wheel(32, 32, notches)
    settle(widget)
    assert (only(widget).amount, only(widget).lines) == (0.8, (((32, 32),),))
    assert widget.fields.amount.value == 0.8
    assert widget.status == "This tissue grows by 0.8 px."
    assert widget.solution.displacement[32, 40] == pytest.approx((0, 0.8), abs=0.1)
    person.turn_wheel(34, 34, -5)
    settle(widget)
    assert only(widget).amount == -1.2
    assert widget.status == "This tissue shrinks by 1.2 px."
    person.turn_wheel(32, 32, -100)
    settle(widget)
    assert only(widget).amount == -6.4, "the patch vanished"
    for amount in (-1.2, 0.8):
        widget.undo()
        assert only(widget).amount == amount
    widget.undo()
    assert not widget.drawing.marks


def test_the_wheel_grows_all_tissue_of_a_label_and_a_disc_of_the_main_tissue(
    pulling_beside, settle
):
    person, widget = pulling_beside
    rows = Material(1, "brain", 1.0), Material(2, "tumour", 3.0), Material(3, "cyst", 0.0)
    labels = np.ones((64, 64), np.uint8)
    labels[24:32, 24:40] = labels[50:54, 50:54] = 2
    labels[10:14, 10:14] = 3
    widget.tissue = person.viewer.add_labels(labels, metadata=layer_metadata(TISSUE, rows))
    widget.tool = "expand"
    widget.start()
    settle(widget)
    for notches in (1, 1, -1, 2):
        person.turn_wheel(28, 36, notches)
    assert widget.materials[1].growth == pytest.approx(0.15)
    assert widget.status == "All of 'tumour' grows by 15 % in length, as in the table of tissues."
    settle(widget)
    assert not widget.drawing.marks
    size = widget.solution.displacement[[24, 31], 28, 0]
    assert size[1] - size[0] == pytest.approx(0.15 * 7, rel=0.5)
    assert np.abs(widget.solution.displacement[50:54, 50:54]).max() > 0.05
    person.turn_wheel(28, 36, -100)
    assert widget.materials[1].growth == pytest.approx(-0.8), "the tissue vanished"
    for growth in (0.15, 0):
        widget.undo()
        assert widget.materials[1].growth == growth
    person.turn_wheel(44, 20)
    assert only(widget).amount > 0
    assert not any(row.growth for row in widget.materials)
    settle(widget)


def test_turns_of_the_wheel_during_a_long_repaint_are_one_undo_step(
    monkeypatch, open_beside, settle, wait_for
):
    monkeypatch.setattr(pointer, "_WHEEL_REST", 0)
    person, widget = open_beside()
    widget.tool = "expand"
    widget.start()
    settle(widget)
    # Both the end of the rest and a turn of the wheel wait for the event loop.
    pending = single_shot(None, 0, lambda: person.turn_wheel(32, 32))
    person.turn_wheel(32, 32)
    pending.start()
    wait_for(lambda: not (pending.isActive() or widget.session.drawing_in_progress))
    assert only(widget).amount > 0
    widget.undo()
    assert not widget.drawing.marks


def test_the_wheel_over_pulled_tissue_keeps_the_pull_and_adds_growth(pulling_beside, settle):
    person, widget = pulling_beside
    person.key(LANDMARK)
    widget.fields.radius.value = 8.0
    person.drag((32, 32), (32, 36))
    settle(widget)
    pulled = widget.drawing
    person.key(EXPAND)
    for _ in range(4):
        person.turn_wheel(33, 38)
    settle(widget)
    moves = widget.solution.displacement
    assert widget.status.startswith("This displaced tissue grows by 1.6 px.")
    assert moves[32, 32] == pytest.approx((0, 4), abs=0.1), "the pull is lost"
    assert moves[32, [24, 40], 1] == pytest.approx((2.4, 5.6), abs=0.2), "the patch does not grow"
    assert widget.fields.amount.value == 1.6
    widget.fields.amount.value = 0.8
    assert only(widget) == replace(pulled.marks[0], amount=0.8)


def test_displaced_tissue_grows_from_where_it_is_and_keeps_its_stretch(pulling_beside, settle):
    person, widget = pulling_beside
    widget.drawing = Drawing((Arrow((32, 22), (0, 8), 4.0),))
    settle(widget)
    field = widget.solution.displacement
    row, col = by = field[32, 38]
    assert col > 1, "the tissue is not displaced"
    assert np.ptp(field[32, 34:43, 1]) > 1, "the tissue is not squeezed"
    place = 32 + row, 38 + col
    person.key(EXPAND)
    widget.fields.radius.value = 4.0
    widget.fields.amount.value = 0.8
    person.drag(place, place)
    settle(widget)
    moves, mark = widget.solution.displacement, widget.drawing.marks[-1]
    assert moves[32, 38] == pytest.approx(by, abs=0.2), "the growth undoes the pull"
    assert (moves - field)[32, [34, 42], 1] == pytest.approx((-0.8, 0.8), abs=0.05)
    person.turn_wheel(*place, -8)
    assert widget.drawing.marks[1:] == (replace(mark, amount=-0.8),)


def test_a_pull_of_a_grown_patch_keeps_the_growth(pulling_beside, settle):
    person, widget = pulling_beside
    widget.drawing = Drawing((Stroke("expand", (((32, 32),),), 6.0, amount=1.0),))
    settle(widget)
    person.key(Qt.Key.Key_G)
    widget.fields.radius.value = 7.0
    person.drag((34, 33), (34, 37))
    settle(widget)
    moves = widget.solution.displacement
    assert (only(widget).radius, only(widget).amount) == (6.0, 1.0)
    assert moves[32, [26, 32, 38], 1] == pytest.approx((3, 4, 5), abs=0.2)


def test_a_pushed_patch_grows_with_the_wheel_and_is_pushed_farther(pulling_beside, settle):
    person, widget = pulling_beside
    widget.drawing = Drawing((Stroke("move", (((32, 32),),), 8.0, by=(0.0, 4.0)),))
    settle(widget)
    person.key(EXPAND)
    person.turn_wheel(32, 36, 4)
    person.pick(32, 38)
    person.drag((32, 36), (34, 36))
    settle(widget)
    assert (only(widget).by, only(widget).amount) == ((2.0, 4.0), 1.6)
    moves = widget.solution.displacement
    assert moves[[24, 40], 32, 0] == pytest.approx((0.4, 3.6), abs=0.2)


def test_a_wide_patch_grows_around_pulled_tissue(pulling_beside, settle):
    person, widget = pulling_beside
    pull = Arrow((32, 32), (0, 2), 3.0)
    widget.drawing = Drawing((pull,))
    settle(widget)
    person.key(EXPAND)
    widget.fields.radius.value = 14.0
    person.turn_wheel(32, 42)
    settle(widget)
    assert widget.drawing.marks[1:] == (pull,)
    assert widget.solution.displacement[32, 32] == pytest.approx((0, 2), abs=0.05)


def test_the_wheel_changes_nothing_where_a_pull_would_be_lost(pulling_beside, settle):
    person, widget = pulling_beside
    cases = (
        (Arrow((32, 40), (0, 2), 6.0), "Not grown: a pull is in the way. Turn the wheel over it"),
        (Arrow((32, 40), (0, 0), 6.0), "Not grown: a held place is in the way"),
        (Landmark((32, 40), (33, 40), 6.0), "Not grown: a landmark is in the way"),
        (Stroke("move", (((32, 40),),), 6.0, by=(0, 1)), "Not grown: pushed tissue is in the way"),
        (Arrow((32, 32), (0, 0), 0.5), "the patch is too small"),
        (Stroke("move", (((20, 32), (44, 32)),), 1.0, by=(0, 1)), "an open line has no inside"),
    )
    for pull, reason in cases:
        widget.drawing = before = Drawing((pull,))
        settle(widget)
        step = widget.session.next_undo
        person.key(EXPAND)
        widget.fields.radius.value = 6.0
        for _ in range(2):
            person.turn_wheel(32, 32)
        assert reason in widget.status
        assert (widget.drawing, widget.session.next_undo) == (before, step), reason


def test_the_wheel_zooms_unless_grow_is_active_over_tissue(open_beside, settle):
    person, widget = open_beside(disc())
    settle(widget)
    camera = camera_of(person.viewer)
    for row, col in ((32, 32), (1, 1)):
        person.turn_wheel(row, col)
        assert camera.mouse_zoom
    person.key(EXPAND)
    person.turn_wheel(1, 1)
    assert camera.mouse_zoom, "the wheel does not zoom over air"
    person.turn_wheel(32, 32, modifiers=("Control",))
    assert not widget.drawing.marks, "a turn with Ctrl, which moves through slices, is used"
    assert not camera.mouse_zoom
    person.viewer.dims.ndisplay = 3
    assert camera.mouse_zoom
    person.viewer.dims.ndisplay = 2
    assert not camera.mouse_zoom
    person.key(Qt.Key.Key_G)
    assert camera.mouse_zoom


def disc():
    """Return an image of a bright disc in air."""
    rows, cols = np.indices((64, 64))
    inside = np.hypot(rows - 32, cols - 32) < 28
    return np.where(inside, 120 + 60 * ((rows // 8 + cols // 8) % 2), 0).astype(np.uint8)


def test_the_circle_of_the_cursor_is_drawn_only_at_the_mouse_and_without_a_square(
    make_napari_viewer, unstyled, qtbot, settle, at_rest
):
    viewer = make_napari_viewer(show=True)
    viewer.mouse_over_canvas = True
    viewer.add_image(np.ones((40, 60)), contrast_limits=(0, 1))
    widget = dock_in(viewer)
    Screen(widget).press("Pull")
    settle(widget)
    assert by_name(viewer, "Motion").cursor == "circle"
    corner = viewer.screenshot(canvas_only=True, flash=False)[:30, :30, :3]
    assert np.ptp(corner) < 10, "the circle is in the corner before the mouse moves"
    arrows = viewer.add_vectors(np.array([[[2.0, 2.0], [0.0, 1.0]]]))
    arrows.cursor_size, arrows.cursor = 2, "circle"  # as a tool does
    person = Person(viewer, qtbot)
    person.move(20, 30, button=Qt.MouseButton.NoButton)
    at_rest()

    def white_at_the_cursor():
        place, picture = person.where(20, 30), viewer.screenshot(flash=False)
        rows, cols = (slice(at - 15, at + 15) for at in (place.y(), place.x()))
        return (picture[rows, cols] == 255).all()

    assert not white_at_the_cursor(), "the circle is not drawn"
    arrows.cursor = "standard"
    assert white_at_the_cursor(), "napari's square was not removed"


def test_keys_change_the_radius_of_the_brush(pulling_beside):
    person, widget = pulling_beside
    person.key(PIN)
    widget.fields.radius.value = 4.0
    person.key(Qt.Key.Key_BracketRight)
    assert widget.fields.radius.value == 5.0
    assert by_name(person.viewer, "Motion").cursor_size == pytest.approx(10.0)
    person.key(Qt.Key.Key_BracketLeft)
    assert widget.fields.radius.value == 4.0


def test_a_registered_tool_receives_mouse_and_keys_and_shows_its_fields(
    pulling_beside, monkeypatch
):
    person, widget = pulling_beside
    monkeypatch.setitem(BY_NAME, Notes.name, Notes)
    layer, before = by_name(person.viewer, "Motion"), widget.drawing
    assert layer.cursor == "circle"
    widget.tool = "notes"
    assert layer.cursor == "pointing"
    assert widget.fields.words == "Notes"
    assert widget.status == Notes.hint
    widget.fields.softness.value = 0.25
    person.press(20, 20)
    person.move(20, 24)
    tool = widget._pointer.tool
    assert (tool.places, tool.settings) == ([(20, 20), (20, 24)], {"softness": 0.25})
    assert widget.status == "Noted."
    person.key(Qt.Key.Key_Escape)
    person.release(20, 24)
    assert (widget.drawing, widget.session.next_undo) == (before, None)
    person.key(Qt.Key.Key_G)
    assert layer.cursor == "circle"


def test_the_cursor_of_a_tool_is_not_set_in_other_modes_of_napari(pulling_beside):
    person, widget = pulling_beside
    layer = by_name(person.viewer, "Motion")
    layer.mode = "transform"
    before = layer.cursor
    assert before != "circle"
    widget.fields.radius.value = 7.0
    widget.drawing = Drawing((Arrow((44, 40), (0, 5), 6.0),))
    assert layer.cursor == before
    layer.mode = "pan_zoom"
    assert (layer.cursor, layer.cursor_size) == ("circle", pytest.approx(14.0))


def test_a_message_says_that_a_surface_painted_inside_tissue_keeps_its_place(
    brushing_beside, settle
):
    touch, widget = brushing_beside
    Screen(widget).press("Slide")
    for row, is_inside in ((30, True), (0, False)):
        touch.paint((row, 20), (row, 40))
        settle(widget)
        assert widget.status.startswith("To let tissue slide along this surface") is is_inside


def test_changing_the_slice_during_a_stroke_ends_the_stroke(open_beside, settle):
    stack = np.random.default_rng(0).integers(50, 200, (3, 48, 64)).astype(np.uint8)
    person, widget = open_beside(stack)
    viewer = person.viewer
    viewer.dims.set_current_step(0, 1)
    widget.start()
    person.key(PIN)
    settle(widget)
    person.press(20, 30)
    person.move(24, 30)
    viewer.dims.set_current_step(0, 2)
    person.move(30, 30)
    person.release(30, 30)
    settle(widget)
    assert not widget.drawing.marks
    assert not displayed_paint(person).any()
    viewer.dims.set_current_step(0, 1)
    settle(widget)
    assert only(widget).lines[0][-1] == pytest.approx((24, 30), abs=0.6)
    assert displayed_paint(person).shape == (1, 48, 64)
    assert displayed_paint(person)[0, 22, 30] == number_of("pin")


def test_removing_or_renaming_result_layers_does_not_interrupt_a_stroke(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(PIN)
    image, arrows = by_name(person.viewer, "MR"), by_name(person.viewer, "Motion")
    for number, gone in enumerate(["Motion, painted", "image", "arrows"], 1):
        row = 8 * number - 4
        person.press(row, 20)
        person.move(row, 24)
        image.name, arrows.name = f"T{number}", f"mine {number}"
        (layer,) = (
            each
            for each in person.viewer.layers
            if gone in (each.name, metadata_of(each).get("kind"))
        )
        person.viewer.layers.remove(layer)
        person.move(row, 30)
        person.release(row, 30)
        settle(widget)
        assert widget.drawing.marks[number].lines[0][-1] == pytest.approx((row, 30), abs=0.6), gone
        assert displayed_paint(person)[row, 25] == number_of("pin"), gone


def test_removing_the_motion_layer_ends_a_stroke(brushing_beside, at_rest):
    person, widget = brushing_beside
    person.key(PIN)
    person.press(20, 20)
    person.move(20, 24)
    person.viewer.layers.remove("Motion")
    person.move(20, 30)
    person.release(20, 30)
    at_rest()
    assert not widget.session.drawing_in_progress
    assert widget.status.startswith("The layer 'Motion' was deleted")
    assert not text_of(person.viewer).visible


def test_text_of_another_plugin_on_the_canvas_is_not_changed(open_beside):
    person, widget = open_beside()
    text = text_of(person.viewer)
    text.text, text.visible = "patient 7", True
    widget.start()
    assert text.text == "patient 7"
    widget.stop()
    assert text.visible


def test_presets_offer_their_tissues_and_unpainted_tissue_is_the_first(brushing_beside, settle):
    person, widget = brushing_beside
    person.key(MATERIAL)
    fields = widget.fields
    assert fields.preset.native.isVisibleTo(widget.native)
    fields.preset.value = next(each for each in fields.preset.choices if each.unit == "kPa")
    settle(widget)
    before = displacement(widget)
    names = [row.name for row in fields.preset.value.materials]
    assert names[0] in text_of(person.viewer).text + str(fields.material.native.itemText(1))
    fields.material.value = fields.preset.value.materials[0].label
    person.paint((20, 20), (30, 20))
    settle(widget)
    assert displacement(widget) == pytest.approx(before, abs=0.02), (
        "painting the tissue of the unpainted sites changed the displacement"
    )


@pytest.mark.parametrize(
    ("data", "place", "tissues"),
    [
        (np.zeros((32, 32, 3), np.uint8), {}, ["normal", "soft", "stiff"]),
        (np.zeros((32, 32), np.uint16), {}, ["normal tissue", "soft tissue", "tumour"]),
        (np.zeros((32, 32), np.uint8), {"units": "mm"}, ["normal tissue", "soft tissue", "tumour"]),
    ],
    ids=["colours", "16 bits", "millimetres"],
)
def test_a_photograph_is_offered_materials_instead_of_tissues(
    open_beside, settle, data, place, tissues
):
    _, widget = open_beside(data, **place)
    settle(widget)
    assert [row.name for row in widget.fields.preset.value.materials] == tissues
    widget.make_layers()
    assert [row.name for row in widget.materials[1:]] == tissues


def test_a_preset_is_chosen_again_with_its_image_or_study(open_beside, settle, tmp_path):
    person, widget = open_beside()
    viewer, first, preset = person.viewer, widget.image, PRESETS[4]
    widget.fields.preset.value = preset
    widget.drawing = Drawing((Stroke("tissue", (((30, 30),),), 5.0, label=2),))
    settle(widget)
    widget.save_study(tmp_path / "painted.study")
    widget.image = viewer.add_image(np.zeros((32, 32), np.uint16), name="other")
    assert widget.fields.preset.value == PRESETS[0]
    widget.image = first
    assert widget.fields.preset.value == preset
    viewer.layers.clear()
    widget.open_study(tmp_path / "painted.study")
    assert widget.study.tissue.preset == preset


def test_the_tissue_brush_starts_with_a_label_of_tissue(open_beside, settle):
    person, widget = open_beside()
    labels = person.viewer.add_labels(np.ones((64, 64), np.uint8), name="T")
    rows = (Material(0, "x", 1.0), Material(1, "gel", 2.0), Material(2, "air", 0.0))
    labels.metadata.update(layer_metadata(TISSUE, rows, "kPa"))
    widget.tissue = labels
    assert widget.start()
    settle(widget)
    assert widget.fields.material.value == 1
