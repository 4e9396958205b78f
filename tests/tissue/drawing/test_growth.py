"""Tests of where a patch can grow without undoing a pull."""

from dataclasses import replace

import pytest

from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Stroke
from napari_hmrf.tissue.drawing.growth import patch_at, with_patch

SHAPE, SPACING = (60, 60), (1.0, 1.0)
PULL = Arrow((30, 30), (0, 4), 4.0)
HOLD = Stroke("pin", (((30, 30),),), 6.0)
PATCH = Stroke("expand", (((30, 30),),), 15.0)


def test_the_patch_at_a_position_is_the_last_mark_that_moves_or_holds_tissue_there():
    doubt = Stroke("confidence", (((30, 30),),), 9.0, confidence=0.5)
    assert patch_at(Drawing((PATCH, PULL, doubt)), (30, 33), SPACING) == 1
    assert patch_at(Drawing((PATCH, PULL, doubt)), (30, 40), SPACING) == 0
    assert patch_at(Drawing((PULL, HOLD)), (30, 30), SPACING) is None
    assert patch_at(Drawing((PULL,)), (30, 50), SPACING) is None


@pytest.mark.parametrize("place", [(30, 30), (10, 12, 14)])
def test_a_patch_is_added_below_pulls_in_its_interior(place):
    shape, spacing = (SHAPE, SPACING) if len(place) == 2 else ((20, 24, 28), (1.0, 1.0, 1.0))
    patch = Stroke("expand", ((place,),), 9.0)
    inside = Arrow(place, (1.0,) * len(place), 3.0)
    outside = Arrow((1,) * len(place), (1.0,) * len(place), 1.0)
    drawing, number = with_patch(Drawing((outside, inside)), patch, spacing, shape)
    assert (drawing.marks, number) == ((outside, patch, inside), 1)


def test_a_pull_that_later_marks_hide_does_not_stop_growth():
    far = Arrow((30, 44), (0, 4), 4.0)  # across the outline of the patch
    assert with_patch(Drawing((far,)), PATCH, SPACING, SHAPE) == far
    hidden = Drawing((far, Stroke("free", (((30, 44),),), 5.0)))
    drawing, number = with_patch(hidden, PATCH, SPACING, SHAPE)
    assert (drawing.marks, number) == ((*hidden.marks, PATCH), 2)


def test_a_patch_is_refused_if_a_later_mark_would_hold_its_outline():
    ring = Stroke("pin", (((30, 15), (30, 16)),), 2.0)
    assert with_patch(Drawing((PULL, ring)), PATCH, SPACING, SHAPE) == ring
    drawing, number = with_patch(Drawing((ring, PULL)), PATCH, SPACING, SHAPE)
    assert (drawing.marks, number) == ((ring, PATCH, PULL), 1)


def test_a_landmark_with_a_standard_deviation_has_no_patch():
    mark = Landmark((10.0, 10.0), (12.0, 10.0), 4.0)
    assert patch_at(Drawing((mark,)), (10.0, 10.0), (1.0, 1.0)) == 0
    assert patch_at(Drawing((replace(mark, sd=1),)), (10.0, 10.0), (1.0, 1.0)) is None
    patch = Stroke("expand", (((10.0, 20.0),),), 10.0, amount=1.0)
    assert with_patch(Drawing((mark,)), patch, (1.0, 1.0), (40, 40)) == mark
    drawing, _ = with_patch(Drawing((replace(mark, sd=1),)), patch, (1.0, 1.0), (40, 40))
    assert patch in drawing.marks
