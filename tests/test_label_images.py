"""Large label images are looked up without sorting, whatever their type and values."""

import numpy as np
import pytest

from napari_hmrf.tissue.labels import labels_present, values_at

IMAGES = [
    np.array([[0, 3], [3, 250]], np.uint8),
    np.array([[-128, 127], [0, 5]], np.int8),
    np.array([[-7, 2], [2, -7]], np.int64),
    np.array([[2**63 - 1, 2**63 - 3], [2**63 - 1, 2**63 - 1]], np.int64),
    np.array([[2**64 - 1, 2**64 - 2], [2**64 - 1, 2**64 - 1]], np.uint64),
    np.array([[-(2**63), 2**63 - 1], [0, 1]], np.int64),
    np.array([[0, 2**40], [5, 5]], np.int64),
    np.array([[True, False], [False, False]]),
    np.array([[4, 4], [4, 4]], ">i4"),
    np.zeros((0, 3), np.uint8),
]


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: f"{image.dtype}-{image.max(initial=0)}")
def test_labels_and_their_values_are_those_that_sorting_finds(image):
    expected, where = np.unique(image, return_inverse=True)
    present = labels_present(image)
    np.testing.assert_array_equal(present, expected)
    assert present.dtype == expected.dtype
    values = np.arange(len(expected), dtype=np.float32) + 10
    found = values_at(image, present, values)
    np.testing.assert_array_equal(found, values[where].reshape(image.shape))
    assert found.dtype == np.float32
