"""Tests of properties of tissue that are fitted to its motion."""

import threading

import numpy as np
import pytest

from napari_hmrf import Cancelled, ElasticPrior, Multigrid, Problem, ProblemError, solve
from napari_hmrf.errors import ArgumentError
from napari_hmrf.landmarks import Landmarks
from napari_hmrf.loads import growth, weight
from napari_hmrf.posterior import fit
from validation.bodies import between_plates, dice_of, noisy
from validation.oracles.elasticity import direct_solution

SIZE = 40
LABELS = np.ones((SIZE, SIZE), int)
LABELS[6:16, 6:16], LABELS[22:34, 8:18], LABELS[14:30, 24:34] = 2, 3, 4
TRUE = {1: 1.0, 2: 3.0, 3: 0.4, 4: 8.0}
NU = 0.3


def stretched(stiffness, loads=None):
    """Return tissue that is held at its first row, and moved at its last row."""
    return between_plates(stiffness, (3, 1), loads=loads)


def stiffness_of(values):
    return np.select([label == LABELS for label in values], list(values.values()))


def measured(displacement):
    """Return a displacement with noise of a twentieth of its size, and the size of the noise."""
    return noisy(displacement, 0.05, dice_of(0))


UNIFORM = stretched(np.ones((SIZE, SIZE)))
#: Motion by another program, with elements by scikit-fem.
SEEN, SD = measured(direct_solution(stretched(stiffness_of(TRUE)), ElasticPrior(NU)))


@pytest.fixture(scope="module")
def found():
    """Return the fit of the stiffness of three labels."""
    return fit(UNIFORM, LABELS, measured=SEEN, sd=SD, stiffness=[2, 3, 4], prior=ElasticPrior(NU))


def test_ratios_of_stiffness_are_found_from_the_motion_of_another_program(found):
    assert found.misfit == pytest.approx(1, abs=0.1)
    for label in (2, 3, 4):
        value = found.stiffness[label]
        assert value.value == pytest.approx(TRUE[label], rel=0.1)
        assert value.interval[0] < TRUE[label] < value.interval[1]
        assert value.sd < 0.1
    np.testing.assert_allclose(
        found.solution.displacement, SEEN, atol=5 * SD, err_msg="the solution is not the fitted one"
    )


def test_a_stiffness_is_as_certain_as_its_effect_on_the_motion_exceeds_the_noise(found):
    stiffer = np.where(LABELS == 3, 1.1, 1) * found.problem.stiffness
    moved = solve(stretched(stiffer), ElasticPrior(NU), optimizer=Multigrid(1e-4)).displacement
    effect = (moved - found.solution.displacement) / SD / np.log(1.1)
    precision = max(1, found.misfit) * np.linalg.inv(found.covariance)[1, 1]
    assert precision == pytest.approx((effect**2).sum(), rel=0.2)


def test_a_homogeneous_sample_shows_no_inclusion():
    seen, sd = measured(direct_solution(UNIFORM, ElasticPrior(NU)))
    found = fit(UNIFORM, LABELS, measured=seen, sd=sd, stiffness=[2, 3, 4], prior=ElasticPrior(NU))
    for value in found.stiffness.values():
        assert value.interval[0] < 1 < value.interval[1]
        assert value.value == pytest.approx(1, rel=0.15)


def test_growth_and_poissons_ratio_are_found_together():
    true = stretched(stiffness_of(TRUE), growth(0.2 * (LABELS == 2)))
    seen, sd = measured(solve(true, ElasticPrior(0.4)).displacement)
    guess = stretched(stiffness_of(TRUE))
    found = fit(guess, LABELS, measured=seen, sd=sd, growth=[2, 3], poisson=[1, 2, 3, 4])
    assert found.growth[2].value == pytest.approx(0.2, rel=0.05)
    assert found.growth[2].interval[0] < 0.2 < found.growth[2].interval[1]
    assert abs(found.growth[3].value) < 0.02
    assert found.poisson[1].value == pytest.approx(0.4, abs=0.03)


