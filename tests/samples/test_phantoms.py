"""Tests of the phantoms: their images, boundaries and problems."""

import numpy as np
import pytest

from napari_hmrf import ArgumentError, ElasticPrior, solve
from napari_hmrf.data import PHANTOM_NAMES, phantom, reference_displacement, sample
from napari_hmrf.fields import rmsd
from napari_hmrf.study.models import parts_of
from napari_hmrf.tissue.boundary_rules import boundary_images, stiffness_image

BRAINS = ("expansion", "mass-effect")
SMALL_SIZES = (16, 17, 18, 31)


def outward(sites, centre):
    away = sites - np.asarray(centre)
    return away / np.linalg.norm(away, axis=-1, keepdims=True)


@pytest.mark.parametrize("name", PHANTOM_NAMES)
def test_the_stored_sample_equals_the_drawn_phantom(name):
    stored, drawn = sample(name), phantom(name)
    for array in ("image", "tissue_labels", "boundary_labels"):
        np.testing.assert_array_equal(getattr(stored, array), getattr(drawn, array))
        assert getattr(stored, array).dtype == np.uint8
    assert stored.materials == drawn.materials
    assert stored.boundary == drawn.boundary
    assert (stored.name, stored.title) == (drawn.name, drawn.title)


@pytest.mark.parametrize("name", PHANTOM_NAMES)
def test_the_stored_reference_satisfies_the_boundary_of_its_phantom(name):
    problem, reference = phantom(name).problem, reference_displacement(name)
    assert reference.dtype == np.float32
    known = problem.confidence > 0
    np.testing.assert_allclose(reference[known], problem.observed[known], atol=5.1e-4)
    assert (reference[~problem.tissue] == 0).all()


@pytest.mark.parametrize("name", PHANTOM_NAMES)
def test_the_problem_of_a_phantom_follows_its_labels_and_tables(name):
    drawn = phantom(name, 48)
    y, c = boundary_images(drawn.boundary_labels, drawn.boundary, spacing=1)
    np.testing.assert_array_equal(drawn.problem.observed, y)
    np.testing.assert_array_equal(drawn.problem.confidence, c)
    np.testing.assert_array_equal(
        drawn.problem.stiffness, stiffness_image(drawn.tissue_labels, drawn.materials)
    )


@pytest.mark.parametrize("name", PHANTOM_NAMES)
def test_a_phantom_of_any_size_has_a_free_inside(name):
    for size in SMALL_SIZES:
        drawn = phantom(name, size)
        assert drawn.image.shape == ((round(size / 3), size) if name == "bar" else (size, size))
        free = drawn.problem.tissue & ~(drawn.problem.confidence > 0).any(axis=-1)
        assert free.any()
        assert (drawn.problem.observed != 0).any()


@pytest.mark.parametrize("name", BRAINS)
def test_the_brain_has_the_tissues_and_stiffnesses_of_the_paper(name):
    drawn = phantom(name)
    assert set(np.unique(drawn.tissue_labels)) == {0, 1, 2, 3}
    by_name = {material.name: material.stiffness for material in drawn.materials}
    assert by_name["normal tissue"] == 20
    assert by_name["soft tissue"] == 10
    assert by_name["tumour"] == 40
    assert set(np.unique(drawn.problem.stiffness)) == {0, 10, 20, 40}


@pytest.mark.parametrize("name", BRAINS)
def test_the_image_is_black_outside_and_shows_tumour_grey_and_white_tissue(name):
    drawn = phantom(name)
    means = [drawn.image[drawn.tissue_labels == label].mean() for label in (0, 3, 1, 2)]
    assert means == sorted(means)
    assert np.diff(means).min() > 30
    deep = drawn.image[100:110, 60:90]
    assert deep.std() > 2  # Some texture makes motion within a tissue visible.


