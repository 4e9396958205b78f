"""Tests of the coarse volume and the cut that are shown during a drag in the 3-D view."""

import numpy as np
import pytest

from napari_hmrf import warp
from napari_hmrf.field.volume_preview import CutPlane, VolumePreview

SHAPE, SPACING, EVERY = (40, 44, 36), (2.0, 1.0, 1.0), 4
PLANE = CutPlane((20, 22, 18), (1.0, 0.4, -0.3))


@pytest.fixture(scope="module")
def motion():
    """Return a smooth image, a smooth displacement on all voxels, and the tissue."""
    places = np.moveaxis(np.indices(SHAPE), 0, -1)
    image = np.float32(100 + places @ (1.0, 2.0, -1.5))
    away = ((places - (20, 22, 18)) * (2, 1, 1) / 16) ** 2
    d = np.exp(-away.sum(axis=-1))[..., np.newaxis] * np.float32((2.0, 3.0, -2.0))
    return image, np.float32(d), np.ones(SHAPE, bool)


def coarse(array):
    return np.ascontiguousarray(array[::EVERY, ::EVERY, ::EVERY])


def test_a_coarse_volume_agrees_with_the_whole_volume(motion):
    image, d, tissue = motion
    preview = VolumePreview(image, EVERY, SPACING)
    shown = preview.coarse(coarse(d), coarse(tissue))
    inside = (slice(1, -1),) * 3  # tissue may leave the volume at its border
    exact = coarse(warp(image, d, spacing=SPACING, tissue=tissue))
    moved = np.abs(exact - coarse(image))[inside].max()
    assert np.abs(shown - exact)[inside].max() < 0.15 * moved


@pytest.mark.parametrize("kind", [np.float32, np.uint8])
def test_a_cut_agrees_with_the_whole_volume(motion, kind):
    image, d, tissue = motion
    image = image.astype(kind)
    preview = VolumePreview(image, EVERY, SPACING)
    where = tuple(PLANE.voxels(SHAPE).T)
    shown = preview.cut(coarse(d), coarse(tissue), PLANE)
    exact = warp(image, d, spacing=SPACING, tissue=tissue)[where].astype(float)
    # Tissue may leave the volume at its border.
    inside = np.all([(at > 4) & (at < size - 5) for at, size in zip(where, SHAPE, strict=True)], 0)
    error, moved = (np.abs(each - exact)[inside] for each in (shown, image[where]))
    assert shown.dtype == kind
    assert np.sqrt(np.mean(error**2)) < 0.15 * np.sqrt(np.mean(moved**2))


def test_tissue_at_the_border_moves_in_a_cut():
    image = np.zeros((24, 24, 24), np.float32)
    image[8:16] = 100
    tissue = image > 0
    d = np.where(tissue[..., np.newaxis], np.float32((4, 0, 0)), 0)
    preview = VolumePreview(image, 4, (1, 1, 1))
    plane = CutPlane((12, 12, 12), (0, 0, 1))
    seen = np.full(image.shape, np.nan)
    seen[tuple(plane.voxels(image.shape).T)] = preview.cut(
        d[::4, ::4, ::4], np.ascontiguousarray(tissue[::4, ::4, ::4]), plane
    )
    assert seen[17, 12, 12] == 100, "the front did not move"
    assert seen[9, 12, 12] < 100, "the tissue left its image behind"


@pytest.mark.parametrize("normal", [(1, 0, 0), (0, 0, 2), (0.3, -0.4, 0.2)])
def test_a_cut_consists_of_the_voxels_near_its_plane(normal):
    plane = CutPlane((10, 12.5, 14), normal, thickness=2.0)
    found = np.zeros((20, 24, 28), bool)
    found[tuple(plane.voxels(found.shape).T)] = True
    unit = np.array(normal) / np.linalg.norm(normal)
    away = np.abs((np.moveaxis(np.indices(found.shape), 0, -1) - plane.position) @ unit)
    assert np.array_equal(found, away <= 2.0)


def test_a_line_along_a_plane_does_not_meet_it():
    assert PLANE.meets((0, 0, 0), (0.4, -1, 0)) is None
    met = PLANE.meets((0, 22, 18), (1, 0, 0))
    assert met == pytest.approx(PLANE.position)
