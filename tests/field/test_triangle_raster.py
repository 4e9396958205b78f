"""Agreement of the vectorized and the compiled rasteriser of triangles."""

import numpy as np
import pytest

from napari_hmrf import SeilerPrior, solve
from napari_hmrf.compute.compile_cache.loops import only_read
from napari_hmrf.data import phantom
from napari_hmrf.field import triangle_arrays, triangle_raster


def assert_same_maps(moved, tissue):
    """Assert that both rasterisers give the same inverse map."""
    (one, state), (other, states) = (
        module.rasterise(moved, only_read(tissue)) for module in (triangle_raster, triangle_arrays)
    )
    np.testing.assert_array_equal(states, state)
    np.testing.assert_allclose(other[state > 0], one[state > 0], atol=1e-6)


def moved_sites(d):
    return d + np.moveaxis(np.indices(d.shape[:2], float), 0, -1)


@pytest.mark.parametrize("size", [1, 2, 9])
def test_both_rasterisers_agree_on_resting_tissue(size):
    assert_same_maps(moved_sites(np.zeros((size, size + 1, 2))), np.ones((size, size + 1), bool))


@pytest.mark.parametrize(
    ("far", "holes"),
    [(0.3, 0.2), (2.0, 0.0), (2.0, 0.7), (8.0, 0.2)],
    ids=["gently", "folded", "folded threads", "torn"],
)
def test_both_rasterisers_agree_on_random_motion(far, holes):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(23, 31, 2)) * far
    assert_same_maps(moved_sites(d), rng.random((23, 31)) >= holes)


def test_both_rasterisers_agree_on_a_phantom():
    made = phantom("expansion", 80)
    found = solve(made.problem, SeilerPrior(), backend="cpu")
    assert_same_maps(moved_sites(found.displacement / made.problem.unit), made.problem.tissue)


def test_both_rasterisers_agree_on_collapsed_tissue_and_tissue_outside():
    d = np.zeros((12, 14, 2))
    d[4:8] = 40.0
    d[:, 9:, 1] = -3.0
    tissue = np.ones((12, 14), bool)
    tissue[2, 2] = False
    assert_same_maps(moved_sites(d), tissue)


def test_both_rasterisers_agree_when_pixels_are_processed_in_batches(monkeypatch):
    monkeypatch.setattr(triangle_arrays, "_AT_ONCE", 50)
    rng = np.random.default_rng(1)
    assert_same_maps(moved_sites(rng.normal(size=(15, 12, 2))), rng.random((15, 12)) < 0.9)
