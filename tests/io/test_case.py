"""Tests of cases, which are solved from files in the shell."""

import re
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    BoundaryRule,
    Drawing,
    FileFormatError,
    Grid,
    Landmark,
    Material,
    Motion,
    Problem,
    ProblemError,
    Study,
    Tissue,
    read_study,
    solve,
    solve_study,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.fields import write_field
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.case import read_case, solve_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.fields import geometry_of
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.io.tables import read_materials, read_rules
from napari_hmrf.landmarks import write_points
from napari_hmrf.tissue import edge_confidence
from napari_hmrf.tissue.boundary_rules import RIGID, boundary_images, stiffness_image
from napari_hmrf.tissue.usual_lengths import usual_radius

sitk = pytest.importorskip("SimpleITK")

SHAPE = (30, 36)
TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
PLACE = Geometry.of_itk((3, *SHAPE), (2.0, 0.5, 0.7), (-10.0, 20.0, 5.0), TURN)


@pytest.fixture
def files(tmp_path):
    """Write a scan of three slices with labels, tables and a painted boundary.

    Return the folder and the arrays of scan, labels and rim.
    """
    scan = np.random.default_rng(1).integers(1, 200, (3, *SHAPE), dtype=np.int16)
    labels = np.ones(SHAPE, np.uint8)
    labels[10:20, 12:24] = 2
    rim = np.zeros(SHAPE, np.uint8)
    rim[0], rim[-1], rim[:, 0] = 1, 2, 1
    write_image(tmp_path / "scan.nii.gz", ImageFile(scan, PLACE))
    write_image(tmp_path / "labels.png", ImageFile(labels))
    write_image(tmp_path / "rim.png", ImageFile(rim))
    (tmp_path / "m.csv").write_text("label,name,stiffness,poisson\n1,brain,3,0.49\n2,bone,Rigid,\n")
    (tmp_path / "r.csv").write_text(
        "label,action,row,col,confidence\n1,fixed,,,\n2,move,1.5,-0.5,1\n"
    )
    return tmp_path, scan, labels, rim


def case(folder, **more):
    return Case(image=folder / "scan.nii.gz", slice=1, **more)


def test_tables_saved_by_a_spreadsheet_are_read(files):
    folder, *_ = files
    assert read_materials(folder / "m.csv") == (
        Material(1, "brain", 3.0, 0.49),
        Material(2, "bone", RIGID),
    )
    assert read_rules(folder / "r.csv") == (
        BoundaryRule(1, "fixed"),
        BoundaryRule(2, "move", vector=(1.5, -0.5)),
    )


#: Tables of materials with an error, and the line that the message names, or 0.
INVALID_MATERIALS = [
    ("", 0),
    ("label,name\n1,brain\n", 2),
    ("label,stiffness\n1,stiff\n", 2),
    ("label,stiffness\n1,3\nx,3\n", 3),
    ("label,stiffness\n1,\n", 2),
    ("label,stiffness\n1,0\n", 0),
    ("label,stiffness\n", 0),
    ("label,stiffness\n\n1,3\n\n1,4\n", 5),
    ("label,stiffness\n1,3,4\n", 2),
    ("label,stiffness,poison\n1,3,.4\n", 0),
    ("label,stiffness,poisson\n1,3,0.4\n2,3,0.7\n", 3),
]


def refused_line(read, path, text, line):
    """Assert that a table is refused, and that the message names the file and the line."""
    path.write_text(text)
    with pytest.raises(FileFormatError, match=rf"t\.csv: line {line}\b" if line else r"t\.csv"):
        read(path)


def test_an_error_in_a_table_of_materials_names_its_line(tmp_path):
    for text, line in INVALID_MATERIALS:
        refused_line(read_materials, tmp_path / "t.csv", text, line)


