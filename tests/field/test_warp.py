"""Warp of an image: the value at X moves to X + d(X)."""

import numpy as np
import pytest

from napari_hmrf import warp
from napari_hmrf.data import phantom, reference_displacement
from napari_hmrf.field.deformation import count_folds
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.fields import inverse_map, resample
from napari_hmrf.results.finer_grid import on_finer_grid
from napari_hmrf.solver.solution import Provenance, Solution


def site_indices(shape):
    return np.moveaxis(np.indices(shape), 0, -1).astype(float)


def field(shape, vector):
    return np.broadcast_to(np.asarray(vector, dtype=float), (*shape, 2))


def smooth_field(shape, amplitude):
    row, col = np.indices(shape) / max(shape) * 5
    return amplitude * np.stack([np.sin(row + 1.3 * col), np.cos(1.1 * row - col)], axis=-1)


@pytest.fixture
def picture():
    return np.random.default_rng(1).integers(0, 256, (23, 31)).astype(np.uint8)


def test_resting_tissue_does_not_change(picture):
    for order in range(6):
        np.testing.assert_array_equal(
            warp(picture, field(picture.shape, (0, 0)), spacing=1, order=order), picture
        )


def test_a_dot_moves_along_the_displacement():
    image = np.zeros((20, 20), dtype=np.uint8)
    image[8, 6] = 200
    moved = warp(image, field((20, 20), (5, -3)), spacing=1)
    assert moved[13, 3] == 200
    assert moved.sum() == 200


@pytest.mark.parametrize("order", [0, 1, 3])
def test_whole_pixels_are_moved_exactly(picture, order):
    moved = warp(picture, field(picture.shape, (4, -7)), spacing=1, order=order, fill=9)
    np.testing.assert_array_equal(moved[4:, :-7], picture[:-4, 7:])
    assert (moved[:4] == 9).all()
    assert (moved[:, -7:] == 9).all()


def test_an_affine_stretch_moves_grey_values_exactly():
    shape = (40, 40)
    image = site_indices(shape) @ np.array([2.0, 3.0])  # linear, so that interpolation is exact
    gradient = np.array([[1.3, 0.2], [-0.1, 0.9]])
    moved_to = (site_indices(shape) - 20) @ gradient.T + 20
    result = warp(image, moved_to - site_indices(shape), spacing=1, fill=np.nan)
    back = (site_indices(shape) - 20) @ np.linalg.inv(gradient).T + 20
    inside = ((back >= 0) & (back <= 39)).all(axis=-1)
    assert inside.sum() > 700
    np.testing.assert_allclose(result[inside], (back @ np.array([2.0, 3.0]))[inside], atol=1e-9)


def test_the_inverse_map_is_exact_for_steep_motion():
    """Stretch by 3.6, where a fixed-point inversion diverges."""
    col = np.arange(60.0)
    moved = 30 + 29.5 * np.sinh(1.9 * (col - 29.5) / 29.5) / np.sinh(1.9)
    moved = np.interp(col, np.linspace(0, 59, 60), moved[::1])
    displacement = np.zeros((5, 60, 2))
    displacement[..., 1] = moved - col
    coordinates, covered = inverse_map(displacement, spacing=1)
    sources = coordinates[2, :, 1]
    inside = covered[2] & (col >= moved[0]) & (col <= moved[-1])
    assert inside.sum() > 55
    np.testing.assert_allclose(np.interp(sources[inside], col, moved), col[inside], atol=1e-9)


def test_a_warp_and_its_inverse_restore_the_image():
    shape = (80, 90)
    image = 100 + 50 * np.sin(site_indices(shape) @ np.array([0.2, 0.15]))
    forth = smooth_field(shape, 4.0)
    coordinates, covered = inverse_map(forth, spacing=1)
    back = np.where(covered[..., None], coordinates - site_indices(shape), 0)
    again = warp(warp(image, forth, spacing=1, order=3), back, spacing=1, order=3)
    middle = (slice(12, -12), slice(12, -12))
    assert np.abs(again - image)[middle].max() < 1.0
    assert np.abs(warp(image, forth, spacing=1) - image)[middle].max() > 20


