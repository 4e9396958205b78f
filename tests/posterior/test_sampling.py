"""Tests of fields sampled from the posterior of a problem."""

import threading

import numpy as np
import pytest
import scipy

from napari_hmrf import Cancelled, ElasticPrior, NeoHookeanPrior, Problem, ProblemError, solve
from napari_hmrf.errors import ArgumentError, BackendError
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import growth
from napari_hmrf.posterior import sample_posterior
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.sampling import Sampler, checked_prior
from napari_hmrf.solver.operator import Operator
from validation.oracles.elasticity import stiffness_matrix
from validation.oracles.posterior import posterior_covariance

SCALE = StrainScale(0.1)
COUNT = 50


def held_block(shape=(9, 8), spacing=None, seed=0, **more):
    """Return a block of random stiffness whose first row or plane is held."""
    rng = np.random.default_rng(seed)
    axes = len(shape)
    c = np.zeros((*shape, axes))
    c[0] = 1
    m = 100 ** rng.random(shape)
    m[(slice(2, 4),) * axes] = 0
    return Problem(
        observed=0 * c, confidence=c, stiffness=m, spacing=spacing or (1.0,) * axes, **more
    )


def with_tensors(problem, sd=0.3, share=0.2):
    rng = np.random.default_rng(1)
    axes = len(problem.shape)
    factors = rng.normal(size=(*problem.shape, axes, axes))
    tensors = (
        factors @ factors.swapaxes(-1, -2) * (rng.random(problem.shape) < share)[..., None, None]
    )
    energy = SCALE.energy(problem.stiffness, problem.spacing)
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=problem.spacing,
        precision=tensors * energy / sd**2,
    )


def with_landmarks(shape=(8, 9)):
    """Return free tissue with five landmarks."""
    rng = np.random.default_rng(2)
    none = np.zeros((*shape, len(shape)))
    points = rng.random((5, len(shape))) * (np.array(shape) - 1)
    marks = Landmarks(points, points + 0.5, sd=[0.2, 0.5, 1.0, 0.3, 0.4], scale=SCALE)
    return Problem(
        observed=none, confidence=none, stiffness=10 ** rng.random(shape), landmarks=marks
    )


def with_bone():
    problem = held_block()
    m = problem.stiffness.copy()
    m[5:7, 3:6] = np.inf
    return Problem(observed=problem.observed, confidence=problem.confidence, stiffness=m)


@pytest.mark.parametrize(
    "problem",
    [
        held_block(spacing=(1.0, 3.0)),
        held_block((5, 4, 4), (2.0, 1.0, 1.0)),
        with_tensors(held_block()),
        pytest.param(with_tensors(held_block((4, 5, 4))), marks=pytest.mark.campaign),
        with_landmarks(),
    ],
    ids=["image", "volume", "tensors", "tensors in a volume", "landmarks"],
)
def test_samples_have_the_covariance_of_the_posterior(problem):
    covariance, free = posterior_covariance(problem, ElasticPrior(), SCALE)
    mean = solve(problem, backend="cpu").displacement.ravel()
    drawn = sample_posterior(problem, n=COUNT, scale=SCALE, backend="cpu")
    deviations = np.stack([field.ravel() for field in drawn]).astype(float) - mean
    held = problem.known.ravel() | ~np.repeat(problem.tissue.ravel(), len(problem.shape))
    assert np.abs(deviations[:, held]).max(initial=0) < 1e-4, "held tissue moves"
    # Deviations in units of the posterior are independent standard normal numbers.
    root = np.linalg.cholesky(covariance)
    units = np.linalg.solve(root, deviations[:, free].T)
    squares = (units**2).sum() / units.size
    assert squares == pytest.approx(1, abs=5 * np.sqrt(2 / units.size) + 0.01)
    assert np.abs(units.mean(axis=1)).max() < 5 / np.sqrt(COUNT)


