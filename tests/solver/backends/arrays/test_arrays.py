"""NumPy models of the host, compared with the compiled models."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Problem, SeilerPrior
from napari_hmrf.solver.backends.arrays import elastic, exact, seiler
from napari_hmrf.solver.backends.cpu import exact as compiled
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.backends.cpu.seiler_model import CpuSeilerModel

SHAPES = [((9, 12), (1.0, 1.0)), ((31, 17), (1.0, 2.5)), ((2, 40), (1.0, 1.0))]
PRIORS = {
    "stress": ElasticPrior(0.4),
    "strain": ElasticPrior(0.499, plane="strain"),
    "centred": SeilerPrior(),
    "blanket": SeilerPrior(conditional="blanket"),
}


def both_models(prior, shape, spacing):
    """Return both models of random tissue with holes and some prescribed components."""
    rng = np.random.default_rng(0)
    m = 10 ** rng.uniform(-2, 1, shape)
    m[rng.random(shape) < 0.1] = 0
    problem = Problem(
        observed=np.zeros((*shape, 2)),
        confidence=rng.random((*shape, 2)) < 0.2,
        stiffness=m,
        spacing=spacing,
    )
    material = prior.material(problem)
    if isinstance(prior, ElasticPrior):
        both = CpuElasticModel(material), elastic.ArrayElasticModel(material)
    else:
        both = CpuSeilerModel(material), seiler.ArraySeilerModel(material)
    held = np.zeros((2, shape[0] + 4, shape[1] + 4), dtype=bool)
    held[:, 2:-2, 2:-2] = np.moveaxis(problem.known, -1, 0)
    for model in both:
        model.hold(held)
    return both


#: Each prior and each grid, at least once.
CASES = [
    ("stress", *SHAPES[1]),
    ("strain", *SHAPES[0]),
    ("centred", *SHAPES[1]),
    ("blanket", *SHAPES[1]),
    ("blanket", *SHAPES[2]),
]
cases = pytest.mark.parametrize(
    ("prior", "shape", "spacing"),
    [
        *CASES,
        *(
            pytest.param(name, *grid, marks=pytest.mark.campaign)
            for name in PRIORS
            for grid in SHAPES
            if (name, *grid) not in CASES
        ),
    ],
    indirect=["prior"],
)


@pytest.fixture
def prior(request):
    return PRIORS[request.param]


@cases
def test_every_level_matches_the_compiled_loops(prior, shape, spacing):
    loops, plain = both_models(prior, shape, spacing)
    assert len(loops.levels) == len(plain.levels)
    assert loops.bounds == plain.bounds
    np.testing.assert_array_equal(loops.moves, plain.moves)
    tissue = ["lame"] if isinstance(prior, ElasticPrior) else ["stiffness", "even"]
    for one, other in zip(loops.levels, plain.levels, strict=True):
        assert one.grid == other.grid
        assert (one.weight is None) == (other.weight is None)
        for name in ("inverse", *tissue, *(["weight"] if one.weight is not None else [])):
            if name == "even" and one is loops.levels[0]:
                continue
            a, b = (getattr(level, name)[..., 2:-2, 2:-2] for level in (one, other))
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-30, err_msg=name)


@cases
def test_forces_and_energies_match_the_compiled_loops(prior, shape, spacing):
    loops, plain = both_models(prior, shape, spacing)
    d = np.random.default_rng(1).normal(size=loops.moves.shape)
    d[:, :2] = d[:, -2:] = d[..., :2] = d[..., -2:] = 0
    inside = np.s_[:, 2:-2, 2:-2]
    steep = np.maximum(loops.steepness, 1e-30)
    np.testing.assert_allclose(plain.steepness, loops.steepness, rtol=1e-6, atol=1e-12)
    scale = np.abs(loops.pull(d)).max()
    np.testing.assert_allclose(plain.pull(d)[inside], loops.pull(d)[inside], atol=1e-7 * scale)
    load = np.where(steep > 1e-30, np.random.default_rng(2).normal(size=d.shape), 0.0)
    for given in (None, load):
        one, other = loops.balance(d, given), plain.balance(d, given)
        np.testing.assert_allclose(
            one.unit * one.rest, other.unit * other.rest, atol=2e-6 * max(one.most, 1e-9)
        )
        assert one.most == pytest.approx(other.most, rel=1e-5)
        assert one.norm == pytest.approx(other.norm, rel=1e-5)
    assert plain.work(d) == pytest.approx(loops.work(d), rel=1e-5)


def test_operations_on_displacements_match_the_compiled_loops():
    rng = np.random.default_rng(0)
    y, first, second = rng.normal(size=(3, 6, 7, 2)).astype(np.float32)
    observed, tissue = rng.random((6, 7, 2)) < 0.5, rng.random((6, 7)) < 0.8
    found = []
    for module in (exact, compiled):
        d, held = np.zeros((2, 10, 11)), np.zeros((2, 10, 11), dtype=bool)
        nothing = np.full(y.shape, np.nan, np.float32), 0.0
        module.prescribe(y, observed, 0.5, *nothing, *nothing, d, held)
        plain = d.copy()
        module.prescribe(y, observed, 0.5, first, 0.25, second, 2.0, d, held)
        module.blend(first, 0.5, held, d)
        module.add(d, np.ones(d.shape, np.float32), 0.125)
        out = np.zeros((6, 7, 2), np.float32)
        module.gather(d, out)
        finite = np.zeros(6, dtype=bool)
        broken = out.copy()
        broken[2, 3, 0] = np.inf
        module.settle(broken, tissue, np.float32(1.5), np.zeros(6, dtype=bool))
        module.settle(out, tissue, np.float32(1.5), finite)
        found.append((plain, d, held, out, finite))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def test_nan_displacements_are_detected():
    values, finite = np.ones((3, 4, 2), np.float32), np.zeros(3, dtype=bool)
    values[1, 2, 0] = np.nan
    exact.settle(values, np.ones((3, 4), dtype=bool), np.float32(1), finite)
    assert finite.tolist() == [True, False, True]
