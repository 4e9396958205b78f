"""Tests of the ranges of the fields of the tools."""

import numpy as np
import pytest
from qtpy.QtTest import QTest


def type_into(field, text):
    field.native.selectAll()
    QTest.keyClicks(field.native, text)
    field.native.editingFinished.emit()


@pytest.mark.parametrize("scale", [0.001, 1.0, 40.0])
def test_the_range_of_a_length_depends_on_the_image_and_is_in_its_tooltip(widget, settle, scale):
    widget._viewer.add_image(np.ones((30, 40)), scale=(scale, scale))
    settle(widget)
    fields = widget.fields
    least, most = fields.radius_range
    assert least == pytest.approx(scale / 2)
    assert most == pytest.approx(40 * scale)
    for field in (fields.radius, fields.amount):
        assert f"to {most:g} px." in field.tooltip
    assert fields.radius.native.textFromValue(least).strip("0.") != ""


def test_a_radius_that_is_too_small_or_too_large_is_not_accepted(pulling_beside, settle):
    touch, dock = pulling_beside
    radius = dock.fields.radius
    for text in ("0.0001", "99999"):
        type_into(radius, text)
        least, most = dock.fields.radius_range
        assert least <= radius.value <= most
        touch.drag((20, 20), (22, 23))
        settle(dock)
        assert dock.drawing.marks[-1].radius == radius.value
