"""Tests of the ranges of the fields of the tools."""

import numpy as np
import pytest
from qtpy.QtTest import QTest

from napari_hmrf.tissue.drawing import Arrow, Drawing


def type_into(field, text):
    field.native.selectAll()
    QTest.keyClicks(field.native, text)
    field.native.editingFinished.emit()


@pytest.mark.parametrize("scale", [0.001, 1.0, 40.0])
def test_lengths_range_from_half_a_pixel_to_the_diagonal_of_the_image(widget, settle, scale):
    shape = (30, 40)
    widget._viewer.add_image(np.ones(shape), scale=(scale, scale))
    settle(widget)
    fields = widget.fields
    assert (fields.radius.min, fields.radius.max) == pytest.approx((scale / 2, 50 * scale))
    for field in (fields.by_row, fields.by_col, fields.amount):
        assert (field.min, field.max) == pytest.approx((-50 * scale, 50 * scale))
    for field in (fields.radius, fields.amount):
        assert f"to {field.max:g} px." in field.tooltip
    assert fields.radius.native.textFromValue(fields.radius.min).strip("0.") != ""


def test_a_radius_that_is_too_small_or_too_large_is_not_accepted(pulling_beside, settle):
    touch, dock = pulling_beside
    radius = dock.fields.radius
    for text in ("0.0001", "99999"):
        type_into(radius, text)
        assert 0.5 <= radius.value <= radius.max
        touch.drag((20, 20), (22, 23))
        settle(dock)
        assert dock.drawing.marks[-1].radius == radius.value


def test_selecting_a_mark_outside_the_range_does_not_change_the_mark(pulling_beside, settle):
    touch, dock = pulling_beside
    huge = Drawing((Arrow((30, 30), (1.0, 0.0), 400.0),))
    dock.drawing = huge
    settle(dock)
    touch.pick(31, 30)
    assert dock.fields.radius.value == dock.fields.radius.max
    assert dock.drawing == huge
