"""Strain, area ratio and folds of fields with known analytic values."""

import numpy as np
import pytest

from napari_hmrf.data import phantom
from napari_hmrf.field.strain import (
    deformation_gradient,
    equivalent_strain,
    fold_mask,
    green_lagrange_strain,
    principal_strains,
    small_strain,
    strain_through_slice,
)
from napari_hmrf.fields import count_folds, jacobian_determinant
from napari_hmrf.samples.phantoms import reference_displacement

SPACING = np.array([2.0, 0.5])
#: Derivatives of the row component along rows and columns, then of the column component.
GRADIENT = np.array([[0.2, 0.1], [-0.3, 0.05]])


def positions(shape, spacing=SPACING):
    """Return the position of each site, in the unit of the spacing."""
    return np.moveaxis(np.indices(shape), 0, -1) * spacing


def assert_uniform(found, expected, **tolerance):
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), **tolerance)


def rotation_matrix(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_an_affine_motion_has_a_constant_gradient_including_the_borders():
    displacement = positions((7, 9)) @ GRADIENT.T
    found = deformation_gradient(displacement, spacing=SPACING)
    assert found.dtype == np.float32
    assert_uniform(found, np.eye(2) + GRADIENT, atol=1e-6)
    assert_uniform(
        small_strain(displacement, spacing=SPACING), [[0.2, -0.1], [-0.1, 0.05]], atol=1e-6
    )
    large = (GRADIENT + GRADIENT.T + GRADIENT.T @ GRADIENT) / 2
    assert_uniform(green_lagrange_strain(displacement, spacing=SPACING), large, atol=1e-6)


def test_a_rotation_has_no_green_lagrange_strain_but_a_small_strain():
    turn = rotation_matrix(0.5)
    displacement = positions((8, 6)) @ (turn - np.eye(2)).T
    assert_uniform(
        green_lagrange_strain(displacement, spacing=SPACING), np.zeros((2, 2)), atol=1e-6
    )
    assert_uniform(deformation_gradient(displacement, spacing=SPACING), turn, atol=1e-6)
    shrunk = np.cos(0.5) - 1
    assert_uniform(small_strain(displacement, spacing=SPACING), shrunk * np.eye(2), atol=1e-6)


def test_a_rotation_does_not_change_principal_strains():
    stretch = np.diag([1.3, 0.9])
    displacement = positions((6, 6)) @ (rotation_matrix(1.0) @ stretch - np.eye(2)).T
    strain = green_lagrange_strain(displacement, spacing=SPACING)
    assert_uniform(principal_strains(strain), [(1.3**2 - 1) / 2, (0.9**2 - 1) / 2], atol=1e-6)


def test_differences_are_central_inside_and_one_sided_at_the_border():
    displacement = np.zeros((4, 12, 2))
    x = positions((4, 12))[..., 1]
    displacement[..., 0] = 0.01 * x**2
    gradient = deformation_gradient(displacement, spacing=SPACING)
    np.testing.assert_allclose(gradient[:, 1:-1, 0, 1], 0.02 * x[:, 1:-1], atol=1e-6)
    np.testing.assert_allclose(gradient[:, 0, 0, 1], 0.01 * SPACING[1], atol=1e-6)
    assert_uniform(gradient[..., 1, 1], 1.0, atol=1e-6)


def test_principal_strains_are_the_eigenvalues_largest_first():
    strain = np.random.default_rng(1).normal(size=(20, 2, 2))
    strain = strain + strain.swapaxes(-1, -2)
    expected = np.linalg.eigvalsh(strain)[:, ::-1]
    np.testing.assert_allclose(principal_strains(strain), expected, rtol=1e-5, atol=1e-6)


def test_equivalent_strain_matches_textbook_values():
    bar = np.diag([0.1, -0.05])  # incompressible stretch by 0.1: -0.05 along both other directions
    assert equivalent_strain(bar, through=-0.05) == pytest.approx(0.1)
    assert strain_through_slice(bar, 1 / 3) == pytest.approx(-0.025)
    shear = np.array([[0, 0.03], [0.03, 0]])
    assert equivalent_strain(shear) == pytest.approx(0.06 / np.sqrt(3))
    assert equivalent_strain(np.eye(2) * 0.2, through=0.2) == pytest.approx(0, abs=1e-7)
    turn = rotation_matrix(0.7)
    assert equivalent_strain(turn @ bar @ turn.T, -0.05) == pytest.approx(0.1)


def test_the_area_ratio_is_the_determinant_of_the_gradient():
    rng = np.random.default_rng(0)
    tissue = rng.random((15, 12)) > 0.2
    displacement = 0.2 * rng.normal(size=(15, 12, 2))
    gradient = deformation_gradient(displacement, spacing=SPACING, tissue=tissue)
    expected = jacobian_determinant(displacement, spacing=SPACING, tissue=tissue)
    np.testing.assert_allclose(
        np.linalg.det(gradient[tissue].astype(float)), expected[tissue], rtol=1e-5, atol=1e-6
    )


def test_the_fold_mask_agrees_with_the_fold_count():
    displacement = np.zeros((8, 20, 2))
    displacement[:, :10, 1] = 2.5
    displacement[2, 15, 1] = -1.5  # passes its neighbour, which central differences miss
    found = fold_mask(displacement, spacing=1)
    assert found[:, 9:11].all()
    assert found[2, 15]
    assert found.sum() == count_folds(displacement, spacing=1)
    assert not fold_mask(
        reference_displacement("bar"), spacing=1, tissue=phantom("bar").problem.tissue
    ).any()


def test_strain_is_nan_in_void_and_ignores_values_there():
    tissue = np.zeros((8, 9), dtype=bool)
    tissue[2:6, 1:7], tissue[7, 8] = True, True
    displacement = np.where(tissue[..., None], positions((8, 9)) @ GRADIENT.T, np.nan)
    strain = small_strain(displacement, spacing=SPACING, tissue=tissue)
    assert np.isnan(strain[~tissue]).all()
    assert not strain[7, 8].any()  # a lone site has no strain
    tissue[7, 8] = False
    strain = small_strain(displacement, spacing=SPACING, tissue=tissue)
    assert_uniform(strain[tissue], [[0.2, -0.1], [-0.1, 0.05]], atol=1e-6)
    for derived in (principal_strains(strain), equivalent_strain(strain)):
        assert np.isfinite(derived[tissue]).all()
        assert np.isnan(derived[~tissue]).all()
    assert not fold_mask(displacement, spacing=SPACING, tissue=tissue)[~tissue].any()


def test_a_strain_of_one_millionth_is_resolved():
    displacement = positions((5, 5), 1.0) * 1e-6
    assert_uniform(
        green_lagrange_strain(displacement, spacing=1), 1e-6 * np.eye(2), rtol=1e-4, atol=1e-11
    )
