"""Tests of the scale of the prior, by maximum likelihood."""

import threading

import numpy as np
import pytest
import scipy

from napari_hmrf import Cancelled, ElasticPrior, Problem, ProblemError, solve
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.posterior import check_agreement, fit_scale
from validation.oracles.posterior import data_covariance, interpolation

SCALE = StrainScale(0.1)


def observed(is_held, shape=(9, 8), spacing=(1.0, 2.0), n=10, strain=0.5, sd=0.1, seed=0):
    """Return tissue whose landmarks move as a sample of the prior, plus errors."""
    rng = np.random.default_rng(seed)
    axes = len(shape)
    c, y = np.zeros((2, *shape, axes))
    if is_held:
        c[0], y[0] = 1, 0.7
    m = 20 ** rng.random(shape)
    # Neighbouring landmarks differ by their errors only.
    points = np.repeat(0.1 + rng.random((n // 2, axes)) * (np.array(shape) - 1.3), 2, axis=0)
    points[1::2] += 0.1
    sds = sd * (1 + rng.random(n))
    marks = Landmarks(points, points, sd=sds, scale=SCALE)
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=spacing, landmarks=marks)
    rows = interpolation(points, shape)
    ways, covariance = data_covariance(problem, ElasticPrior(), StrainScale(strain), rows.toarray())
    moved = ways @ np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))
    if is_held:
        moved += rows @ at_rest(problem).ravel()
    else:
        moved += rows @ turned(shape, spacing).ravel()
    moved = moved.reshape(n, axes) + sds[:, None] * rng.normal(size=(n, axes))
    marks = Landmarks(points, points + moved / spacing, sd=sds, scale=SCALE)
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing, landmarks=marks)


def at_rest(problem):
    """Return the motion that held tissue causes without landmarks."""
    bare = Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=problem.spacing,
    )
    return solve(bare, backend="cpu").displacement.astype(float)


def turned(shape, spacing, angle=0.5):
    """Return a rotation and a shift, without strain."""
    place = np.moveaxis(np.indices(shape), 0, -1) * np.array(spacing)
    field = np.ones(place.shape)
    field[..., 0] -= angle * place[..., 1]
    field[..., 1] += angle * place[..., 0]
    return field


def dense(problem, strain):
    """Return the logarithm of the likelihood by a dense covariance."""
    marks = problem.landmarks
    rows = interpolation(marks.points, problem.shape).toarray()
    ways, covariance = data_covariance(problem, ElasticPrior(), StrainScale(strain), rows)
    covariance = covariance + (ways.T * marks.sd.ravel() ** 2) @ ways
    seen = marks.displacement(problem.spacing).ravel()
    if problem.known.any():
        seen = seen - rows @ at_rest(problem).ravel()
    return scipy.stats.multivariate_normal(np.zeros(len(covariance)), covariance).logpdf(
        ways.T @ seen
    )


@pytest.mark.parametrize(
    ("shape", "is_held"),
    [((9, 8), True), ((9, 8), False), ((4, 4, 4), False)],
    ids=["held image", "free image", "free volume"],
)
def test_the_fitted_scale_is_that_of_the_largest_dense_likelihood(shape, is_held):
    spacing = (1.0, 2.0, 1.0)[: len(shape)]
    problem = observed(is_held, shape, spacing)
    found = fit_scale(problem, backend="cpu")
    strain = found.scale.strain
    assert found.freedom == 10 * len(shape) - (0 if is_held else (3, 6)[len(shape) - 2])
    largest = dense(problem, strain)
    assert found.log_likelihood == pytest.approx(largest, abs=0.02)
    for factor in (0.9, 1.1):
        assert dense(problem, factor * strain) < largest
    for end in found.strain_interval:
        assert dense(problem, end) == pytest.approx(largest - 1.92, abs=0.03)


