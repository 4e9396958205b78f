"""Tests of the head phantom and of its growing tumour."""

import numpy as np
import pytest
from scipy.ndimage import label

from napari_hmrf import ArgumentError, solve, warp
from napari_hmrf.data import head_phantom
from napari_hmrf.field.strain import jacobian_determinant
from napari_hmrf.samples.head import GROWTH


@pytest.fixture(scope="module")
def small():
    return head_phantom(48)


@pytest.fixture(scope="module")
def grown(small):
    return solve(small.problem)


def test_each_part_of_the_head_has_its_place_and_volume(small):
    counts = np.bincount(small.tissue_labels.ravel(), minlength=4) * np.prod(small.spacing)
    brain, ventricles, tumour = counts[1:] / 1e6
    assert brain + ventricles + tumour == pytest.approx(
        4 / 3 * np.pi * 0.62 * 0.84 * 0.66, rel=0.02
    ), "the volume in litres is wrong"
    assert tumour == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.02)
    assert 0.015 < ventricles < 0.03
    assert label(small.tissue_labels > 0)[1] == label(small.tissue_labels == 3)[1] == 1
    bone = (small.image > 200) & (small.tissue_labels == 0)
    assert bone.any()
    assert small.image[0].mean() < 5, "there is no air around the head"


def test_the_tumour_grows_and_the_brain_stays_inside_the_skull(small, grown):
    labels = small.tissue_labels
    after = warp(labels, grown.displacement, spacing=small.spacing, tissue=labels > 0, order=0)
    larger = (after == 3).sum() / (labels == 3).sum()
    assert 1.5 < larger < 1.25**3
    assert ((after > 0) == (labels > 0)).mean() > 0.99
    ratio = jacobian_determinant(grown.displacement, spacing=small.spacing, tissue=labels > 0)
    assert np.median(ratio[labels == 3]) == pytest.approx(1.25**3, rel=0.03)
    assert np.nanmean(ratio[labels == 2]) < 0.98, "ventricles are not compressed"


def test_the_tissue_of_the_sample_does_not_fold():
    assert solve(head_phantom(48, growth=GROWTH).problem).count_folds() == 0


def test_the_rim_moves_outward_and_the_skull_is_fixed(small):
    known = small.problem
    rim, skull = small.boundary_labels == 2, small.boundary_labels == 1
    assert (known.known.any(axis=-1) == (rim | skull)).all()
    assert not known.observed[skull].any()
    moved = known.observed[rim]
    assert np.linalg.norm(moved, axis=-1) == pytest.approx(5.0, rel=1e-5)
    away = np.argwhere(rim) - np.argwhere(small.tissue_labels == 3).mean(axis=0)
    away /= np.linalg.norm(away, axis=-1)[:, None]
    assert ((moved / 5 * away).sum(axis=-1) > 0.98).all()


def test_axes_of_the_head_point_up_back_and_left(small):
    frame = small.frame
    assert frame.axis_labels == ("superior", "posterior", "left")
    middle = [*((n - 1) / 2 for n in small.image.shape), 1.0]
    assert np.array(frame.matrix) @ middle == pytest.approx([0, 0, 0, 1])
    tumour = [*np.argwhere(small.tissue_labels == 3).mean(axis=0), 1.0]
    assert (np.array(frame.matrix) @ tumour)[:3] == pytest.approx((10, 28, 30), abs=1.0)


def test_the_motion_in_millimetres_does_not_depend_on_the_voxel_size(small, grown):
    fine = head_phantom(64)
    other = solve(fine.problem)
    far, near = (
        np.linalg.norm(each.displacement, axis=-1)[of.tissue_labels == 1].mean()
        for each, of in ((grown, small), (other, fine))
    )
    assert far == pytest.approx(near, rel=0.15)


def test_the_head_is_reproducible_and_read_only(small):
    again = head_phantom(48)
    np.testing.assert_array_equal(again.image, small.image)
    with pytest.raises(ValueError, match="read-only"):
        small.image[0, 0, 0] = 1


def test_an_invalid_size_of_the_head_is_refused():
    for size in (23, 30.5, "large", None):
        with pytest.raises(ArgumentError, match="size"):
            head_phantom(size)