def test_the_shell_solves_growth_pressure_and_large_motion(tmp_path, capsys):
    labels, paint = np.ones((24, 24), np.uint8), np.zeros((24, 24), np.uint8)
    labels[8:16, 8:16], paint[-1], paint[0, 6:18] = 2, 1, 2
    write_image(tmp_path / "labels.png", ImageFile(labels))
    write_image(tmp_path / "paint.png", ImageFile(paint))
    (tmp_path / "m.csv").write_text("label,stiffness,growth\n1,1,\n2,6,0/0.4\n")
    (tmp_path / "r.csv").write_text("label,action,amount\n1,fixed,\n2,press,0.2\n")
    given = ["solve", "labels.png", "--labels", "labels.png", "--materials", "m.csv"]
    given += ["--boundary", "paint.png", "--rules", "r.csv", "--model", "large-motion"]
    given = [str(tmp_path / text) if "." in text else text for text in given]
    assert main([*given, "-o", str(tmp_path / "out"), "--backend", "cpu"]) == 0
    assert (
        "note: forces are in the unit of stiffness, which is not known" in capsys.readouterr().out
    )
    study, solution = read_study(tmp_path / "out" / "labels.study")
    assert study.model_name == "large motion"
    assert study.tissue.materials[1].growth == (0.0, 0.4)
    assert solution.displacement[0, 12, 0] > 1  # The pressure pushes the tissue down.
    assert solution.reach.least_jacobian > 0


def test_a_pressed_label_without_a_surface_is_refused_by_name(files, capsys, monkeypatch):
    folder, *_ = files
    monkeypatch.chdir(folder)
    paint = np.zeros(SHAPE, np.uint8)
    paint[-1], paint[5, 5] = 1, 2
    write_image(folder / "paint.png", ImageFile(paint))
    (folder / "press.csv").write_text("label,action,amount\n1,fixed,\n2,press,0.2\n")
    told = "solve labels.png --hold-edge --boundary paint.png --rules press.csv -o out"
    assert main(told.split()) == 1
    assert (
        "'paint.png' under label 2 covers no face of the tissue's surface"
        in capsys.readouterr().err
    )


def test_the_shell_and_python_give_the_same_field(files, capsys):
    folder, scan, labels, rim = files
    out = folder / "out"
    command = ["solve", folder / "scan.nii.gz", "--slice", 1, "--labels", folder / "labels.png"]
    command += ["--materials", folder / "m.csv", "--boundary", folder / "rim.png"]
    command += ["--rules", folder / "r.csv", "-o", out, "--backend", "cpu"]
    assert main([str(each) for each in command]) == 0
    assert "elastic, moved up to" in capsys.readouterr().out
    study, solution = read_study(out / "scan.study")
    spacing = PLACE.spacing[1:]
    y, c = boundary_images(rim, read_rules(folder / "r.csv"), spacing=spacing)
    problem = Problem(
        observed=y,
        confidence=c,
        stiffness=stiffness_image(labels, read_materials(folder / "m.csv")),
        spacing=spacing,
    )
    expected = solve(problem, study.prior.__class__(0.49), backend="cpu")
    np.testing.assert_allclose(solution.displacement, expected.displacement, atol=1e-5)
    np.testing.assert_array_equal(study.pictures.image, scan[1])
    seen = read_image(out / "scan deformed.nii.gz")
    assert seen.pixels.shape == SHAPE
    np.testing.assert_allclose(seen.geometry.origin, (-10, 20, 7)), "the second slice"
    assert main(["replay", str(out / "scan.study")]) == 0


def test_a_slice_stores_its_number_and_is_exported_at_its_place_in_the_volume(files):
    folder, *_ = files
    before = read_case(case(folder, hold_edge=True))
    assert before.grid.place.index == (1, 0, 0)
    pull = Drawing((Arrow((12, 14), (1.0, 2.0), 2.0),))
    before = replace(before, motion=replace(before.motion, drawing=pull))
    # Saved without a field: a later solution lies in the same place.
    study = read_study(write_study(folder / "a.study", before)).study
    assert study.grid.place.index == (1, 0, 0)
    path = write_study(folder / "b.study", study, solve_study(study, backend="cpu"))
    assert main(["export", str(path), str(folder / "field.mha")]) == 0
    field = sitk.ReadImage(str(folder / "field.mha"))
    volume = sitk.ReadImage(str(folder / "scan.nii.gz"))
    at = volume.TransformIndexToPhysicalPoint((0, 0, 1))
    np.testing.assert_allclose(field.GetOrigin(), at, atol=1e-5)
    np.testing.assert_allclose(field.GetDirection(), volume.GetDirection(), atol=1e-6)
    assert field.GetSpacing() == pytest.approx(volume.GetSpacing())


