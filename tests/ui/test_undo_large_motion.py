"""Tests of undo and *Solve precisely* in large motion, where a result depends on earlier edits."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import Arrow, Drawing
from napari_hmrf.solver.optimizers import work
from tests.support.screen import Screen

#: Pulls of one patch, in pixels, each of which needs less work than the largest pull from rest.
PULLS = np.arange(2.5, 20.1, 2.5)


@pytest.fixture
def pulled_in_steps(open_beside, settle, monkeypatch):
    """Return a dock with a long pull, which was drawn in steps, in large motion."""
    monkeypatch.setattr(work, "_LEAST_CYCLE_SITES", {2: 0.0, 3: 0.0})
    _, dock = open_beside()
    dock.start()
    dock.settings, dock.device = replace(dock.settings, budget=12.0), "cpu"
    dock.model = "large motion"
    for pull in PULLS:
        dock.drawing = pulled_by(pull)
        settle(dock)
    assert moved_as_pulled(dock)
    return dock


def pulled_by(pull):
    return Drawing((Arrow((30, 24), (0.0, float(pull)), 5.0),))


def moved_as_pulled(dock, pull=PULLS[-1]):
    """Return whether the result has the largest motion of a pull, without a warning."""
    largest = np.linalg.norm(dock.solution.displacement, axis=-1).max()
    return largest == pytest.approx(pull, abs=0.01) and not dock.warning


def press(dock, words, settle):
    Screen(dock).press(words)
    settle(dock)


def test_undo_of_a_reset_restores_the_result(pulled_in_steps, settle):
    dock = pulled_in_steps
    before = dock.solution.displacement
    models = []
    dock.deformation_changed.connect(lambda moved: models.append(moved.study.model_name))
    dock.reset()
    settle(dock)
    assert dock.solution is None
    models.clear()
    press(dock, "Undo", settle)
    assert moved_as_pulled(dock)
    assert np.array_equal(dock.solution.displacement, before)
    assert set(models) == {"large motion"}, "the default model was solved first"


def test_a_saved_result_is_shown_when_the_study_is_opened(pulled_in_steps, settle, tmp_path):
    dock = pulled_in_steps
    path, known = dock.save_study(tmp_path / "pulled"), dock.solution.displacement
    dock._viewer.layers.clear()
    dock.open_study(path)
    settle(dock)
    assert moved_as_pulled(dock)
    np.testing.assert_array_equal(dock.solution.displacement, known)


def test_undo_and_redo_restore_the_result_of_each_step(pulled_in_steps, settle):
    dock = pulled_in_steps
    for pull in PULLS[-2:-5:-1]:
        press(dock, "Undo", settle)
        assert moved_as_pulled(dock, pull)
    dock.cancel()  # the next solve would start from rest
    for pull in PULLS[-3:]:
        press(dock, "Redo", settle)
        assert moved_as_pulled(dock, pull)


def test_a_precise_solve_that_is_too_long_keeps_the_result_and_reports_it(pulled_in_steps, settle):
    dock = pulled_in_steps
    Screen(dock).entry("More", "Solve precisely").trigger()
    settle(dock)
    assert moved_as_pulled(dock)
    assert "Kept the earlier result" in dock.status
    dock.drawing = pulled_by(PULLS[-1] + 1)
    settle(dock)
    assert dock.solution.reach.missing == 0, "the next solve started from a field that is too short"
    assert "earlier result" not in dock.status