def test_labels_stay_labels():
    labels = (site_indices((40, 40))[..., 0] // 10).astype(np.int32) * 1_000_003
    moved = warp(labels, smooth_field((40, 40), 3.0), spacing=1, order=0)
    assert moved.dtype == np.int32
    assert set(np.unique(moved)) <= set(np.unique(labels)) | {0}


def test_large_labels_are_exact():
    labels = np.full((6, 6), 2**63 - 5, dtype=np.uint64)
    moved = warp(labels, field((6, 6), (0.3, 0)), spacing=1, order=0)
    assert (moved == labels).all()


def test_colour_channels_and_alpha_move_together(picture):
    colours = np.stack([picture, picture[::-1], 255 - picture, picture.T.ravel()[: picture.size]
                        .reshape(picture.shape)], axis=-1)  # fmt: skip
    displacement = smooth_field(picture.shape, 2.0)
    for channels in (3, 4):
        moved = warp(colours[..., :channels], displacement, spacing=1)
        assert moved.shape == (*picture.shape, channels)
        for channel in range(channels):
            np.testing.assert_array_equal(
                moved[..., channel], warp(colours[..., channel], displacement, spacing=1)
            )


def test_displacements_are_in_the_unit_of_the_pixel_spacing(picture):
    moved = warp(picture, field(picture.shape, (2.0, 1.5)), spacing=(2.0, 0.5))
    np.testing.assert_array_equal(moved[1:, 3:], picture[:-1, :-3])


def test_a_solution_on_larger_pixels_moves_an_image_by_the_same_length(picture):
    d, tissue = field((12, 16), (4.0, -2.0)), np.ones((12, 16), bool)
    coarse = Solution(d, np.zeros(1), (), tissue, (4.0, 1.0), Provenance("cpu", ""))
    fine = on_finer_grid(coarse, np.ones(picture.shape, bool), 2)
    np.testing.assert_array_equal(fine.warp(picture)[2:, :-4], picture[:-2, 4:])


@pytest.mark.parametrize(
    "dtype", ["bool", "uint8", "int16", "uint16", "int32", "uint64", "float16", "float32", "f8"]
)
def test_the_data_type_of_the_image_is_kept(dtype):
    image = np.random.default_rng(0).integers(0, 2, (12, 12)).astype(dtype)
    before = image.copy()
    moved = warp(image, smooth_field((12, 12), 1.0), spacing=1)
    assert moved.dtype == image.dtype
    assert moved.shape == image.shape
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("dtype", ["uint8", "int64", "uint64"])
def test_integers_are_rounded_and_never_wrap_around(dtype):
    top = np.iinfo(dtype).max
    image = np.zeros((16, 16), dtype=dtype)
    image[:, 8:] = top
    moved = warp(image, field((16, 16), (0.0, 0.4)), spacing=1, order=3)
    overshoot = warp((image > 0).astype(float), field((16, 16), (0.0, 0.4)), spacing=1, order=3)
    assert overshoot.max() > 1
    assert overshoot.min() < 0
    assert (moved[overshoot > 1] >= top - top // 1000).all()
    assert (moved[overshoot < 0] <= 0).all()
    ramp = np.array([[0, 1, 2, 3]] * 4, dtype=dtype)
    assert warp(ramp, field((4, 4), (0.0, 0.4)), spacing=1)[1, 2] == 2  # 1.6


def test_a_nan_pixel_does_not_spread():
    image = np.ones((20, 20), dtype=np.float32)
    image[9, 9], image[4, 15] = np.nan, np.inf
    for order in (1, 3):
        moved = warp(image, field((20, 20), (0.25, 0.25)), spacing=1, order=order)
        assert np.isnan(moved[9, 9])
        assert moved[4, 15] == np.inf
        np.testing.assert_allclose(moved[np.isfinite(moved)], 1.0, rtol=1e-6)
        assert np.isfinite(moved).sum() == 398
    assert np.isnan(warp(np.full((4, 4), np.nan), field((4, 4), (0.2, 0)), spacing=1)).all()


def block(shape, rows, cols):
    mask = np.zeros(shape, dtype=bool)
    mask[rows, cols] = True
    return mask


def test_tissue_covers_resting_void_and_leaves_the_fill_value_behind():
    shape = (12, 30)
    tissue = block(shape, slice(3, 9), slice(5, 15))
    image = np.where(tissue, 100, 7).astype(np.uint8)
    moved = warp(image, field(shape, (0, 6)), spacing=1, tissue=tissue, fill=1)
    expected = np.full(shape, 7, dtype=np.uint8)
    expected[3:9, 5:15] = 1
    expected[3:9, 11:21] = 100
    np.testing.assert_array_equal(moved, expected)


@pytest.mark.parametrize("shift", [0, 1.5, 2, 3, 6, 6.3, -4])
def test_overlap_of_two_pieces_is_detected_without_folds(shift):
    """Move the left of two pieces, 2 pixels apart, towards the right one."""
    shape = (12, 40)
    left, right = block(shape, slice(2, 9), slice(5, 15)), block(shape, slice(2, 9), slice(17, 30))
    displacement = field(shape, (0, shift)) * left[..., None]
    _, _, overlaps = inverse_map_and_overlaps(displacement, spacing=1, tissue=left | right)
    expected = np.zeros(shape, bool)
    if shift >= 3:  # the last site of the left piece, 14, reaches the first of the right one, 17
        expected[2:9, 17 : int(14 + shift) + 1] = True
    np.testing.assert_array_equal(overlaps, expected)


@pytest.mark.parametrize(("shape", "amplitude"), [((23, 31), 0.0), ((64, 40), 2.0)])
def test_bending_causes_no_overlap(shape, amplitude):
    bent = smooth_field(shape, amplitude)
    assert count_folds(bent, spacing=1) == 0
    assert not inverse_map_and_overlaps(bent, spacing=1)[2].any()
    assert not inverse_map_and_overlaps(bent * (0.3, 2.0), (0.3, 2.0))[2].any()


def test_compression_causes_no_overlap():
    """Compress tissue to a tenth, unevenly, so that many sites share a pixel."""
    shape = (40, 40)
    pressed = -0.9 * site_indices(shape) + np.random.default_rng(0).uniform(
        -0.02, 0.02, (*shape, 2)
    )
    assert count_folds(pressed, spacing=1) == 0
    assert not inverse_map_and_overlaps(pressed, spacing=1)[2].any()


def test_a_fold_causes_an_overlap():
    shape = (20, 40)
    folded = np.zeros((*shape, 2))
    folded[:, :20, 1] = 8.0  # the left half overlaps the right half
    overlaps = inverse_map_and_overlaps(folded, spacing=1)[2]
    assert overlaps[:, 22:27].all()
    assert not overlaps[:, :19].any()
    assert not overlaps[:, 29:].any()


def test_the_displacement_of_void_is_ignored():
    shape = (12, 12)
    tissue = block(shape, slice(0, 6), slice(0, 12))
    displacement = np.where(tissue[..., None], (0.0, 0.0), np.nan)
    image = np.arange(144.0).reshape(shape)
    np.testing.assert_array_equal(warp(image, displacement, spacing=1, tissue=tissue), image)


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.49, 0.51, 0.8, 1.0])
def test_tissue_keeps_its_size_under_subpixel_motion(shift):
    shape = (30, 30)
    tissue = block(shape, slice(10, 20), slice(10, 20))
    moved = warp(
        tissue.astype(np.uint8) * 100, field(shape, (shift, shift)), spacing=1, tissue=tissue
    )
    assert (moved > 90).sum() == 100


