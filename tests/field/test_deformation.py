"""Local size change, folds, grids and arrows of a displacement field."""

import numpy as np
import pytest

from napari_hmrf import ProblemError
from napari_hmrf.data import phantom, reference_displacement
from napari_hmrf.field.strain import fold_mask
from napari_hmrf.fields import (
    arrows,
    count_folds,
    deformation_grid,
    jacobian_determinant,
    magnitude,
    rmsd,
)


def site_indices(shape):
    return np.moveaxis(np.indices(shape), 0, -1).astype(float)


def test_a_uniform_strain_changes_all_areas_equally_including_the_borders():
    gradient = np.array([[0.2, 0.1], [-0.3, 0.05]])
    spacing = np.array([2.0, 0.5])
    displacement = (site_indices((7, 9)) * spacing) @ gradient.T
    expected = np.linalg.det(np.eye(2) + gradient)
    np.testing.assert_allclose(
        jacobian_determinant(displacement, spacing=spacing), expected, rtol=1e-6
    )


def test_interior_differences_are_central():
    displacement = np.zeros((5, 9, 2))
    displacement[..., 1] = 0.01 * np.arange(9.0) ** 2
    jacobian = jacobian_determinant(displacement, spacing=1)
    np.testing.assert_allclose(jacobian[2, 1:-1], 1 + 0.02 * np.arange(1, 8), rtol=1e-6)
    assert jacobian.dtype == np.float32


def test_the_determinant_is_nan_outside_tissue_and_ignores_values_there():
    tissue = np.zeros((8, 8), dtype=bool)
    tissue[2:6, 1:7] = True
    displacement = np.where(tissue[..., None], 0.1 * site_indices((8, 8)), np.nan)
    jacobian = jacobian_determinant(displacement, spacing=1, tissue=tissue)
    assert np.isnan(jacobian[~tissue]).all()
    np.testing.assert_allclose(jacobian[tissue], 1.21, rtol=1e-6)


def test_a_line_of_tissue_has_no_transverse_strain_and_a_lone_site_has_none():
    tissue = np.zeros((5, 9), dtype=bool)
    tissue[2, :6], tissue[4, 8] = True, True
    jacobian = jacobian_determinant(0.1 * site_indices((5, 9)), spacing=1, tissue=tissue)
    np.testing.assert_allclose(jacobian[2, :6], 1.1, rtol=1e-6)
    assert jacobian[4, 8] == 1


def test_resting_translated_and_solved_tissue_has_no_folds():
    assert count_folds(np.zeros((6, 7, 2)), spacing=1) == 0
    assert count_folds(np.full((6, 7, 2), 1e3), spacing=1) == 0
    for name in ("expansion", "mass-effect", "bar"):
        tissue = phantom(name).problem.tissue
        assert count_folds(reference_displacement(name), spacing=1, tissue=tissue) == 0


def test_a_mirrored_body_is_folded_everywhere():
    displacement = np.zeros((6, 7, 2))
    displacement[..., 1] = -2 * np.arange(7)
    assert count_folds(displacement, spacing=1) == 42
    assert (jacobian_determinant(displacement, spacing=1) < 0).all()


@pytest.mark.parametrize("shape", [(6, 7), (1, 5), (9, 3), (4, 5, 6), (1, 4, 4)])
def test_folds_are_counted_at_corners_of_elements_made_of_tissue(shape):
    random = np.random.default_rng(len(shape))
    tissue = random.random(shape) < 0.8
    d = 0.4 * random.normal(size=(*shape, len(shape))) * tissue[..., None]
    place = np.moveaxis(np.indices(shape), 0, -1) + d
    expected = np.zeros(shape, dtype=bool)
    for first in np.ndindex(*(size - 1 for size in shape)):
        corners = [tuple(np.add(first, step)) for step in np.ndindex(*[2] * len(shape))]
        if not all(tissue[corner] for corner in corners):
            continue
        for corner in corners:
            edges = []
            for axis, low in enumerate(first):
                ends = [(*corner[:axis], low + end, *corner[axis + 1 :]) for end in (0, 1)]
                edges.append(place[ends[1]] - place[ends[0]])
            expected[corner] |= np.linalg.det(edges) <= 0
    np.testing.assert_array_equal(fold_mask(d, spacing=1, tissue=tissue), expected)
    assert count_folds(d, spacing=1, tissue=tissue) == expected.sum()
    assert expected.any() == (min(shape) > 1)


def test_a_negative_determinant_beside_a_hole_is_not_a_fold():
    tissue = np.ones((3, 3), dtype=bool)
    tissue[0, 0] = False
    d = np.zeros((3, 3, 2))
    d[0, 1] = (3.5, 0)  # between the holes and past the row below, but in no element
    tissue[0, 2] = False
    assert count_folds(d, spacing=1, tissue=tissue) == 0
    assert (jacobian_determinant(d, spacing=1, tissue=tissue)[tissue] <= 0).any()


def test_a_site_that_passes_its_neighbour_is_a_fold_despite_central_differences():
    displacement = np.zeros((5, 9, 2))
    displacement[2, 4, 1] = -1.5
    assert (jacobian_determinant(displacement, spacing=1) > 0).all()
    assert count_folds(displacement, spacing=1) > 0


def test_folds_are_located_at_the_overlap():
    displacement = np.zeros((8, 20, 2))
    displacement[:, :10, 1] = 2.5  # the left half overlaps the right
    folded = jacobian_determinant(displacement, spacing=1) <= 0
    assert folded[:, 9:11].all()
    assert folded.sum() == 16
    assert count_folds(displacement, spacing=1) == 16


