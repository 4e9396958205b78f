"""Smoothing spline of landmarks inside tissue."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from napari_hmrf.errors import ProblemError
from napari_hmrf.landmarks import Landmarks, fit_spline, spline

FULL = np.ones((40, 50), bool)


def _points(count, tissue, seed=0):
    """Return positions between pixels of tissue, at least a pixel away from void."""
    rng = np.random.default_rng(seed)
    points = 1 + rng.random((50 * count, tissue.ndim)) * (np.array(tissue.shape) - 3)
    near = np.floor(points).astype(int)
    return points[tissue[tuple(near.T)] & tissue[tuple(near.T + 1)]][:count]


def _places(tissue):
    return np.argwhere(tissue).astype(float)


@pytest.mark.parametrize("shape", [(30, 41), (14, 16, 18)])
def test_an_affine_motion_is_reproduced_exactly(shape):
    axes, spacing = len(shape), (2.0, 1.0, 0.7)[: len(shape)]
    tissue = ((np.moveaxis(np.indices(shape), 0, -1) - 6) ** 2).sum(axis=-1) > 9
    rate = np.random.default_rng(1).normal(size=(axes, axes)) / 10
    points = _points(30, tissue)
    marks = Landmarks(points, points + (points @ rate + 2) / spacing, sd=0.1)
    field = spline(marks, tissue, spacing=spacing)
    np.testing.assert_allclose(field[tissue], _places(tissue) @ rate + 2, atol=1e-4)
    assert not field[~tissue].any()


def test_a_bending_motion_is_reproduced_between_landmarks():
    def motion(x):
        away = (x - 20) / 20
        return np.stack([3 * away[:, 0] * away[:, 1], 2 * away[:, 1] ** 2], axis=1)

    points = _points(50, FULL)
    field = spline(Landmarks(points, points + motion(points), sd=0.1), FULL, spacing=1)
    errors = np.linalg.norm(field[FULL] - motion(_places(FULL)), axis=1)
    assert errors.mean() < 0.02


@pytest.mark.parametrize("width", [1, 5])
def test_tissue_on_two_sides_of_a_slit_moves_independently(width):
    tissue = np.ones((120, 120), bool)
    tissue[30:, 61 : 61 + width] = False
    points = _points(150, tissue)
    depth = np.clip(points[:, 0] - 30, 0, None) / 90
    opening = np.where(points[:, 1] < 61, -4, 4) * np.sqrt(depth)
    marks = Landmarks(points, points + np.stack([0 * opening, opening], axis=1), sd=0.1)
    field = spline(marks, tissue, spacing=1)
    gap = field[60:, 61 + width, 1] - field[60:, 60, 1]
    assert np.abs(gap - 8 * np.sqrt((np.arange(60, 120) - 30) / 90)).max() < 1
    assert np.abs(np.diff(field[:20, 55:70, 1], axis=1)).max() < 0.5, "there is no slit here"


def test_noise_is_smoothed_more_where_the_standard_deviation_is_larger():
    rng = np.random.default_rng(2)
    points = _points(100, FULL)
    motion = np.stack([np.sin(points[:, 1] / 10), np.cos(points[:, 0] / 10)], axis=1)
    sd = np.where(rng.random((100, 2)) < 0.5, 0.1, 1.0)
    targets = points + motion + sd * rng.normal(size=(100, 2))
    places = _places(FULL)
    truth = np.stack([np.sin(places[:, 1] / 10), np.cos(places[:, 0] / 10)], axis=1)

    def error(sd):
        field = spline(Landmarks(points, targets, sd=sd), FULL, spacing=1)
        return np.sqrt(((field[FULL] - truth) ** 2).mean())

    even, found = error(0.5), error(sd)
    assert even < 0.5 * np.sqrt((sd**2).mean())
    assert found < 0.6 * even
    assert error(10 * sd) == pytest.approx(found), "only ratios have an effect"


def test_the_unit_of_length_has_no_effect_and_long_pixels_keep_the_field():
    rng = np.random.default_rng(3)
    points = _points(60, FULL)
    shift = rng.normal(size=points.shape)
    spacing = np.array([3.0, 1.0])
    coarse = np.ones((14, 50), bool)
    marks = Landmarks(points, points + shift, sd=0.3)
    field = spline(marks, FULL, spacing=1)
    scaled = spline(Landmarks(points, points + shift, sd=300), FULL, spacing=1000)
    np.testing.assert_allclose(scaled, 1000 * field, rtol=1e-3, atol=1)
    # Rows 0, 3, ... of the same tissue
    oblong = Landmarks(points / spacing, (points + shift) / spacing, sd=0.3)
    rows = spline(oblong, coarse, spacing=spacing)[:13]
    assert np.abs(rows - field[:39:3]).mean() < 0.15


@pytest.mark.parametrize("count", [50, 200])
def test_the_error_is_within_a_tenth_of_a_thin_plate_spline_with_the_best_smoothing(count):
    def motion(x):
        phase = x @ np.random.default_rng(4).normal(size=(2, 30)) / 20
        waves = np.random.default_rng(5).normal(size=(2, 30, 2))
        return np.cos(phase) @ waves[0] + np.sin(phase) @ waves[1]

    tissue = ((np.moveaxis(np.indices((80, 80)), 0, -1) - 40) ** 2).sum(axis=-1) < 38**2
    points, places = _points(count, tissue), _places(tissue)
    shifts = motion(points) + np.random.default_rng(6).normal(size=points.shape) / 2
    field = spline(Landmarks(points, points + shifts, sd=0.5), tissue, spacing=1)

    def error(found):
        return np.linalg.norm(found - motion(places), axis=1).mean()

    rival = min(
        error(RBFInterpolator(points / 40, shifts, smoothing=smoothing)(places / 40))
        for smoothing in np.logspace(-4, 1, 6)
    )
    assert error(field[tissue]) < 1.1 * rival


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (_points(3, FULL), "landmarks: are only 3.*at least 4"),
        (np.linspace((1, 2), (30, 40), 6), "landmarks: all lie on a line.*Add"),
        (np.concatenate([_points(9, FULL), [(39.5, 4)]]), "outside the image.* number 9"),
        (np.ones((6, 3)), "have 3 coordinates, but tissue has 2 axes"),
    ],
)
def test_landmarks_that_do_not_determine_a_motion_are_refused(points, message):
    with pytest.raises(ProblemError, match=message):
        spline(Landmarks(points, points, sd=1), FULL, spacing=1)


def test_void_and_impossible_tissue_are_refused():
    points = _points(9, FULL)
    marks = Landmarks(points, points, sd=1)
    beside = FULL.copy()
    beside[:, int(points[4, 1]) : int(points[4, 1]) + 2] = False
    with pytest.raises(ProblemError, match=r"points outside the tissue.*Move or remove"):
        spline(marks, beside, spacing=1)
    with pytest.raises(ProblemError, match="tissue: has no pixels above 0"):
        spline(marks, 0 * FULL, spacing=1)
    with pytest.raises(ProblemError, match="tissue: has shape"):
        spline(marks, FULL[0], spacing=1)
    with pytest.raises(ProblemError, match="spacing: is"):
        spline(marks, FULL, spacing=(1, 0))
    with pytest.raises(ProblemError, match="landmarks: are of type list"):
        spline([points], FULL, spacing=1)


def _random_motion(rng):
    """Return a smooth random motion of pixels, with a standard deviation of 3 pixels."""
    frequency = rng.normal(size=(200, 2)) / 12
    phase, size = rng.uniform(0, 2 * np.pi, (2, 200)), rng.normal(size=(2, 200)) * 0.3

    def motion(x):
        waves = [np.cos(x @ frequency.T + phase[axis]) @ size[axis] for axis in range(2)]
        return np.stack(waves, axis=1)

    return motion


def test_the_standard_deviation_covers_the_errors_at_its_rate():
    ratios = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        motion, points = _random_motion(rng), _points(60, FULL, seed)
        shifts = motion(points) + 0.2 * rng.normal(size=points.shape)
        fit = fit_spline(Landmarks(points, points + shifts, sd=1), FULL, spacing=1)
        assert 0.1 < fit.noise.mean() < 0.4, "the noise is estimated"
        places = _places(FULL)
        ratios.append(np.abs(fit.displacement[FULL] - motion(places)) / fit.sd[FULL])
    assert 0.55 < np.mean(np.array(ratios) < 1) < 0.85
    assert 0.87 < np.mean(np.array(ratios) < 1.96) < 0.995


def test_the_standard_deviation_has_the_unit_of_the_motion_and_grows_away_from_landmarks():
    rng = np.random.default_rng(0)
    points = _points(40, FULL[:, :25])
    shifts = _random_motion(rng)(points) + 0.2 * rng.normal(size=points.shape)
    fit, twice = (
        fit_spline(Landmarks(points, points + scale * shifts, sd=1), FULL, spacing=1)
        for scale in (1, 2)
    )
    np.testing.assert_allclose(twice.sd, 2 * fit.sd, rtol=1e-4)
    np.testing.assert_allclose(twice.noise, 2 * fit.noise, rtol=1e-4)
    assert fit.sd[:, 48].min() > 2 * fit.sd[:, :24].max()


def test_a_piece_of_tissue_without_landmarks_is_uncertain():
    tissue = FULL.copy()
    tissue[:, 24:26] = False
    points = _points(40, np.where(np.arange(50) < 24, tissue, False))
    shifts = _random_motion(np.random.default_rng(1))(points)
    fit = fit_spline(Landmarks(points, points + shifts, sd=1), tissue, spacing=1)
    assert fit.sd[:, 27].min() > fit.sd[:, :24].max()
    assert not fit.sd[~tissue].any()


def test_the_standard_deviation_is_that_of_universal_kriging():
    tissue, rng = np.ones((8, 8), bool), np.random.default_rng(2)
    points = _points(12, tissue)
    marks = Landmarks(points, points + rng.normal(size=points.shape), sd=1)
    fit = fit_spline(marks, tissue, spacing=1)._fit
    count = len(fit.affine)
    covariance = fit.factors.solve(np.eye(count))
    # A wide prior of the affine motion, and the posterior by the inverse of all precisions.
    wide = covariance + 1e6 * fit.affine @ fit.affine.T
    seen = fit.interpolate.toarray()
    noisy = seen @ wide @ seen.T + fit.damping * np.eye(len(points))
    after = wide - wide @ seen.T @ np.linalg.solve(noisy, seen @ wide)
    expected = np.sqrt(fit.scale * np.diag(after))
    np.testing.assert_allclose(fit.sd()[:, 0], expected, rtol=0.02)


@pytest.mark.parametrize("count", [4, 6, 30])
def test_exact_landmarks_and_few_landmarks_are_met(count):
    points = _points(count, FULL)
    shifts = _random_motion(np.random.default_rng(3))(points)
    fit = fit_spline(Landmarks(points, points + shifts, sd=1e-4), FULL, spacing=1)
    assert np.isfinite(fit.displacement).all()
    assert np.isfinite(fit.sd).all()
    if count == 30:
        near = np.rint(points).astype(int)
        assert np.abs(fit.displacement[tuple(near.T)] - shifts).max() < 1