def test_the_outline_of_the_expanding_brain_moves_outward_everywhere():
    problem = phantom("expansion").problem
    edge = (problem.confidence > 0).all(axis=-1)
    moves = problem.observed[edge]
    np.testing.assert_allclose(np.linalg.norm(moves, axis=-1), 10, rtol=1e-5)
    directions = outward(np.argwhere(edge), (149.5, 149.5))
    assert ((moves / 10 * directions).sum(axis=-1) > 0.9).all()
    left, right = edge[:, :150], edge[:, 150:]
    np.testing.assert_array_equal(left, right[:, ::-1])


def test_the_tumour_grows_radially_inside_a_fixed_skull():
    drawn = phantom("mass-effect")
    rim = drawn.boundary_labels == 2
    centre = np.argwhere(drawn.tissue_labels == 3).mean(axis=0)
    moves = drawn.problem.observed[rim]
    np.testing.assert_allclose(np.linalg.norm(moves, axis=-1), 8, rtol=1e-5)
    assert ((moves / 8 * outward(np.argwhere(rim), centre)).sum(axis=-1) > 0.98).all()
    fixed = drawn.boundary_labels == 1
    assert (drawn.problem.observed[fixed] == 0).all()
    assert (drawn.problem.confidence[fixed] == 1).all()


def test_the_motion_of_a_phantom_scales_with_its_size():
    for name in PHANTOM_NAMES:
        large, small = phantom(name, 300).problem, phantom(name, 150).problem
        assert np.abs(small.observed).max() == pytest.approx(
            np.abs(large.observed).max() / 2, rel=1e-3
        )


def test_the_bar_is_pulled_only_at_its_right_end():
    drawn = phantom("bar")
    problem = drawn.problem
    assert problem.tissue.all()
    assert set(np.unique(problem.stiffness[:, :150])) == {20}
    assert set(np.unique(problem.stiffness[:, 150:])) == {10}
    assert (problem.confidence[:, :3] == 1).all()
    assert (problem.observed[:, :3] == 0).all()
    assert (problem.observed[:, -3:] == (0, 20)).all()
    assert (problem.confidence[:, 3:-3] == 0).all()


@pytest.mark.parametrize(
    ("name", "model", "pixels", "levels", "sweeps"),
    [
        ("expansion", "paper", 1.03, 10, 700),
        ("mass-effect", "paper", 0.65, 10, 700),
        ("expansion", "paper, converged", 0.23, 1, None),
        ("mass-effect", "paper, converged", 0.34, 1, None),
    ],
)
def test_table_1_of_the_paper_is_reproduced_for_the_phantoms(name, model, pixels, levels, sweeps):
    """Check the README's table: RMSD from finite elements, 300 x 300 pixels, 10 levels of 70
    sweeps."""
    problem = phantom(name).problem
    prior, optimizer = parts_of(model)
    solution = solve(problem, prior, optimizer=optimizer, backend="cpu")
    found = rmsd(solution.displacement, reference_displacement(name), problem.tissue)
    assert found == pytest.approx(pixels, abs=0.006)
    assert solution.provenance.model == model
    assert len(solution.levels) == levels
    assert sweeps is None or solution.iterations == sweeps
    assert sweeps is None or {level.iterations for level in solution.levels} == {70}


@pytest.mark.parametrize("name", BRAINS)
def test_elastic_tissue_of_the_same_material_equals_the_finite_element_field(name):
    problem = phantom(name).problem
    solution = solve(problem, ElasticPrior(0.3), backend="cpu")
    # The reference is stored to a thousandth of a pixel.
    assert rmsd(solution.displacement, reference_displacement(name), problem.tissue) < 6e-4


def test_an_unknown_phantom_is_refused_by_name():
    for read in (phantom, sample, reference_displacement):
        with pytest.raises(ArgumentError, match="'liver'"):
            read("liver")


def test_a_size_too_small_for_a_phantom_is_refused():
    for size in (15, 0, -3, 64.0, "big", None):
        with pytest.raises(ArgumentError, match=r"^size "):
            phantom("bar", size)


def test_the_arrays_of_a_phantom_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        sample("bar").image[0, 0] = 1
