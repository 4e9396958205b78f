"""Energies of the paper's prior, checked against its equations and examples."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Problem, SeilerPrior
from napari_hmrf.errors import ArgumentError, ProblemError
from napari_hmrf.solver.priors import line_steps, line_weights
from validation.oracles.paper import cliques, local_energies, total_energy


def random_problem(shape=(7, 9), seed=0, void=True, **more):
    rng = np.random.default_rng(seed)
    m = rng.choice([0.0, 10, 20, 40] if void else [10.0, 20, 40], size=shape)
    m[0, 0] = 10
    c = rng.random((*shape, 2)) * (rng.random((*shape, 2)) < 0.3)
    c[0, 0] = 1
    return Problem(
        observed=rng.normal(size=(*shape, 2)), confidence=c, stiffness=m, **more
    ), rng.normal(size=(*shape, 2))


def three_in_a_row(first, second, third, m):
    """Return a problem of three sites in a column, and their displacement."""
    d = np.array([[first], [second], [third]], dtype=float)
    m = np.array(m, dtype=float)[:, None]
    return Problem(observed=np.zeros_like(d), confidence=np.ones_like(d), stiffness=m), d


def test_the_first_energy_term_of_example_1_of_the_paper_is_zero():
    # m_t / m_u = 2 and the strain doubles from s-t to t-u. The second term of V is
    # (1 * -2 + 1)^2 = 1, the contradiction in eq. 7 that the documentation explains.
    problem, d = three_in_a_row((1, 0), (2, 0), (4, 0), (20, 20, 10))
    observed = 5.0 * np.abs(d).sum()
    energy = SeilerPrior(penalty=5.0).site_energy(problem, d).sum() - observed
    assert energy == pytest.approx(0 + 1)


def test_example_2_of_the_paper_is_8_not_2_8():
    # Eq. 13 for (1, 1), (2, 2), (1, 1) gives 2^2 + 2^2 = 8; the paper prints the square root.
    # V also has the mirrored term, which has the same value here.
    d = np.zeros((3, 3, 2))
    d[0, 0], d[1, 1], d[2, 2] = 1, 2, 1
    m = np.zeros((3, 3))
    m[np.diag_indices(3)] = 10
    problem = Problem(observed=d, confidence=np.ones_like(d), stiffness=m)
    assert SeilerPrior().site_energy(problem, d).sum() == pytest.approx(2 * 8)


@pytest.mark.parametrize("conditional", ["centred", "blanket"])
def test_the_total_energy_is_the_sum_over_all_cliques(conditional):
    problem, d = random_problem()
    prior = SeilerPrior(penalty=3.5, conditional=conditional)
    shares = prior.site_energy(problem, d)
    assert shares.sum() == pytest.approx(total_energy(problem, d, 3.5), rel=1e-9)
    assert prior.mean_energy(problem, d) == pytest.approx(shares.sum() / problem.tissue.sum())


def test_up_to_twelve_cliques_contain_a_site():
    y = np.zeros((5, 5, 2))
    problem = Problem(observed=y, confidence=1 + y, stiffness=np.ones((5, 5)))
    every = cliques(problem.stiffness, problem.spacing)
    assert sum(np.count_nonzero(np.stack(sites) == 12) for *sites, _ in every) == 12


@pytest.mark.parametrize("conditional", ["centred", "blanket"])
def test_the_parabola_of_a_site_matches_its_local_energy(conditional):
    problem, d = random_problem((5, 6), seed=3)
    prior = SeilerPrior(conditional=conditional)
    parabola = prior.site_parabola(problem, d)
    blanket, p = conditional == "blanket", np.zeros_like(d)
    energies = local_energies(problem.stiffness, d, p, d, problem.spacing, blanket)
    for there in np.random.default_rng(1).normal(size=(4, *d.shape)):
        away = (there - parabola.lowest) ** 2 - (d - parabola.lowest) ** 2
        rise = (parabola.curvature * away).sum(axis=-1)
        np.testing.assert_allclose(energies(there) - energies(d), rise, atol=1e-8)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.7, 2.0)])
def test_a_uniform_strain_of_uniform_tissue_has_no_energy(spacing):
    i, j = np.mgrid[:6, :8]
    d = np.stack([0.1 * i - 0.3 * j + 1, 0.2 * i + 0.05 * j - 2], axis=-1)
    problem = Problem(
        observed=d, confidence=np.ones_like(d), stiffness=np.full((6, 8), 3.0), spacing=spacing
    )
    assert SeilerPrior().site_energy(problem, problem.observed).sum() == pytest.approx(0, abs=1e-6)


def test_the_terms_of_the_total_energy_can_be_told_apart_for_a_field_in_double_precision():
    i, j = np.mgrid[:6, :8]
    d = np.stack([0.013 * i + 0.007 * j, 0.011 * j], axis=-1)
    prior = SeilerPrior()
    problem = Problem(observed=d, confidence=np.ones_like(d), stiffness=np.ones((6, 8)), spacing=2)
    off = np.abs(problem.observed - d) / problem.unit
    observation = (prior.limit(problem) * off).sum(axis=-1)
    assert observation.sum() > 1e-4  # `observed` is in single precision
    np.testing.assert_allclose(prior.site_energy(problem, d), observation, atol=1e-12)


def test_the_energy_depends_only_on_ratios_of_stiffness():
    problem, d = random_problem()
    scaled = Problem(
        observed=problem.observed, confidence=problem.confidence, stiffness=problem.stiffness * 1000
    )
    prior = SeilerPrior()
    np.testing.assert_allclose(prior.site_energy(scaled, d), prior.site_energy(problem, d))


def test_the_energy_does_not_depend_on_the_unit_of_length():
    problem, d = random_problem()
    metres = Problem(
        observed=problem.observed * 1e-3,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=(1e-3, 1e-3),
    )
    prior = SeilerPrior()
    np.testing.assert_allclose(
        prior.site_energy(metres, d * 1e-3), prior.site_energy(problem, d), rtol=1e-4
    )


def test_the_energy_has_no_preferred_direction():
    problem, d = random_problem((6, 6))
    prior = SeilerPrior()
    expected = prior.site_energy(problem, d)
    flipped = Problem(
        observed=problem.observed[::-1] * (-1, 1),
        confidence=problem.confidence[::-1],
        stiffness=problem.stiffness[::-1],
    )
    np.testing.assert_allclose(prior.site_energy(flipped, d[::-1] * (-1, 1)), expected[::-1])
    turn = (1, 0, 2)
    turned = Problem(
        observed=problem.observed.transpose(turn)[..., ::-1],
        confidence=problem.confidence.transpose(turn)[..., ::-1],
        stiffness=problem.stiffness.T,
    )
    swapped = d.transpose(turn)[..., ::-1]
    np.testing.assert_allclose(prior.site_energy(turned, swapped), expected.T)


def test_void_belongs_to_no_clique():
    problem, d = random_problem(void=False)
    m = problem.stiffness.copy()
    m[3, 3] = 0
    energy = SeilerPrior().site_energy(
        Problem(observed=problem.observed, confidence=problem.confidence, stiffness=m), d
    )
    wild = d.copy()
    wild[3, 3] = 1e6  # an arbitrary value
    np.testing.assert_array_equal(
        SeilerPrior().site_energy(
            Problem(observed=problem.observed, confidence=problem.confidence, stiffness=m), wild
        ),
        energy,
    )
    assert energy[3, 3] == 0


def test_the_line_weights_of_square_pixels_match_the_paper():
    np.testing.assert_allclose(
        line_weights((3.0, 3.0)), [[1, 0], [0, 1], [1, 1], [1, 1]], atol=1e-12
    )


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 2.0), (3.0, 1.0), (1.0, 1.2)])
def test_the_continuum_limit_does_not_depend_on_the_pixel_shape(spacing):
    # Second moments of the lines in physical lengths: a ratio of 3 to 2, and no shear.
    weights = line_weights(spacing)
    assert (weights >= 0).all()
    steps = np.array(line_steps(2)) * spacing
    for component in (0, 1):
        moment = np.einsum("l,li,lj->ij", weights[:, component], steps, steps)
        along, across = moment[component, component], moment[1 - component, 1 - component]
        assert along / across == pytest.approx(1.5)
        assert moment[0, 1] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"penalty": 0},
        {"penalty": np.inf},
        {"penalty": "a"},
        {"penalty": 1e39},
        {"conditional": "middle"},
        {"damping": 0},
        {"damping": 2},
        {"damping": "none"},
    ],
)
def test_invalid_parameters_of_a_prior_are_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SeilerPrior(**wrong)


@pytest.mark.parametrize("prior", [SeilerPrior(), ElasticPrior(), NeoHookeanPrior()])
def test_the_energy_of_a_field_on_another_grid_or_with_nan_is_refused(prior):
    rest, tissue = np.zeros((8, 9, 2)), np.ones((8, 9))
    problem = Problem(observed=rest, confidence=rest + 1, stiffness=tissue)
    energy = getattr(prior, "mean_energy", None) or prior.energy
    for displacement in (0.0, np.zeros(2), np.zeros((2, 8, 9)), "rest", rest + np.nan):
        with pytest.raises(ProblemError) as refused:
            energy(problem, displacement)
        assert refused.value.field == "displacement"
    with pytest.raises(ArgumentError, match="problem"):
        energy(tissue, rest)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 2.0)])
def test_the_penalty_grows_with_the_stiffness_beside_observations(spacing):
    shape = (16, 16)
    c = np.zeros((*shape, 2))
    c[8, 8] = 1
    y = np.zeros((*shape, 2))
    uniform = SeilerPrior().resolved(
        Problem(observed=y, confidence=c, stiffness=np.ones(shape), spacing=spacing)
    )
    assert uniform.penalty == pytest.approx(1e4)
    m = np.ones(shape)
    m[8, 8] = 50
    stiff = SeilerPrior().resolved(Problem(observed=y, confidence=c, stiffness=m, spacing=spacing))
    assert stiff.penalty > 100 * uniform.penalty
    m[8, 8], m[0, 0] = 1, 50  # stiff tissue far from any observation
    far = SeilerPrior().resolved(Problem(observed=y, confidence=c, stiffness=m, spacing=spacing))
    assert far.penalty == pytest.approx(1e4)
    assert (
        SeilerPrior(penalty=7)
        .resolved(Problem(observed=y, confidence=c, stiffness=m, spacing=spacing))
        .penalty
        == 7
    )
