"""Problems without a unique solution, and difficult problems with one."""

import warnings

import numpy as np
import pytest

from benchmarks import campaign
from napari_hmrf import (
    ArgumentError,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    ProblemError,
    SeilerPrior,
    solve,
)
from validation.bodies import between_plates, dice_of
from validation.problems import random_problem


def solve_drawn(seed, number):
    drawn = random_problem(dice_of(seed, number))
    return solve(drawn.problem, drawn.prior, optimizer=Multigrid(drawn.tolerance), backend="cpu")


def test_tissue_that_bends_without_energy_is_named():
    with pytest.raises(ProblemError, match=r"5 pixels around \(1, 2\) could still bend"):
        solve_drawn(101, 137)


@pytest.mark.parametrize("prior", [ElasticPrior(), ElasticPrior(penalty=3.0), NeoHookeanPrior()])
def test_fully_observed_tissue_can_be_one_pixel_wide(prior):
    y, c = np.zeros((2, 5, 1, 2))
    y[:, 0, 0], c[...] = np.linspace(0, 0.3, 5), 1
    solution = solve(
        Problem(observed=y, confidence=c, stiffness=np.ones((5, 1))), prior, backend="cpu"
    )
    np.testing.assert_allclose(solution.displacement, y, atol=1e-6)


def test_thin_tissue_with_unobserved_sites_is_rejected():
    y, c = np.zeros((2, 5, 1, 2))
    c[0] = 1
    with pytest.raises(ProblemError, match="no tissue that is two pixels wide"):
        solve(
            Problem(observed=y, confidence=c, stiffness=np.ones((5, 1))),
            ElasticPrior(),
            backend="cpu",
        )


@pytest.mark.parametrize(
    ("kind", "penalty"),
    [(ElasticPrior, 1e-31), (ElasticPrior, 1e31), (SeilerPrior, 1e-300), (NeoHookeanPrior, 5e-324)],
)
def test_a_penalty_out_of_range_is_rejected(kind, penalty):
    with pytest.raises(ArgumentError, match="penalty must be a number from 1e-30 to 1e"):
        kind(penalty=penalty)


@pytest.mark.parametrize("penalty", [1e-30, 1e-12, 1e30])
def test_an_extreme_penalty_is_solved_without_warnings(penalty):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = solve(
            between_plates(np.ones((12, 10)), (1, 0)), ElasticPrior(penalty=penalty), backend="cpu"
        )
    expected = pytest.approx(min(1, 12.6 * penalty), rel=0.01, abs=1e-6)
    assert np.abs(solution.displacement).max() == expected


@pytest.mark.parametrize(
    "sequence",
    [
        pytest.param((2, 49), id="a slow motion that a warm start hides"),
        pytest.param((3, 119), id="an undo that leaves an earlier error"),
        pytest.param((5, 49), id="mild contrast that cycles resolve badly"),
        pytest.param((5, 295), id="slow motions that early cycles miss"),
        pytest.param((7, 1793), id="pixels twice as long as wide"),
        pytest.param((12, 635), id="nearly incompressible tissue"),
        pytest.param((9, 1177), id="much tissue attached at a few pixels"),
    ],
)
def test_live_results_agree_with_cold_solves(sequence):
    verdicts = list(campaign.judge_edits(*sequence))
    assert len(verdicts) > 3
    assert not [verdict for verdict in verdicts if verdict.is_fault]
