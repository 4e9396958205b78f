"""Tests of the command line: help, options, errors and overwritten files."""

import argparse
import csv
import os
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    Cavity,
    Drawing,
    Grid,
    HmrfError,
    Landmark,
    Motion,
    Pictures,
    Study,
    Tissue,
    read_study,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.cases import Case
from napari_hmrf.cli import main, parser_of_commands, read_command
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.fields import write_field
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_tables import read_cases
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.solver.optimizers import Monitor, Multigrid
from napari_hmrf.study.models import parts_of

SHAPE = (20, 24)


def commands():
    parser = parser_of_commands()
    (choices,) = (
        action.choices
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    return choices


def test_every_command_has_a_description_an_example_and_help_for_each_option():
    for name, command in commands().items():
        assert re.match(r"[A-Z].*\.$", command.description)
        example = command.epilog.removeprefix("example: ")
        typed = shlex.split(example)
        assert typed[:2] == ["napari-hmrf", name]
        assert type(read_command(typed[1:])).__name__.lower() == name
        bare = [action.dest for action in command._actions if not action.help]
        assert bare == []
        assert example in command.format_help(), "the example is broken across lines"


def test_an_image_instead_of_a_result_is_refused_with_a_hint(tmp_path, capsys):
    photo = write_image(tmp_path / "photo.png", ImageFile(np.ones(SHAPE, np.uint8)))
    for command in ("measure {}", "play {} x.gif", "export {} x.mha"):
        assert main(command.format(photo).split()) == 1
        said = capsys.readouterr().err
        assert "damaged" not in said
        assert re.search(r"photo\.png.* Give .*a saved result", said)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write an image with labels, a rim and their tables; return the folder."""
    monkeypatch.chdir(tmp_path)
    labels = np.ones(SHAPE, np.uint8)
    labels[6:12, 6:12] = 2
    rim = np.zeros(SHAPE, np.uint8)
    rim[0], rim[-1] = 1, 2
    write_image("labels.png", ImageFile(labels))
    write_image("rim.png", ImageFile(rim))
    write_image("image.png", ImageFile(50 * labels))
    (tmp_path / "m.csv").write_text("label,name,stiffness,poisson\n1,brain,3,0.4\n2,fat,1,\n")
    (tmp_path / "r.csv").write_text("label,action,row,col\n1,fixed,,\n2,move,1,0\n")
    return tmp_path


SOLVE = "solve image.png --labels labels.png --materials m.csv --boundary rim.png --rules r.csv"


def run(line, capsys):
    code = main(line.split())
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.mark.parametrize("command", [f"{SOLVE} -o out", "replay a.study"])
def test_the_shell_reports_the_progress_of_the_preparation(files, capsys, monkeypatch, command):
    grid = Grid(SHAPE, (1, 1))
    pull = Drawing((Arrow(at=(10, 12), by=(0, 3), radius=3),))
    write_study("a.study", Study(grid, Tissue(), Motion(hold_edge=True, drawing=pull)))

    def slowly(*problem, progress, **more):
        for message in (f"{PREPARING}: about 10 s left", "level 2"):
            progress(Monitor(message, 0.1))
        return solve(*problem, **more)

    monkeypatch.setattr("napari_hmrf.study.ground.solve", slowly)
    code, out, err = run(command, capsys)
    assert code == 0
    assert PREPARING not in out
    assert err.splitlines() == [f"10%  {PREPARING}: about 10 s left"]


def test_an_area_is_printed_without_an_exponent(files, capsys):
    pull = Drawing((Arrow(at=(10, 12), by=(0, 30), radius=30),))
    study = Study(Grid(SHAPE, (10, 10)), Tissue(), Motion(hold_edge=True, drawing=pull))
    write_study("a.study", study, solve_study(study, backend="cpu"))
    code, out, _ = run("measure a.study", capsys)
    assert code == 0
    assert "48000" in out


def test_no_command_overwrites_a_file_without_force(files, capsys):
    assert run(f"{SOLVE} -o out", capsys)[0] == 0
    (files / "names.json").write_text('{"1": "brain"}')
    lines = {
        f"{SOLVE} -o out": "out/image.study",
        "export out/image.study f.mha": "f.mha",
        "apply out/image.study labels.png --labels -o moved": "moved/labels.png",
        "measure out/image.study -o t.csv": "t.csv",
        "play out/image.study a.gif": "a.gif",
        "materials names.json -o n.csv": "n.csv",
        "register labels.png image.png -o registered": "registered/labels.study",
        "truth image.png --labels labels.png --materials m.csv -o pairs": "pairs/image.mha",
    }
    for line, name in lines.items():
        if not line.startswith("solve"):
            (files / name).parent.mkdir(exist_ok=True)
            (files / name).write_text("mine")
        before = (files / name).read_bytes()
        code, out, err = run(line, capsys)
        assert code == 1, line
        assert f"{(files / name).name} already exists" in err
        assert "--force" in err
        assert out == ""
        assert (files / name).read_bytes() == before
    for line in list(lines)[1:6]:
        assert run(f"{line} --force", capsys)[0] == 0, line
        assert (files / lines[line]).read_bytes() != b"mine"


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="needs /dev/null")
def test_a_device_is_written_without_force(files, capsys):
    assert run(f"{SOLVE} -o out", capsys)[0] == 0
    os.symlink("/dev/null", files / "none.csv")
    assert run("measure out/image.study -o none.csv", capsys)[0] == 0


def test_the_shell_sets_the_parameters_of_the_energy(files, capsys):
    line = f"{SOLVE} -o out --poisson 0.3 --plane strain --tolerance 0.01 --penalty 0.5"
    code, out, err = run(f"{line} --weight=-0.01/0.02", capsys)
    assert code == 0, err
    assert "note: --poisson 0.3 replaces the Poisson's ratios of m.csv\n" in out
    study, solution = read_study(files / "out" / "image.study")
    assert {row.poisson for row in study.tissue.materials} == {0.3}
    assert study.motion.weight == (-0.01, 0.02)
    prior, optimizer = (solution.provenance.parameters[part] for part in ("prior", "optimizer"))
    assert (prior["plane"], prior["penalty"], optimizer["tolerance"]) == ("strain", 0.5, 0.01)
    bare = read_case(Case(files / "image.png", hold_edge=True, poisson=0.2))
    assert bare.prior.poisson == 0.2
    plain = read_case(
        Case(files / "image.png", labels=files / "labels.png", hold_edge=True, poisson=0.2)
    )
    assert [(row.label, row.poisson) for row in plain.tissue.materials] == [(1, 0.2), (2, 0.2)]
    assert any("label 2 is not in the table" in note for note in plain.notes)


def test_the_shell_removes_tissue_and_fills_the_cavity(files, capsys):
    paint = np.zeros(SHAPE, np.uint8)
    paint[-1], paint[6:12, 6:12] = 1, 2
    write_image("paint.png", ImageFile(paint))
    (files / "r.csv").write_text("label,action\n1,fixed\n2,remove\n")
    line = SOLVE.replace("rim.png", "paint.png") + " -o out --weight 0.01/0"
    code, _, err = run(f"{line} --cavity 0.1/0.02/0.5", capsys)
    assert code == 0, err
    study, solution = read_study(files / "out" / "image.study")
    assert study.motion.cavity == Cavity(0.1, 0.02, 0.5)
    assert (solution.removed == (study.motion.labels == 2)).all()
    assert solution.displacement[12, 8, 0] > solution.displacement[14, 8, 0] > 0


def test_an_invalid_number_is_refused_before_the_solve(files, capsys):
    for option in (
        *(f"--cavity {wrong}" for wrong in ("0/-1", "much", "0/0/0/0", "0/1/-0.5")),
        *("--tolerance 0", "--budget -1", "--penalty x", "--weight 1", "--plane both"),
    ):
        with pytest.raises(SystemExit):
            run(f"{SOLVE} -o out {option}", capsys)
        assert option.split()[0] in capsys.readouterr().err


def test_a_parameter_that_the_model_lacks_is_refused_by_name(files, capsys):
    for options in (
        "--model paper --poisson 0.3",
        "--model paper --plane strain",
        "--model paper-converged --weight 0/1",
        "--model paper --cavity 0.1",
        "--model paper --tolerance 0.1",
        "--budget 20",
        "--weight 0/0/1",
        "--forward",
    ):
        code, out, err = run(f"{SOLVE} -o out {options}", capsys)
        assert code == 1
        assert re.search("--[a-z]+", options.removeprefix("--model"))[0] in err
        assert out == ""
    assert not (files / "out").exists()


def test_the_shell_and_tables_set_the_budget_of_large_motion(files, capsys):
    assert run(f"{SOLVE} -o out --model large-motion --budget 20", capsys)[0] == 0
    (files / "cases.csv").write_text(
        "name,image,hold-edge,model,budget\na,image.png,yes,large-motion,inf\n"
    )
    case = next(iter(read_cases(files / "cases.csv"))).case
    assert read_case(case).optimizer == Multigrid(budget=None)
    solution = read_study(files / "out" / "image.study")[1]
    assert solution.provenance.parameters["optimizer"]["budget"] == 20


def test_the_forward_option_reads_a_file_as_a_forward_field(tmp_path):
    d = np.zeros((*SHAPE, 2))
    d[..., 1] = np.linspace(0, 3, SHAPE[1])
    write_image(tmp_path / "image.png", ImageFile(np.ones(SHAPE, np.uint8)))
    import SimpleITK as sitk

    bare = sitk.GetImageFromArray(d[..., ::-1], isVector=True)
    sitk.WriteImage(bare, str(tmp_path / "f.mha"))
    given = Case(tmp_path / "image.png", boundary=tmp_path / "f.mha", forward=True)
    np.testing.assert_allclose(read_case(given).motion.observed, d, atol=1e-6)
    back = Case(tmp_path / "image.png", boundary=tmp_path / "f.mha")
    assert abs(read_case(back).motion.observed - d).max() > 0.1
    write_field(tmp_path / "own.mha", d, spacing=(1, 1))


def test_a_painted_label_without_a_rule_is_refused(files, capsys):
    (files / "r.csv").write_text("label,action\n1,fixed\n")
    code, _, err = run(f"{SOLVE} -o out", capsys)
    assert code == 1
    assert "'rim.png' has labels without a rule: 2." in err


def test_a_model_has_the_same_names_in_python_and_in_the_shell(files, capsys):
    assert parts_of("large-motion") == parts_of("large motion")
    assert Study(Grid(SHAPE, (1.0, 1.0)), model="large-motion").model_name == "large motion"
    with pytest.raises(HmrfError, match=r"unknown model 'soft'\. Use one of .elastic"):
        parts_of("soft")
    code, out, _ = run(f"{SOLVE} -o out --model large_motion", capsys)
    assert code == 0
    assert ", large-motion, moved up to" in out
    assert "large motion" not in out


def test_notes_in_the_shell_name_options_of_the_shell(files, capsys):
    (files / "r.csv").write_text("label,action,row,col\n1,move,1,0\n2,move,1,0\n")
    code, out, _ = run(f"{SOLVE} -o out", capsys)
    assert code == 0
    assert "hold its edge (--hold-edge), or paint the tissue that stays in place" in out
    (files / "m.csv").write_text("label,stiffness\n1,3\n2,rigid\n")
    code, _, err = run(f"{SOLVE} -o out --model paper --force", capsys)
    assert code == 1
    assert "Use the elastic model (--model elastic)" in err
    assert "Advanced" not in err


def test_a_case_without_motion_is_refused(files, capsys):
    code, _, err = run("solve image.png --hold-edge -o out", capsys)
    assert code == 1
    assert "nothing moves" in err
    assert "--boundary" in err
    assert not (files / "out").exists(), "an empty folder was made"


def test_play_shows_the_middle_slice_of_a_volume_and_prints_its_number(tmp_path, capsys):
    from PIL import Image

    shape = (6, 8, 10)
    pull = Drawing((Arrow((3, 4, 5), (0, 0, 1.0), 2.0),))
    image = np.arange(480, dtype=np.float32).reshape(shape)
    study = Study(
        Grid(shape, (1.0, 1.0, 1.0)),
        Tissue(stiffness=np.ones(shape)),
        Motion(hold_edge=True, drawing=pull),
        pictures=Pictures(image),
    )
    path = write_study(tmp_path / "v.study", study, solve_study(study, backend="cpu"))
    code, out, _ = run(f"play {path} {tmp_path / 'a.gif'}", capsys)
    assert code == 0
    assert (
        "note: showing slice 3, the middle of slices 0 to 5; use --slice to select another slice\n"
        in out
    )
    with Image.open(tmp_path / "a.gif") as film:
        assert film.size == (10, 8)
        assert film.n_frames > 10
    assert run(f"play {path} {tmp_path / 'b.gif'} --slice 6", capsys)[2].startswith(
        "napari-hmrf: --slice is 6, but the volume has slices 0 to 5. Choose one of these slices."
    )
    assert run(f"play {path} {tmp_path / 'b.gif'} --slice 2", capsys)[:2] == (
        0,
        f"written: {tmp_path / 'b.gif'}\n",
    )


def test_a_demo_overwrites_only_its_own_folder_and_prints_a_note(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CI", "true")
    monkeypatch.setattr("napari_hmrf.samples.demo.write_pictures", lambda *_, **__: [])
    line = "demo --size 24 --backend cpu --no-window"
    assert run(line, capsys)[0] == 0
    code, out, _ = run(line, capsys)
    assert code == 0
    assert "note: an earlier demo in demo-output is overwritten\n" in out
    code, _, err = run(f"{line} --out demo-output", capsys)
    assert code == 1
    assert "demo-output already exists and is not empty" in err
    assert run(f"{line} --out demo-output --force", capsys)[0] == 0


def test_measure_adds_error_bars_and_uncertainty_writes_images_and_a_place(files, capsys):
    assert run(f"{SOLVE} -o out", capsys)[0] == 0
    code, out, _ = run("measure out/image.study --uncertainty -o m.csv --force", capsys)
    assert code == 0
    assert "mean_displacement_sd" in out
    with open("m.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["unit"] for row in rows] == ["px", "px"]
    for axis in ("", "_row", "_col"):
        assert all(float(row[f"mean_displacement{axis}_sd"]) > 0 for row in rows)
    assert float(rows[1]["mean_displacement_row"]) == pytest.approx(
        float(rows[1]["mean_displacement"]), rel=0.05
    )
    code, out, _ = run("measure out/image.study -o m.csv --force", capsys)
    assert "_sd" not in (files / "m.csv").read_text() + out

    surface = np.zeros(SHAPE, np.uint8)
    surface[7] = 1
    write_image("surface.png", ImageFile(surface))
    command = "uncertainty out/image.study --samples 4 --within surface.png -o sd.tif"
    code, out, _ = run(command, capsys)
    assert code == 0
    assert "px at pixel (7, " in out
    assert "written: sd.tif, sd-row.tif, sd-col.tif" in out
    assert read_image("sd.tif").pixels.shape == SHAPE
    code, _, err = run(command, capsys)
    assert code == 1
    assert "--force" in err


def test_uncertainty_names_a_wrong_landmark_and_states_the_typical_strain(files, capsys):
    places = [(4, 4), (4, 12), (4, 20), (10, 8), (10, 16), (16, 4), (16, 12), (16, 20)]
    marks = [Landmark(place, (place[0], place[1] + 0.5), radius=1.0, sd=0.3) for place in places]
    marks[3] = Landmark(places[3], (15, 3), radius=1.0, sd=0.3)
    for count, typical_strain, said in (
        (
            8,
            0.02,
            (
                r"landmarks do not agree with the tissue \(p < 0.0001\)",
                r"landmark at pixel \(10, 8\) does not agree",
                r"typical strain is 7\d.* % \(5\d.* to 10\d.* %\)",
            ),
        ),
        (1, 1.0, ("the landmarks agree", "unknown, because landmarks are too few")),
    ):
        motion = Motion(
            hold_edge=True, drawing=Drawing(tuple(marks[:count])), typical_strain=typical_strain
        )
        study = Study(Grid(SHAPE, (1, 1)), Tissue(), motion)
        write_study("a.study", study, solve_study(study, backend="cpu"))
        code, out, _ = run("uncertainty a.study --samples 2 --landmarks", capsys)
        assert code == 0
        for each in said:
            assert re.search(each, out), out
    pull = Drawing((Arrow(at=(10, 12), by=(0, 3), radius=3),))
    study = replace(study, motion=Motion(hold_edge=True, drawing=pull))
    write_study("b.study", study, solve_study(study, backend="cpu"))
    code, _, err = run("uncertainty b.study --landmarks", capsys)
    assert code == 1
    assert "b.study is unknown: landmarks: are missing" in err


def test_a_result_without_a_known_uncertainty_is_refused_with_the_reason(files, capsys):
    pull = Drawing((Arrow(at=(10, 12), by=(0, 3), radius=3),))
    motion = Motion(hold_edge=True, drawing=pull)
    study = Study(Grid(SHAPE, (1, 1)), Tissue(), motion, model="paper")
    solution = solve_study(study, backend="cpu")
    write_study("a.study", study, solution)
    solution.write("a.npz")
    for command, said in (
        ("measure a.study --uncertainty", "a.study: model"),
        ("uncertainty a.study", "a.study is unknown: model"),
        ("measure a.npz --uncertainty", "a.npz is a saved result"),
        ("uncertainty a.npz", "a.npz is a saved result"),
    ):
        code, _, err = run(command, capsys)
        assert code == 1
        assert said in err
