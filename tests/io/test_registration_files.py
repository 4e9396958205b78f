"""Registration of two image files in the shell: positions, tissue, masks, landmarks and outputs."""

import json
import sys

import numpy as np
import pytest
import scipy

from napari_hmrf import Monitor, cli, read_study, solve, warp
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.fields import read_field
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.landmarks import write_points

sitk = pytest.importorskip("SimpleITK")

SHAPE = (64, 72)


def texture(seed=0, shape=SHAPE, width=2.0):
    noise = np.random.default_rng(seed).normal(size=shape)
    image = scipy.ndimage.gaussian_filter(noise, width)
    return np.float32((image - image.min()) / np.ptp(image))


def bend(shape=SHAPE, size=2.0):
    """Return a smooth displacement in pixels that vanishes at the edges."""
    place = np.indices(shape) / np.reshape(np.array(shape) - 1, (-1, *(1,) * len(shape)))
    wave = np.prod(np.sin(np.pi * place), axis=0)
    return size * np.stack([wave * (-1) ** axis for axis in range(len(shape))], axis=-1)


def turn(degrees, axes=2):
    """Return a rotation in the plane of the first two axes."""
    angle, matrix = np.radians(degrees), np.eye(axes)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return matrix


def write(path, pixels, spacing=None, origin=None, direction=None):
    image = sitk.GetImageFromArray(pixels)
    n = image.GetDimension()
    image.SetSpacing(spacing or (1.0,) * n)
    image.SetOrigin(origin or (0.0,) * n)
    image.SetDirection((np.eye(n) if direction is None else direction).ravel().tolist())
    sitk.WriteImage(image, str(path))
    return image


def register(*arguments, out="out"):
    return cli.main(["register", *arguments, "-o", out])


def report(name="before"):
    with open(f"out/{name} registration.json", encoding="utf-8") as file:
        return json.load(file)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def pair(folder):
    """Write two images in millimetres, and return the true displacement in mm."""
    before, truth = texture(), bend()
    write("before.mha", before, (0.5, 0.8), (10.0, -5.0))
    write("after.mha", warp(before, truth, spacing=1), (0.5, 0.8), (10.0, -5.0))
    return truth * (0.8, 0.5)


INNER = slice(8, -8), slice(8, -8)


def test_simpleitk_moves_the_second_image_to_the_first_with_the_written_field(pair, capsys):
    assert register("before.mha", "after.mha") == 0
    said = capsys.readouterr().out
    assert "similarity" in said
    assert "0 folds" in said
    fixed, moving = (sitk.ReadImage(f"{name}.mha") for name in ("before", "after"))
    field = sitk.ReadImage("out/before to after field.mha", sitk.sitkVectorFloat64)
    moved = sitk.Resample(moving, fixed, sitk.DisplacementFieldTransform(field))
    ours = read_image("out/after registered.mha").pixels
    difference = sitk.GetArrayFromImage(moved) - ours
    assert np.abs(difference)[INNER].max() < 1e-3
    assert np.abs(ours - sitk.GetArrayFromImage(fixed))[INNER].mean() < 0.02
    written = report()
    assert written["similarity_before"] < 0.9 < written["similarity_after"]
    assert written["unit"] == "mm"
    # The study contains the motion, and is replayed.
    study, solution = read_study("out/before.study")
    assert np.linalg.norm(solution.displacement - pair, axis=-1)[INNER].mean() < 0.1
    assert study.motion.measured.record["second image"] == "after"
    assert cli.main(["replay", "out/before.study"]) == 0
    assert "identical" in (said := capsys.readouterr().out) or "within its tolerance" in said
    deformed = read_image("out/before deformed.mha").pixels
    after = read_image("after.mha").pixels
    assert np.abs(deformed - after)[INNER].mean() < 0.02
    jacobian = read_image("out/before jacobian.mha").pixels
    np.testing.assert_allclose(jacobian, solution.jacobian(), atol=0.01)


def test_different_grids_at_their_places_show_the_same_displacement():
    before, truth = texture(width=4), bend()
    write("before.mha", before, (1.0, 1.0), (3.0, 7.0))
    after = write("bent.mha", warp(before, truth, spacing=1), (1.0, 1.0), (3.0, 7.0))
    grid = sitk.Image((110, 120), sitk.sitkFloat32)  # turned, finer and farther out
    grid.SetSpacing((0.8, 0.7))
    grid.SetDirection(turn(10).ravel().tolist())
    grid.SetOrigin((10.0, -8.0))
    sitk.WriteImage(sitk.Resample(after, grid, sitk.Transform(), sitk.sitkBSpline), "after.mha")
    assert register("before.mha", "after.mha") == 0
    field = read_field("out/before to after field.mha").vectors
    assert np.linalg.norm(field - truth, axis=-1)[INNER].mean() < 0.2


