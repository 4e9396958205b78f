"""Tests of the agreement of landmarks with the model."""

import numpy as np
import pytest
import scipy

from napari_hmrf import ElasticPrior, Problem, ProblemError
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.posterior import check_agreement
from validation.oracles.posterior import data_covariance, interpolation

SCALE = StrainScale(0.2)
SHAPE = (9, 8)
POINTS = np.array([(2, 2), (2, 6), (4.5, 4), (5, 1.5), (6, 6.2), (7.5, 3), (8, 7)], float)
SD = 0.2


def tissue(moved, held, points=POINTS, sd=SD):
    """Return uniform tissue whose landmarks moved by the given distances."""
    c = np.zeros((*SHAPE, 2))
    c[0] = held
    marks = Landmarks(points, points + moved, sd=sd, scale=SCALE)
    return Problem(observed=0 * c, confidence=c, stiffness=np.ones(SHAPE), landmarks=marks)


def drawn(held, count, seed=0):
    """Return motions of the landmarks that agree with the model, shape (count, n, 2)."""
    problem = tissue(0.0, held)
    rows = interpolation(POINTS, SHAPE).toarray()
    ways, covariance = data_covariance(problem, ElasticPrior(), SCALE, rows)
    covariance = covariance + SD**2 * np.eye(len(covariance))
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(count, len(covariance))) @ np.linalg.cholesky(covariance).T
    return (values @ ways.T).reshape(count, len(POINTS), 2)


@pytest.mark.parametrize("held", [True, False])
def test_the_statistic_is_that_of_the_dense_covariance(held):
    moved = drawn(held, 1)[0]
    problem = tissue(moved, held)
    found = check_agreement(problem, backend="cpu")
    rows = interpolation(POINTS, SHAPE).toarray()
    ways, covariance = data_covariance(problem, ElasticPrior(), SCALE, rows)
    inverse = np.linalg.inv(covariance + SD**2 * np.eye(len(covariance)))
    precision = ways @ inverse @ ways.T
    pull = precision @ moved.ravel()
    assert found.freedom == 2 * len(POINTS) - (0 if held else 3)
    assert found.chi_squared == pytest.approx(moved.ravel() @ pull, rel=1e-3)
    assert found.p_value == pytest.approx(scipy.stats.chi2.sf(found.chi_squared, found.freedom))
    np.testing.assert_allclose(
        found.residuals.ravel(), pull / np.sqrt(np.diag(precision)), atol=2e-3
    )


def test_a_residual_is_the_difference_from_the_prediction_by_all_other_landmarks():
    moved = drawn(True, 1)[0]
    found = check_agreement(tissue(moved, True), backend="cpu")
    rows = interpolation(POINTS, SHAPE).toarray()
    _, covariance = data_covariance(tissue(0.0, True), ElasticPrior(), SCALE, rows)
    covariance = covariance + SD**2 * np.eye(len(covariance))
    own, others = np.arange(2), np.arange(2, 2 * len(POINTS))
    between = covariance[np.ix_(own, others)] @ np.linalg.inv(covariance[np.ix_(others, others)])
    left = moved.ravel()[own] - between @ moved.ravel()[others]
    spread = covariance[np.ix_(own, own)] - between @ covariance[np.ix_(others, own)]
    expected = scipy.stats.chi2.sf(left @ np.linalg.inv(spread) @ left, 2)
    assert found.landmark_p_values[0] == pytest.approx(expected, rel=0.01)


def test_a_wrong_landmark_is_named():
    moved = drawn(False, 1)[0]
    moved[4] += (2.5, -2.5)
    found = check_agreement(tissue(moved, False), backend="cpu")
    assert found.p_value < 1e-4
    assert found.landmark_p_values.argmin() == 4
    assert found.landmark_p_values[4] < 0.01 / len(POINTS)


def test_a_rigid_motion_of_free_tissue_agrees_perfectly():
    angle = 0.2
    moved = 3 + angle * np.stack([-POINTS[:, 1], POINTS[:, 0]], axis=1)
    found = check_agreement(tissue(moved, False), backend="cpu")
    assert found.chi_squared < 1e-3
    assert check_agreement(tissue(moved, True), backend="cpu").p_value < 1e-6


def test_a_component_that_no_other_observation_predicts_has_no_residual():
    points = np.array([(2.0, 2.0), (6.0, 6.0)])
    found = check_agreement(tissue(0.5, False, points), backend="cpu")
    assert found.freedom == 1
    assert np.isfinite(found.landmark_p_values).all()
    rim = tissue(0.0, False, np.array([(2.0, 2.0), (2.0, 6.0)]))
    assert np.isnan(check_agreement(rim, backend="cpu").residuals[:, 0]).all()


def test_landmarks_that_only_determine_a_rigid_motion_are_refused():
    c = np.zeros((*SHAPE, 2))
    c[0, 0] = 1
    marks = Landmarks([(6, 6)], [(6, 7)], sd=SD, scale=SCALE)
    problem = Problem(observed=0 * c, confidence=c, stiffness=np.ones(SHAPE), landmarks=marks)
    assert check_agreement(problem, backend="cpu").freedom == 1
    with pytest.raises(ProblemError, match="free"):
        check_agreement(tissue(0.5, False, np.array([(2.0, 2.0)])), backend="cpu")
