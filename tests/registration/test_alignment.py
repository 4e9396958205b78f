"""Alignment: turns and shifts of any size, and pairs that must not be aligned."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from napari_hmrf import NoteWarning
from napari_hmrf.registration import register
from napari_hmrf.registration.alignment import align

pytest.importorskip("SimpleITK")


def texture(seed, shape, width):
    image = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), width)
    return ((image - image.min()) / np.ptp(image)).astype(np.float32)


def about_the_centre(shape, turn, shift):
    """Return the matrix of a turn about the centre of an image, and a shift."""
    centre = (np.array(shape) - 1) / 2
    matrix = np.eye(len(shape) + 1)
    matrix[:-1, :-1], matrix[:-1, -1] = turn, centre - turn @ centre + shift
    return matrix


def moved(image, matrix):
    """Return the image whose content is moved by a matrix; black where the content is unknown."""
    back = np.linalg.inv(matrix)
    return ndimage.affine_transform(image, back[:-1, :-1], back[:-1, -1], order=1)


def aligned(kind, fixed, moving, spacing=1.0, **options):
    sizes = (spacing,) * fixed.ndim
    masks = np.ones(fixed.shape, bool), np.ones(moving.shape, bool)
    return align(kind, fixed, moving, spacing=sizes, moving_spacing=sizes, masks=masks, **options)


def mean_error(found, truth, shape):
    sites = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, len(shape))
    away = sites @ (found - truth)[:-1, :-1].T + (found - truth)[:-1, -1]
    return np.linalg.norm(away, axis=1).mean()


@pytest.mark.parametrize("kind", ["rigid", "affine"])
@pytest.mark.parametrize("contrast", [1, -1])
def test_a_picture_that_is_turned_far_and_shifted_is_found(kind, contrast):
    before = texture(0, (150, 180), 3)
    angle = np.radians(150)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    truth = about_the_centre(before.shape, turn, (20, -25))
    after = 300 * contrast * moved(before, truth) ** 1.3
    found = aligned(kind, before, after, spacing=0.5)
    assert found.notes == ()
    truth[:-1, -1] *= 0.5
    assert mean_error(found.matrix, truth, before.shape) < 0.5


def test_a_volume_that_is_turned_far_is_found():
    shape = (20, 14, 17)
    axes = np.meshgrid(*(np.linspace(-1.2, 1.2, n) for n in shape), indexing="ij")
    inside = np.linalg.norm(axes, axis=0) < 1
    body = ndimage.gaussian_filter(inside.astype(np.float32), 0.7)
    before = body * (0.4 + texture(1, shape, 2))
    turn = Rotation.from_rotvec(np.radians(160) * np.array([0.6, 0.0, 0.8])).as_matrix()
    truth = about_the_centre(before.shape, turn, (2, -1, 1))
    found = aligned("rigid", before, moved(before, truth))
    assert mean_error(found.matrix, truth, before.shape) < 0.5


def test_images_without_common_tissue_stay_where_they_are_with_a_note():
    before, after = texture(2, (96, 96), 2), texture(3, (96, 96), 2)
    with pytest.warns(NoteWarning, match="were not aligned"):
        found = register(before, after, spacing=1, initial="rigid")
    np.testing.assert_array_equal(found.matrix, np.eye(3))
    assert any("were not aligned" in note for note in found.solution.notes)
    start = about_the_centre(before.shape, np.eye(2), (3.5, -1))
    np.testing.assert_array_equal(aligned("affine", before, after, start=start).matrix, start)
    assert aligned("rigid", before, np.zeros_like(before)).notes


def test_symmetric_tissue_is_not_turned_by_half_a_turn():
    rows, cols = np.indices((120, 120)) - 59.5
    ring = np.exp(-(((np.hypot(rows, 1.4 * cols) - 40) / 4) ** 2)) + np.exp(-((rows / 6) ** 2))
    noise = [0.05 * texture(seed, ring.shape, 1) for seed in (4, 5)]
    truth = about_the_centre(ring.shape, np.eye(2), (6, 4))
    first = (ring + noise[0]).astype(np.float32)
    found = aligned("rigid", first, moved(ring, truth).astype(np.float32) + noise[1])
    assert mean_error(found.matrix, truth, ring.shape) < 1


def test_images_at_the_same_place_are_not_resampled():
    before = texture(6, (64, 64), 2)
    found = aligned("affine", before, 2 * before + 1)
    np.testing.assert_array_equal(found.matrix, np.eye(3))
    assert found.notes == ()