@pytest.mark.parametrize("vector", [(0, 2.3), (1.6, 0.2), (-2.0, 3.0)])
def test_tissue_one_pixel_thin_does_not_vanish(vector):
    shape = (16, 16)
    tissue = block(shape, slice(4, 12), 6) | block(shape, 8, slice(2, 12))
    image = np.where(tissue, 50, 0).astype(np.uint8)
    moved = warp(image, field(shape, vector), spacing=1, tissue=tissue)
    assert (moved >= 25).sum() == tissue.sum()


@pytest.mark.parametrize("along", [0, 1])
def test_a_thin_line_that_is_stretched_does_not_tear(along):
    shape = (9, 40) if along else (40, 9)
    tissue = block(shape, 4, slice(2, 12)) if along else block(shape, slice(2, 12), 4)
    displacement = np.zeros((*shape, 2))
    displacement[..., along] = 2 * site_indices(shape)[..., along]  # three times as long
    moved = warp(tissue.astype(np.uint8), displacement, spacing=1, tissue=tissue)
    seen = moved[4] if along else moved[:, 4]
    assert seen[6:34].all()
    assert moved.sum() == 28


@pytest.mark.parametrize("squeeze", [0.98, 0.9])
def test_the_edge_of_a_body_stays_smooth(squeeze):
    """Stretch a bar, which narrows: its long sides remain straight."""
    shape = (40, 120)
    displacement = np.stack(
        [(squeeze - 1) * (site_indices(shape)[..., 0] - 19.5), 0.1 * site_indices(shape)[..., 1]],
        axis=-1,
    )
    moved = warp(np.ones(shape, dtype=np.uint8), displacement, spacing=1)
    assert np.unique(moved.sum(axis=0)).size == 1


