"""Tests of maps of stiffness from measured motion."""

import numpy as np
import pytest
from scipy import ndimage

from napari_hmrf import ElasticPrior, ProblemError, solve
from napari_hmrf.loads import growth
from napari_hmrf.posterior import stiffness_map
from validation.bodies import between_plates, dice_of, noisy
from validation.oracles.elasticity import direct_solution

SIZE = 32
ROWS, COLS = np.indices((SIZE, SIZE))
INCLUSIONS = (np.hypot(ROWS - 10, COLS - 9) < 5) | (np.hypot(ROWS - 21, COLS - 22) < 4.5)


def squeezed(stiffness, loads=None):
    """Return tissue that is squeezed between its first and its last row or plane."""
    return between_plates(stiffness, (-2, 0, 0)[: stiffness.ndim], loads=loads)


def rim(mask):
    return mask & ~ndimage.binary_erosion(mask)


def test_two_inclusions_are_found_with_their_contrast_and_outline():
    true = squeezed(np.where(INCLUSIONS, 3.0, 1.0))
    seen, sd = noisy(direct_solution(true, ElasticPrior(0.3)), 0.02, dice_of(0))
    found = stiffness_map(squeezed(np.ones((SIZE, SIZE))), seen, sd=sd, prior=ElasticPrior(0.3))
    assert found.misfit == pytest.approx(1, abs=0.05)
    ratios = found.stiffness / np.median(found.stiffness[~INCLUSIONS])
    assert np.median(ratios[INCLUSIONS]) == pytest.approx(3, rel=0.25)
    outline = rim(ratios > np.sqrt(3))
    assert ndimage.label(ratios > np.sqrt(3))[1] == 2
    assert ndimage.distance_transform_edt(~rim(INCLUSIONS))[outline].max() <= 2
    assert ndimage.distance_transform_edt(~outline)[rim(INCLUSIONS)].max() <= 2


def test_the_map_of_a_homogeneous_sample_is_uniform():
    uniform = squeezed(np.full((SIZE, SIZE), 5.0))
    seen, sd = noisy(direct_solution(uniform, ElasticPrior(0.3)), 0.05, dice_of(0))
    found = stiffness_map(uniform, seen, sd=sd, prior=ElasticPrior(0.3))
    assert np.ptp(np.log(found.stiffness)) < 0.05
    assert np.median(found.stiffness) == pytest.approx(5, rel=0.05)


def test_an_inclusion_in_a_volume_is_found_beside_void():
    shape = (5, 6, 6)
    away = np.linalg.norm(np.indices(shape).T - (2, 2, 2), axis=-1).T
    m = np.where(away < 1.8, 4.0, 1.0)
    m[:, 4:, 4:] = 0
    seen, sd = noisy(solve(squeezed(m)).displacement, 0.01, dice_of(0))
    found = stiffness_map(squeezed((m > 0).astype(float)), seen, sd=sd)
    assert not found.stiffness[m == 0].any()
    inside = np.median(found.stiffness[away < 1.5])
    assert inside > 1.7 * np.median(found.stiffness[(away > 2.5) & (m > 0)])


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"loads": growth(np.full((SIZE, SIZE), 0.1))}, r"Use fit\(\) for tissue that grows"),
        ({"stiffness": np.where(INCLUSIONS, np.inf, 1.0)}, "a finite stiffness"),
    ],
)
def test_tissue_that_grows_or_is_rigid_is_refused(more, reason):
    problem = squeezed(**{"stiffness": np.ones((SIZE, SIZE)), **more})
    with pytest.raises(ProblemError, match=reason):
        stiffness_map(problem, np.zeros((SIZE, SIZE, 2)), sd=1.0)