def test_the_fitted_problem_has_the_fitted_scale():
    found = fit_scale(observed(is_held=True), backend="cpu")
    assert found.problem.landmarks.scale == found.scale
    again = fit_scale(found.problem, backend="cpu")
    assert again.scale.strain == pytest.approx(found.scale.strain, rel=1e-3)


def test_a_precision_gives_the_same_scale_as_landmarks_at_its_sites():
    base = observed(is_held=True)
    sites = np.array([(2, 1), (2, 5), (4, 3), (5, 6), (6, 1), (7, 4), (8, 7), (8, 2)])
    moves = at_rest(base)[tuple(sites.T)] + np.random.default_rng(0).normal(0, 0.5, sites.shape)
    marks = Landmarks(sites, sites + moves / base.spacing, sd=0.2, scale=SCALE)
    given = {"confidence": base.confidence, "stiffness": base.stiffness}
    of_marks = Problem(observed=base.observed, **given, spacing=base.spacing, landmarks=marks)
    y = base.observed.copy()
    y[tuple(sites.T)] = moves
    precision = np.zeros(base.shape)
    precision[tuple(sites.T)] = SCALE.energy(base.stiffness, base.spacing) / 0.2**2
    of_sites = Problem(observed=y, **given, spacing=base.spacing, precision=precision)
    one = fit_scale(of_marks, backend="cpu")
    other = fit_scale(of_sites, scale=SCALE, backend="cpu")
    assert other.scale.strain == pytest.approx(one.scale.strain, rel=1e-3)
    field, same = (solve(each.problem, backend="cpu").displacement for each in (one, other))
    np.testing.assert_allclose(field, same, atol=5e-3)


def test_tissue_whose_landmarks_move_as_a_rigid_body_is_not_strained():
    base = observed(is_held=False)
    marks = base.landmarks
    moved = interpolation(marks.points, base.shape) @ turned(base.shape, base.spacing).ravel()
    targets = marks.points + moved.reshape(-1, 2) / base.spacing
    marks = Landmarks(marks.points, targets, sd=marks.sd, scale=SCALE)
    still = {"observed": base.observed, "confidence": base.confidence}
    problem = Problem(**still, stiffness=base.stiffness, spacing=base.spacing, landmarks=marks)
    with pytest.raises(ProblemError, match="errors of the observations explain") as refused:
        fit_scale(problem, backend="cpu")
    assert refused.value.field == "scale"


def with_marks(points, held=True, targets=None):
    c = np.zeros((9, 8, 2))
    c[:2] = held
    points = np.array(points, float)
    marks = Landmarks(points, points + 0.3 if targets is None else targets, sd=0.1, scale=SCALE)
    return Problem(observed=0 * c, confidence=c, stiffness=np.ones((9, 8)), landmarks=marks)


def without_data():
    problem = with_marks([(4, 4)])
    return Problem(
        observed=problem.observed, confidence=problem.confidence, stiffness=problem.stiffness
    )


@pytest.mark.parametrize(
    ("problem", "reason"),
    [
        (without_data(), "are missing"),
        (with_marks([(4, 4)]), "too few"),
        (with_marks([(4, 4), (6, 5)], held=False), "too few"),
        (with_marks([(0.5, 3), (0.5, 4), (0.2, 6)]), "all in held tissue"),
    ],
)
def test_observations_that_do_not_determine_a_scale_are_refused(problem, reason):
    with pytest.raises(ProblemError, match=reason) as refused:
        fit_scale(problem, backend="cpu")
    assert refused.value.field == "landmarks"


@pytest.mark.parametrize("function", [fit_scale, check_agreement])
def test_progress_is_reported_and_work_can_be_cancelled(function):
    cancel, reports = threading.Event(), []
    problem = observed(True)
    function(problem, progress=reports.append, backend="cpu")
    fractions = [report.fraction for report in reports]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0
    assert fractions[-1] == 1

    def stop(_):
        cancel.set()

    with pytest.raises(Cancelled):
        function(problem, progress=stop, cancel=cancel, backend="cpu")