def test_an_alignment_is_part_of_the_field_but_not_of_the_study():
    before = texture(3, width=4)
    image = write("before.mha", before)
    moved = sitk.Euler2DTransform((32.0, 32.0), np.radians(-6), (-4.0, 3.0))
    there = sitk.Resample(image, image, moved, sitk.sitkBSpline)
    transposed = np.array([[0.0, 1.0], [1.0, 0.0]])
    write("after.mha", sitk.GetArrayFromImage(there).T.copy(), direction=transposed)
    points = np.array([(28.0, 30.0), (36.0, 40.0)])  # row, col
    back = moved.GetInverse()
    targets = [back.TransformPoint(point[::-1].tolist()) for point in points]
    write_points("marks.csv", points, targets)  # the rows of the second file are along x
    assert register("before.mha", "after.mha", "--rigid", "--landmarks", "marks.csv") == 0
    field = sitk.ReadImage("out/before to after field.mha", sitk.sitkVectorFloat64)
    whole = sitk.DisplacementFieldTransform(field)
    for point in ((30.0, 25.0), (40.0, 36.0)):
        assert whole.TransformPoint(point) == pytest.approx(back.TransformPoint(point), abs=0.5)
    study, solution = read_study("out/before.study")
    assert np.abs(solution.displacement[20:-20, 20:-20]).max() < 1
    for mark in study.motion.drawing.marks:
        np.testing.assert_allclose(mark.target, mark.source, atol=0.5)
    assert report()["alignment"] == "rigid"


def test_a_volume_in_another_orientation_is_registered():
    shape = (28, 32, 36)
    before, truth = texture(1, shape), bend(shape, 1.5)
    image = write("before.nii.gz", before, (1.0, 1.0, 1.0), (5.0, 6.0, 7.0))
    bent = sitk.GetImageFromArray(warp(before, truth, spacing=1))
    bent.CopyInformation(image)
    sitk.WriteImage(sitk.DICOMOrient(bent, "PIR"), "after.nii.gz")
    assert register("before.nii.gz", "after.nii.gz") == 0
    found = read_study("out/before.study").solution.displacement
    inner = (slice(6, -6),) * 3
    assert np.linalg.norm(found - truth, axis=-1)[inner].mean() < 0.2
    sides = read_image("out/after registered.nii.gz").pixels - before
    assert np.abs(sides)[inner].mean() < 0.02


def test_bone_from_labels_stays_rigid_and_void_stays_in_place(pair, folder):
    labels = np.ones(SHAPE, np.uint8)
    labels[20:36, 24:40], labels[:6] = 2, 0
    write("labels.mha", labels, (0.5, 0.8), (10.0, -5.0))
    (folder / "tissue.csv").write_text(
        "label,name,stiffness,poisson\n0,air,0,\n1,soft,1,0.4\n2,bone,rigid,\n"
    )
    tissue = ("--labels", "labels.mha", "--materials", "tissue.csv")
    assert register("before.mha", "after.mha", *tissue) == 0
    field = read_field("out/before to after field.mha").vectors
    assert not field[:5].any()
    jacobian = read_image("out/before jacobian.mha").pixels
    assert np.abs(jacobian[22:34, 26:38] - 1).max() < 1e-4


def test_masks_exclude_pixels_of_each_image(pair):
    hole = np.ones(SHAPE, np.uint8)
    hole[25:37, 30:42] = 0
    around = scipy.ndimage.binary_dilation(hole == 0, iterations=5) & (hole > 0)
    before, after = (
        sitk.GetArrayFromImage(sitk.ReadImage(f"{n}.mha")) for n in ("before", "after")
    )
    place = (0.5, 0.8), (10.0, -5.0)
    write("mask.mha", hole, *place)

    def error(*options):
        assert register(*options, "--force") == 0
        found = read_study(f"out/{options[0].partition('.')[0]}.study").solution.displacement
        return np.linalg.norm(found - pair, axis=-1)[around].mean()

    write("damaged.mha", before * hole, *place)
    assert error("damaged.mha", "after.mha", "--mask", "mask.mha") < 0.2
    write("other.mha", after * hole, *place)
    assert error("before.mha", "other.mha", "--moving-mask", "mask.mha") < 0.2


