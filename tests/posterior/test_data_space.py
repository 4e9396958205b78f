"""Tests of the covariance of observations under the prior."""

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Problem, ProblemError
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.posterior import check_agreement
from napari_hmrf.posterior.data_space import data_space
from napari_hmrf.posterior.sampling import checked_prior, energy_of
from validation.oracles.posterior import data_covariance, interpolation

SCALE = StrainScale(0.1)


def test_landmarks_in_much_softer_tissue_have_the_dense_covariance():
    shape = (16, 16)
    m = np.ones(shape)
    m[6:12, 6:12] = 1e-5
    c = np.zeros((*shape, 2))
    c[0] = 1
    points = np.array([(2.0, 3.0), (14.0, 3.5), (9.0, 9.0), (8.2, 9.5), (0.0, 5.0)])
    marks = Landmarks(points, points, sd=0.2, scale=SCALE)
    problem = Problem(observed=0 * c, confidence=c, stiffness=m, landmarks=marks)
    energy = energy_of(problem, None)
    space = data_space(problem, checked_prior(problem, None), energy, "cpu", None, None)
    found = space.basis @ np.diag(energy * space.variance) @ space.basis.T
    rows = interpolation(points, shape).toarray()
    _, expected = data_covariance(problem, ElasticPrior(), SCALE, rows)
    sd = np.sqrt(np.maximum(np.diag(expected), 1e-12))
    assert sd[4:8].min() > 20 * sd[:4].max()
    np.testing.assert_allclose(found[:8, :8], expected[:8, :8], rtol=1e-3, atol=1e-3 * sd[0] ** 2)
    assert np.abs(found[8:]).max() < 1e-6, "a held landmark moves"


def test_too_many_observations_are_refused():
    c = np.zeros((40, 40, 2))
    c[0] = 1
    problem = Problem(
        observed=0 * c, confidence=c, stiffness=np.ones((40, 40)), precision=np.ones((40, 40))
    )
    with pytest.raises(ProblemError, match="3,200 components") as refused:
        check_agreement(problem, scale=SCALE, backend="cpu")
    assert refused.value.field == "precision"
