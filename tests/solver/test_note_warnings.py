"""Notes of a solution: warnings in scripts, the repr, and files."""

import warnings

import numpy as np
import pytest

import napari_hmrf
from napari_hmrf import (
    Grid,
    NoteWarning,
    Provenance,
    Solution,
    Study,
    Tissue,
    read_study,
    write_study,
)
from napari_hmrf.note_warnings import warning_of_notes
from napari_hmrf.solver.solve import solve
from napari_hmrf.study.ground import at_place_of


def noted(*notes):
    field = np.zeros((3, 4, 2))
    run = Provenance("cpu", "here")
    return Solution(field, np.zeros(1), (), np.ones((3, 4), bool), (1, 1), run, notes=notes)


def test_a_script_is_warned_once_of_each_note_at_its_own_line():
    made = noted("the edge is held", "label 3 has no effect")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(2):
            assert warning_of_notes(lambda: made)() is made
    assert [(str(each.message), each.filename) for each in caught] == [
        (note, __file__) for note in made.notes
    ]


def test_public_functions_warn_and_those_of_the_package_do_not(monkeypatch):
    for name in ("solve", "solve_study", "replay"):
        assert getattr(napari_hmrf, name).__wrapped__ is not None
    assert napari_hmrf.solve.__wrapped__ is solve
    with pytest.warns(NoteWarning, match="held"):
        warning_of_notes(lambda: noted("the edge is held"))()


def test_a_study_file_keeps_the_notes_and_the_unit_of_stress(tmp_path):
    study = Study(Grid((3, 4), 1.0), Tissue(stiffness=np.ones((3, 4)), unit="kPa"))
    made = at_place_of(study, noted("the edge is held"))
    assert made.stress_unit == "kPa"
    again = read_study(write_study(tmp_path / "noted", study, made)).solution
    assert again.notes == made.notes
    assert again.stress_unit == "kPa"


def test_notes_are_counted_in_the_repr_and_kept_in_files(tmp_path):
    made = noted("one", "two")
    assert repr(made).endswith(", 2 notes)")
    assert "note" not in repr(noted())
    assert Solution.read(made.write(tmp_path / "noted.npz")).notes == ("one", "two")
