"""Error bars of a registration, whose scale held-out images determine."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import Grid, Problem, ProblemError, Study, warp
from napari_hmrf.landmarks import StrainScale
from napari_hmrf.posterior import image_uncertainty, study_uncertainty, uncertainty
from napari_hmrf.registration import register
from napari_hmrf.study.measured_motion import MeasuredMotion


def smooth(rng, shape, width):
    values = ndimage.gaussian_filter(rng.normal(size=shape), width)
    return values / values.std()


def moved_pair(rng, shape, size, width):
    """Return an image with texture, the moved image with noise, and the displacement."""
    fixed = smooth(rng, shape, 1.5).astype(np.float32)
    motion = np.stack([size * smooth(rng, shape, width) for _ in shape], axis=-1)
    moving = warp(fixed, motion, spacing=1) + rng.normal(scale=0.1, size=shape)
    return fixed, moving.astype(np.float32), motion


@pytest.mark.parametrize("width", [12, 20])
def test_error_bars_follow_the_errors_of_smooth_and_of_rough_motions(width):
    """Errors and their bars differ by less than a factor of 2, whatever the motion."""
    fixed, moving, motion = moved_pair(np.random.default_rng(width), (120, 140), 2.0, width)
    found = register(fixed, moving, spacing=1, compare_all=True)
    bars = image_uncertainty(found.problem, found.prior)
    away = ndimage.uniform_filter(found.displacement - motion, (7, 7, 0))
    units = np.abs(away / bars.sd)
    assert 0.5 < np.quantile(units, 0.68) < 1.5
    assert (units < 1.96).mean() > 0.85


def test_where_the_images_show_nothing_the_displacement_is_less_sure():
    fixed, moving, _ = moved_pair(np.random.default_rng(1), (90, 120), 1.5, 15)
    fixed[30:60, 40:80] = np.nan
    found = register(fixed, moving, spacing=1, compare_all=True)
    bars = image_uncertainty(found.problem, found.prior)
    assert bars.along[45, 60] > 2 * np.median(bars.along[:20])


def test_the_unit_of_stiffness_and_of_length_has_no_effect_on_relative_errors():
    fixed, moving, _ = moved_pair(np.random.default_rng(2), (64, 64), 1.5, 12)
    one = register(fixed, moving, spacing=1, compare_all=True)
    stiff = np.full(fixed.shape, 40.0)
    other = register(fixed, moving, spacing=0.5, stiffness=stiff, compare_all=True)
    bars = [image_uncertainty(found.problem, found.prior, 6).along for found in (one, other)]
    np.testing.assert_allclose(2 * bars[1], bars[0], rtol=0.02)


def test_a_registered_study_has_error_bars_unlike_other_measured_motion():
    fixed, moving, _ = moved_pair(np.random.default_rng(3), (64, 64), 1.5, 12)
    found = register(fixed, moving, spacing=1, compare_all=True)
    study = Study(Grid(fixed.shape, (1, 1)), motion=found.motion(), prior=found.prior)
    whole = study_uncertainty(study, 6)
    np.testing.assert_allclose(
        whole.along, image_uncertainty(found.problem, found.prior, 6).along, rtol=0.05
    )
    assert set(whole.labels) == {1}
    unknown = MeasuredMotion(found.observed, found.precision)
    other = replace(study, motion=replace(study.motion, measured=unknown))
    with pytest.raises(ProblemError, match="not that of a registration"):
        study_uncertainty(other, 6)


def test_images_too_small_for_a_held_out_ball_and_problems_without_images_are_refused():
    none, precision = np.zeros((10, 10, 2)), np.zeros((10, 10))
    precision[0, :2] = 1
    problem = Problem(
        observed=none, confidence=none, stiffness=np.ones((10, 10)), precision=precision
    )
    with pytest.raises(ProblemError, match="too little tissue"):
        image_uncertainty(problem)
    held = Problem(observed=none, confidence=none + 1, stiffness=np.ones((10, 10)))
    with pytest.raises(ProblemError, match="Pass the problem of a registration"):
        image_uncertainty(held)
    assert uncertainty(problem, n=2, scale=StrainScale()).n == 2
