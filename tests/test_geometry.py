"""Where a grid is, for ITK, nibabel and the arrays of this package."""

import itertools

import numpy as np
import pytest

from napari_hmrf.geometry import SAME, Geometry

SHAPE = (4, 5, 6)
SPACING = (2.0, 0.5, 0.7)
ORIGIN = (-10.0, 20.0, 5.0)
ORDERS = [*itertools.permutations(range(3))]


def oblique():
    """Return a rotation about no axis of the patient."""
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    return turn


@pytest.fixture
def grid():
    return Geometry.of_itk(SHAPE, SPACING, ORIGIN, oblique())


def test_a_grid_has_the_positions_of_itk(grid):
    sitk = pytest.importorskip("SimpleITK")
    image = sitk.Image(SHAPE[::-1], sitk.sitkUInt8)
    image.SetSpacing(SPACING[::-1])
    image.SetOrigin(ORIGIN)
    image.SetDirection(oblique().ravel())
    for index in np.ndindex(SHAPE):
        theirs = image.TransformIndexToPhysicalPoint(index[::-1])
        np.testing.assert_allclose(grid.to_world(index), theirs[::-1], atol=1e-12)
        np.testing.assert_allclose(grid.to_pixels(theirs[::-1]), index, atol=1e-12)
    assert grid.spacing == pytest.approx(SPACING)
    assert grid.origin == ORIGIN
    np.testing.assert_allclose(grid.direction, oblique(), atol=1e-12)


def test_lengths_along_an_axis_are_exact():
    grid = Geometry.of_itk(SHAPE, SPACING, ORIGIN, -np.eye(3)[:, [1, 2, 0]])
    assert grid.spacing == SPACING
    np.testing.assert_array_equal(grid.direction, -np.eye(3)[:, [1, 2, 0]])
    assert Geometry.at_origin((3, 4)).spacing == (1.0, 1.0)


@pytest.mark.parametrize("order", ORDERS)
def test_a_pixel_stays_in_its_place_when_axes_are_reordered_and_reversed(grid, order):
    indices = np.moveaxis(np.indices(SHAPE), 0, -1)
    positions = grid.to_world(indices)
    for count in range(4):
        for axes in itertools.combinations(range(3), count):
            turned = grid.reordered(order).reversed_along(axes)
            moved = np.flip(positions.transpose(*order, 3), axes)
            assert turned.shape == moved.shape[:3]
            here = np.moveaxis(np.indices(turned.shape), 0, -1)
            np.testing.assert_allclose(turned.to_world(here), moved, atol=1e-12)


def test_a_slice_stays_in_its_volume(grid):
    flat = grid.slice_at(3)
    assert flat.shape == (1, 5, 6)
    np.testing.assert_allclose(flat.to_world((0, 2, 4)), grid.to_world((3, 2, 4)))


def test_grids_are_in_the_same_place_if_their_corners_are(grid):
    assert grid.same_as(grid)
    assert not grid.same_as(None)
    assert not grid.same_as(Geometry.at_origin((4, 5)))
    assert not grid.same_as(grid.scaled(1.1))
    for axis, size in enumerate(SHAPE):
        # An error of the spacing adds up along the axis.
        for share, is_same in ((0.9, True), (1.1, False)):
            affine = grid.affine.copy()
            affine[:, axis] *= 1 + share * SAME / (size - 1)
            assert grid.same_as(Geometry(SHAPE, affine)) == is_same
    scan, rounded = (
        Geometry.at_origin((512, 512), (size,) * 2, "millimeter") for size in (0.9765625, 0.977)
    )
    assert rounded.same_as(scan)
    shifted = Geometry.of_itk((512, 512), scan.spacing, (0.5, 0.5), np.eye(2))
    assert not shifted.same_as(scan)
    cut = Geometry((3, 4, 5), grid.affine)
    assert cut.same_as(grid)
    assert grid.same_as(cut)


def test_axes_are_straightened_up_to_rounding(grid):
    assert grid.right_angled() is grid
    rounded, sheared = grid.affine.copy(), grid.affine.copy()
    rounded[:, 0] += 0.02 * rounded[:, 1]
    nearest = Geometry(SHAPE, rounded).right_angled()
    np.testing.assert_allclose(nearest.direction @ nearest.direction.T, np.eye(3), atol=1e-12)
    assert nearest.farthest_from(grid) < 0.1 * min(SPACING)
    sheared[:, 0] += 0.2 * sheared[:, 1]
    with pytest.raises(ValueError, match="right angles"):
        Geometry(SHAPE, sheared).right_angled()


def test_a_covering_grid_keeps_rows_and_slices(grid):
    affine = grid.affine.copy()
    affine[:, 0] += 0.6 * affine[:, 1] - 0.3 * affine[:, 2]
    sheared = Geometry(SHAPE, affine)
    covering = sheared.covering()
    assert covering.right_angled() is covering
    assert covering.spacing == pytest.approx(SPACING)
    corners = [*itertools.product(*((0, size - 1) for size in SHAPE))]
    at = covering.to_pixels(sheared.to_world(corners))
    np.testing.assert_allclose(at[:, 0], np.array(corners)[:, 0], atol=1e-9)
    assert (at.min(axis=0) > -0.02).all()
    assert (at.max(axis=0) < np.array(covering.shape) - 0.98).all()
    assert covering.shape == (4, 7, 7)
    affine[:, 1] = affine[:, 2] + 0.1 * affine[:, 1]
    with pytest.raises(ValueError, match="30 degrees"):
        Geometry(SHAPE, affine).covering()
