"""Tests of the motion of a problem due to forces."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import growth
from napari_hmrf.solver.operator import Operator, typical_size
from validation.oracles.posterior import posterior_covariance

SCALE = StrainScale(0.1)


def observed_block(moved=0.0, loads=None):
    """Return tissue of random stiffness with a held row and two landmarks."""
    shape, spacing = (9, 8), (1.0, 2.0)
    c = np.zeros((*shape, 2))
    c[0] = 1
    points = np.array([(4.5, 3.0), (7.0, 6.2)])
    return Problem(
        observed=moved * c,
        confidence=c,
        stiffness=100 ** np.random.default_rng(0).random(shape),
        spacing=spacing,
        landmarks=Landmarks(points, points + moved, sd=[0.2, 0.5], scale=SCALE),
        loads=loads,
    )


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_the_error_of_a_motion_of_any_size_is_within_the_tolerance(size):
    problem = observed_block()
    covariance, free = posterior_covariance(problem, ElasticPrior(), SCALE)
    force = size * np.random.default_rng(1).normal(size=problem.observed.shape)
    expected = np.zeros(force.size)
    energy = SCALE.energy(problem.stiffness, problem.spacing)
    expected[free] = covariance @ force.ravel()[free] / energy
    operator = Operator(problem, ElasticPrior(), "cpu")
    rms = typical_size(expected.reshape(force.shape)[operator.moves])
    for tolerances in ({"rtol": 1e-4}, {"rtol": 0.0, "atol": 1e-4 * rms}):
        found = operator.solve(force, **tolerances)
        errors = np.linalg.norm(found - expected.reshape(force.shape), axis=-1)
        assert errors.max() <= 1e-4 * rms


def test_loads_and_observed_displacements_have_no_effect():
    force = np.random.default_rng(1).normal(size=(9, 8, 2))
    still, moved = (
        Operator(problem, ElasticPrior(), "cpu").solve(force)
        for problem in (observed_block(), observed_block(2.0, growth(np.full((9, 8), 0.1))))
    )
    np.testing.assert_array_equal(moved, still)


def test_the_size_of_a_motion_is_that_of_the_piece_that_moves():
    piece, rest = np.full((4, 2), 3.0), np.full((6, 2), 1e-9)
    assert typical_size(np.concatenate([piece, rest])) == pytest.approx(3 * np.sqrt(0.8))
