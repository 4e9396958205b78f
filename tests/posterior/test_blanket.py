"""Tests of samples of the paper's model in its blanket reading."""

import numpy as np
import pytest

from napari_hmrf import Problem, ProblemError, SeilerPrior
from napari_hmrf.errors import ArgumentError
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.posterior import sample_posterior, uncertainty
from napari_hmrf.posterior.blanket import CliqueNoise
from validation.oracles.paper import equations, solve_exactly

BLANKET = SeilerPrior(conditional="blanket")
COUNT = 50


def held_block(shape=(8, 7), spacing=(1.0, 1.0), moved=0.0):
    """Return a block of random stiffness with void, whose first and last rows are held."""
    y, c = np.zeros((2, *shape, 2))
    c[:2] = c[-1] = 1
    y[-1] = moved
    m = 5 ** np.random.default_rng(0).random(shape)
    m[3:5, :2] = 0
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)


PROBLEM = held_block(moved=(0.5, 1.0))
#: Second derivatives of the energy of the paper, without observations.
MATRIX = 2 * equations(PROBLEM.stiffness, PROBLEM.spacing, "blanket").toarray()
FREE = (MATRIX.diagonal() > 0) & ~PROBLEM.known.ravel()


def test_samples_have_the_mean_and_covariance_of_the_posterior():
    mean = solve_exactly(PROBLEM, "blanket").ravel()[FREE]
    drawn = sample_posterior(PROBLEM, BLANKET, n=COUNT, scale=StrainScale(0.05), backend="cpu")
    fields = np.stack([field.ravel() for field in drawn]).astype(float)
    held = PROBLEM.observed.ravel()[~FREE]
    np.testing.assert_allclose(fields[:, ~FREE], np.tile(held, (COUNT, 1)), atol=1e-5)
    deviations = fields[:, FREE] - mean
    # Deviations in units of the posterior are independent standard normal numbers.
    units = np.linalg.cholesky(MATRIX[np.ix_(FREE, FREE)]).T @ deviations.T / 0.5
    assert (units**2).mean() == pytest.approx(1, abs=5 * np.sqrt(2 / units.size) + 0.01)
    covariance = units @ units.T / COUNT
    assert np.abs(covariance - np.eye(len(units))).max() < 7 / np.sqrt(COUNT)
    assert np.abs(units.mean(axis=1)).max() < 5 / np.sqrt(COUNT)


def test_the_noise_of_the_cliques_has_the_covariance_of_their_matrix():
    noise = CliqueNoise(PROBLEM, energy=3.0)
    forces = np.stack([noise.force(0, number).ravel() for number in range(1000)])
    expected = 3.0 * MATRIX
    error = forces.T @ forces / len(forces) - expected
    spread = np.sqrt(np.outer(np.diag(expected), np.diag(expected)) * 2 / len(forces))
    assert (np.abs(error) <= 5 * spread).all()


def test_the_strains_of_neighbouring_patches_differ_by_the_typical_strain():
    shape = (28, 28)
    c = np.zeros((*shape, 2))
    c[:2] = 1
    problem = Problem(observed=0 * c, confidence=c, stiffness=np.ones(shape))
    drawn = np.stack(list(sample_posterior(problem, BLANKET, n=40, backend="cpu")))
    for size in (3, 8):
        along = (drawn[:, size:] - drawn[:, :-size]) / size
        patches = along[:, 8:-size:size, 2:-size:size, 1]
        change = np.diff(patches, axis=2)
        assert np.sqrt((change**2).mean()) == pytest.approx(0.1, rel=0.6)


def test_a_sample_depends_on_its_seed_and_number_only():
    few = list(sample_posterior(PROBLEM, BLANKET, n=1, seed=5, backend="cpu"))
    many = list(sample_posterior(PROBLEM, BLANKET, n=2, seed=5, backend="cpu"))
    np.testing.assert_array_equal(few[0], many[0])
    assert np.abs(many[1] - many[0]).max() > 0.01


def doubted():
    problem = held_block()
    return Problem(
        observed=problem.observed, confidence=0.5 * problem.confidence, stiffness=problem.stiffness
    )


def with_landmarks():
    problem = held_block()
    marks = Landmarks([(5, 5)], [(5, 6)], sd=0.1)
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        landmarks=marks,
    )


def loose():
    c = np.zeros((8, 8, 2))
    c[0] = 1  # the tissue can still be stretched
    return Problem(observed=0 * c, confidence=c, stiffness=np.ones((8, 8)))


@pytest.mark.parametrize(
    ("problem", "prior", "named", "reason"),
    [
        (held_block(), SeilerPrior(), "prior", "centred reading, which has no energy"),
        (doubted(), BLANKET, "confidence", "may slip"),
        (held_block(), SeilerPrior(conditional="blanket", penalty=1.0), "confidence", "a penalty"),
        (with_landmarks(), BLANKET, "landmarks", "paper's prior"),
        (loose(), BLANKET, "confidence", "could still grow"),
    ],
)
def test_other_posteriors_of_the_paper_are_refused_with_the_reason(problem, prior, named, reason):
    with pytest.raises(ProblemError, match=reason) as refused:
        sample_posterior(problem, prior, n=1)
    assert refused.value.field == named


def test_a_scale_that_is_a_number_is_refused():
    with pytest.raises(ArgumentError, match="StrainScale"):
        sample_posterior(PROBLEM, BLANKET, n=1, scale=0.1)


def test_error_bars_of_patches_are_for_elastic_tissue():
    with pytest.raises(ProblemError, match="SeilerPrior"):
        uncertainty(held_block(), BLANKET)
