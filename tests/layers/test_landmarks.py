"""Tests of landmarks from two Points layers."""

import numpy as np
import pytest
from napari.layers import Image, Points

from napari_hmrf import ProblemError
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.tissue.drawing import Landmark


def landmarks(where, should, image=None, view=None, **place):
    image = image or Image(np.zeros((40, 50)), name="MR")
    where, should = Points(where, name="is", **place), Points(should, name="ought", **place)
    frame = frame_of(image, view)
    shape = image.data.shape[-2:]
    return read_landmarks(where, should, frame, shape, radius=3.0, confidence=0.5)


def test_points_are_paired_by_their_order():
    found = landmarks([[1, 2], [10, 20]], [[3, 4], [11, 22]])
    assert found == (
        Landmark((1, 2), (3, 4), 3.0, 0.5),
        Landmark((10, 20), (11, 22), 3.0, 0.5),
    )


def test_points_are_read_at_their_world_position():
    image = Image(np.zeros((40, 50)), scale=(0.5, 2), translate=(10, 0), units=("mm", "mm"))
    (found,) = landmarks([[1.5, 1.0]], [[1.6, 1.0]], image, units=("cm", "cm"))
    assert found.source == pytest.approx((10, 5))
    assert found.target == pytest.approx((12, 5))


def test_only_pairs_on_the_displayed_slice_are_read():
    image = Image(np.zeros((5, 40, 50)), name="stack")
    view = View((1, 2), (3.0, 0.0, 0.0))
    where, should = [[3, 1, 2], [4, 5, 6]], [[3, 2, 2], [4, 6, 6]]
    assert landmarks(where, should, image, view) == (Landmark((1, 2), (2, 2), 3.0, 0.5),)
    on_all = landmarks([[1, 2]], [[2, 2]], image, view)
    assert on_all == (Landmark((1, 2), (2, 2), 3.0, 0.5),)
    with pytest.raises(ProblemError, match="'ought' has point 0 with its target on another slice"):
        landmarks([[3, 1, 2]], [[4, 2, 2]], image, view)
    with pytest.raises(ProblemError, match="no points on slice 3"):
        landmarks([[2, 1, 2]], [[2, 2, 2]], image, view)


@pytest.mark.filterwarnings(
    "ignore:invalid value:RuntimeWarning"
)  # The warning is raised by napari's thumbnail.
@pytest.mark.parametrize(
    ("where", "should", "words"),
    [
        ([[1, 2]], [[1, 2], [3, 4]], "'ought' has 2 points, but 'is' has 1"),
        (np.zeros((0, 2)), np.zeros((0, 2)), "'is' has no points"),
        ([[1, 2], [50, 4]], [[1, 2], [3, 4]], "'is' has point 1 outside the image"),
        ([[1, 2]], [[np.nan, 2]], "'ought' has NaN or infinity in point 0"),
        ([[1, 2], [9, 9], [1.2, 2]], [[5, 2], [9, 9], [8, 2]], "'is' has points 0 and 2 in one"),
    ],
)
def test_points_without_a_valid_pair_are_refused_by_name(where, should, words):
    with pytest.raises(ProblemError, match=words):
        landmarks(where, should)


def test_a_feature_of_the_target_layer_contains_standard_deviations():
    where = [[1, 2], [10, 20], [10.2, 20], [30, 40]]
    targets = Points(np.add(where, [[1, 0], [2, 0], [0, 2], [1, 1]]), name="ought")
    targets.features = {"sd": [0.5, 2, 1, np.nan]}
    pair, image = (
        (Points(where, name="is"), targets),
        (frame_of(Image(np.zeros((40, 50)))), (40, 50)),
    )
    assert [mark.sd for mark in read_landmarks(*pair, *image)] == [0.5, 2, 1, 0]
    assert {mark.sd for mark in read_landmarks(*pair, *image, sd=3)} == {3}
    for value in (-1, "wide"):
        targets.features = {"sd": [0.5, 2, 1, value]}
        with pytest.raises(ProblemError, match=r"'ought' has an invalid .* of point 3\."):
            read_landmarks(*pair, *image)
    targets.features = {"sd": [0.5, 2, 1, 1e9]}
    with pytest.raises(ProblemError, match=r"'ought' .* 1e\+09 for point 3\. Use at most 64\.03"):
        read_landmarks(*pair, *image)


def test_close_landmarks_have_patches_that_do_not_overlap():
    near, also, far = landmarks([[10, 10], [10, 14], [30, 40]], [[11, 10], [9, 14], [30, 40]])
    assert (near.radius, also.radius, far.radius) == (2.0, 2.0, 3.0)


def test_points_with_an_additional_axis_are_read_on_the_displayed_slice():
    image = Image(np.zeros((40, 50)))
    pair = (
        Points([[3, 1, 2], [4, 5, 6]], name="is"),
        Points([[3, 2, 2], [4, 6, 6]], name="ought"),
    )
    view = View((1, 2), (4.0, 0.0, 0.0))
    found = read_landmarks(*pair, frame_of(image, view), (40, 50), view, radius=3.0)
    assert found == (Landmark((5, 6), (6, 6), 3.0),)
