"""Tests of the ranges of the fields of the tools."""

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest

from napari_hmrf import Landmark, read_study, write_study
from napari_hmrf.layers.compat import camera_of
from tests.support.screen import Screen


def type_into(field, text):
    field.native.selectAll()
    QTest.keyClicks(field.native, text)
    field.native.editingFinished.emit()


@pytest.mark.parametrize("scale", [0.001, 40.0])
def test_the_range_of_a_length_depends_on_the_image(widget, settle, scale):
    widget._viewer.add_image(np.ones((30, 40)), scale=(scale, scale))
    settle(widget)
    fields = widget.fields
    least, most = fields.radius_range
    assert least == pytest.approx(scale / 2)
    assert most == pytest.approx(40 * scale)
    assert fields.radius.native.textFromValue(least).strip("0.") != ""


def test_the_radius_of_new_marks_follows_the_view_until_it_is_set(pulling_beside, settle):
    touch, dock = pulling_beside
    camera, radius = camera_of(touch.viewer), dock.fields.radius
    usual = radius.value
    camera.zoom *= 4
    near = radius.value
    assert near == pytest.approx(usual / 4, rel=0.15)
    touch.drag((30, 30), (31, 31))
    camera.zoom /= 4
    assert radius.value == near, "the field does not show the selected mark"
    touch.drag((50, 50), (52, 52))
    radius.value = 7.0
    camera.zoom *= 4
    touch.key(Qt.Key.Key_Escape)
    touch.drag((10, 50), (11, 51))
    settle(dock)
    assert [mark.radius for mark in dock.drawing.marks] == [near, 7.0, 7.0]
    dock.undo()
    dock.undo()
    assert dock.drawing.marks[1].radius == usual


def test_fields_change_the_last_mark_until_escape(pulling_beside, settle):
    touch, dock = pulling_beside
    touch.drag((20, 20), (22, 23))
    dock.fields.radius.value = 8.0
    touch.key(Qt.Key.Key_Escape)
    dock.fields.radius.value = 5.0
    settle(dock)
    assert [mark.radius for mark in dock.drawing.marks] == [8.0]


def test_a_landmark_with_an_uncertainty_gives_way_and_each_edit_is_one_step(pulling_beside, settle):
    touch, dock = pulling_beside
    Screen(dock).press("Landmark")
    sd, radius = dock.fields.sd, dock.fields.radius
    assert sd.native.isVisibleTo(dock.native)
    assert radius.enabled
    touch.drag((30, 30), (34, 30))
    settle(dock)
    assert dock.solution.displacement[30, 30] == pytest.approx((4, 0), abs=0.02)
    sd.value = 2
    settle(dock)
    (mark,) = dock.drawing.marks
    assert mark.sd == 2
    assert not radius.enabled
    assert 0.1 < dock.solution.displacement[30, 30, 0] < 3.9
    before = dock.solution.displacement
    touch.drag((34, 30), (36, 30))
    settle(dock)
    assert dock.drawing.marks[0].target == (36, 30)
    assert dock.solution.displacement[30, 30, 0] > before[30, 30, 0]
    for sd_before, target in ((2, (34, 30)), (0, (34, 30))):
        dock.undo()
        assert (dock.drawing.marks[0].sd, dock.drawing.marks[0].target) == (sd_before, target)


def test_a_new_landmark_has_the_uncertainty_in_the_field(pulling_beside, settle):
    touch, dock = pulling_beside
    Screen(dock).press("Landmark")
    dock.fields.sd.value = 0.5
    touch.drag((30, 30), (32, 30))
    Screen(dock).press("Pull")
    assert dock.fields.radius.enabled, "the radius of a pull depends on the uncertainty"
    touch.drag((50, 50), (52, 50))
    settle(dock)
    assert [type(mark).__name__ for mark in dock.drawing.marks] == ["Landmark", "Arrow"]
    assert dock.drawing.marks[0].sd == 0.5