def test_landmarks_in_the_units_of_both_images_move_tissue_without_contrast():
    before = np.where(np.indices(SHAPE)[1] < 36, texture(6), np.float32(0.5))
    write("before.mha", before, (0.5, 0.5), (4.0, 4.0))
    write("after.mha", before, (0.5, 0.5), (4.0, 4.0))
    points = np.array([(20.0, 54.0), (40.0, 54.0), (30.0, 62.0)])
    write_points("marks.csv", points / 2, (points + np.array((0, 3))) / 2)
    marks = ("--landmarks", "marks.csv", "--landmark-sd", "0.1")
    assert register("before.mha", "after.mha", *marks) == 0
    study, solution = read_study("out/before.study")
    np.testing.assert_allclose(solution.at(points), [(0, 1.5)] * 3, atol=0.3)
    assert [mark.sd for mark in study.motion.drawing.marks] == [0.1] * 3


def test_pictures_are_registered_in_pixels():
    before = np.uint8(255 * texture(width=3))
    write_image("before.png", ImageFile(before))
    write_image("after.png", ImageFile(np.uint8(warp(before, bend(), spacing=1))))
    assert register("before.png", "after.png") == 0
    assert report()["unit"] == "px"
    assert read_image("out/after registered.tif").pixels.dtype == np.uint8
    solution = read_study("out/before.study").solution
    assert np.linalg.norm(solution.displacement - bend(), axis=-1)[INNER].mean() < 0.2


def test_the_shell_reports_the_preparation_of_the_computer(pair, capsys, monkeypatch):
    def slowly(*problem, progress, **more):
        progress(Monitor(f"{PREPARING}: about 10 s left", 0.1))
        return solve(*problem, progress=progress, **more)

    monkeypatch.setattr("napari_hmrf.registration.matching.solve", slowly)
    assert register("before.mha", "after.mha") == 0
    assert capsys.readouterr().err.endswith(f"{PREPARING}: about 10 s left\n")


def test_a_larger_smoothness_leads_to_smaller_strains(pair):
    def largest_change(smoothness):
        assert register("before.mha", "after.mha", "--smoothness", smoothness, "--force") == 0
        return np.abs(read_image("out/before jacobian.mha").pixels - 1).max()

    assert largest_change("300") < 0.5 * largest_change("1")


#: Arguments after FIXED, by the file or option that the message names.
INVALID = {
    "volume.mha": "volume.mha",
    "flat.png": "flat.png",
    "level.mha": "level.mha",
    "--landmarks": "after.mha --landmark-sd 1",
    "zero.mha": "after.mha --mask zero.mha",
    "small.mha": "after.mha --moving-mask small.mha",
    "marks.csv": "after.mha --landmarks marks.csv",
    "grow.csv": "after.mha --labels labels.mha --materials grow.csv",
    "none.mha": "none.mha",
}


def test_invalid_input_is_refused_in_one_sentence_without_results(pair, folder, capsys):
    place = (0.5, 0.8), (10.0, -5.0)
    write("volume.mha", np.ones((8, 9, 10), np.uint8))
    write_image("flat.png", ImageFile(np.ones(SHAPE, np.uint8)))
    write("level.mha", np.ones(SHAPE, np.uint8), *place)
    write("zero.mha", np.zeros(SHAPE, np.uint8), *place)
    write("labels.mha", np.ones(SHAPE, np.uint8), *place)
    write("small.mha", np.ones((20, 24), np.uint8))
    write_points("marks.csv", [(900.0, 3.0)], [(3.0, 3.0)])
    (folder / "grow.csv").write_text("label,name,stiffness,poisson,growth\n1,a,1,0.3,0.1\n")
    for name, arguments in INVALID.items():
        assert register("before.mha", *arguments.split()) == 1
        said = capsys.readouterr().err
        assert name in said
        assert said.count("\n") == 1
    assert not list(folder.glob("out/*"))


def test_a_rigid_alignment_without_simpleitk_is_refused_before_any_work(
    folder, capsys, monkeypatch
):
    for name in ("before.png", "after.png"):
        write_image(name, ImageFile(np.uint8(255 * texture())))
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    assert register("before.png", "after.png", "--affine") == 1
    assert "--affine requires SimpleITK, which is not installed" in capsys.readouterr().err
    assert register("before.png", "after.png") == 0
    assert "before to after field.mha was not written" in capsys.readouterr().out
    assert (folder / "out" / "before.study").exists()
