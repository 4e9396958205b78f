"""Tests of levels that store only rows of tissue."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_opening, gaussian_filter

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.cpu import layout
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.optimizers.cycle import Cycle, smoothing_of
from tests.support.opengl import on_compute_thread


def blobs(seed) -> np.ndarray:
    """Return the stiffness of tissue in irregular pieces, with holes and rows without tissue."""
    random = np.random.default_rng(seed)
    m = 1000 ** random.random((173, 158))
    tissue = gaussian_filter(random.normal(size=m.shape), 9) > 0.01
    tissue[60:64] = False
    tissue[:, :30] = False
    tissue[:, 150:] = seed % 2 == 0
    return np.where(tissue, m, 0)


def random_problem(m, seed) -> Problem:
    random = np.random.default_rng(seed)
    c = random.random((*m.shape, 2)) < 0.02
    c[110:125] = True  # rows in which nothing moves
    # A prescribed pixel outside every element would change the cycle in one of the layouts only.
    c &= binary_opening(m > 0, np.ones((2, 2)))[..., None]
    return Problem(
        observed=random.normal(size=c.shape),
        confidence=c.astype(float),
        stiffness=m,
        spacing=(1.0, 1.5),
    )


@pytest.fixture
def small_layouts(monkeypatch):
    """Store only tissue at any size."""
    monkeypatch.setattr(layout, "_FEW", {2: 0, 3: 0})
    monkeypatch.setattr(layout, "_FULL", 2.0)


def results_of(model: CpuElasticModel, problem: Problem) -> dict:
    """Return everything that a solve reads from a model, as planes."""
    random = np.random.default_rng(3)
    d, held = host.prescribed(problem)
    model.hold(held)
    finest, cycle = model.levels[0], Cycle(model, smoothing_of(model.material))
    load = (random.normal(size=held.shape) * model.moves).astype(np.float32)
    found = {"correction": finest.planes(cycle.run(finest.vector(load))).copy()}
    direction, image = finest.vector(load.copy()), finest.vector()
    found["product"] = finest.apply(direction, image)
    found["image"] = finest.planes(image).copy()
    balance = model.balance(d, load.astype(np.float64))
    found["rest"] = finest.planes(balance.rest).copy()
    found["most"], found["norm"] = balance[2:]
    found["work"], found["pull"] = model.work(d), model.pull(d).copy()
    found["moves"], found["steepness"] = model.moves, model.steepness
    return found


def assert_same_results(model: CpuElasticModel, problem: Problem) -> None:
    """Compare a model with one that stores all sites."""
    actual = results_of(model, problem)
    expected = results_of(CpuElasticModel(model.material), problem)
    for name, value in expected.items():
        most = np.abs(value).max()
        np.testing.assert_allclose(actual[name], value, rtol=0, atol=2e-6 * most, err_msg=name)


@pytest.mark.parametrize("seed", range(4))
def test_an_image_stored_without_void_is_solved_as_one_with_void(seed, small_layouts):
    problem = random_problem(blobs(seed), seed)

    def compare():
        model = CpuElasticModel(ElasticPrior(0.4).material(problem), whole=False)
        assert not model.levels[0].layout.is_whole
        assert not model.levels[1].layout.is_whole
        assert_same_results(model, problem)

    on_compute_thread(compare)


def test_an_image_stored_without_void_stays_correct_while_its_tissue_changes(small_layouts):
    def compare():
        model = None
        for seed in (1, 2, 1):
            problem = random_problem(blobs(seed), seed)
            material = ElasticPrior(0.4).material(problem)
            if model is None:
                model = CpuElasticModel(material, whole=False)
            assert model.fits(material, whole=False)
            model.assemble(material)
            assert_same_results(model, problem)

    on_compute_thread(compare)


@pytest.mark.parametrize("shape", [(31, 42), (12, 15, 19)])
def test_a_vector_keeps_its_values_at_tissue(shape, small_layouts):
    random = np.random.default_rng(1)
    tissue = np.zeros([size + 4 for size in shape], dtype=np.float32)
    inside = tissue[(slice(2, -3),) * len(shape)]
    inside[...] = random.random(inside.shape) < 0.1
    made = layout.Layout.of_tissue(tissue, whole=False)
    values = random.normal(size=(len(shape), *tissue.shape)).astype(np.float32)
    packed = made.packed(values)
    assert packed[0].size < tissue.size + 5 * 512
    at = tissue > 0
    np.testing.assert_array_equal(made.unpacked(packed)[:, at], values[:, at])


def test_images_with_little_void_and_small_images_are_stored_with_void():
    def levels_of(m):
        problem = random_problem(m, 0)
        model = CpuElasticModel(ElasticPrior(0.4).material(problem), whole=False)
        return [level.layout.is_whole for level in model.levels]

    full, half = np.ones((300, 300)), np.ones((300, 300))
    half[np.tri(300, dtype=bool)] = 0
    found = on_compute_thread(
        lambda: (levels_of(full), levels_of(half), levels_of(half[150:, 150:]))
    )
    assert all(found[0])
    assert not found[1][0]
    assert all(found[1][2:])
    assert all(found[2])
