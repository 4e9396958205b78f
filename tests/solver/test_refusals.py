"""Refusals of problems without one answer, and answers to those that have one after all."""

import warnings

import live_edits
import numpy as np
import pytest
import trust
from exact.rank import free_motions
from random_problems import random_problem

from napari_hmrf import (
    ArgumentError,
    ConvergenceError,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    ProblemError,
    SeilerPrior,
    solve,
)


def answer(seed, number):
    drawn = random_problem(seed, number)
    return solve(drawn.problem, drawn.prior, optimizer=Multigrid(drawn.tolerance), backend="cpu")


def test_tissue_that_bends_at_no_cost_is_named():
    with pytest.raises(ProblemError, match=r"5 pixels around \(1, 2\) could still bend"):
        answer(101, 137)


def test_tissue_that_double_precision_cannot_tell_is_named_with_its_cost():
    with pytest.raises(ConvergenceError, match=r"around \(22, 0\) .* is 4e-14 of"):
        answer(101, 1109)


@pytest.mark.parametrize(("number", "motions"), [(137, 1), (49, 3), (1109, 0), (1211, 0)])
def test_motions_at_no_cost_are_counted_exactly(number, motions):
    assert free_motions(random_problem(101, number).problem) == motions


@pytest.mark.parametrize(
    ("number", "outcome"), [(137, "refused, free"), (1211, "refused, sensitive")]
)
def test_a_refusal_is_judged_by_its_reason(number, outcome):
    assert trust.judge(random_problem(101, number), "cpu").outcome == outcome


@pytest.mark.parametrize("prior", [ElasticPrior(), ElasticPrior(penalty=3.0), NeoHookeanPrior()])
def test_where_all_is_observed_nothing_needs_to_be_two_pixels_wide(prior):
    y, c = np.zeros((2, 5, 1, 2))
    y[:, 0, 0], c[...] = np.linspace(0, 0.3, 5), 1
    solution = solve(Problem(y, c, np.ones((5, 1))), prior, backend="cpu")
    np.testing.assert_allclose(solution.displacement, y, atol=1e-6)


def test_thin_tissue_that_is_not_all_observed_is_refused():
    y, c = np.zeros((2, 5, 1, 2))
    c[0] = 1
    with pytest.raises(ProblemError, match="no tissue that is two pixels wide"):
        solve(Problem(y, c, np.ones((5, 1))), ElasticPrior(), backend="cpu")


def pushed():
    c = np.zeros((12, 10, 2))
    c[0] = c[-1] = 1
    y = np.zeros_like(c)
    y[-1, :, 0] = 1
    return Problem(y, c, np.ones((12, 10)))


@pytest.mark.parametrize("kind", [ElasticPrior, SeilerPrior, NeoHookeanPrior])
@pytest.mark.parametrize("penalty", [1e-300, 5e-324, 1e-31, 1e31])
def test_a_penalty_beyond_double_precision_is_refused(kind, penalty):
    with pytest.raises(ArgumentError, match="penalty must be a number from 1e-30 to 1e"):
        kind(penalty=penalty)


@pytest.mark.parametrize("penalty", [1e-30, 1e-12, 1e30])
def test_an_extreme_penalty_is_answered(penalty):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = solve(pushed(), ElasticPrior(penalty=penalty), backend="cpu")
    assert np.abs(solution.displacement).max() == pytest.approx(min(1, 12.6 * penalty), rel=0.01)


@pytest.mark.parametrize(
    "sequence",
    [
        pytest.param((2, 49), id="a slow motion that a warm start hides"),
        pytest.param((3, 119), id="an undo that leaves an earlier error"),
        pytest.param((5, 49), id="mild tissue that cycles see badly"),
        pytest.param((5, 295), id="slow motions that early cycles do not tell"),
        pytest.param((7, 1793), id="pixels twice as long as wide"),
        pytest.param((12, 635), id="tissue that is hard to compress"),
        pytest.param((9, 1177), id="much tissue that hangs at a few pixels"),
    ],
)
def test_live_answers_agree_with_cold_ones(sequence):
    answers = live_edits.judge(*sequence)
    assert len(answers) > 3
    assert not [answer for answer in answers if answer.is_violation]