def test_a_slice_of_a_stack_without_a_place_stores_its_number(tmp_path):
    stack = np.random.default_rng(0).integers(1, 200, (4, *SHAPE), dtype=np.uint8)
    write_image(tmp_path / "stack.tif", ImageFile(stack))
    write_image(tmp_path / "pulled.tif", ImageFile((np.indices(SHAPE)[0] == 9).astype(np.uint8)))
    (tmp_path / "r.csv").write_text("label,action,row,col\n1,move,0.5,0\n")
    how = {"boundary": tmp_path / "pulled.tif", "rules": tmp_path / "r.csv"}
    given = Case(tmp_path / "stack.tif", slice=2, hold_edge=True, **how)
    assert read_case(given).grid.place.index == (2, 0, 0)
    saved = solve_case(given, tmp_path / "out", backend="cpu")
    assert geometry_of(saved.solution).origin == (0, 0, 2)
    assert (tmp_path / "out" / "stack deformed.tif").exists(), (
        "the deformed stack was not written; it requires no SimpleITK"
    )


#: Tables of rules with an error, and the line that the message names.
INVALID_RULES = [
    ("label,action\n1,fixed\n2,push\n", 3),
    ("label,action\n0,fixed\n", 2),
    ("label,action,confidence\n1,fixed,2\n", 2),
    ("label,action,row\n1,move,nan\n", 2),
    ("label,action\n1,move\n", 2),
    ("label,action\n1,expand\n", 2),
    ("label,action\n1,press\n", 2),
    ("label,action,row,col\n1,move,3,\n", 2),
    ("label,action,amount\n1,fixed,3\n", 2),
    ("label,action,row,col,amount\n1,move,1,0,3\n", 2),
    ("label,action,amount,confidence\n1,press,1,0.5\n", 2),
    ("label,action,row,row2\n1,move,1,\n", 0),
    ("label,stiffness\n1,3\n", 0),
    ("label,action,dx\n1,move,1\n", 0),
    ("label,action,confidence\n1,slide,0.5\n", 2),
    ("label,action,amount\n1,remove,0.5\n", 2),
]


def test_an_error_in_a_table_of_rules_names_its_line(tmp_path):
    for text, line in INVALID_RULES:
        refused_line(read_rules, tmp_path / "t.csv", text, line)


def test_unused_columns_of_a_rule_may_contain_their_defaults(tmp_path):
    (tmp_path / "t.csv").write_text("label,action,row,col,amount,confidence\n1,press,0,0,3,1\n")
    assert read_rules(tmp_path / "t.csv") == (BoundaryRule(1, "press", amount=3.0),)


def test_a_rule_that_slides_needs_no_distance_and_may_have_one(tmp_path):
    (tmp_path / "t.csv").write_text("label,action,amount\n1,slide,\n2,slide,-0.5\n")
    slides = BoundaryRule(1, "slide"), BoundaryRule(2, "slide", amount=-0.5)
    assert read_rules(tmp_path / "t.csv") == slides
    (tmp_path / "t.csv").write_text("label,action\n1,slide\n")
    assert read_rules(tmp_path / "t.csv") == slides[:1]


def test_a_rule_that_removes_tissue_needs_no_other_column(tmp_path):
    (tmp_path / "t.csv").write_text("label,action\n1,remove\n")
    assert read_rules(tmp_path / "t.csv") == (BoundaryRule(1, "remove"),)


