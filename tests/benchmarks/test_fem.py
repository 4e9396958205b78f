"""Tests of the finite-element reference: patch test, bar, annulus, free pieces and units."""

import numpy as np
import pytest
from fem import plane_stress_displacement, rmsd

from napari_hmrf import Problem
from napari_hmrf.data import phantom, reference_displacement

NU = 0.3


def edge_of(shape):
    edge = np.ones(shape, dtype=bool)
    edge[1:-1, 1:-1] = False
    return edge


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 2.0)])
def test_a_uniform_strain_of_the_edge_extends_into_the_inside(spacing):
    """Patch test."""
    strain = np.array([[0.02, -0.01], [0.03, 0.015]])
    places = np.moveaxis(np.indices((9, 12)), 0, -1) * np.array(spacing)
    exact = places @ strain.T
    c = np.repeat(edge_of((9, 12))[..., None], 2, axis=-1).astype(float)
    problem = Problem(exact, c, np.full((9, 12), 7.0), spacing=spacing)
    np.testing.assert_allclose(plane_stress_displacement(problem, NU), exact, atol=1e-6)


def test_a_free_bar_contracts_by_poissons_ratio():
    h, w, pull = 5, 21, 0.1
    y, c = np.zeros((h, w, 2)), np.zeros((h, w, 2))
    c[:, [0, -1], 1] = 1
    y[:, -1, 1] = pull
    c[h // 2, 0, 0] = 1
    d = plane_stress_displacement(Problem(y, c, np.ones((h, w))), NU)
    strain = pull / (w - 1)
    rows, cols = np.indices((h, w))
    np.testing.assert_allclose(d[..., 1], strain * cols, atol=1e-7)
    np.testing.assert_allclose(d[..., 0], -NU * strain * (rows - h // 2), atol=1e-7)


def test_strain_is_inversely_proportional_to_stiffness():
    h, w = 3, 41
    y, c = np.zeros((h, w, 2)), np.zeros((h, w, 2))
    c[:, [0, -1], 1] = 1
    y[:, -1, 1] = 1
    c[1, 0, 0] = 1
    m = np.full((h, w), 20.0)
    m[:, 20:] = 10.0
    d = plane_stress_displacement(Problem(y, c, m), poisson=0.0)
    strain = np.diff(d[1, :, 1])
    assert strain[30] / strain[10] == pytest.approx(2, rel=1e-9)


def annulus_error(n):
    """Return the RMS error of u(r) = r + b^2/r on a ring with prescribed edges."""
    row, col = (np.indices((n, n)) - (n - 1) / 2) / (n / 2)
    r = np.hypot(row, col)
    radial = 0.05 * (r + 0.16 / np.maximum(r, 0.1))
    exact = np.stack([radial * row / np.maximum(r, 0.1), radial * col / np.maximum(r, 0.1)], -1)
    tissue = (r > 0.3) & (r < 0.97)
    edge = tissue & ((r < 0.4) | (r > 0.87))  # The edge has the same width on every grid.
    c = np.repeat(edge[..., None], 2, axis=-1).astype(float)
    d = plane_stress_displacement(Problem(exact, c, tissue.astype(float)), NU)
    return rmsd(d, exact, tissue & ~edge)


def test_the_error_of_lames_annulus_is_quadratic_in_the_pixel_size():
    coarse, fine = annulus_error(40), annulus_error(160)
    order = np.log(coarse / fine) / np.log(4)
    assert 1.7 < order < 2.6


def test_the_scale_of_the_stiffness_does_not_change_the_field():
    problem = phantom("mass-effect", 32).problem
    stiffer = Problem(problem.observed, problem.confidence, problem.stiffness * 1000)
    np.testing.assert_allclose(
        plane_stress_displacement(problem), plane_stress_displacement(stiffer), atol=1e-9
    )


def test_tissue_without_an_element_has_its_prescribed_displacement_or_zero():
    y, c, m = np.zeros((8, 8, 2)), np.zeros((8, 8, 2)), np.zeros((8, 8))
    m[:4, :4] = 1
    c[0, :4] = 1
    m[6, 2], m[6, 6] = 1, 1
    y[6, 2], c[6, 2] = (1, 2), 1
    d = plane_stress_displacement(Problem(y, c, m))
    np.testing.assert_array_equal(d[6, 2], (1, 2))
    np.testing.assert_array_equal(d[6, 6], (0, 0))


def test_tissue_that_could_translate_or_rotate_is_refused():
    y, c, m = np.zeros((8, 8, 2)), np.zeros((8, 8, 2)), np.zeros((8, 8))
    m[:3], m[5:] = 1, 1
    c[0] = 1
    with pytest.raises(ValueError, match=r"around \(.*6.0.*3.5.*\) could move freely"):
        plane_stress_displacement(Problem(y, c, m))
    c[6, 3] = 1
    with pytest.raises(ValueError, match="could move freely"):
        plane_stress_displacement(Problem(y, c, m))
    c[6, 4] = 1
    assert not plane_stress_displacement(Problem(y, c, m)).any()


def test_poissons_ratio_must_be_physical():
    with pytest.raises(ValueError, match="poisson"):
        plane_stress_displacement(phantom("bar", 16).problem, poisson=0.5)


def test_the_stored_reference_equals_the_computed_solution():
    stored = reference_displacement("bar")
    computed = plane_stress_displacement(phantom("bar").problem)
    assert np.abs(stored - computed).max() < 6e-4


def test_rmsd_covers_only_the_body_and_is_in_pixels():
    a = np.zeros((4, 4, 2))
    b = a + np.array([3.0, 4.0])
    b[0] = 1e9
    inside = np.ones((4, 4), dtype=bool)
    inside[0] = False
    assert rmsd(a, b, inside) == pytest.approx(5)
    assert rmsd(a, b, inside, unit=0.5) == pytest.approx(10)
