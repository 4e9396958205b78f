"""Pairs of images with a known deformation, checked with SimpleITK."""

from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pytest
from scipy.spatial import KDTree

from napari_hmrf import read_study, solve_study, warp
from napari_hmrf.augmentation import ground_truth
from napari_hmrf.cli import main
from napari_hmrf.errors import ArgumentError
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.case import Case, read_case
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.landmarks import read_points

sitk = pytest.importorskip("SimpleITK")

SHAPE = (40, 48)
TURN = np.array([[0.8, -0.6], [0.6, 0.8]])
PLACE = Geometry.of_itk(SHAPE, (0.5, 0.7), (-10.0, 20.0), TURN)


def blob(shape, at, radius):
    away = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) - at
    return np.linalg.norm(away, axis=-1) < radius


def smooth_image(shape):
    waves = np.prod([np.sin(np.arange(n) / 3) for n in shape[-1:]], axis=0)
    return (100 + 50 * waves + 5 * np.arange(shape[-2])[:, None]) * np.ones(shape)


def write_files(tmp_path):
    labels = np.ones(SHAPE, np.uint8)
    labels[blob(SHAPE, (20, 24), 7)] = 2
    write_image(tmp_path / "scan.mha", ImageFile(smooth_image(SHAPE).astype(np.float32), PLACE))
    write_image(tmp_path / "labels.png", ImageFile(labels))
    (tmp_path / "m.csv").write_text("label,name,stiffness\n1,brain,3\n2,bone,rigid\n")
    return tmp_path


