"""Tests of the conversion of marks between a slice and its volume."""

import pytest

from napari_hmrf import Arrow, Landmark, Stroke
from napari_hmrf.tissue.drawing.extents import SliceInVolume

AXIAL = SliceInVolume.of((1, 2), (7, 0, 0), (0, 1, 2))
#: A sagittal slice whose rows are the last axis of a film of volumes.
TURNED = SliceInVolume.of((3, 1), (9, 0, 4, 0), (1, 2, 3))

MARKS = [
    Arrow((3, 5), (1, -2), 4.0, 0.5),
    Landmark((3, 5), (4, 8), 4.0),
    Stroke("move", (((3, 5), (4, 6)), ((8, 8),)), 2.0, by=(1.0, 2.0)),
    Stroke("expand", (((3, 5),),), 2.0, amount=-1.5),
    Arrow((3, 5), (1, 0), 4.0, components="row"),
]


@pytest.mark.parametrize("mark", MARKS, ids=range(len(MARKS)))
def test_a_mark_that_is_copied_to_the_volume_and_back_is_unchanged(mark):
    for place in (AXIAL, TURNED):
        assert place.to_slice(place.to_volume(mark)) == mark


def test_a_mark_is_placed_on_its_slice_of_the_volume():
    assert AXIAL.to_volume(MARKS[0]) == Arrow((7, 3, 5), (0, 1, -2), 4.0, 0.5)
    assert TURNED.to_volume(MARKS[0]) == Arrow((5, 4, 3), (-2, 0, 1), 4.0, 0.5)
    assert TURNED.to_volume(MARKS[4]).components == "col"


def test_marks_on_other_slices_and_motion_across_the_slice_are_left_out():
    assert AXIAL.to_slice(Arrow((6, 3, 5), (0, 1, 2), 4.0)) is None
    assert AXIAL.to_slice(Stroke("pin", (((7, 3, 5), (8, 3, 5)),), 2.0)) is None
    assert AXIAL.to_slice(Arrow((7.4, 3, 5), (6, 1, 2), 4.0)) == Arrow((3, 5), (1, 2), 4.0)
    assert TURNED.to_slice(Arrow((5, 4, 3), (0, 2, 0), 4.0, components="row")) is None
