"""Lines that display prescribed motion."""

import numpy as np
import pytest

from napari_hmrf.field.motion_lines import motion_marks, patch_lines

SPACING = (0.5, 2.0)


def ends(lines):
    return lines.sum(axis=1)


def is_at(points, *place):
    return np.isclose(points, place, atol=1e-9).all(axis=1).any()


def test_a_moving_patch_has_an_arrow_from_its_start_to_its_target():
    lines = patch_lines((10, 20), (3.0, 4.0), 2.0, SPACING)
    shaft = np.isclose(lines[:, 0], (10, 20)).all(axis=1)
    np.testing.assert_allclose(ends(lines[shaft]), [(10 + 3 / 0.5, 20 + 4 / 2.0)])


def test_the_outline_of_a_patch_surrounds_the_arrow_head():
    lines = patch_lines((10, 20), (3.0, 4.0), 2.0, SPACING)
    away = np.linalg.norm((lines[:20, 0] - (16, 22)) * SPACING, axis=1)
    assert away == pytest.approx(2.0)


@pytest.mark.parametrize("only", [None, 0, 1])
def test_a_pinned_patch_has_a_cross_and_a_sliding_patch_a_double_arrow(only):
    lines = patch_lines((10, 20), (0.0, 0.0), 2.0, SPACING, only=only)[20:]
    assert len(lines) == (2 if only is None else 5)
    ways = lines[0 if only is not None else slice(None), 1]
    assert [axis for axis in (0, 1) if np.any(np.atleast_2d(ways)[:, axis])] == (
        [0, 1] if only is None else [only]
    )


def test_a_landmark_has_a_cross_at_its_source():
    plain = patch_lines((10, 20), (3.0, 4.0), 2.0, SPACING)
    found = patch_lines((10, 20), (3.0, 4.0), 2.0, SPACING, is_place=True)
    np.testing.assert_array_equal(found[: len(plain)], plain)
    middles = found[len(plain) :, 0] + found[len(plain) :, 1] / 2
    np.testing.assert_allclose(middles, [(10, 20), (10, 20)])


def test_a_circle_of_uncertainty_is_at_most_as_wide_as_the_image():
    lines = patch_lines((10, 20), (0.0, 0.0), 1.0, (1.0, 1.0), spread=1e9, shape=(30, 40))
    assert np.abs(lines[:, 0] - (10, 20)).max() == pytest.approx(20)
    volume = {"spread": 1e9, "shape": (8, 30, 40)}
    lines = patch_lines((4, 10, 20), (0.0, 0.0, 0.0), 1.0, (0.01, 1.0, 1.0), **volume)
    assert np.unique(lines[:, 0, 0].round(6)).tolist() == [*range(8)]
    assert np.abs(lines[:, 0] - (4, 10, 20)).max() == pytest.approx(20, rel=1e-3)


def test_only_shafts_leave_the_displayed_slices_of_a_volume():
    lines = patch_lines((4, 10, 20), (2.0, 3.0, 4.0), 3.0, (1.0, 0.5, 2.0), across=0)
    leaning = lines[lines[:, 1, 0] != 0]
    np.testing.assert_allclose(ends(leaning), [(6, 16, 22)])


def test_marks_distinguish_fixed_moving_and_sliding_sites():
    at = np.array([[1.0, 1.0], [5.0, 5.0], [9.0, 9.0]])
    by = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]])
    known = np.array([[True, True], [True, True], [False, True]])
    lines = motion_marks(at, by, known, apart=1.0)
    assert is_at(ends(lines), 7, 5), "the arrow should end at the target"
    crossed = lines[np.isclose(lines[:, 0] + lines[:, 1] / 2, (1, 1)).all(axis=1)]
    assert len(crossed) == 2
    (shaft,) = lines[np.isclose(lines[:, 0] + lines[:, 1] / 2, (9, 9)).all(axis=1)]
    assert shaft[1, 0] == 0, "the line should be along the prescribed component"