#: Options after the image, and the file or option that the message names.
REFUSED = [
    ("", "--boundary"),
    ("--hold-edge --materials m.csv", "--materials"),
    ("--hold-edge --labels labels.png --maps rim.png", "--maps"),
    ("--hold-edge --rules r.csv", "--rules"),
    ("--boundary pairs.csv --rules r.csv", "--rules"),
    ("--hold-edge --confidence edges", "--confidence"),
    ("--hold-edge --slice 1", "--slice"),
    ("--boundary labels.png", "--rules"),
    ("--boundary zero.png --rules r.csv", "zero.png"),
    ("--boundary labels.png --rules plane.csv", "plane.csv"),
    ("--hold-edge --labels colours.png", "colours.png"),
    ("--boundary none.csv", "none.csv"),
    ("--boundary two.csv", "two.csv"),
    ("--hold-edge --labels complex.tif", "complex.tif"),
    ("--boundary pairs.csv", "pairs.csv"),
    ("--boundary wide.csv", "wide.csv"),
    ("--hold-edge --labels gone.png", "gone.png"),
    ("--hold-edge --labels .", "DICOM"),
    ("--hold-edge --labels labels.png --materials .", "folder"),
    ("--hold-edge --labels empty.png", "empty.png"),
]


def test_options_without_effect_and_unsuitable_files_are_refused_in_the_shell(
    files, capsys, monkeypatch
):
    folder, *_ = files
    monkeypatch.chdir(folder)
    write_image(folder / "zero.png", ImageFile(np.zeros(SHAPE, np.uint8)))
    write_image(folder / "colours.png", ImageFile(np.zeros((*SHAPE, 3), np.uint8), colours=True))
    write_points(folder / "pairs.csv", np.array([[3.0, 4], [900, 4]]), np.ones((2, 2)))
    write_points(folder / "wide.csv", np.array([[3.0, 4], [9, 4]]), np.ones((2, 2)), sd=[1, 1e9])
    (folder / "plane.csv").write_text("label,action,plane,row,col\n1,fixed,,,\n2,move,1,0,0\n")
    (folder / "empty.png").write_bytes(b"")
    (folder / "none.csv").write_text('"a","false","1","2","3","4"\n')
    (folder / "two.csv").write_text('"a","true",10,12,3,4\n"b","true",10,12.2,8,9\n')
    write_image(folder / "complex.tif", ImageFile(np.ones(SHAPE, np.complex64)))
    for options, name in REFUSED:
        assert main(["solve", "rim.png", "-o", "out", *options.split()]) == 1, options
        said = capsys.readouterr().err
        assert name in said
        assert len(said.splitlines()) == 1
    assert not list(folder.glob("out/*"))


def test_options_that_a_study_contains_are_refused(files, capsys):
    folder, *_ = files
    command = ["solve", folder / "rim.png", "--labels", folder / "rim.png", "--hold-edge"]
    (folder / "part.csv").write_text("label,stiffness\n0,3\n1,3\n2,3\n")
    command += ["--materials", folder / "part.csv", "-o", folder / "out"]
    command += ["--boundary", folder / "rim.png", "--rules", folder / "r.csv"]
    assert main([str(each) for each in command]) == 0
    study = str(folder / "out" / "rim.study")
    assert main(["solve", study, "-o", str(folder / "out"), "--hold-edge", "--model", "paper"]) == 1
    assert "Leave out --hold-edge, --model, or give an image" in capsys.readouterr().err
    assert main(["replay", study, "--image", str(folder / "rim.png")]) == 1
    assert "rim.study contains its own image. Leave out --image." in capsys.readouterr().err
    assert main(["measure", study, "-o", str(folder / "t.xlsx")]) == 1
    said = capsys.readouterr().err
    assert "t.xlsx: measurements are saved as comma-separated text. End the name in .csv." in said
    write_image(folder / "small.png", ImageFile(np.ones((4, 5), np.uint8)))
    for what in (["measure", study, "--labels"], ["play", study, str(folder / "a.gif"), "--image"]):
        assert main([*what, str(folder / "small.png")]) == 1
        assert "small.png: is 4 x 5, but the field is 30 x 36" in capsys.readouterr().err


