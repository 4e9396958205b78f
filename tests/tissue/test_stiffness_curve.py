"""Tests of the stiffness curve, which maps intensities to stiffnesses."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from napari_hmrf.errors import ArgumentError, ProblemError
from napari_hmrf.field.brightness import luminance
from napari_hmrf.tissue.stiffness_curve import (
    StiffnessCurve,
    first_curve,
    with_point,
)

RAMP = StiffnessCurve(((0, 1), (100, 100)))


def test_a_curve_interpolates_logarithmically_or_linearly():
    assert RAMP(50) == pytest.approx(10)
    assert StiffnessCurve(RAMP.points, logarithmic=False)(50) == pytest.approx(50.5)


def test_a_curve_is_constant_beyond_its_ends():
    np.testing.assert_allclose(RAMP([-1e30, -np.inf, 1e30, np.inf]), [1, 1, 100, 100])


def test_dark_and_masked_and_nan_pixels_are_void():
    curve = StiffnessCurve(RAMP.points, void_below=20)
    np.testing.assert_array_equal(curve([0, 19.9, np.nan]), [0, 0, 0])
    assert curve(20.0) == pytest.approx(RAMP(20.0))
    masked = np.ma.array([50.0, 60.0], mask=[True, False])
    assert curve(masked)[0] == 0
    assert not np.ma.isMA(curve(masked))


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        *((kind, (3, 4)) for kind in "?bhHlLefdg"),
        *(("B", shape) for shape in [(), (0,), (7,), (2, 3, 4, 5)]),
    ],
)
def test_the_stiffness_has_the_shape_of_an_image_of_any_type(kind, shape):
    image = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(np.dtype(kind))
    for curve in (
        RAMP,
        StiffnessCurve(
            ((-3, 2), (1, 5), (300, 1)), void_below=1, between="smooth", logarithmic=False
        ),
    ):
        stiffness = curve(image)
        assert stiffness.dtype == np.float32
        assert stiffness.shape == shape
        np.testing.assert_allclose(stiffness, curve(image.astype(float)), rtol=1e-5)


@pytest.mark.parametrize("kind", [np.int8, np.int64, np.uint64])
def test_extreme_integers_are_mapped_exactly(kind):
    ends = np.iinfo(kind)
    many = np.full(1000, ends.max, kind)
    many[0] = ends.max - 1
    np.testing.assert_allclose(RAMP(many), 100)
    np.testing.assert_allclose(RAMP(np.full(1000, ends.min, kind)), 1)
    assert RAMP(np.array([ends.min, ends.max])).tolist() == [1, 100]


def test_a_strided_view_of_an_image_is_mapped_correctly():
    image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    np.testing.assert_array_equal(RAMP(image.T[::-2]), RAMP(image).T[::-2])


@pytest.mark.parametrize("image", [np.array([1j]), np.array(["a"]), np.array([None])])
def test_intensities_that_are_not_real_numbers_are_refused(image):
    with pytest.raises(ProblemError, match="real numbers"):
        RAMP(image)


curves = st.builds(
    lambda points, between, logarithmic: StiffnessCurve(
        tuple(sorted(points.items())), void_below=None, between=between, logarithmic=logarithmic
    ),
    st.dictionaries(st.integers(-1000, 1000), st.floats(1e-3, 1e4), min_size=2, max_size=8),
    st.sampled_from(["straight", "smooth"]),
    st.booleans(),
)


@settings(max_examples=25)
@given(curves)
def test_a_curve_passes_through_its_points_without_overshoot(curve):
    intensities, stiffnesses = np.array(curve.points).T
    np.testing.assert_allclose(curve(intensities), stiffnesses, rtol=1e-5)
    for (left, one), (right, other) in zip(curve.points, curve.points[1:], strict=False):
        between = curve(np.linspace(left, right, 50))
        assert between.min() >= min(one, other) * (1 - 1e-5)
        assert between.max() <= max(one, other) * (1 + 1e-5)
        assert (np.diff(between) * (other - one) >= -1e-4 * max(one, other) ** 2).all()


@settings(max_examples=15)
@given(curves)
def test_a_stored_curve_is_read_back_equal(curve):
    stored = json.loads(json.dumps(curve.as_dict()))
    again = StiffnessCurve.from_dict(stored)
    assert again == curve
    assert hash(again) == hash(curve)


def test_a_smooth_curve_is_a_monotone_cubic():
    from scipy.interpolate import PchipInterpolator

    points = ((0, 1), (10, 5), (30, 6), (31, 40))
    curve = StiffnessCurve(points, between="smooth", logarithmic=False)
    at = np.linspace(0, 31, 1001)
    np.testing.assert_allclose(curve(at), PchipInterpolator(*np.array(points).T)(at), atol=0.02)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"points": ()}, "points must be two or more pairs"),
        ({"points": ((0, 1),)}, "points must be two or more pairs"),
        ({"points": ((0, 1), (0, 2))}, "intensity 0 twice. List each once, in increasing order"),
        ({"points": ((5, 1), (0, 2))}, "intensity 0 after 5. List each once, in increasing order"),
        ({"points": ((0, 1), (1, 0))}, "a stiffness, above 0"),
        ({"points": ((0, 1), (1, -3))}, "a stiffness, above 0"),
        ({"points": ((0, 1), (1, float("nan")))}, "a stiffness, above 0"),
        ({"points": ((0, 1), (float("inf"), 2))}, "pairs of an intensity and a stiffness"),
        ({"points": ((0, 1), (1, 1e300))}, "no larger than 3.4e+38"),
        ({"points": ((0, 1), (1,))}, "pairs of an intensity and a stiffness"),
        ({"points": 5}, "pairs of an intensity and a stiffness"),
        ({"points": (("a", 1), (1, 1))}, "pairs of an intensity and a stiffness"),
        ({"void_below": float("nan")}, "void_below must be a number"),
        ({"void_below": "dark"}, "void_below must be a number"),
        ({"between": "wavy"}, "between must be straight or smooth, not 'wavy'"),
        ({"logarithmic": 2}, "logarithmic must be True or False"),
        ({"unit": None}, "unit must be text"),
    ],
)
def test_an_invalid_curve_is_refused_in_one_sentence(values, said):
    with pytest.raises(ArgumentError) as error:
        StiffnessCurve(**{"points": RAMP.points, **values})
    assert said in str(error.value)


@pytest.mark.parametrize("values", [None, [], {}, {"points": [[0, 1], [1, 2]], "extra": 1}])
def test_an_invalid_stored_curve_is_refused(values):
    with pytest.raises(ArgumentError, match=r"^curve "):
        StiffnessCurve.from_dict(values)


def test_the_initial_curve_makes_brighter_pixels_stiffer():
    image = np.random.default_rng(0).normal(100, 20, (64, 64))
    curve = StiffnessCurve.from_percentiles(image)
    assert [stiffness for _, stiffness in curve.points] == [10, 20, 40]
    assert curve.points[1][0] == pytest.approx(100, abs=2)
    assert (curve(image) < 20).mean() == pytest.approx(0.5, abs=0.01)


def test_the_initial_curve_ignores_the_background():
    image = np.zeros((50, 50))
    image[10:40, 10:40] = np.linspace(50, 150, 900).reshape(30, 30)
    curve = StiffnessCurve.from_percentiles(image, void_below=10)
    assert curve.points[1][0] == pytest.approx(100, abs=1)
    assert (curve(image) == 0).sum() == 50 * 50 - 900


def test_the_initial_curve_requires_two_intensities():
    image = np.zeros((40, 40), bool)
    image[0, 0] = True
    assert StiffnessCurve.from_percentiles(image).points == ((0, 10), (1, 40))
    for flat in (np.full((4, 4), 3), np.full((4, 4), np.nan), np.zeros((0, 4))):
        with pytest.raises(ProblemError, match="single intensity"):
            StiffnessCurve.from_percentiles(flat)


def test_the_initial_curve_excludes_dark_surroundings_and_includes_dark_holes():
    head = np.full((40, 40), 3.0) + np.random.default_rng(0).random((40, 40))
    head[8:32, 8:32] = 100 + 20 * np.random.default_rng(1).random((24, 24))
    head[18:22, 18:22] = 12  # fluid
    m = first_curve(head)(head)
    assert (m[:8] == 0).mean() > 0.97
    assert (m[8:32, 8:32] > 0).all()
    assert first_curve(head[8:32, 8:32]).void_below is None


def test_luminance_weights_colours_by_perceived_brightness():
    red, green, white = np.eye(4, 3)[0] * 255, np.eye(4, 3)[1] * 255, np.full(3, 255)
    bright = luminance(np.array([[red, green, white]], dtype=np.uint8))
    assert bright.shape == (1, 3)
    assert bright[0, 0] < bright[0, 1] < bright[0, 2]
    assert bright[0, 2] == pytest.approx(255)
    np.testing.assert_array_equal(luminance(np.zeros((2, 2, 4), np.uint8) + 255), bright[0, 2])


def test_points_are_added_moved_and_removed_as_new_curves():
    three = with_point(RAMP, None, (50, 3))
    assert three.points == ((0, 1), (50, 3), (100, 100))
    assert with_point(three, 1, (60, 4)).points == ((0, 1), (60, 4), (100, 100))
    assert with_point(three, 1, None) == RAMP
    with pytest.raises(ArgumentError, match="two or more"):
        with_point(RAMP, 0, None)
    assert RAMP.points == ((0, 1), (100, 100))