def test_other_models_refuse_an_uncertain_landmark_with_a_message(pulling_beside, settle):
    touch, dock = pulling_beside
    dock.model = "paper"
    Screen(dock).press("Landmark")
    dock.fields.sd.value = 0.5
    touch.drag((30, 30), (32, 30))
    settle(dock)
    assert "has a landmark with an uncertainty (±), which the model 'paper'" in dock.status
    dock.model = "large motion"
    settle(dock)
    assert dock.solution is not None
    assert "uncertainty" not in dock.status


def test_a_larger_typical_strain_brings_tissue_closer_to_an_uncertain_landmark(
    pulling_beside, settle
):
    touch, dock = pulling_beside
    Screen(dock).press("Landmark")
    dock.fields.sd.value = 2
    touch.drag((30, 30), (34, 30))
    settle(dock)
    before = dock.solution.displacement[30, 30, 0]
    dock._form.model.in_detail.strain.value = 40
    settle(dock)
    assert before + 0.2 < dock.solution.displacement[30, 30, 0] < 4
    assert dock.study.motion.typical_strain == 0.4
    strain = dock._form.model.in_detail.strain.native
    assert not strain.isHidden()
    dock.model = "paper"
    assert strain.isHidden()


def test_further_fields_are_visible_on_request_or_with_another_value(pulling_beside):
    touch, dock = pulling_beside
    confidence, direction = dock.fields.confidence, dock.fields.components
    further = confidence.native, direction.native
    assert [field.isHidden() for field in further] == [True, True]
    Screen(dock).press("More tools")
    assert [field.isHidden() for field in further] == [False, False]
    confidence.value = 0.5
    Screen(dock).press("More tools")
    assert [field.isHidden() for field in further] == [False, True], "a used value is hidden"
    touch.drag((30, 30), (32, 30))
    dock.tool = "slide"
    dock.start()
    assert dock._form.motion.more.isExpanded(), "the button of the tool in use is not visible"


def test_the_advice_about_folds_names_the_uncertainty_of_landmarks(pulling_beside, settle):
    touch, dock = pulling_beside
    dock.unfolds = False
    Screen(dock).press("Landmark")
    touch.drag((30, 30), (50, 30))
    settle(dock)
    assert "tissue folds" in dock.warning
    assert "±" not in dock.warning
    dock.fields.sd.value = 0.01
    settle(dock)
    assert "tissue folds" in dock.warning
    assert "with a larger ±, tissue folds less" in dock.warning


def test_a_drift_is_ticked_undone_and_saved_with_the_study(pulling_beside, settle, tmp_path):
    touch, dock = pulling_beside
    Screen(dock).press("Landmark")
    dock.fields.sd.value = 0.5
    for row, col in ((20, 20), (20, 40), (40, 20), (40, 40)):
        touch.drag((row, col), (1.1 * row, col))
    settle(dock)
    box = Screen(dock).button("affine drift")
    dock._form.motion.switches.hold_edge.value = False
    settle(dock)
    strained = np.abs(dock.solution.strain()).max()
    box.click()
    settle(dock)
    assert np.abs(dock.solution.strain()).max() < 0.2 * strained
    assert dock.study.motion.drift
    assert "a drift was estimated with the landmarks: strains of" in dock.residual
    assert "hinders" not in dock.residual
    dock._form.motion.switches.hold_edge.value = True
    settle(dock)
    assert "the held outer edge hinders the drift" in dock.residual
    dock.undo()
    settle(dock)
    saved = read_study(write_study(tmp_path / "a.study", dock.study)).study
    assert saved.motion.drift
    dock.model = "large motion"
    settle(dock)
    assert "has landmarks with an affine drift, which the model 'large motion'" in dock.status
    box.click()
    settle(dock)
    assert "drift" not in dock.status


def test_a_landmark_drawn_later_outside_tissue_is_named(pulling_beside, settle):
    touch, dock = pulling_beside
    touch.drag((30, 30), (32, 30))
    settle(dock)
    far = Landmark((-40.0, 9.0), (-38.0, 9.0), 1.0, sd=1.0)
    dock.drawing = dock.drawing.with_mark(far)
    settle(dock)
    assert "The landmark at (-40, 9) is outside the image and has no effect." in dock.warning
    assert Screen(dock).button("⚠").text().endswith("The landmark has no effect")