def test_magnitude_is_a_length_in_the_unit_of_the_displacement():
    lengths = magnitude(np.full((3, 4, 2), [3.0, 4.0]))
    assert lengths.dtype == np.float32
    np.testing.assert_array_equal(lengths, np.full((3, 4), 5.0))


def test_a_grid_at_rest_is_square_and_spans_the_image():
    segments = deformation_grid(np.zeros((21, 41, 2)), spacing=1, every=10)
    ends = segments.sum(axis=1)
    assert segments.shape[1:] == (2, 2)
    assert segments.dtype == np.float32
    rows = segments[segments[:, 1, 0] == 0]  # lines along a row
    cols = segments[segments[:, 1, 1] == 0]
    assert len(rows) + len(cols) == len(segments)
    assert set(rows[:, 0, 0]) == {0, 10, 20}
    assert set(cols[:, 0, 1]) == {0, 10, 20, 30, 40}
    assert rows[:, 1, 1].sum() == 3 * 40
    assert cols[:, 1, 0].sum() == 5 * 20
    assert ends.max(axis=0).tolist() == [20, 40]


def test_cells_of_a_grid_are_square_where_pixels_are_not():
    segments = deformation_grid(np.zeros((21, 61, 2)), spacing=(3.0, 1.0), every=12)
    rows = segments[segments[:, 1, 0] == 0]
    cols = segments[segments[:, 1, 1] == 0]
    assert set(np.diff(np.unique(rows[:, 0, 0])) * 3) == {12}
    assert set(np.diff(np.unique(cols[:, 0, 1]))) == {12}


def test_a_grid_moves_with_the_tissue_in_pixels():
    displacement = np.broadcast_to([4.0, 1.5], (21, 21, 2))
    still = deformation_grid(np.zeros((21, 21, 2)), spacing=(2.0, 0.5))
    moved = deformation_grid(displacement, spacing=(2.0, 0.5))
    np.testing.assert_allclose(moved[:, 0] - still[:, 0], np.tile([2.0, 3.0], (len(still), 1)))
    np.testing.assert_allclose(moved[:, 1], still[:, 1], atol=1e-5)


def test_grid_lines_are_drawn_in_tissue_only():
    tissue = np.zeros((40, 40), dtype=bool)
    tissue[8:33, 8:33] = True
    tissue[20, 20] = False
    segments = deformation_grid(np.zeros((40, 40, 2)), spacing=1, every=1, tissue=tissue)
    ends = segments.sum(axis=1)
    assert ((segments[:, 0] >= 8) & (ends <= 32)).all()
    around = np.abs(np.concatenate([segments[:, 0], ends]) - 20).max(axis=1)
    assert around.min() == 1
    assert len(segments) == 2 * 24 * 25 - 4


def test_arrows_start_at_sites_and_have_lengths_in_pixels():
    displacement = site_indices((50, 60)) * 0.1
    vectors = arrows(displacement, spacing=(2.0, 0.5), about=100)
    assert vectors.shape[1:] == (2, 2)
    assert vectors.dtype == np.float32
    starts, directions = vectors[:, 0], vectors[:, 1]
    np.testing.assert_allclose(directions, starts * [0.05, 0.2], rtol=1e-5)
    assert 60 < len(vectors) < 160


@pytest.mark.parametrize("about", [1, 10, 1000, 10**6])
def test_about_the_requested_number_of_arrows_starts_in_tissue(about):
    problem = phantom("expansion").problem
    vectors = arrows(
        reference_displacement("expansion"), spacing=1, tissue=problem.tissue, about=about
    )
    wanted = min(about, int(problem.tissue.sum()))
    assert 0.5 * wanted <= len(vectors) <= max(2 * wanted, 4)
    assert problem.tissue[tuple(vectors[:, 0].astype(int).T)].all()


@pytest.mark.parametrize("shape", [(1, 2), (2, 1), (2, 2), (1, 300)])
def test_arrows_of_tiny_images_have_the_usual_shape(shape):
    vectors = arrows(np.ones((*shape, 2)), spacing=1)
    assert vectors.shape == (np.prod(shape), 2, 2)
    assert arrows(np.ones((*shape, 2)), spacing=1, tissue=np.zeros(shape)).shape == (0, 2, 2)
    assert deformation_grid(np.ones((*shape, 2)), spacing=1, every=1).shape[1:] == (2, 2)


def test_thin_tissue_between_the_sampled_sites_gets_arrows():
    tissue = np.zeros((100, 100), dtype=bool)
    tissue[::10, ::10] = True
    tissue[:, 5] = False
    assert len(arrows(np.ones((100, 100, 2)), spacing=1, tissue=tissue, about=4)) >= 1


def test_a_grid_wider_than_the_image_has_one_line_along_each_axis():
    displacement = np.zeros((5, 7, 2))
    far = deformation_grid(displacement, spacing=1, every=10**30, pieces=1)
    np.testing.assert_array_equal(
        far, deformation_grid(displacement, spacing=1, every=100, pieces=1)
    )


def test_rmsd_is_the_root_mean_square_length_of_the_difference_in_tissue():
    reference = np.zeros((2, 3, 2))
    found = reference + np.array([3.0, 4.0])
    found[0] = np.nan
    tissue = np.array([[0, 0, 0], [1, 1, 0]], bool)
    found[1, 1] = 0
    assert rmsd(found, reference, tissue) == pytest.approx(5 / np.sqrt(2))
    with pytest.raises(ProblemError) as refusal:
        rmsd(found, reference[:1])
    assert refusal.value.field == "reference"
    with pytest.raises(ProblemError) as refusal:
        rmsd(found, reference, ~tissue & tissue)
    assert refusal.value.field == "tissue"
    with pytest.raises(ProblemError) as refusal:
        rmsd(found, reference, 0.5 * tissue)  # a map of probabilities
    assert refusal.value.field == "tissue"
