"""Direct factorization of a whole system."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_hmrf import ElasticPrior, Problem, SeilerPrior
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.backends.cpu.seiler_model import CpuSeilerModel
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.factors import Factors

PRIORS = {
    "stress": ElasticPrior(0.4),
    "strain": ElasticPrior(0.49, plane="strain"),
    "centred": SeilerPrior(),
    "blanket": SeilerPrior(conditional="blanket"),
}


def model_of(prior, shape, spacing=(1.0, 1.0), held=True, seed=0):
    """Return a model of random tissue with a hole, two fixed edges and some fixed components."""
    rng = np.random.default_rng(seed)
    m = 10 ** rng.uniform(0, 2, shape)
    m[3:6, 2:4] = 0
    c = np.zeros((*shape, 2))
    if held:
        c[0] = c[-1] = 1
        c[rng.random(c.shape) < 0.05] = 1
    else:
        c[0, 0] = 1
    problem = Problem(observed=np.zeros_like(c), confidence=c, stiffness=m, spacing=spacing)
    kind = CpuElasticModel if isinstance(prior, ElasticPrior) else CpuSeilerModel
    model = kind(prior.material(problem))
    planes = np.zeros((2, shape[0] + 4, shape[1] + 4), dtype=bool)
    planes[:, 2:-2, 2:-2] = np.moveaxis(problem.known, -1, 0)
    model.hold(planes)
    return model


def ignore_progress(part):
    """Ignore the progress."""


GRIDS = [
    ((9, 7), (1.0, 3.0)),
    ((40, 23), (1.0, 1.0)),
    ((6, 64), (1.0, 3.0)),
    ((50, 51), (1.0, 1.0)),
]
SOME = [(prior, *grid) for prior, grid in zip(PRIORS, GRIDS, strict=True)]


@pytest.mark.parametrize(
    ("prior", "shape", "spacing"),
    [
        *SOME,
        *(
            pytest.param(prior, *grid, marks=pytest.mark.campaign)
            for prior in PRIORS
            for grid in GRIDS
            if (prior, *grid) not in SOME
        ),
    ],
)
def test_solving_for_the_forces_of_a_displacement_recovers_it(prior, shape, spacing):
    model = model_of(PRIORS[prior], shape, spacing)
    d = np.random.default_rng(1).normal(size=model.moves.shape) * model.moves
    balance = model.balance(d, None)
    found = -balance.unit * Factors(model.material, model.moves, ignore_progress).solve(
        balance.rest
    )
    np.testing.assert_allclose(found, d, atol=2e-4)


def test_a_nearly_singular_system_is_solved_to_many_digits():
    """A plate of the paper's cliques with stiff blobs: bending has 1e-12 of the diagonal."""
    rng = np.random.default_rng(0)
    m = np.where(gaussian_filter(rng.random((34, 34)), 1.5) > 0.5, 1e6, 1.0)
    problem = Problem(
        observed=np.zeros((34, 34, 2)), confidence=rng.random((34, 34, 2)) < 0.07, stiffness=m
    )
    model = CpuSeilerModel(PRIORS["blanket"].material(problem))
    held = np.zeros(model.moves.shape, dtype=bool)
    held[:, 2:-2, 2:-2] = np.moveaxis(problem.known, -1, 0)
    model.hold(held)
    d = rng.normal(size=model.moves.shape) * model.moves
    factors = Factors(model.material, model.moves, ignore_progress)
    d += factors.solve(np.where(model.moves, model.pull(d, np.zeros_like(d)), 0.0))
    assert np.abs(d).max() < 0.3
    d += factors.solve(np.where(model.moves, model.pull(d, np.zeros_like(d)), 0.0))
    assert np.abs(d).max() < 1e-3


def test_forces_from_differences_match_the_compiled_loops():
    model = model_of(PRIORS["blanket"], (30, 21), (1.0, 2.5))
    d = np.random.default_rng(2).normal(size=model.moves.shape)
    steep = np.maximum(model.steepness, 1e-300)
    few, many = model.pull(d).copy(), model.pull(d, np.zeros_like(d))
    assert (np.abs(many - few) <= 1e-9 * steep).all()
    assert (np.abs(model.pull(np.zeros_like(d), d) - many) <= 1e-9 * steep).all()


def test_unconstrained_tissue_has_no_factorization():
    model = model_of(PRIORS["stress"], (20, 20), held=False)
    with pytest.raises(Singular):
        Factors(model.material, model.moves, ignore_progress)


def test_springs_make_the_system_of_unconstrained_tissue_regular():
    model = model_of(PRIORS["stress"], (20, 20), held=False)
    springs = np.where(model.moves, 0.5, 0.0)
    load = np.random.default_rng(2).normal(size=springs.shape) * model.moves
    d = Factors(model.material, model.moves, ignore_progress, springs).solve(load)
    rest = load + np.where(model.moves, model.pull(d), 0.0) - springs * d
    assert np.abs(rest).max() < 1e-6


def test_the_factorization_reports_progress_and_can_be_interrupted():
    model = model_of(PRIORS["stress"], (70, 70))
    parts = []
    Factors(model.material, model.moves, parts.append)
    assert 0 < parts[0] < 0.5 < parts[-1] <= 1

    def stop(part):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Factors(model.material, model.moves, stop)