def test_the_noise_of_an_element_has_the_covariance_of_its_matrix():
    spacing, prior = (2.0, 1.0, 1.0), ElasticPrior(0.4)
    # Elements with void between them have independent noise.
    m = np.full((2, 2, 400, 3), 2.0)
    m[..., 2] = 0
    c = np.ones((2, 2, 1200, 3))
    problem = Problem(
        observed=0 * c, confidence=c, stiffness=m.reshape(2, 2, 1200), spacing=spacing
    )
    noise = PosteriorNoise(problem, prior, energy=3.0)
    draws = np.stack([noise.force(0, number) for number in range(10)]).reshape(10, 2, 2, 400, 3, 3)
    forces = np.moveaxis(draws[..., :2, :], 3, 1).reshape(4000, 24)
    one = Problem(
        observed=0 * c[:, :, :2],
        confidence=c[:, :, :2],
        stiffness=np.full((2, 2, 2), 2.0),
        spacing=spacing,
    )
    expected = 3.0 * stiffness_matrix(one, prior).toarray()
    error = np.cov(forces.T) - expected
    assert np.abs(error).max() < 0.1 * np.abs(expected).max()
    # Rigid motions do no work: noise at each point of integration would twist the element.
    assert np.abs(forces.reshape(-1, 8, 3).sum(axis=1)).max() < 1e-5 * np.abs(forces).max()


def test_random_forces_do_not_depend_on_the_number_of_threads(monkeypatch):
    problem = held_block((600, 90))
    noise, forces = PosteriorNoise(problem, ElasticPrior(), energy=1.0), []
    for threads in (1, 2, 7):
        monkeypatch.setattr("os.cpu_count", lambda threads=threads: threads)
        forces.append(noise.force(0, 1))
    np.testing.assert_array_equal(forces[0], forces[1])
    np.testing.assert_array_equal(forces[0], forces[2])
    assert (forces[0] != 0).mean() > 0.9


def test_bone_moves_as_one_body_in_each_sample():
    problem = with_bone()
    for field in sample_posterior(problem, n=3, backend="cpu"):
        moved = field[problem.rigid].astype(float)
        places = np.argwhere(problem.rigid).astype(float)
        design = np.c_[places - places.mean(axis=0), np.ones(len(places))]
        fit, *_ = np.linalg.lstsq(design, moved, rcond=None)
        assert np.abs(design @ fit - moved).max() < 1e-3
        strain = (fit[:2] + fit[:2].T) / 2
        assert np.abs(strain).max() < 1e-3
        assert np.abs(moved).max() > 0.01


def test_a_sample_depends_on_its_seed_and_number_only():
    problem = held_block()
    few = list(sample_posterior(problem, n=2, seed=5, backend="cpu"))
    many = list(sample_posterior(problem, n=4, seed=5, backend="cpu"))
    other = next(sample_posterior(problem, n=1, seed=6, backend="cpu"))
    np.testing.assert_array_equal(few, many[:2])
    assert np.abs(other - few[0]).max() > 0.01
    assert np.abs(many[2] - many[1]).max() > 0.01


def test_empty_space_around_the_tissue_of_a_volume_changes_no_sample():
    axes, shape = 3, (7, 6, 5)
    bare, precision = held_block(shape), np.zeros((*shape, 3))
    precision[5, 4] = 40.0
    points = np.array([(5.5, 2.5, 3.0), (4.2, 4.5, 1.1)])
    poisson = np.random.default_rng(0).uniform(0.2, 0.45, shape)
    first, around = np.array((3, 0, 6)), ((3, 2), (0, 9), (6, 1))
    fields = []
    for origin, margins in ((0, ((0, 0),) * 3), (first, around)):
        vector = (*margins, (0, 0))
        scale = StrainScale(0.1, extent=2.0)
        marks = Landmarks(points + origin, points + origin + 1, sd=0.2, scale=scale)
        problem = Problem(
            observed=np.pad(bare.observed, vector),
            confidence=np.pad(bare.confidence, vector),
            stiffness=np.pad(bare.stiffness, margins),
            precision=np.pad(precision, vector),
            landmarks=marks,
        )
        prior = ElasticPrior(np.pad(poisson, margins))
        fields += sample_posterior(problem, prior, n=1, backend="cpu")
    field, padded = fields
    inside = tuple(slice(b, b + size) for b, size in zip(first, shape, strict=True))
    np.testing.assert_allclose(padded[inside], field, atol=0.02 * np.abs(field).max())
    padded[inside] = 0
    assert padded.shape[:axes] == (12, 15, 12)
    assert not padded.any()


