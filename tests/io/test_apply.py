"""Tests of `apply`, which moves images, labels and landmarks with the tissue."""

import numpy as np
import pytest

from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    Motion,
    Pictures,
    ProblemError,
    Study,
    Tissue,
    solve_study,
    warp,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.apply import apply_field, read_field_file
from napari_hmrf.io.fields import write_field
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.landmarks import read_points, write_points
from tests.support.exchanged_fields import FieldCase

sitk = pytest.importorskip("SimpleITK")

SHAPE = (40, 48)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Write a study of a pulled photograph with its solution; return its path and the solution."""
    pull = Drawing((Arrow(at=(20, 22), by=(3.0, 5.0), radius=5),))
    photo = np.random.default_rng(2).integers(1, 255, (*SHAPE, 3), dtype=np.uint8)
    study = Study(
        Grid(SHAPE, (1.0, 1.0)),
        Tissue(stiffness=np.ones(SHAPE)),
        Motion(hold_edge=True, drawing=pull),
        pictures=Pictures(photo, name="photo"),
    )
    solution = solve_study(study, backend="cpu")
    return write_study(tmp_path_factory.mktemp("case") / "case", study, solution), solution


def field_arguments(solution):
    field = {"displacement": solution.displacement, "tissue": solution.tissue}
    return {**field, "spacing": solution.spacing}


def test_an_input_file_is_never_overwritten(solved, tmp_path):
    path, _ = solved
    write_image(tmp_path / "photo.png", ImageFile(np.full(SHAPE, 9, np.uint8)))
    before = (tmp_path / "photo.png").read_bytes()
    with pytest.raises(ProblemError, match="would be overwritten"):
        apply_field(
            read_field_file(path), tmp_path / "photo.png", tmp_path / "photo.png", labels=False
        )
    assert (tmp_path / "photo.png").read_bytes() == before


def test_images_labels_and_films_are_warped(solved, tmp_path, capsys):
    path, solution = solved
    dice = np.random.default_rng(1)
    photo = dice.integers(0, 255, (*SHAPE, 3), dtype=np.uint8)
    labels = dice.integers(0, 9, SHAPE, dtype=np.uint8)
    film = dice.integers(0, 255, (3, *SHAPE), dtype=np.uint16)
    write_image(tmp_path / "photo.png", ImageFile(photo, colours=True))
    write_image(tmp_path / "labels.png", ImageFile(labels))
    write_image(tmp_path / "film.tif", ImageFile(film))
    out = str(tmp_path / "out")
    files = [str(tmp_path / name) for name in ("photo.png", "film.tif")]
    assert main(["apply", str(path), *files, "-o", out]) == 0
    assert main(["apply", str(path), str(tmp_path / "labels.png"), "--labels", "-o", out]) == 0
    assert "blended" not in capsys.readouterr().out
    read = {name: read_image(tmp_path / "out" / name).pixels for name in ("photo.png", "film.tif")}
    np.testing.assert_array_equal(read["photo.png"], warp(photo, **field_arguments(solution)))
    for frame, before in zip(read["film.tif"], film, strict=True):
        np.testing.assert_array_equal(frame, warp(before, **field_arguments(solution)))
    moved = read_image(tmp_path / "out" / "labels.png").pixels
    np.testing.assert_array_equal(moved, warp(labels, order=0, **field_arguments(solution)))
    assert set(np.unique(moved)) <= set(np.unique(labels)) | {0}, "a new label appeared"


def test_labels_moved_as_an_image_cause_a_note(solved, tmp_path, capsys):
    path, _ = solved
    labels = np.random.default_rng(1).integers(0, 9, SHAPE, dtype=np.uint8)
    write_image(tmp_path / "labels.png", ImageFile(labels))
    files = str(tmp_path / "labels.png"), "-o", str(tmp_path / "out")
    assert main(["apply", str(path), *files]) == 0
    said = "note: labels.png contains only 9 whole numbers, up to 8, and was interpolated; if the"
    assert said in capsys.readouterr().out


def test_a_note_counts_pixels_that_are_nan_or_infinite(solved, tmp_path, capsys):
    path, _ = solved
    photo = np.ones(SHAPE, np.float32)
    photo[3, 4:7] = np.nan
    write_image(tmp_path / "mr.tif", ImageFile(photo))
    out = str(tmp_path / "out")
    assert main(["apply", str(path), str(tmp_path / "mr.tif"), "-o", out]) == 0
    said = capsys.readouterr().out
    assert "note: mr.tif is NaN or infinite at 3 pixels, and remains so where they move" in said
    assert np.isnan(read_image(tmp_path / "out" / "mr.tif").pixels).any()


def test_labels_that_are_no_whole_numbers_are_refused(solved, tmp_path):
    write_image(tmp_path / "seg.tif", ImageFile(np.full(SHAPE, 1.5, np.float32)))
    with pytest.raises(ProblemError, match=r"seg\.tif: have the value 1\.5"):
        apply_field(
            read_field_file(solved[0]), tmp_path / "seg.tif", tmp_path / "moved.tif", labels=True
        )
    assert not (tmp_path / "moved.tif").exists()


def test_landmarks_move_with_the_tissue(solved, tmp_path):
    path, solution = solved
    at = np.array([[20.0, 22.0], [10.5, 30.25]])
    write_points(tmp_path / "nose.csv", at)
    assert main(["apply", str(path), str(tmp_path / "nose.csv"), "-o", str(tmp_path / "o")]) == 0
    moved = read_points(tmp_path / "o/nose.csv").points
    np.testing.assert_allclose(moved[0], at[0] + solution.displacement[20, 22])
    np.testing.assert_allclose(
        moved, moved_points(at, solution.displacement, spacing=(1.0, 1.0)), atol=1e-9
    )


def test_a_note_counts_landmarks_outside_the_image(solved, tmp_path, capsys):
    path, _ = solved
    rows, cols = SHAPE
    corners = np.array([[-0.5, -0.5], [rows - 0.5, cols - 0.5], [rows, 3.0], [3.0, -1.0]])
    write_points(tmp_path / "nose.csv", corners)
    assert main(["apply", str(path), str(tmp_path / "nose.csv"), "-o", str(tmp_path / "o")]) == 0
    assert "note: 2 of 4 points are outside the image" in capsys.readouterr().out


def test_a_note_counts_landmarks_in_other_slices_which_do_not_move(tmp_path, capsys):
    case = FieldCase("slice")
    case.write(tmp_path / "back.mha")
    at = np.full((3, case.axes), 8.0)
    at[:, 0] = 0, 4, -0.4
    place = read_field_file(tmp_path / "back.mha").geometry
    write_points(tmp_path / "there.fcsv", place.to_world(at))
    before = read_points(tmp_path / "there.fcsv").points
    out = tmp_path / "o"
    files = [str(tmp_path / name) for name in ("back.mha", "there.fcsv")]
    assert main(["apply", *files, "-o", str(out)]) == 0
    steps = np.linalg.norm(read_points(out / "there.fcsv").points - before, axis=1)
    assert steps[1] < 1e-9
    assert (steps[[0, 2]] > 0.1).all()
    assert "1 of 3 points are in other slices" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["slice", "3-D"])
def test_points_move_as_in_simpleitk(name, tmp_path):
    case = FieldCase(name)
    case.write(tmp_path / "forth.mha", forward=True)
    case.write(tmp_path / "back.mha")
    transform = sitk.DisplacementFieldTransform(
        sitk.ReadImage(str(tmp_path / "forth.mha"), sitk.sitkVectorFloat64)
    )
    here = case.image(np.zeros(case.shape))
    index = np.random.default_rng(5).uniform(5, np.array(case.shape) - 6, (50, case.n))
    index = np.pad(index, ((0, 0), (case.axes - case.n, 0)))
    at = np.array(
        [here.TransformContinuousIndexToPhysicalPoint(each[::-1].tolist()) for each in index]
    )
    write_points(tmp_path / "a.mrk.json", at[:, ::-1])
    apply_field(
        read_field_file(tmp_path / "back.mha"),
        tmp_path / "a.mrk.json",
        tmp_path / "b.mrk.json",
        labels=False,
    )
    expected = np.array([transform.TransformPoint(point.tolist()) for point in at])
    moved = read_points(tmp_path / "b.mrk.json").points[:, ::-1]
    np.testing.assert_allclose(moved, expected, atol=0.02 * min(case.spacing))


def test_a_field_of_one_slice_moves_only_that_slice_of_a_volume(tmp_path):
    case = FieldCase("slice")
    case.write(tmp_path / "field.nrrd")
    values = np.random.default_rng(3).random((5, *case.shape)).astype(np.float32)
    first = np.array(case.origin) - 2 * case.direction[:, 2] * case.spacing[0]
    place = Geometry.of_itk(values.shape, case.spacing, tuple(first), case.direction)
    write_image(tmp_path / "scan.nii.gz", ImageFile(values, place))
    field = read_field_file(tmp_path / "field.nrrd")
    apply_field(field, tmp_path / "scan.nii.gz", tmp_path / "moved.nii.gz", labels=False)
    moved = read_image(tmp_path / "moved.nii.gz").pixels
    np.testing.assert_array_equal(moved[[0, 1, 3, 4]], values[[0, 1, 3, 4]])
    np.testing.assert_allclose(
        moved[2], warp(values[2], field.displacement, spacing=field.spacing), atol=0.01
    )
    elsewhere = Geometry.of_itk(values.shape, case.spacing, (0, 0, 0), case.direction)
    write_image(tmp_path / "other.nii.gz", ImageFile(values, elsewhere))
    with pytest.raises(
        ProblemError, match=r"other\.nii\.gz: has no slice at the place of the field"
    ):
        apply_field(field, tmp_path / "other.nii.gz", tmp_path / "moved.nii.gz", labels=False)


def test_a_volume_moves_as_in_simpleitk(tmp_path):
    case = FieldCase("3-D")
    case.write(tmp_path / "field.mha")
    values = np.random.default_rng(3).random(case.shape)
    place = Geometry.of_itk(values.shape, case.spacing, case.origin, case.direction)
    write_image(tmp_path / "scan.mha", ImageFile(values, place))
    transform = sitk.DisplacementFieldTransform(
        sitk.ReadImage(str(tmp_path / "field.mha"), sitk.sitkVectorFloat64)
    )
    scan = sitk.ReadImage(str(tmp_path / "scan.mha"))
    theirs = sitk.GetArrayFromImage(sitk.Resample(scan, scan, transform, sitk.sitkLinear))
    field = read_field_file(tmp_path / "field.mha")
    apply_field(field, tmp_path / "scan.mha", tmp_path / "moved.mha", labels=False)
    moved = read_image(tmp_path / "moved.mha").pixels
    inside = (slice(4, -4),) * 3
    assert np.abs(moved - theirs)[inside].max() < 0.02  # The noise has a slope of 1 per voxel.
    labels = np.random.default_rng(3).integers(0, 5, case.shape).astype(np.uint8)
    write_image(tmp_path / "labels.mha", ImageFile(labels, place))
    apply_field(field, tmp_path / "labels.mha", tmp_path / "moved.mha", labels=True)
    assert set(np.unique(read_image(tmp_path / "moved.mha").pixels)) <= set(range(5))


def test_a_failed_file_is_reported_and_the_other_files_are_moved(solved, tmp_path, capsys):
    path, _ = solved
    write_image(tmp_path / "small.png", ImageFile(np.zeros((4, 5), np.uint8)))
    write_image(tmp_path / "right.png", ImageFile(np.zeros(SHAPE, np.uint8)))
    files = [str(tmp_path / name) for name in ("small.png", "right.png")]
    assert main(["apply", str(path), *files, "-o", str(tmp_path / "out")]) == 1
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["right.png"]
    assert "small.png: is 4 x 5, but the field is 40 x 48" in capsys.readouterr().err


def test_two_files_with_the_same_name_and_a_field_as_image_are_refused(solved, tmp_path, capsys):
    path, _ = solved
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_image(tmp_path / folder / "x.png", ImageFile(np.zeros(SHAPE, np.uint8)))
    files = [str(tmp_path / folder / "x.png") for folder in ("a", "b")]
    assert main(["apply", str(path), *files, "-o", str(tmp_path / "out")]) == 1
    assert "x.png is the name of two files" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    for n in (2, 3):
        field = str(tmp_path / f"{n}.nrrd")
        write_field(field, np.zeros((*(6, 7, 8)[:n], n)), spacing=(1,) * n)
        assert main(["solve", field, "--hold-edge", "-o", str(tmp_path / "out")]) == 1
        assert (
            f"{n}.nrrd: the file contains a displacement field. Give an image"
            in capsys.readouterr().err
        )


def test_a_study_is_exported_replayed_and_read_again_in_the_shell(solved, tmp_path, capsys):
    path, solution = solved
    assert main(["export", str(path), str(tmp_path / "field.mha")]) == 0
    said = capsys.readouterr().out
    assert "the backward field, which moves images" in said
    assert "at the centres of the pixels that tissue moved to" in said
    assert "at the edge of the tissue, the error may be larger" in said
    again = read_field_file(tmp_path / "field.mha").displacement
    # The field is inverted twice, and the edge of a pulled patch limits the accuracy.
    assert np.abs(again - solution.displacement).max() < 0.2
    assert main(["replay", str(path)]) == 0
    assert "the fields are bit-for-bit identical" in capsys.readouterr().out


def test_fields_without_a_unit_are_written_in_pixels(tmp_path):
    write_field(tmp_path / "a.mha", np.ones((6, 7, 2)), spacing=(1, 1), forward=True)
    assert sitk.ReadImage(str(tmp_path / "a.mha")).GetSpacing() == (1.0, 1.0)


def test_files_without_a_place_have_the_axes_of_the_scan_and_napari_those_that_it_shows(tmp_path):
    def write(name, pixels):
        image = sitk.GetImageFromArray(pixels)
        image.SetDirection((0, 1, 0, 0, 0, 1, 1, 0, 0))  # i to S, j to L, k to P
        sitk.WriteImage(image, str(tmp_path / name))

    head = np.random.default_rng(0).random((7, 8, 9)).astype(np.float32)
    pulled = np.zeros(head.shape, np.uint8)
    pulled[3:5, 3:5, 4:6] = 1
    write("scan.mha", head)
    write("paint.mha", pulled)
    write_image(tmp_path / "scan.tif", ImageFile(head))
    (tmp_path / "rules.csv").write_text("label,action,plane,row,col\n1,move,1,0.5,0\n")
    write_points(tmp_path / "nose.csv", np.array([[4.0, 3.0, 3.0]]))  # in pixels, as by napari
    files = [str(tmp_path / name) for name in ("scan.mha", "paint.mha", "rules.csv", "o")]
    scan, paint, rules, out = files
    solve = ["solve", scan, "--boundary", paint, "--rules", rules, "--hold-edge", "-o", out]
    assert main(solve) == 0
    study = str(tmp_path / "o" / "scan.study")
    moving = [str(tmp_path / name) for name in ("scan.mha", "scan.tif", "nose.csv")]
    assert main(["apply", study, *moving, "-o", str(tmp_path / "moved")]) == 0
    shown, as_in_file, nose = (tmp_path / "moved" / name.rsplit("/", 1)[-1] for name in moving)
    upright = read_image(as_in_file).pixels.transpose(2, 0, 1)
    np.testing.assert_array_equal(read_image(shown).pixels, upright)
    np.testing.assert_allclose(read_points(nose).points, [[5.0, 3.5, 3.0]], atol=1e-3)
