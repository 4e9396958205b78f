"""Tests of batches: cases from a table, sweeps, failures, interruption and resuming."""

import csv
import os
import signal
import sys
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from filelock import FileLock

from napari_hmrf import (
    BoundaryRule,
    FileFormatError,
    Grid,
    HmrfError,
    Material,
    Motion,
    Study,
    Tissue,
    read_study,
    write_study,
)
from napari_hmrf.cases import Case, read_cases, solve_cases
from napari_hmrf.cli import main
from napari_hmrf.io import batch
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.io.sweeps import Change, changed
from tests.support.killed_worker import KILLER, solve_or_end

SHAPE = (24, 30)
MATERIALS = (Material(1, "brain", 3.0), Material(2, "Tumour", 8.0), Material(3, "skull", np.inf))
RULES = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 2.0), name="rim"))


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write a film of three images, labels, tables and a boundary; return the folder."""
    monkeypatch.chdir(tmp_path)
    labels = np.ones(SHAPE, np.uint8)
    labels[10:14, 12:18] = 2
    rim = np.zeros(SHAPE, np.uint8)
    rim[:, 0], rim[:, -1] = 1, 2
    film = np.random.default_rng(0).integers(1, 200, (3, *SHAPE), dtype=np.uint8)
    for name, pixels in {"labels.tif": labels, "rim.tif": rim, "image.tif": labels}.items():
        write_image(name, ImageFile(pixels))
    write_image("film.tif", ImageFile(film))
    (tmp_path / "m.csv").write_text("label,name,stiffness\n1,brain,3\n2,tumour,8\n")
    (tmp_path / "r.csv").write_text("label,name,action,row,col\n1,,fixed,,\n2,rim,move,0,2\n")
    return tmp_path


@pytest.fixture
def in_this_process(monkeypatch):
    """Solve cases without worker processes, for tests of the files of a batch."""
    monkeypatch.setattr(batch, "one_thread", lambda: None)

    @contextmanager
    def no_processes(solve_one, _):
        def submit(case):
            solved = Future()
            solved.set_result(solve_one(case))
            return solved

        yield submit

    monkeypatch.setattr(batch, "_processes", no_processes)


def write_table(folder, *lines, more=""):
    """Write a table of cases; each line gives a name, an image and the extra columns."""
    titles = f"name,image,labels,materials,boundary,rules{more}"
    parts = [line.split(",", 2) for line in lines]
    rows = [
        ",".join([name, image, "labels.tif", "m.csv", "rim.tif", "r.csv", *rest])
        for name, image, *rest in parts
    ]
    (folder / "cases.csv").write_text("\n".join([titles, *rows]))
    return folder / "cases.csv"


def summary(folder):
    with open(folder / "summary.csv", newline="") as file:
        return {row["case"]: row for row in csv.DictReader(file)}


def moved(folder, name):
    study, solution = read_study(folder / name / "image.study")
    assert study is not None
    return float(np.abs(solution.displacement).max())


def test_a_cell_with_several_values_makes_one_case_per_value(files):
    table = write_table(
        files,
        "film,film.tif,all,0.1;20%,",
        ",image.tif,,0.1/0,paper-converged",
        "b,film.tif,1-2,,",
        more=",slice,growth:tumour,model",
    )
    cases = read_cases(table)
    assert [case.name for case in cases] == [
        *(f"film_slice-{n}_growth-tumour-{by}" for n in range(3) for by in ("0.1", "20percent")),
        "image_growth-tumour-0.1_0_model-paper-converged",
        "b_slice-1",
        "b_slice-2",
    ]
    assert cases[3].changes == (Change("growth", 0.2, "tumour"),)
    assert cases[3].case == Case(
        files / "film.tif",
        labels=files / "labels.tif",
        materials=files / "m.csv",
        boundary=files / "rim.tif",
        rules=files / "r.csv",
        slice=1,
    )
    assert cases[6].case.model == "paper, converged"
    assert cases[6].changes == (Change("growth", (0.1, 0.0), "tumour"),)


#: Tables with an error, and the line that the message names, or 0.
INVALID = [
    ("", 0),
    ("image\n", 0),
    ("image,growth\na.tif,1\n", 0),
    ("image,lables\na.tif,b\n", 0),
    ("image,image\na.tif,b\n", 0),
    ("image\na.tif\na.png\n", 3),
    ("name,image\na/b,a.tif\n", 2),
    ("name,image\n..,a.tif\n", 2),
    ("image,labels\n,b\n", 2),
    ("image,study\na.tif,b\n", 2),
    ("image,slice\na.tif,x\n", 2),
    ("image,model\na.tif,soft\n", 2),
    ("image,poisson\na.tif,0.7\n", 2),
    ("image,growth:1\na.tif,-2\n", 2),
    ("image,amount:1\na.tif,;\n", 2),
    ("name,image\nSummary.csv,a.tif\n", 2),
    ("name,image\na b,a.tif\nA_B,b.tif\n", 3),
    ("name,image\n!,a.tif\n_,b.tif\n", 3),
    ("name,image\n=1+1,a.tif\n", 2),
    ("name,image\n~root,a.tif\n", 2),
    ("image,plane\na.tif,bulge\n", 2),
    ("image,penalty\na.tif,-1\n", 2),
    ("image,weight\na.tif,0.1\n", 2),
    ("image,hold-edge\na.tif,maybe\n", 2),
    ("image\na.tif,b\n", 2),
]


def test_an_error_in_a_table_of_cases_names_its_line(tmp_path):
    for text, line in INVALID:
        (tmp_path / "t.csv").write_text(text)
        with pytest.raises(FileFormatError, match=rf"t\.csv: line {line}\b" if line else r"t\.csv"):
            read_cases(tmp_path / "t.csv")


def study(**more):
    labels = np.ones(SHAPE, np.uint8)
    motion = Motion(labels=np.ones(SHAPE, np.uint8), rules=RULES)
    return Study(
        Grid(SHAPE, (1.0, 1.0)), Tissue(labels=labels, materials=MATERIALS), motion, **more
    )


@pytest.mark.parametrize(
    ("change", "rows"),
    [
        (Change("growth", 0.2, "2"), {2: (8.0, 0.45, 0.2)}),
        (Change("stiffness", 5.0, "tumour"), {2: (5.0, 0.45, 0.0)}),
        (Change("stiffness", 5.0, "bone"), {3: (5.0, 0.45, 0.0)}),
        (Change("poisson", 0.3), {1: (3.0, 0.3, 0), 2: (8.0, 0.3, 0), 3: (np.inf, 0.3, 0)}),
    ],
    ids=lambda value: ":".join(map(str, value)) if isinstance(value, Change) else "",
)
def test_a_sweep_changes_the_tissue_of_a_label_a_name_or_a_kind(change, rows):
    found = changed(study(), [change]).tissue.materials
    now = {row.label: (row.stiffness, row.poisson, row.growth) for row in found}
    was = {row.label: (row.stiffness, row.poisson, row.growth) for row in MATERIALS}
    assert now == {**was, **rows}


def test_a_sweep_changes_the_amount_of_a_rule_and_the_model():
    both = [Change("amount", 5.0, "rim"), Change("model", "paper")]
    found = changed(study(), both)
    assert found.motion.rules == (RULES[0], BoundaryRule(2, "move", vector=(0, 5.0), name="rim"))
    assert found.model_name == "paper"
    unnamed = replace(study(), tissue=Tissue(labels=np.ones(SHAPE, np.uint8)))
    (row,) = changed(unnamed, [Change("poisson", 0.3)]).tissue.materials
    assert (row.label, row.poisson) == (1, 0.3)
    bare = Study(Grid(SHAPE, (1.0, 1.0)))
    assert changed(bare, [Change("poisson", 0.3)]).prior.poisson == 0.3


def test_a_sweep_over_a_missing_tissue_or_boundary_is_refused():
    paper = study(model="paper")
    for of, change in (
        (study(), Change("growth", 0.1, "bowel")),
        (study(), Change("amount", 3.0, "brain")),
        (study(), Change("amount", 3.0, "1")),
        (paper, Change("poisson", 0.3)),
    ):
        with pytest.raises(HmrfError, match=change.what):
            changed(of, [change])


def test_a_failed_case_is_reported_and_the_other_cases_are_solved(files, in_this_process, capsys):
    own = study()
    labels = own.motion.labels.copy()
    labels[-1] = 2
    write_study("own.study", replace(own, motion=replace(own.motion, labels=labels)))
    table = write_table(files, "a,image.tif,4;5", "broken,gone.tif,4", more=",amount:rim")
    with open(table, "a") as file:
        file.write("\nstudy,own.study,,,,,3\n")
    assert main(["batch", str(table), "out", "--jobs", "1"]) == 1
    said = capsys.readouterr()
    assert "broken: " in said.err
    assert "gone.tif: there is no such file or folder" in said.err
    assert "3 of 4 cases are solved" in said.out
    out = files / "out"
    assert sorted(path.name for path in out.glob("[!.]*")) == [
        "a_amount-rim-4",
        "a_amount-rim-5",
        "study",
        "summary.csv",
    ]
    assert {name: rows["amount:rim"] for name, rows in summary(out).items()} == {
        "a_amount-rim-4": "4",
        "a_amount-rim-5": "5",
        "broken": "4",
        "study": "3",
    }
    rows = summary(out)
    assert [rows[name]["state"] for name in rows] == ["done", "done", "failed", "done"]
    assert float(rows["a_amount-rim-5"]["largest_displacement"]) == pytest.approx(5)
    assert 0 < float(rows["a_amount-rim-5"]["error_bound"]) < 0.01
    assert rows["study"]["folds"] == "0"
    for number in ("largest_displacement", "error_bound"):
        for value in filter(None, (row[number] for row in rows.values())):
            assert float(value) == float(f"{float(value):.6g}"), "a value has digits of rounding"
    assert moved(out, "a_amount-rim-4") == pytest.approx(4)
    assert read_study(out / "study" / "own.study").solution is not None
    # An existing result is neither overwritten nor solved again, unless its row changed.
    assert main(["batch", str(table), "out"]) == 1
    assert "'a_amount-rim-4' already exists. Resume the batch" in capsys.readouterr().err
    before = (out / "study").stat().st_ino
    write_table(files, "a,image.tif,4", "broken,image.tif,6", more=",amount:rim")
    text = table.read_text().replace("a,image", '"a_amount-rim-5",image')
    table.write_text(f"{text}\nstudy,own.study,,,,,3\n")
    capsys.readouterr()
    assert main(["batch", str(table), "out", "--jobs", "1", "--resume"]) == 0
    said = capsys.readouterr().out
    assert "note: ignored, because no case in the table has this name: a_amount-rim-4\n" in said
    assert "note: solved again, because the line in the table has changed: a_amount-rim-5\n" in said
    assert "3 of 3 cases are solved" in said
    assert (out / "study").stat().st_ino == before
    assert moved(out, "a_amount-rim-5") == pytest.approx(4)
    assert moved(out, "broken") == pytest.approx(6)
    assert not (out / batch.UNFINISHED).exists()


def test_names_of_folders_need_no_quotation_marks(tmp_path):
    (tmp_path / "t.csv").write_text(
        "name,image,growth:a b\n'Ann, 3 = x',a b.tif,-0.1;0.2/0\n".replace("'", '"') + ",a b.tif,\n"
    )
    names = [case.name for case in read_cases(tmp_path / "t.csv")]
    assert names == ["Ann_3_x_growth-a_b--0.1", "Ann_3_x_growth-a_b-0.2_0", "a_b"]


def test_a_case_with_changed_files_is_solved_again(files, in_this_process, caplog):
    for name in ("b.tif", "c.tif"):
        write_image(name, read_image("image.tif"))
    table = write_table(
        files, *(f"{name}.tif,4" for name in ("a,image", "b,b", "c,c")), more=",amount:rim"
    )
    cases = read_cases(table)
    first = solve_cases(cases, files / "out", jobs=1)
    assert {each.state for each in first} == {"done"}
    os.utime(files / "image.tif")  # Only the time stamp changes.
    assert solve_cases(cases, files / "out", jobs=1, resume=True) == first
    assert not caplog.messages
    write_image("b.tif", ImageFile(np.full(SHAPE, 7, np.uint8)))
    (files / "c.tif").unlink()
    told = []
    again = solve_cases(cases, files / "out", jobs=1, resume=True, report=told.append)
    assert told == ["solved again, because input files have changed: b, c"]
    assert again[0] == first[0]
    assert [each.state for each in again] == ["done", "done", "failed"]
    assert "(the folder c still contains an earlier result, which is ignored)" in again[2].error


def test_a_finished_case_with_a_damaged_result_is_solved_again(files, in_this_process):
    cases = read_cases(write_table(files, "a,image.tif", "b,image.tif"))
    first = solve_cases(cases, files / "out", jobs=1)
    assert {each.state for each in first} == {"done"}
    saved, told = files / "out" / "a" / "image.study", []
    saved.write_bytes(saved.read_bytes()[:-100])
    again = solve_cases(cases, files / "out", jobs=1, resume=True, report=told.append)
    assert told == ["solved again, because files of the result are damaged or missing: a"]
    assert again[1] == first[1]
    read_study(saved)


def test_a_folder_in_use_by_another_batch_is_refused(files, in_this_process, capsys):
    unfinished = files / "out" / batch.UNFINISHED
    unfinished.mkdir(parents=True)
    table = write_table(files, "a,image.tif")
    with FileLock(files / "out" / batch.LOCK):
        for more in ([], ["--resume"]):
            assert main(["batch", str(table), "out", "--jobs", "1", *more]) == 1
            assert "another batch is using this folder" in capsys.readouterr().err
        assert unfinished.exists(), "the unfinished work of the running batch was removed"
    assert main(["batch", str(table), "out", "--jobs", "1"]) == 0


def test_a_summary_contains_no_formula_and_lists_guessed_values(files, in_this_process):
    (files / "=m.csv").write_text("label,name\n1,brain\n2,colon\n")
    table = write_table(files, "x,image.tif", "y,image.tif,-4", more=",amount:rim")
    table.write_text(table.read_text().replace("m.csv", "=m.csv"))
    solve_cases(read_cases(table), files / "out", jobs=1)
    rows = summary(files / "out")
    assert rows["x"]["state"] == "done"
    assert rows["x"]["notes"].startswith("'=m.csv: the table only names its labels, so published")
    assert "no stiffness is known for 2 (colon)" in rows["x"]["notes"]
    assert rows["y"]["amount:rim"] == "-4", "a number was written as text"


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_a_killed_worker_process_fails_only_its_case():
    cases = [SimpleNamespace(name=name) for name in ("first", KILLER, "last")]
    with batch._processes(solve_or_end, 1) as submit:
        outcomes = [future.result() for future in map(submit, cases)]
    assert [each.state for each in outcomes] == ["done", "failed", "done"]
    assert f"was ended by {signal.Signals.SIGKILL.name}" in outcomes[1].error


def test_an_interrupted_batch_is_resumed_without_solving_finished_cases_again(
    files, monkeypatch, capsys, request
):
    def interrupt(_):
        raise KeyboardInterrupt

    table = write_table(files, "a,image.tif,1;2;3;4;5;6", more=",amount:rim")
    with monkeypatch.context() as interrupted:
        interrupted.setattr(batch.BatchProgress, "words", property(interrupt))
        assert main(["batch", str(table), "out", "--jobs", "1"]) == 130
    assert "interrupted" in capsys.readouterr().err
    out = files / "out"
    states = {name: row["state"] for name, row in summary(out).items()}
    assert states["a_amount-rim-1"] == "done"
    assert states["a_amount-rim-6"] == "not done"
    assert not (out / batch.UNFINISHED).exists()
    first = out / "a_amount-rim-1" / "case.json"
    before = first.stat().st_mtime_ns
    request.getfixturevalue("in_this_process")
    assert main(["batch", str(table), "out", "--resume", "--jobs", "1"]) == 0
    assert {row["state"] for row in summary(out).values()} == {"done"}
    assert first.stat().st_mtime_ns == before
    assert moved(out, "a_amount-rim-6") == pytest.approx(6)


def test_the_progress_of_a_batch_is_a_readable_text():
    assert batch.BatchProgress(0, 0, 9).words == "0 of 9 cases"
    assert batch.BatchProgress(1, 0, 1).words == "1 of 1 case"
    assert batch.BatchProgress(5, 1, 9, 42.0).words == "6 of 9 cases, 1 failed, about 42 s left"
    assert batch.BatchProgress(5, 0, 9, 600.0).words == "5 of 9 cases, about 10 min left"
    assert batch.BatchProgress(5, 0, 9, 36000.0).words == "5 of 9 cases, about 10 h left"


def test_a_scheduler_without_dask_is_refused(files, monkeypatch):
    table = write_table(files, "a,image.tif")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        HmrfError, match=r'in a copy of the repository, run: pip install "\.\[cluster\]"'
    ):
        solve_cases(read_cases(table), files / "out", scheduler="tcp://127.0.0.1:1")


def test_a_scheduler_that_does_not_exist_is_refused_before_anything_is_written(files):
    table = write_table(files, "a,image.tif")
    with pytest.raises(HmrfError, match=r"scheduler file .*none.json does not exist"):
        solve_cases(read_cases(table), files / "out", scheduler=str(files / "none.json"))
    assert not (files / "out").exists()


@pytest.mark.filterwarnings("ignore")
def test_the_workers_of_a_dask_scheduler_solve_cases(files):
    distributed = pytest.importorskip("distributed")
    table = write_table(files, "a,image.tif,1;2", "broken,gone.tif,1", more=",amount:rim")
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        command = ["batch", str(table), "out", "--scheduler", cluster.scheduler_address]
        assert main(command) == 1
    states = {name: row["state"] for name, row in summary(files / "out").items()}
    assert states == {"a_amount-rim-1": "done", "a_amount-rim-2": "done", "broken": "failed"}
    assert moved(files / "out", "a_amount-rim-2") == pytest.approx(2)
