"""Warps, strain and arrows of displacement fields of volumes."""

import os
import subprocess
import sys
from itertools import permutations

import numpy as np
import pytest

from napari_hmrf import warp
from napari_hmrf.field.deformation import arrows, magnitude
from napari_hmrf.field.moved_points import interpolate_linearly, moved_points
from napari_hmrf.field.strain import (
    deformation_gradient,
    equivalent_strain,
    fold_mask,
    green_lagrange_strain,
    jacobian_determinant,
    principal_strains,
    small_strain,
)
from napari_hmrf.fields import inverse_map

SHAPE = (9, 11, 13)
SIZE = (1.0, 1.7, 0.6)


def places(shape=SHAPE, spacing=(1.0, 1.0, 1.0)):
    return np.moveaxis(np.indices(shape, dtype=float), 0, -1) * spacing


def bent(shape=SHAPE, amount=0.8):
    """Return a smooth motion that stays within the volume."""
    part = np.pi * places(shape) / (np.array(shape) - 1)
    hill = np.sin(part).prod(axis=-1)
    return amount * np.stack([hill, -hill, 0.5 * hill * np.cos(part[..., 0])], axis=-1)


def ball(shape=SHAPE):
    away = (places(shape) - (np.array(shape) - 1) / 2) / (np.array(shape) / 2)
    return (away**2).sum(axis=-1) < 0.8


def turned_by(degrees, axis=0):
    angle = np.deg2rad(degrees)
    matrix = np.eye(3)
    one, other = [each for each in range(3) if each != axis]
    matrix[one, one] = matrix[other, other] = np.cos(angle)
    matrix[one, other], matrix[other, one] = -np.sin(angle), np.sin(angle)
    return matrix


def linear(matrix, spacing=SIZE):
    """Return the motion with a constant deformation gradient."""
    return places(spacing=spacing) @ (matrix - np.eye(3)).T


def test_a_dot_moves_along_the_displacement():
    image = np.zeros(SHAPE, np.uint8)
    image[4, 5, 6] = 200
    moved = warp(image, np.full((*SHAPE, 3), (2.0, -1.7, 1.8)), spacing=SIZE)
    assert np.argwhere(moved).tolist() == [[6, 4, 9]]


def test_linear_motion_is_inverted_exactly():
    matrix = np.eye(3) + np.array([[0.1, 0.05, 0], [-0.08, 0.05, 0.1], [0.02, 0, -0.1]])
    origin, covered = inverse_map(linear(matrix), spacing=SIZE)
    ends = places()[covered] * SIZE
    inner = (origin[covered] > 0.5).all(axis=1) & (origin[covered] < np.array(SHAPE) - 1.5).all(1)
    np.testing.assert_allclose((origin[covered] * SIZE @ matrix.T)[inner], ends[inner], atol=1e-9)
    assert inner.sum() > 300


def test_the_warped_image_samples_the_inverse_map():
    d, image = bent(), places()[..., 2] * places()[..., 1]
    origin, covered = inverse_map(d, spacing=1)
    assert covered.all()
    ends = moved_points(origin.reshape(-1, 3), d, spacing=(1, 1, 1)).reshape(origin.shape)
    np.testing.assert_allclose(ends, places(), atol=1e-6)
    values = interpolate_linearly(image[..., None], origin.reshape(-1, 3)).reshape(SHAPE)
    np.testing.assert_allclose(warp(image, d, spacing=1), values)


def test_equal_in_plane_motion_of_all_slices_matches_the_motion_of_one_slice():
    d = np.zeros((*SHAPE, 3))
    d[..., 1:] = bent()[4, ..., 1:] + 0.3
    d[..., 1:] += 0.4 * np.sin(places()[0, ..., 1:] / 3)
    tissue = np.repeat(ball()[4][None], len(d), axis=0)
    origin, covered = inverse_map(d, spacing=1, tissue=tissue)
    slice_origin, slice_covered = inverse_map(d[0, ..., 1:], spacing=1, tissue=tissue[0])
    for plane in range(len(d)):
        both = covered[plane] & slice_covered
        near = np.abs(origin[plane][..., 1:] - slice_origin)[both]
        assert (covered[plane] == slice_covered).mean() > 0.99
        # Slices are interpolated linearly on triangles, and volumes trilinearly.
        assert (near < 0.02).mean() > 0.8, "differences are allowed only at the outline"
        assert near.max() < 1.0


@pytest.mark.parametrize("order", list(permutations(range(3)))[1:])
def test_the_warp_does_not_depend_on_the_order_of_the_axes(order):
    image = np.random.default_rng(2).normal(size=SHAPE)
    d, tissue = bent(amount=1.3), ball()
    moved = warp(image, d, tissue=tissue, spacing=SIZE)
    sizes = [SIZE[axis] for axis in order]
    other = warp(
        image.transpose(order),
        d.transpose(*order, 3)[..., list(order)],
        tissue=tissue.transpose(order),
        spacing=sizes,
    )
    inside = np.isclose(moved.transpose(order), other)
    assert inside.mean() > 0.97, "differences are allowed only at the outline"