def test_file_system_errors_are_reported_in_plain_sentences(files, capsys, monkeypatch):
    folder, *_ = files
    monkeypatch.chdir(folder)
    (folder / "folder.mha").mkdir()
    write_field(folder / "f.mha", np.zeros((*SHAPE, 2)), spacing=(1, 1))
    missing, folder_given = "there is no such file or folder", "it is a folder"
    for command, sentence in (
        ("export gone.study f.mha", missing),
        ("export . f.mha", folder_given),
        ("export f.mha no/f.nrrd", "its folder does not exist"),
        ("export f.mha folder.mha", folder_given),
        ("apply f.mha rim.png -o rim.png", "it is a file, not a folder"),
        ("measure gone.study", missing),
        ("replay gone.study", missing),
    ):
        assert main(command.split()) == 1
        said = capsys.readouterr().err
        assert sentence in said
        assert "Errno" not in said


def test_a_mask_is_read_as_labels_and_folds_cause_a_note(files, capsys):
    folder, _, labels, _ = files
    write_image(folder / "mask.tif", ImageFile(labels > 1))
    (folder / "m01.csv").write_text("label,stiffness\n0,3\n1,9\n")
    write_points(folder / "far.csv", np.array([[15.0, 12]]), np.array([[15.0, 26]]))
    command = "solve rim.png --labels mask.tif --materials m01.csv --boundary far.csv -o out"
    here = [str(folder / each) if "." in each else each for each in command.split()[:-1]]
    assert main([*here, str(folder / "out"), "--hold-edge", "--backend", "cpu"]) == 0
    said = capsys.readouterr().out
    assert re.search("note: the tissue folds over itself at [1-9][0-9]* pixels, which is", said)
    study, _ = read_study(folder / "out" / "rim.study")
    np.testing.assert_array_equal(study.tissue.labels, labels > 1)


def test_probability_maps_determine_the_labels(files):
    folder, *_ = files
    maps = np.zeros((2, 3, *SHAPE), np.uint8)
    maps[0, :, :20], maps[1, :, 15:] = 200, 255
    maps[0, :, :, :5] = 90  # Less likely than no tissue.
    maps[:, :, 10:, -5:] = np.reshape((100, 110), (2, 1, 1, 1))  # Two tissues meet here.
    paths = [folder / "gm.nii.gz", folder / "wm.nii.gz"]
    for path, values in zip(paths, maps, strict=True):
        write_image(path, ImageFile(values, PLACE))
    labels = read_case(case(folder, maps=paths, hold_edge=True)).tissue.labels
    assert set(np.unique(labels[:10, 5:])) == {1}
    assert set(np.unique(labels[15:])) == {2}
    assert set(np.unique(labels[10:, -5:])) == {2}, "there is a hole where two tissues meet"
    assert set(np.unique(labels[:10, :5])) == {0}


def test_landmarks_in_physical_units_move_the_tissue(files):
    folder, *_ = files
    # BigWarp's points are in the unit of the image, relative to the first pixel.
    local = [np.array(each) * PLACE.spacing for each in ([[1.0, 10, 12]], [[1.0, 11, 13]])]
    write_points(folder / "pairs.csv", *local)
    study = read_case(case(folder, boundary=folder / "pairs.csv", hold_edge=True))
    radius = usual_radius(SHAPE, PLACE.spacing[1:])
    (mark,) = study.motion.drawing.marks
    np.testing.assert_allclose([mark.source, mark.target], [(10, 12), (11, 13)])
    assert mark == Drawing((Landmark(mark.source, mark.target, radius),)).marks[0]


def test_a_column_of_standard_deviations_is_in_the_unit_of_the_image(files):
    folder, *_ = files
    places = np.array([[1.0, 10, 12], [1.0, 10.4, 12], [1.0, 5, 5]]) * PLACE.spacing
    write_points(folder / "pairs.csv", places, places + 1e-3, sd=[0.5, 2, 0])
    study = read_case(case(folder, boundary=folder / "pairs.csv", hold_edge=True))
    assert [mark.sd for mark in study.motion.drawing.marks] == [0.5, 2, 0]