def test_a_cell_with_one_missing_corner_is_a_triangle():
    for corner in np.ndindex(2, 2):
        tissue = np.ones((2, 2), dtype=bool)
        tissue[corner] = False
        grown = np.zeros((8, 8), dtype=bool)
        grown[:2, :2] = tissue
        displacement = site_indices((8, 8)) * 5.0  # six times as large
        coordinates, covered = inverse_map(displacement, spacing=1, tissue=grown)
        middle = np.array([[1, 1], [1, 5], [5, 1], [5, 5]])
        inside = [at for at in middle if tuple(at // 4) != corner]
        for at in inside:
            assert covered[tuple(at)]
            np.testing.assert_allclose(coordinates[tuple(at)], at / 6)


def test_upright_tissue_hides_inverted_tissue_at_a_fold():
    """Fold a row of sites: site 4 moves back over sites 2 and 3."""
    at = np.array([0, 1, 2, 3, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5])
    displacement = np.zeros((3, 10, 2))
    displacement[..., 1] = at - np.arange(10)
    coordinates, covered = inverse_map(displacement, spacing=1)
    seen = coordinates[1, :7, 1]
    assert covered[1, :7].all()
    upright = (seen <= 3) | (seen >= 4)
    assert upright.all()


def test_mirrored_tissue_is_shown_if_it_is_the_only_tissue():
    image = np.arange(30.0).reshape(3, 10)
    displacement = np.zeros((3, 10, 2))
    displacement[..., 1] = 9 - 2 * np.arange(10)  # mirrored
    np.testing.assert_array_equal(warp(image, displacement, spacing=1), image[:, ::-1])


def test_growth_leaves_no_holes():
    problem = phantom("expansion", 96).problem
    displacement = site_indices((96, 96)) * 0.07 - 3.3
    _, covered = inverse_map(
        displacement * problem.tissue[..., None], spacing=1, tissue=problem.tissue
    )
    assert covered.all()


def test_collapsed_tissue_and_extreme_displacements_raise_no_error(picture):
    shape = picture.shape
    assert (warp(picture, field(shape, (1e30, -1e30)), spacing=1, fill=3) == 3).all()
    np.testing.assert_array_equal(warp(picture, field(shape, (1e-30, 1e-30)), spacing=1), picture)
    collapsed = np.array([11.0, 15.0]) - site_indices(shape)
    assert (warp(picture, collapsed, spacing=1) > 0).sum() <= 1


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (2, 2), (7, 13)])
def test_images_of_any_shape_are_warped(shape):
    image = np.arange(1.0, 1 + np.prod(shape)).reshape(shape)
    np.testing.assert_array_equal(warp(image, field(shape, (0, 0)), spacing=1), image)
    if shape[1] > 2:
        np.testing.assert_array_equal(
            warp(image, field(shape, (0, 2)), spacing=1)[:, 2:], image[:, :-2]
        )


def test_several_images_share_one_inverse_map(picture):
    displacement = smooth_field(picture.shape, 3.0)
    coordinates, covered = inverse_map(displacement, spacing=1)
    np.testing.assert_array_equal(
        resample(picture, coordinates, covered, order=1), warp(picture, displacement, spacing=1)
    )


def test_the_warped_image_shows_the_brain_expanding():
    drawn = phantom("expansion")
    tissue = drawn.problem.tissue
    moved = warp(
        tissue.astype(np.uint8),
        reference_displacement("expansion"),
        spacing=(1, 1),
        order=0,
        tissue=tissue,
    )
    extent = np.ptp(np.argwhere(moved), axis=0) - np.ptp(np.argwhere(tissue), axis=0)
    np.testing.assert_allclose(extent, 20, atol=1)