def test_the_size_of_the_weight_makes_the_stiffness_absolute():
    held = np.zeros((SIZE, SIZE, 2))
    held[-1] = 1
    m = np.full((SIZE, SIZE), 2.0)
    loads = weight(m, (0.02, 0), spacing=1)
    seen, sd = measured(
        solve(Problem(observed=0 * held, confidence=held, stiffness=m, loads=loads)).displacement
    )
    guess = Problem(observed=0 * held, confidence=held, stiffness=np.ones_like(m), loads=loads)
    whole = np.ones((SIZE, SIZE), int)
    found = fit(guess, whole, measured=seen, sd=sd, stiffness=[1])
    assert found.stiffness[1].value == pytest.approx(2, rel=0.02)
    found = fit(guess, whole, measured=seen, sd=sd, load=True)
    assert found.load.value == pytest.approx(0.5, rel=0.02)
    with pytest.raises(ProblemError, match="can change together"):
        fit(guess, whole, measured=seen, sd=sd, stiffness=[1], load=True)


def test_landmarks_alone_give_the_growth_of_a_tumour():
    true = stretched(np.ones((SIZE, SIZE)), growth(0.3 * (LABELS == 4)))
    field = solve(true).displacement
    points = np.array([(14, 22), (30, 22), (14, 35), (31, 36), (22, 20), (22, 37)])
    rng = np.random.default_rng(0)
    targets = points + field[tuple(points.T)] + rng.normal(0, 0.05, points.shape)
    found = fit(UNIFORM, LABELS, landmarks=Landmarks(points, targets, sd=0.05), growth=[4])
    low, high = found.growth[4].interval
    assert low < 0.3 < high < 0.4


@pytest.mark.parametrize("missing", [np.s_[10:20, 20:30], np.s_[..., 1]])
def test_missing_values_do_not_count(missing):
    seen = SEEN.copy()
    seen[missing] = np.nan
    found = fit(UNIFORM, LABELS, measured=seen, sd=SD, stiffness=[2, 3, 4], prior=ElasticPrior(NU))
    assert found.stiffness[4].interval[0] < TRUE[4] < found.stiffness[4].interval[1]


def test_intervals_are_longer_if_the_model_does_not_explain_the_motion(found):
    wrong = fit(UNIFORM, LABELS, measured=SEEN, sd=SD / 3, stiffness=[2, 3, 4])
    assert wrong.misfit > 5
    assert wrong.stiffness[2].sd > 0.8 * found.stiffness[2].sd


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"stiffness": [1, 2, 3, 4]}, "only ratios of stiffness"),
        ({"stiffness": [9]}, "label 9, which has no soft tissue"),
        ({"load": True}, "has no forces"),
        ({}, "name a label to fit"),
        ({"growth": [2], "sd": None}, "sd: is missing"),
        ({"growth": [2], "sd": -1.0}, "positive length"),
        ({"growth": [2], "measured": None}, "measured: is missing"),
        ({"growth": [2], "measured": np.zeros((3, 3, 2))}, "has shape"),
        ({"growth": [2], "measured": np.full((SIZE, SIZE, 2), np.nan)}, "no values in tissue"),
        ({"growth": [2], "measured": np.full((SIZE, SIZE, 2), np.inf)}, "is infinite"),
        ({"stiffness": [2], "sd": 100.0}, "hardly depends on the stiffness of label 2"),
    ],
)
def test_what_cannot_be_fitted_is_refused_with_the_reason(given, reason):
    with pytest.raises(ProblemError, match=reason):
        fit(UNIFORM, LABELS, **{"measured": SEEN, "sd": SD, **given})


def test_a_flag_is_not_a_number():
    with pytest.raises(ArgumentError, match="load"):
        fit(UNIFORM, LABELS, measured=SEEN, sd=SD, load=2)


@pytest.mark.parametrize("given", [{"stiffness": 2}, {"growth": "2"}, {"poisson": True}])
def test_labels_to_fit_are_a_sequence_of_whole_numbers(given):
    with pytest.raises(ArgumentError, match=f"{next(iter(given))} must be the labels to fit"):
        fit(UNIFORM, LABELS, measured=SEEN, sd=SD, **given)


def test_a_fit_reports_progress_and_can_be_cancelled():
    cancel, reports = threading.Event(), []

    def report(monitor):
        reports.append(monitor.message)
        cancel.set()

    with pytest.raises(Cancelled):
        fit(UNIFORM, LABELS, measured=SEEN, sd=SD, stiffness=[2], progress=report, cancel=cancel)
    assert reports == ["step 1 of the fit"]