@pytest.fixture
def files(tmp_path):
    return write_files(tmp_path)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Write a pair of images; return its folder and the output of the command."""
    folder = write_files(tmp_path_factory.mktemp("pair"))
    with redirect_stdout(StringIO()) as said:
        assert truth(folder, "--amplitude", 2, "--seed", 4) == 0
    return folder, said.getvalue()


def truth(folder, *more):
    arguments = [folder / "scan.mha", "--labels", folder / "labels.png", "--materials"]
    arguments += [folder / "m.csv", "-o", folder / "out", "--patches", 4, *more]
    return main(["truth", *map(str, arguments)])


def _in_space(image, at):
    """Return the place, in x, y, of a point in mm from the first pixel of an image."""
    return image.TransformContinuousIndexToPhysicalPoint(at[::-1] / image.GetSpacing())


def test_simpleitk_reproduces_the_deformed_image_from_the_written_field(pair):
    folder, said = pair
    out = folder / "out"
    assert "moved up to" in said
    assert "field.mha maps each pixel of deformed.mha to its origin" in said
    image = sitk.ReadImage(str(out / "image.mha"), sitk.sitkFloat64)
    deformed = sitk.ReadImage(str(out / "001" / "deformed.mha"), sitk.sitkFloat64)
    field = sitk.ReadImage(str(out / "001" / "field.mha"), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    seen = sitk.GetArrayFromImage(sitk.Resample(image, deformed, transform, sitk.sitkLinear))
    inner = np.s_[2:-2, 2:-2]
    off = np.abs(seen - sitk.GetArrayFromImage(deformed))[inner]
    moved = np.abs(sitk.GetArrayFromImage(image) - sitk.GetArrayFromImage(deformed))[inner]
    assert off.max() < 0.05 * moved.max()
    points = read_points(out / "001" / "landmarks.csv")
    begins, ends = (
        [_in_space(image, at) for at in each] for each in (points.points, points.targets)
    )
    back = [transform.TransformPoint(to) for to in ends]
    off = np.linalg.norm(np.array(back) - begins, axis=1)
    assert np.quantile(off, 0.9) < 0.005
    assert off.max() < 0.1, "larger errors are allowed only where the motion bends within a pixel"
    assert np.linalg.norm(points.targets - points.points, axis=1).max() > 0.5


def test_the_landmarks_of_a_pair_are_read_where_they_were_written(pair):
    out = pair[0] / "out"
    d, spacing = read_study(out / "001" / "truth.study")[1].displacement, PLACE.spacing
    case = Case(out / "image.mha", boundary=out / "001" / "landmarks.csv")
    marks = read_case(case).motion.drawing.marks
    sources, targets = (
        np.array([getattr(mark, end) for mark in marks]) for end in ("source", "target")
    )
    at = tuple(np.rint(sources).astype(int).T)
    np.testing.assert_allclose((targets - sources) * spacing, d[at], atol=1e-3)
    # No patch covers the tissue of another landmark.
    apart = KDTree(sources * spacing).query(sources * spacing, k=2)[0][:, 1]
    assert all(mark.radius <= part / 2 for mark, part in zip(marks, apart, strict=True))


def test_labels_move_with_the_image_and_the_saved_study_reproduces_the_field(pair, capsys):
    out = pair[0] / "out"
    study, solution = read_study(out / "001" / "truth.study")
    assert study.grid.unit == "millimeter"
    again = solve_study(study, backend="cpu").displacement
    assert (np.abs(again - solution.displacement) / solution.spacing).max() < 0.01
    capsys.readouterr()
    assert main(["replay", str(out / "001" / "truth.study")]) == 0
    said = capsys.readouterr().out
    assert "the same field within its tolerance" in said
    assert "the saved field was a sum of solutions" in said
    labels = read_image(out / "labels.mha").pixels
    moved = warp(labels, solution.displacement, spacing=solution.spacing, order=0)
    np.testing.assert_array_equal(read_image(out / "001" / "deformed_labels.mha").pixels, moved)


def test_pairs_differ_from_each_other_and_a_seed_reproduces_them(files):
    assert truth(files, "--count", 2, "--seed", 1) == 0
    first = [read_image(files / "out" / f"00{n}" / "deformed.mha").pixels for n in (1, 2)]
    assert not np.array_equal(*first)
    assert truth(files, "--count", 1, "--seed", 1, "--force") == 0
    again = read_image(files / "out" / "001" / "deformed.mha").pixels
    np.testing.assert_array_equal(again, first[0])


def test_paths_are_also_given_as_text(files):
    image, labels, table = (str(files / name) for name in ("scan.mha", "labels.png", "m.csv"))
    case = Case(image, labels=labels, materials=table)
    [written] = ground_truth.write_truth(case, str(files / "out"), patches=4, count=1.0)
    assert (written.folder, written.unit) == (files / "out" / "001", "millimeter")
    with pytest.raises(ArgumentError, match=r"^image must be the name of a file, not 3$"):
        Case(3)
    with pytest.raises(ArgumentError, match=r"^case must be a Case"):
        ground_truth.write_truth(str(files / "scan.mha"), files)


def test_a_forced_run_replaces_the_pairs_of_an_earlier_run(files, capsys):
    assert truth(files, "--count", 2) == 0
    out = files / "out"
    (out / "002" / "notes.txt").write_text("kept")
    assert truth(files) == 1
    assert "image.mha already exists (and 11 more)" in capsys.readouterr().err
    again = ["truth", str(out / "002" / "truth.study"), "-o", str(out), "--force"]
    assert main(again) == 1
    assert "truth.study is an input, but would be removed" in capsys.readouterr().err
    assert truth(files, "--force") == 0
    assert len([*(out / "001").iterdir()]) == 5
    assert sorted(path.name for path in out.iterdir()) == ["001", "002", "image.mha", "labels.mha"]
    assert [path.name for path in (out / "002").iterdir()] == ["notes.txt"]


def test_an_interrupted_run_leaves_no_part_of_a_pair(files, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    out = files / "out"
    monkeypatch.setattr(ground_truth, "write_study", interrupt)
    assert truth(files) == 130
    assert not [*out.iterdir()]
    monkeypatch.undo()
    assert truth(files, "--count", 2) == 0
    monkeypatch.setattr(ground_truth, "write_study", interrupt)
    assert truth(files, "--force") == 130
    assert len([*out.rglob("*.*")]) == 12, "the earlier run should be kept"


def test_a_volume_is_deformed(tmp_path):
    shape = (12, 14, 16)
    labels = np.ones(shape, np.uint8)
    labels[blob(shape, (6, 7, 8), 2.5)] = 2
    place = Geometry.of_itk(shape, (2.0, 0.5, 0.7), (-10.0, 20.0, 5.0), np.eye(3))
    write_image(tmp_path / "scan.mha", ImageFile(smooth_image(shape).astype(np.float32), place))
    write_image(tmp_path / "labels.mha", ImageFile(labels, place))
    (tmp_path / "m.csv").write_text("label,name,stiffness\n1,brain,3\n2,bone,rigid\n")
    arguments = ["truth", tmp_path / "scan.mha", "--labels", tmp_path / "labels.mha"]
    arguments += ["--materials", tmp_path / "m.csv", "-o", tmp_path / "out", "--patches", 1]
    assert main([*map(str, arguments), "--amplitude", "0.5"]) == 0
    field = sitk.ReadImage(str(tmp_path / "out" / "001" / "field.mha"))
    assert field.GetSize() == shape[::-1]
    assert 0.2 < np.abs(sitk.GetArrayFromImage(field)).max() < 0.51, (
        "the amplitude should be in mm, not in voxels"
    )


def test_the_field_of_a_volume_made_the_deformed_image_also_at_a_free_edge(tmp_path):
    shape = (14, 16, 18)
    place = Geometry.of_itk(shape, (2.0, 0.5, 0.7), (-10.0, 20.0, 5.0), np.eye(3))
    write_image(tmp_path / "scan.mha", ImageFile(smooth_image(shape).astype(np.float32), place))
    write_image(tmp_path / "labels.mha", ImageFile(np.ones(shape, np.uint8), place))
    (tmp_path / "m.csv").write_text("label,name,stiffness\n1,brain,3\n")
    arguments = ["truth", tmp_path / "scan.mha", "--labels", tmp_path / "labels.mha"]
    arguments += ["--materials", tmp_path / "m.csv", "-o", tmp_path / "out", "--patches", 4]
    assert main([*map(str, arguments), "--free-edge", "--weight", "0.01"]) == 0
    pair = tmp_path / "out" / "001"
    image, deformed = (
        sitk.ReadImage(tmp_path / "out" / "image.mha"),
        read_image(pair / "deformed.mha"),
    )
    field = sitk.ReadImage(pair / "field.mha", sitk.sitkVectorFloat64)
    covered = read_image(pair / "deformed_labels.mha").pixels > 0
    transform = sitk.DisplacementFieldTransform(field)
    seen = sitk.GetArrayFromImage(sitk.Resample(image, transform))
    np.testing.assert_allclose(seen[covered], deformed.pixels[covered], atol=1e-3)


@pytest.mark.parametrize("options", [(), ("--slice", "5")])
def test_a_truth_moves_its_landmarks_whatever_axes_the_scan_has(tmp_path, options):
    shape = (10, 12, 14)
    image = sitk.GetImageFromArray(smooth_image(shape).astype(np.float32))
    image.SetDirection((0, 0, 1, 1, 0, 0, 0, 1, 0))  # the slices of the file are sagittal
    image.SetSpacing((0.7, 0.9, 1.1))
    labels = sitk.GetImageFromArray(np.ones(shape, np.uint8))
    labels.CopyInformation(image)
    for name, each in (("scan", image), ("labels", labels)):
        sitk.WriteImage(each, str(tmp_path / f"{name}.nrrd"))
    (tmp_path / "m.csv").write_text("label,name,stiffness\n1,brain,3\n")
    arguments = [tmp_path / "scan.nrrd", "--labels", tmp_path / "labels.nrrd", *options]
    arguments += ["--materials", tmp_path / "m.csv", "-o", tmp_path / "out", "--patches", 1]
    assert main(["truth", *map(str, arguments), "--amplitude", "0.5"]) == 0
    pair = tmp_path / "out" / "001"
    arguments = pair / "truth.study", pair / "landmarks.csv", "-o", tmp_path / "moved"
    assert main(["apply", *map(str, arguments)]) == 0
    moved, before = read_points(tmp_path / "moved" / "landmarks.csv"), read_points(arguments[1])
    assert np.linalg.norm(moved.points - before.points, axis=1).max() > 0.05
    np.testing.assert_allclose(moved.points, moved.targets, atol=1e-4)


def test_a_png_image_keeps_its_pixel_type(files):
    picture = np.clip(smooth_image(SHAPE), 0, 255).astype(np.uint8)
    write_image(files / "scan.png", ImageFile(picture))
    arguments = ["truth", files / "scan.png", "--labels", files / "labels.png", "--materials"]
    arguments += [files / "m.csv", "-o", files / "out", "--patches", 1]
    assert main([*map(str, arguments)]) == 0
    assert read_image(files / "out" / "image.mha").pixels.dtype == np.uint8


def test_an_amplitude_that_is_neither_a_number_nor_a_range_is_rejected(files, capsys):
    with pytest.raises(SystemExit):
        truth(files, "--amplitude", "1-far")
    assert "a range such as 1-4" in capsys.readouterr().err


def test_a_sample_scaled_below_the_amplitude_is_reported_with_shell_options(files, caplog):
    assert truth(files, "--amplitude", "30-40") == 0
    (said,) = [each.getMessage() for each in caplog.records if "amplitude" in each.getMessage()]
    assert "Use a smaller amplitude or fewer patches (--amplitude, --patches)." in said
    assert "least_jacobian" not in said


def test_invalid_arguments_are_reported_before_any_solve(files, capsys):
    case = Case(files / "scan.mha", labels=files / "labels.png", materials=files / "m.csv")
    for name, least in (("count", 1), ("seed", 0)):
        with pytest.raises(
            ArgumentError, match=f"{name} must be a whole number of at least {least}, not -1"
        ):
            ground_truth.write_truth(case, files / "out", **{name: -1})
    assert truth(files, "--amplitude", -1) == 1
    (files / "m.csv").write_text("label,name,stiffness\n1,brain,3\n")
    assert truth(files) == 1
    said = capsys.readouterr().err
    assert "amplitude must be" in said
    assert "solved" not in said
    assert "without a material: 2" in said


def test_a_slice_of_a_volume_with_tissue_maps_keeps_its_position(tmp_path):
    shape = (5, *SHAPE)
    place = Geometry.of_itk(shape, (3.0, 0.5, 0.7), (-10.0, 20.0, 5.0), np.eye(3))
    second = np.broadcast_to(blob(SHAPE, (20, 24), 7), shape)
    maps = {"soft": 255 * ~second, "stiff": 255 * second}
    pictures = {"scan": smooth_image(shape).astype(np.float32)}
    pictures |= {name: pixels.astype(np.uint8) for name, pixels in maps.items()}
    for name, pixels in pictures.items():
        write_image(tmp_path / f"{name}.nii.gz", ImageFile(pixels, place))
    (tmp_path / "m.csv").write_text("label,name,stiffness\n0,air,0\n1,brain,3\n2,bone,rigid\n")
    arguments = [tmp_path / "scan.nii.gz", "--slice", 3, "--maps", tmp_path / "soft.nii.gz"]
    arguments += [tmp_path / "stiff.nii.gz", "--materials", tmp_path / "m.csv", "--patches", 1]
    out = tmp_path / "out"
    assert main(["truth", *map(str, arguments), "--weight", "0.01", "-o", str(out)]) == 0
    volume = sitk.ReadImage(str(tmp_path / "scan.nii.gz"))
    written = [sitk.ReadImage(str(out / name)) for name in ("image.mha", "001/field.mha")]
    for each in written:
        assert each.GetSize() == (SHAPE[1], SHAPE[0], 1)
        np.testing.assert_allclose(
            each.GetOrigin(), volume.TransformIndexToPhysicalPoint((0, 0, 3)), atol=1e-5
        )
    labels = sitk.GetArrayFromImage(sitk.ReadImage(str(out / "labels.mha")))[0]
    np.testing.assert_array_equal(labels, 1 + second[3])
    points = read_points(out / "001" / "landmarks.csv")
    assert not points.points[:, 0].any()  # BigWarp counts from the first pixel of the image
    motion = read_study(out / "001" / "truth.study").study.motion
    assert motion.weight
    assert motion.hold_edge


def test_a_study_file_with_labels_needs_no_other_input(pair, files, capsys):
    out = pair[0] / "out"
    saved = out / "001" / "truth.study"
    again = ["truth", str(saved), "-o", str(files / "again"), "--patches", "4", "--seed", "4"]
    assert main([*again, "--amplitude", "2"]) == 0
    first, second = (
        read_image(each / "001" / "deformed.mha").pixels for each in (out, files / "again")
    )
    np.testing.assert_array_equal(first, second)
    assert main([*again, "--free-edge", "--amplitude", "1.5-2", "--force"]) == 0
    drawn = read_study(files / "again" / "001" / "truth.study").study.motion.rules
    assert 1.5 <= max(np.linalg.norm(rule.vector) for rule in drawn) <= 2
    assert not read_study(files / "again" / "001" / "truth.study").study.motion.hold_edge
    assert main(["truth", str(files / "scan.mha"), "-o", str(files / "none")]) == 1
    assert "has no labels. Give --labels, or --maps" in capsys.readouterr().err
