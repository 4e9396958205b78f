"""Tests of earlier results: a result belongs to one study with its settings."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    Motion,
    Multigrid,
    NeoHookeanPrior,
    Pictures,
    Study,
    Tissue,
    solve_study,
)
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.study import study_results
from napari_hmrf.study.engine import Engine
from napari_hmrf.study.study_results import StudyResults
from tests.support.timeouts import LONG

SHAPE = (24, 24)


def study_with(cols=1.0, optimizer=None):
    motion = Motion(drawing=Drawing((Arrow((12, 12), (0.0, cols), 3.0),)), hold_edge=True)
    optimizer = optimizer or Multigrid()
    return Study(
        Grid(SHAPE, (1.0, 1.0)), TISSUE, motion, prior=NeoHookeanPrior(), optimizer=optimizer
    )


TISSUE = Tissue(stiffness=np.ones(SHAPE, np.float32))
STUDY = study_with()
OTHERS = {
    "drawing": study_with(2.0),
    "tissue": replace(STUDY, tissue=Tissue(stiffness=np.full(SHAPE, 2, np.float32))),
    "prior": replace(STUDY, prior=NeoHookeanPrior(0.2)),
    "tolerance": replace(STUDY, optimizer=Multigrid(1e-2)),
    "grid": replace(STUDY, grid=Grid(SHAPE, (2.0, 2.0))),
    "image": replace(STUDY, pictures=Pictures(image=np.zeros(SHAPE))),
}


@pytest.fixture(scope="module")
def solution():
    return solve_study(STUDY, backend="cpu")


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_a_result_is_found_for_its_own_study_only(solution, other):
    results = StudyResults()
    results.add(STUDY, solution)
    assert results.find(other) is None
    assert results.find(study_with()).displacement is solution.displacement


def test_a_result_is_found_for_any_budget(solution):
    results = StudyResults()
    results.add(STUDY, solution)
    assert results.find(study_with(optimizer=Multigrid(budget=300.0))) is not None


def test_a_preview_is_not_stored(solution):
    results = StudyResults()
    results.add(OTHERS["tolerance"], solution)
    assert results.find(OTHERS["tolerance"]) is None


def test_the_results_that_were_used_last_are_stored_within_a_limit(solution, monkeypatch):
    monkeypatch.setattr(study_results, "MOST_BYTES", 2.5 * solution.displacement.nbytes)
    results, studies = StudyResults(), [study_with(cols) for cols in (1.0, 2.0, 3.0)]
    for study in studies[:2]:
        results.add(study, solution)
    assert results.find(studies[0]) is not None
    results.add(studies[2], solution)
    assert [results.find(study) is not None for study in studies] == [True, False, True]


def test_a_result_from_a_file_is_delivered_to_a_study_that_replaces_a_pending_study(solution):
    ready, answers, came = threading.Event(), [], threading.Event()

    def deliver(answer):
        answers.append(answer)
        came.set()

    compute_thread.submit(ready.wait)
    engine = Engine(deliver, "a test")
    engine.submit(study_with(2.0), "cpu")  # pending: it is replaced below
    engine.deliver_again(STUDY, solution)
    engine.submit(STUDY, "cpu")
    ready.set()
    assert came.wait(LONG)
    engine.close()
    assert [answer.is_earlier for answer in answers] == [True]
    np.testing.assert_array_equal(answers[0].solution.displacement, solution.displacement)
