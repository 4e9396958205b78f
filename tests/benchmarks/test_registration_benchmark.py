"""Tests of the benchmark of registration: its truths, and the conventions of other programs."""

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.registration import interval, run
from benchmarks.registration_rivals import rivals
from benchmarks.registration_truths import TRUTHS, case, phantom_head
from napari_hmrf.fields import count_folds


@pytest.fixture(scope="module")
def head():
    return phantom_head(24)


@pytest.mark.parametrize("truth", TRUTHS)
def test_each_truth_moves_the_brain_without_folds_and_is_reproducible(head, truth):
    first, again = case(head, truth, 3), case(head, truth, 3)
    np.testing.assert_array_equal(first.displacement, again.displacement)
    np.testing.assert_array_equal(first.moving, again.moving)
    assert np.linalg.norm(first.displacement, axis=-1)[head.brain].mean() > 0.5
    assert count_folds(first.displacement, spacing=head.spacing) == 0
    assert np.abs(case(head, truth, 4).displacement - first.displacement).max() > 1


SHIFT = np.array([2.0, -3.0, 4.0])


def test_demons_returns_a_displacement_in_the_order_of_the_axes():
    pytest.importorskip("SimpleITK")
    program = rivals(gaps=(20.0, 40.0), sigmas=(1.0, 1.5))["demons-1.5"]
    spacing = (1.0, 1.5, 2.0)
    noise = np.random.default_rng(0).normal(size=(40, 44, 48))
    fixed = ndimage.gaussian_filter(noise, 3)
    moving = ndimage.shift(fixed, SHIFT / spacing, order=1, mode="nearest")
    found = program.register(fixed, moving, spacing)[12:-12, 12:-12, 12:-12]
    assert np.abs(np.median(found, axis=(0, 1, 2)) - SHIFT).max() < 0.7


def test_a_run_continues_from_its_results(head, tmp_path, monkeypatch):
    results = tmp_path / "results.jsonl"
    first = run(head, ["splines"], [0], ["ours"], results)
    monkeypatch.setattr("benchmarks.registration.case", None)
    assert run(head, ["splines"], [0], ["ours"], results) == first
    unmoved, ours = first
    assert ours["mean"] < unmoved["mean"]


def test_an_interval_contains_the_mean_and_shrinks_with_the_number_of_values():
    values = np.random.default_rng(1).normal(size=400)
    few, many = interval(values[:20]), interval(values)
    assert many[0] < values.mean() < many[1]
    assert many[1] - many[0] < few[1] - few[0]
