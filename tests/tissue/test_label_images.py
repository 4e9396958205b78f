"""Labels are looked up whatever their type and values."""

import numpy as np
import pytest

from napari_hmrf.tissue.boundary_rules import Material, stiffness_image, unlisted

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
def test_each_pixel_gets_the_stiffness_of_its_label(image):
    labels = sorted({int(label) for label in image.flat})
    materials = [Material(label, "", 10 + number) for number, label in enumerate(labels)]
    found = stiffness_image(image, materials)
    assert found.dtype == np.float32
    wanted = [10 + labels.index(int(label)) for label in image.flat]
    np.testing.assert_array_equal(found.ravel(), wanted)


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: f"{image.dtype}-{image.max(initial=0)}")
def test_labels_without_a_row_are_listed(image):
    labels = sorted({int(label) for label in image.flat})
    assert unlisted(image, [Material(label, "", 1) for label in labels[1:]]) == labels[:1]
