"""Marks that stay visible at a low zoom."""

from types import SimpleNamespace

import numpy as np
import pytest

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.thick_marks import half_widths, thickened

SQUARE = Frame.at((1.0, 1.0), ("pixel",) * 2)
TALL = Frame.at((2.0, 1.0, 0.5), ("pixel",) * 3, volume=True)


def view(zoom, displayed, ndim):
    dims = SimpleNamespace(displayed=displayed, ndim=ndim)
    return SimpleNamespace(camera=SimpleNamespace(zoom=zoom), dims=dims)


@pytest.mark.parametrize(("zoom", "widths"), [(4.0, (0, 0)), (1.0, (1, 1)), (0.25, (6, 6))])
def test_a_mark_is_at_least_three_screen_pixels_wide(zoom, widths):
    assert half_widths(view(zoom, (0, 1), 2), SQUARE) == widths
    marks = np.zeros((40, 40), np.uint8)
    marks[20, 20] = 1
    thick = thickened(marks, widths)
    assert thick.any(axis=0).sum() * zoom >= 3
    assert marks.sum() == 1, "the exact marks were changed"


def test_marks_of_a_volume_are_thick_within_the_displayed_slice_only():
    marks = np.zeros((9, 9, 9), np.uint8)
    marks[4, 4, 4] = 1
    widths = half_widths(view(1.0, (1, 2), 3), TALL)
    thick = thickened(marks, widths)
    assert widths == (0, 1, 3)
    assert np.argwhere(thick.any(axis=(1, 2))).ravel().tolist() == [4]


def test_marks_at_the_border_stay_inside_the_image():
    marks = np.zeros((4, 5), np.uint8)
    marks[0, 4] = 1
    assert np.argwhere(thickened(marks, (1, 1))).tolist() == [[0, 3], [0, 4], [1, 3], [1, 4]]


def test_an_image_without_marks_stays_empty():
    assert not thickened(np.zeros((4, 5), np.uint8), (2, 2)).any()