def test_samples_of_nearly_incompressible_tissue_are_as_long_as_exact_ones():
    """With the tolerance of other tissue, their means over patches are 5 % too short."""
    size = 28
    c = np.zeros((size,) * 3 + (3,))
    c[0] = 1
    problem = Problem(observed=0 * c, confidence=c, stiffness=np.ones((size,) * 3))
    prior = checked_prior(problem, ElasticPrior(0.49))
    operator, noise = Operator(problem, prior, "cpu"), PosteriorNoise(problem, prior, 1.0)
    exact = operator.solve(noise.force(0, 1), 3e-5)
    sample = Sampler(operator, noise, 0).deviation(1)
    patch, of_exact = (scipy.ndimage.uniform_filter(each, (7, 7, 7, 1)) for each in (sample, exact))
    assert (patch * of_exact).sum() == pytest.approx((of_exact**2).sum(), rel=1e-3)


def test_samples_do_not_depend_on_the_unit_of_stiffness():
    problem = held_block()
    pascal = Problem(
        observed=problem.observed, confidence=problem.confidence, stiffness=1000 * problem.stiffness
    )
    (one,) = sample_posterior(problem, n=1, backend="cpu")
    (other,) = sample_posterior(pascal, n=1, backend="cpu")
    np.testing.assert_allclose(one, other, atol=1e-3 * np.abs(one).max())


def test_deviations_are_proportional_to_the_typical_strain():
    (one,) = sample_posterior(held_block(), n=1, scale=StrainScale(0.001), backend="cpu")
    (other,) = sample_posterior(held_block(), n=1, scale=StrainScale(1.0), backend="cpu")
    np.testing.assert_allclose(1000 * one, other, atol=0.02 * np.abs(other).max())


def test_growth_moves_the_mean_and_not_the_deviations():
    bare = held_block()
    loads = growth(0.1 * bare.tissue)
    grown = Problem(
        observed=bare.observed, confidence=bare.confidence, stiffness=bare.stiffness, loads=loads
    )
    (still,) = sample_posterior(bare, n=1, backend="cpu")
    (moved,) = sample_posterior(grown, n=1, backend="cpu")
    field = solve(grown, backend="cpu").displacement
    np.testing.assert_allclose(moved - field, still, atol=1e-3)


def doubted():
    problem = held_block()
    return Problem(
        observed=problem.observed, confidence=0.5 * problem.confidence, stiffness=problem.stiffness
    )


def drifting():
    problem = with_landmarks()
    marks = problem.landmarks
    drift = Landmarks(marks.points, marks.targets, sd=marks.sd, drift=True)
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        landmarks=drift,
    )


@pytest.mark.parametrize(
    ("problem", "prior", "named", "reason"),
    [
        (held_block(), NeoHookeanPrior(), "prior", "NeoHookeanPrior"),
        (held_block(), ElasticPrior(penalty=1.0), "confidence", "may slip"),
        (doubted(), None, "confidence", "Pass a precision or landmarks"),
        (drifting(), None, "landmarks", "without a drift"),
        (with_tensors(held_block()), None, "scale", "StrainScale"),
    ],
)
def test_a_posterior_that_is_not_normal_or_not_defined_is_refused(problem, prior, named, reason):
    with pytest.raises(ProblemError, match=reason) as refused:
        sample_posterior(problem, prior, n=1)
    assert refused.value.field == named


def test_loose_tissue_is_refused():
    shape = (6, 6)
    c = np.zeros((*shape, 2))
    c[0, 0] = 1
    with pytest.raises(ProblemError, match="free"):
        sample_posterior(Problem(observed=0 * c, confidence=c, stiffness=np.ones(shape)), n=1)


def test_landmarks_with_another_scale_are_refused():
    with pytest.raises(ProblemError, match="differs from the scale of the landmarks"):
        sample_posterior(with_landmarks(), n=1, scale=StrainScale(0.2))


@pytest.mark.parametrize("given", [{"n": 0}, {"n": 2.5}, {"seed": -1}, {"scale": 0.1}])
def test_invalid_arguments_are_named(given):
    with pytest.raises(ArgumentError, match=next(iter(given))):
        sample_posterior(held_block(), **given)


def test_samples_report_their_progress_and_can_be_cancelled():
    cancel, reports = threading.Event(), []
    drawn = sample_posterior(held_block(), n=4, progress=reports.append, cancel=cancel)
    next(drawn)
    next(drawn)
    assert [report.fraction for report in reports] == [0, 0.25]
    cancel.set()
    with pytest.raises(Cancelled):
        next(drawn)


def test_shaders_do_not_sample_volumes_because_they_have_no_forces():
    with pytest.raises(BackendError, match="volumes with loads"):
        next(sample_posterior(held_block((5, 4, 4)), n=1, backend="opengl"))
