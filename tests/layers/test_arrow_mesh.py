"""Tests of the outline and the heads of arrows and lines."""

import numpy as np
import pytest

from napari_hmrf.layers.arrow_mesh import outlined

WIDTH, ORANGE = 1.0, (1.0, 0.4, 0.0, 1.0)


def drawn(*lengths):
    """Return the corners of outlines and arrows; napari's arrows point along the first axis."""
    edges = [(0, 0.5), (0, -0.5), (0.75, 0.5), (0.75, -0.5), (0.75, 1), (0.75, -1), (1, 0)]
    corners = [np.array(edges) * (length, 1) for length in lengths]
    count = len(lengths)
    faces = np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6]])
    faces = np.concatenate([faces + 7 * number for number in range(count)])
    vertices = np.array(corners, np.float32).reshape(-1, 2)
    vertices, faces, colours = outlined(vertices, faces, np.tile(ORANGE, (3 * count, 1)))
    assert faces.max() == len(vertices) - 1
    outline, fill = vertices.reshape(2, count, 7, 2)
    return outline, fill, colours


def head(arrow):
    """Return the length and the width of a head."""
    return arrow[6, 0] - arrow[4, 0], np.ptp(arrow[4:6, 1])


@pytest.mark.parametrize("length", [0.01, 1.0, 5.0, 40.0])
def test_an_arrow_of_any_length_has_a_visible_head_and_its_tip_in_place(length):
    _, (arrow,), _ = drawn(length)
    long, wide = head(arrow)
    assert long == pytest.approx(max(2 * WIDTH, length / 4), rel=1e-4)
    assert wide == pytest.approx(2 * WIDTH, rel=1e-4)
    np.testing.assert_allclose(arrow[6], (length, 0), atol=1e-6)


def test_a_dark_outline_is_drawn_first_and_is_equally_wide_on_all_sides():
    (outline,), (arrow,), colours = drawn(10.0)
    assert (colours[:3, :3] < 0.1).all()
    np.testing.assert_allclose(colours[3:], [ORANGE] * 3)
    border = 0.3 * WIDTH
    assert outline[0, 0] == pytest.approx(-border, abs=1e-5)
    assert outline[0, 1] == pytest.approx(arrow[0, 1] + np.sign(arrow[0, 1]) * border)
    assert outline[4, 0] == pytest.approx(arrow[4, 0] - border, abs=1e-5)
    for side in (4, 5):
        along = outline[6] - outline[side]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        assert abs((arrow[6] - outline[6]) @ normal) == pytest.approx(border, abs=1e-5)
        assert abs((arrow[side] - outline[6]) @ normal) == pytest.approx(border, abs=1e-5)


def test_an_arrow_of_length_zero_covers_nothing():
    outline, fill, _ = drawn(0.0)
    assert np.ptp(outline, axis=1).max() == 0
    assert np.ptp(fill, axis=1).max() == 0


def test_a_line_in_any_direction_has_a_dark_outline_of_the_same_width_on_all_sides():
    line = np.array([[0, 0.5], [0, -0.5], [8, 0.5], [8, -0.5]], np.float32)
    vertices = np.concatenate([line, line[:, ::-1]])
    faces = np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]])
    vertices, faces, colours = outlined(vertices, faces, np.tile(ORANGE, (4, 1)))
    outline, fill = vertices.reshape(2, 2, 4, 2)
    np.testing.assert_allclose(np.ptp(fill, axis=1), [(8, 1), (1, 8)])
    np.testing.assert_allclose(np.ptp(outline, axis=1), [(9, 2), (2, 9)], rtol=1e-5)
    np.testing.assert_allclose(outline.mean(axis=1), fill.mean(axis=1), atol=1e-6)
    assert (colours[:4, :3] < 0.1).all()
    assert (faces[:4] < 8).all(), "an outline is drawn over a line"


def test_other_shapes_are_left_to_napari():
    faces, colours = np.array([[0, 1, 2]]), np.ones((1, 4))
    assert outlined(np.zeros((3, 2)), faces, colours) is None
    assert outlined(np.zeros((7, 3)), np.tile(faces, (3, 1)), np.ones((3, 4))) is None