def test_a_registration_field_is_observed_at_the_edges_of_the_image(files):
    folder, scan, *_ = files
    d = np.zeros((*SHAPE, 2))
    d[..., 1] = np.sin(np.linspace(0, np.pi, SHAPE[0]))[:, None]
    write_field(folder / "field.mha", d, spacing=PLACE.spacing[1:], forward=True)
    write_field(folder / "back.mha", d, spacing=PLACE.spacing[1:])
    study = read_case(case(folder, boundary=folder / "back.mha", confidence="edges"))
    assert isinstance(study.motion, Motion)
    np.testing.assert_allclose(study.motion.observed[3:-3, 3:-3], d[3:-3, 3:-3], atol=0.02)
    counts = study.motion.confidence
    np.testing.assert_array_equal(counts, edge_confidence(scan[1]))
    assert 0.05 < counts.mean() < 0.15


def test_a_field_of_a_volume_is_observed_on_the_solved_slice(files):
    folder, *_ = files
    # The field has other voxels at the same place and grows from slice to slice.
    other = Geometry.of_itk((3, 18, 30), (2.0, 1.0, 1.0), PLACE.origin, PLACE.direction)
    d = np.zeros((3, 18, 30, 3))
    d[..., 1] = 0.5 * np.arange(3)[:, None, None]
    place = other.as_itk
    write_field(folder / "Warp.nii.gz", d, **place)
    study = read_case(case(folder, boundary=folder / "Warp.nii.gz"))
    known = study.motion.confidence > 0
    assert known.mean() > 0.5
    np.testing.assert_allclose(
        study.motion.observed[known], np.full((known.sum(), 2), (0.5, 0)), atol=0.01
    )
    (folder / "far").mkdir()
    away = {**place, "origin": (900.0, 0.0, 0.0)}
    write_field(folder / "far" / "Warp.mha", d, **away)
    with pytest.raises(ProblemError, match=r"Warp\.mha: does not overlap the image"):
        read_case(case(folder, boundary=folder / "far" / "Warp.mha"))


def test_a_field_in_millimetres_moves_an_image_without_unit_in_pixels(tmp_path):
    d = np.zeros((*SHAPE, 2))
    d[..., 0], d[..., 1] = 1.0, -0.5
    for name, size in (("photo.png", 1.0), ("scan.mha", 0.5)):
        place = None if size == 1 else Geometry.at_origin(SHAPE, (size,) * 2, "millimeter")
        write_image(tmp_path / name, ImageFile(np.ones(SHAPE, np.uint8), place))
    write_field(tmp_path / "mm.mha", d, spacing=(0.5, 0.25), forward=True)
    study = read_case(Case(tmp_path / "photo.png", boundary=tmp_path / "mm.mha"))
    np.testing.assert_allclose(study.motion.observed, np.broadcast_to((2.0, -2.0), d.shape))
    # If both have millimetres, their places count: the field covers half of the columns.
    study = read_case(Case(tmp_path / "scan.mha", boundary=tmp_path / "mm.mha"))
    known = study.motion.confidence > 0
    assert known[:, :18].all()
    assert not known[:, 19:].any()
    np.testing.assert_allclose(study.motion.observed[known], d[known], atol=1e-6)
    write_field(tmp_path / "small.mha", d[:9], spacing=(0.5, 0.25), forward=True)
    with pytest.raises(
        ProblemError, match=r"small\.mha: is 9 x 36 in mil.*, but the image is 30 x 36"
    ):
        read_case(Case(tmp_path / "photo.png", boundary=tmp_path / "small.mha"))


def test_a_field_of_a_picture_moves_a_scan_with_the_same_pixels(tmp_path):
    pull = Drawing((Arrow((12, 14), (1.0, 2.0), 2.0),))
    grid, motion = Grid(SHAPE, (1.0, 1.0)), Motion(hold_edge=True, drawing=pull)
    study = Study(grid, Tissue(stiffness=np.ones(SHAPE)), motion)
    solution = solve_study(study, backend="cpu")
    path = write_study(tmp_path / "photo.study", study, solution)
    place = Geometry.of_itk(SHAPE, (0.5, 0.5), (7.0, 9.0), np.eye(2))
    write_image(tmp_path / "scan.mha", ImageFile(np.ones(SHAPE, np.uint8), place))
    observed = read_case(Case(tmp_path / "scan.mha", boundary=path)).motion.observed
    np.testing.assert_allclose(observed, 0.5 * solution.displacement, atol=1e-5)