def test_labels_stay_labels_and_unmoved_labels_do_not_change():
    labels = np.random.default_rng(0).choice([0, 3, 250], SHAPE).astype(np.uint8)
    tissue = ball()
    moved = warp(labels, bent(), spacing=1, tissue=tissue, order=0)
    assert moved.dtype == np.uint8
    assert set(np.unique(moved)) <= {0, 3, 250}
    far = ~tissue & ~ball(np.array(SHAPE))
    assert far.any()
    still = warp(labels, np.zeros((*SHAPE, 3)), spacing=1, tissue=tissue, order=0)
    np.testing.assert_array_equal(still, labels)


def test_tissue_one_voxel_thin_survives():
    tissue = np.zeros(SHAPE, bool)
    tissue[4, 5, 2:10] = tissue[2:7, 5, 5] = True
    sheet = np.zeros(SHAPE, bool)
    sheet[4] = True
    for thin in (tissue, sheet):
        moved = warp(thin.astype(float), np.full((*SHAPE, 3), 1.0), spacing=1, tissue=thin)
        there = np.zeros(SHAPE)
        there[1:, 1:, 1:] = thin[:-1, :-1, :-1]
        np.testing.assert_allclose(moved, there)


def test_folded_tissue_leaves_no_gap_in_the_inverse_map():
    d = np.zeros((*SHAPE, 3))
    d[5, 3:8, 3:8, 0] = -2.5
    assert fold_mask(d, spacing=1).any()
    _, covered = inverse_map(d, spacing=1)
    assert covered.all()


def test_the_volume_ratio_is_the_determinant_of_the_gradient():
    matrix = np.diag([1.1, 0.9, 1.3])
    ratio = jacobian_determinant(linear(matrix), spacing=SIZE)
    np.testing.assert_allclose(ratio, np.linalg.det(matrix), rtol=1e-6)
    flipped = linear(np.diag([1.0, -0.1, 1.0]))
    assert fold_mask(flipped, spacing=SIZE).all()


@pytest.mark.parametrize("axis", range(3))
def test_a_rotation_has_no_strain(axis):
    matrix = turned_by(25, axis)
    d = linear(matrix)
    tissue = np.ones(SHAPE, bool)
    tissue[:4, 3:7, 8:] = tissue[6:, :3] = False
    strain = green_lagrange_strain(d, spacing=SIZE, tissue=tissue)
    assert np.abs(strain[tissue]).max() < 1e-6
    assert np.isnan(strain[~tissue]).all()
    gradient = deformation_gradient(d, spacing=SIZE, tissue=tissue)
    np.testing.assert_allclose(gradient[tissue], np.tile(matrix, (tissue.sum(), 1, 1)), atol=2e-6)


def test_the_equivalent_strain_of_an_incompressible_bar_is_its_axial_strain():
    strain = np.diag([0.02, -0.01, -0.01])
    assert equivalent_strain(strain) == pytest.approx(0.02)
    shear = np.zeros((3, 3))
    shear[0, 2] = shear[2, 0] = 0.03 / 2
    assert equivalent_strain(shear) == pytest.approx(0.03 / np.sqrt(3))
    turned = turned_by(30, 1) @ strain @ turned_by(30, 1).T
    np.testing.assert_allclose(principal_strains(turned), [0.02, -0.01, -0.01], atol=1e-7)
    assert np.isnan(principal_strains(np.full((3, 3), np.nan))).all()


def test_a_slice_of_a_volume_has_the_strain_of_the_slice():
    d = np.zeros((*SHAPE, 3))
    d[..., 1:] = bent()[4, ..., 1:] + 0.1
    d[..., 2] += 0.05 * places()[..., 1]
    within = small_strain(d[0, ..., 1:], spacing=SIZE[1:])
    strain = small_strain(d, spacing=SIZE)
    np.testing.assert_allclose(strain[3][..., 1:, 1:], within, atol=1e-7)
    assert np.abs(strain[..., 0, :]).max() < 1e-7
    np.testing.assert_allclose(
        jacobian_determinant(d, spacing=SIZE)[3],
        jacobian_determinant(d[0, ..., 1:], spacing=SIZE[1:]),
        rtol=1e-6,
    )


def test_lengths_and_arrows_use_three_components():
    d = np.full((*SHAPE, 3), (1.0, 2.0, 2.0))
    np.testing.assert_allclose(magnitude(d), 3.0)
    found = arrows(d, spacing=SIZE, about=30)
    assert 10 < len(found) < 90
    np.testing.assert_allclose(found[:, 1], np.tile(np.array([1, 2, 2]) / SIZE, (len(found), 1)),
                               rtol=1e-5)  # fmt: skip


@pytest.mark.campaign
def test_volumes_can_be_warped_on_several_threads_at_once():
    script = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from napari_hmrf import warp
image, motion = np.random.default_rng(0).random((24, 24, 24)), np.full((24, 24, 24, 3), 0.4)
alone = warp(image, motion, spacing=1)
with ThreadPoolExecutor(4) as threads:
    for warped in threads.map(lambda _: warp(image, motion, spacing=1), range(8)):
        np.testing.assert_array_equal(warped, alone)
"""
    # This threading layer of Numba aborts a process that enters it from two threads.
    surroundings = {**os.environ, "NUMBA_THREADING_LAYER": "workqueue"}
    subprocess.run([sys.executable, "-c", script], env=surroundings, check=True)
