"""Triangles that are drawn at once are those that are drawn one after the other."""

import numpy as np
import pytest

from napari_hmrf import SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.field import triangle_arrays, triangle_raster


def both(moved, tissue):
    """Both inverse maps are the same."""
    (one, state), (other, states) = (
        module.rasterise(moved, tissue) for module in (triangle_raster, triangle_arrays)
    )
    np.testing.assert_array_equal(states, state)
    np.testing.assert_allclose(other[state > 0], one[state > 0], atol=1e-6)


def moved_by(d):
    return d + np.moveaxis(np.indices(d.shape[:2], float), 0, -1)


@pytest.mark.parametrize("size", [1, 2, 9])
def test_tissue_that_rests_is_where_it_is(size):
    both(moved_by(np.zeros((size, size + 1, 2))), np.ones((size, size + 1), bool))


@pytest.mark.parametrize("far", [0.3, 2.0, 8.0], ids=["gently", "folded", "torn"])
@pytest.mark.parametrize("holes", [0.0, 0.2, 0.7], ids=["whole", "with holes", "threads"])
def test_tissue_that_moves_at_random_is_drawn_alike(far, holes):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(23, 31, 2)) * far
    both(moved_by(d), rng.random((23, 31)) >= holes)


def test_a_phantom_is_drawn_alike():
    made = phantom("expansion", 80)
    found = solve(made.problem, SeilerPrior(), backend="cpu")
    both(moved_by(found.displacement / made.problem.unit), made.problem.tissue)


def test_tissue_that_collapses_or_leaves_is_drawn_alike():
    d = np.zeros((12, 14, 2))
    d[4:8] = 40.0
    d[:, 9:, 1] = -3.0
    tissue = np.ones((12, 14), bool)
    tissue[2, 2] = False
    both(moved_by(d), tissue)


def test_many_pixels_are_asked_a_part_at_a_time(monkeypatch):
    monkeypatch.setattr(triangle_arrays, "_AT_ONCE", 50)
    rng = np.random.default_rng(1)
    both(moved_by(rng.normal(size=(15, 12, 2))), rng.random((15, 12)) < 0.9)