def test_an_image_of_the_same_size_at_another_place_is_refused(files, capsys):
    folder, scan, *_ = files
    far = Geometry.of_itk(PLACE.shape, PLACE.spacing, (0.0, 0.0, 0.0), PLACE.direction)
    write_image(folder / "far.nii.gz", ImageFile(np.ones(scan.shape, np.uint8), far))
    with pytest.raises(ProblemError, match=r"far\.nii\.gz: is not in the same place as the image"):
        read_case(case(folder, labels=folder / "far.nii.gz"))
    write_field(folder / "f.mha", np.zeros((*scan.shape, 3)), **PLACE.as_itk)
    assert main(["apply", *(str(folder / each) for each in ("f.mha", "far.nii.gz"))]) == 1
    assert "far.nii.gz: is not in the same place as the field" in capsys.readouterr().err
    how = {"boundary": folder / "rim.png", "rules": folder / "r.csv"}
    saved = solve_case(case(folder, hold_edge=True, **how), folder / "out", backend="cpu")
    assert saved.study.grid.unit == "millimeter"
    labels = ImageFile(np.ones(SHAPE, np.uint8)[np.newaxis], far)
    write_image(folder / "flat.nrrd", labels)
    study = folder / "out" / "scan.study"
    assert main(["measure", str(study), "--labels", str(folder / "flat.nrrd")]) == 1
    assert "flat.nrrd: is not in the same place as the field" in capsys.readouterr().err


def test_labels_of_one_slice_fit_the_slice_at_their_own_place(files):
    folder, _, labels, _ = files
    place = PLACE.slice_at(1)
    write_image(folder / "own.nrrd", ImageFile(labels[np.newaxis], place))
    given = case(folder, labels=folder / "own.nrrd", hold_edge=True)
    np.testing.assert_array_equal(read_case(given).tissue.labels, labels)
    with pytest.raises(ProblemError, match=r"own\.nrrd: is not in the same place"):
        read_case(replace(given, slice=2))


def test_a_field_moves_a_sagittal_slice_of_a_volume(tmp_path):
    side = np.array(
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    )  # The directions of a sagittal scan.
    place = Geometry.of_itk((4, *SHAPE), (2.0, 0.5, 0.7), (3.0, 4.0, 5.0), side)
    write_image(tmp_path / "side.mha", ImageFile(np.ones((4, *SHAPE), np.uint8), place))
    d = np.zeros((4, *SHAPE, 3))
    d[..., 1], d[..., 2] = 1.0, -0.6
    write_field(tmp_path / "field.mha", d, **place.as_itk, forward=True)
    given = Case(tmp_path / "side.mha", slice=2, boundary=tmp_path / "field.mha")
    study = read_case(given)
    assert study.grid.place.spacing == pytest.approx(study.grid.spacing) == (0.5, 0.7)
    np.testing.assert_allclose(study.motion.observed, d[2, ..., 1:], atol=1e-6)


def test_edge_confidence_is_set_at_steps_of_the_image():
    image = np.zeros((40, 40), np.uint8)
    image[:, 20:] = 100
    assert set(np.flatnonzero(edge_confidence(image).any(axis=0))) == {18, 19, 20, 21}


def test_an_unsuitable_file_is_refused_by_name(files):
    folder, *_ = files
    write_image(folder / "small.png", ImageFile(np.ones((4, 5), np.uint8)))
    write_points(folder / "one.csv", np.ones((2, 2)))
    for more, name in (
        ({"slice": 3}, "scan.nii.gz"),
        ({"labels": folder / "small.png"}, "small.png"),
        ({"boundary": folder / "one.csv"}, "one.csv"),
    ):
        with pytest.raises(ProblemError) as refused:
            read_case(Case(**{"image": folder / "scan.nii.gz", "slice": 1, **more}))
        assert refused.value.field == name
