"""Notes on the shortcomings of a result, in Python, in the shell and in the window."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    BoundaryRule,
    Drawing,
    Grid,
    Motion,
    Problem,
    Study,
    Tissue,
    solve_study,
)
from napari_hmrf.cases import Case
from napari_hmrf.io.case import solve_case
from napari_hmrf.io.study_file import replay, write_study
from napari_hmrf.solver.caveats import in_the_way, shortfall
from napari_hmrf.solver.optimizers.base import Reach
from napari_hmrf.study.shortcomings import shortcomings
from napari_hmrf.ui.window_words import in_window_words
from napari_hmrf.wording import in_shell_words

SHAPE = 20, 24


def pulled_far(shape=SHAPE):
    middle, by = tuple(size // 2 for size in shape), (*(0,) * (len(shape) - 1), 8)
    pull = Drawing((Arrow(middle, by, 2),))
    tissue = Tissue(stiffness=np.ones(shape))
    return Study(Grid(shape, 1, "mm"), tissue, Motion(hold_edge=True, drawing=pull))


def notes_with(notes, words):
    return [note for note in notes if words in note]


def test_a_note_counts_the_folded_pixels(tmp_path):
    solution = solve_study(pulled_far(), backend="cpu")
    folds = solution.count_folds()
    assert folds > 0
    (said,) = notes_with(solution.notes, "folds over itself")
    assert f"at {folds} pixels" in said
    path = write_study(tmp_path / "far.study", pulled_far())
    assert said in replay(path).notes
    solved = solve_case(Case(image=path), tmp_path / "out", backend="cpu")
    assert notes_with(solved.notes, "folds over itself") == [said]


@pytest.mark.parametrize(
    ("shape", "folds", "words"),
    [(SHAPE, 1, "1 pixel,"), ((4, 5, 6), 1, "1 voxel,"), (SHAPE, 2, "2 pixels,")],
)
def test_one_folded_pixel_is_not_several(shape, folds, words):
    solution = SimpleNamespace(tissue=np.ones(shape), reach=None)
    assert f"at {words}" in next(shortcomings(solution, "mm", folds))


def test_a_pull_that_touches_held_tissue_is_named_as_the_cause():
    study = pulled_far()
    drawing = study.motion.drawing.with_mark(Arrow((10, 17), (0, 0), 2))
    motion = replace(study.motion, drawing=drawing)
    study = Study(study.grid, study.tissue, motion, "large motion")
    solution = solve_study(study, backend="cpu")
    (cause,) = notes_with(solution.notes, "touches")
    assert "release one of the two" in cause
    (short,) = notes_with(solution.notes, "short of their targets")
    assert solution.notes.index(cause) < solution.notes.index(short)
    assert not notes_with(solve_study(pulled_far(), backend="cpu").notes, "touches")


def test_a_note_names_what_is_in_the_way_of_a_pull():
    study = pulled_far()
    far = Arrow((10, 12), (0, 11), 2)
    hold = Arrow((10, 19), (0, 0), 1)
    for marks, words in [
        ((far,), "the outer edge, which is held, is in the way at (8, 23)"),
        ((far, hold), "held tissue is in the way at (10, 18)"),
        ((Arrow((10, 20), (0, 11), 3),), "beside the outer edge, which is held"),
    ]:
        motion = replace(study.motion, drawing=Drawing(marks))
        pulled = Study(study.grid, study.tissue, motion, "large motion")
        notes = solve_study(pulled, backend="cpu").notes
        assert len(notes_with(notes, words)) == 1, notes
        assert notes_with(notes, "could not move all the way")


def test_a_note_names_measured_motion_that_holds_the_tissue():
    y, c = np.zeros((2, 8, 8, 2))
    y[3, 3], c[3, 3] = (0, 2), 1
    reach = Reach(0.5, part=0.5, missing=1.0, where=(3, 3), sites=1)
    tissue, precision = np.ones((8, 8)), np.broadcast_to(np.eye(2), (8, 8, 2, 2))
    known = {"observed": y, "confidence": c, "stiffness": tissue}
    assert in_the_way(Problem(**known), reach) == ""
    measured = Problem(**known, precision=precision)
    assert "such as that of a registration" in in_the_way(measured, reach)


def test_folds_of_a_volume_are_counted_only_on_request(tmp_path):
    volume = pulled_far((10, 12, 14))
    solution = solve_study(volume, backend="cpu")
    assert solution.count_folds() > 0
    assert not notes_with(solution.notes, "fold")
    path = write_study(tmp_path / "far.study", volume)
    solved = solve_case(Case(image=path), tmp_path / "out", backend="cpu")
    assert len(notes_with(solved.notes, f"at {solved.folds} voxels")) == 1


def test_a_note_states_how_far_large_motion_falls_short():
    ring = np.zeros(SHAPE, int)
    ring[6:14, 7:17], ring[7:13, 8:16] = 1, 0
    motion = Motion(True, ring, (BoundaryRule(1, "expand", amount=9.0),))
    study = Study(Grid(SHAPE, 1, "mm"), Tissue(stiffness=np.ones(SHAPE)), motion, "large motion")
    solution = solve_study(study, backend="cpu")
    assert solution.reach.part < 1
    (said,) = notes_with(solution.notes, "could not move all the way")
    assert f"{solution.reach.missing:.3g} mm" in said


def test_a_solve_that_stopped_says_how_to_go_on_in_the_terms_of_the_interface():
    stopped = Reach(0.5, part=0.4, missing=3.0, where=(5, 6), sites=9, stopped=True)
    said = shortfall(stopped, "mm")
    assert said.startswith("the solve stopped before the tissue was fully there: 9 pixels stay")
    assert said.endswith("allow more work (`budget`)")
    assert in_shell_words(said, {"budget"}).endswith("allow more work (--budget)")
    assert in_window_words(said).endswith("allow more work (press 'Continue')")
    assert "more work" not in shortfall(replace(stopped, stopped=False), "mm")
