"""Tests of files of volumes and of their displacement fields."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    FileFormatError,
    Grid,
    Material,
    Motion,
    Pictures,
    Problem,
    ProblemError,
    Study,
    Tissue,
    read_study,
    solve,
    warp,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.compute.compile_cache import loader
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.fields import is_study_file, read_field, write_movie
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.apply import apply_field, read_field_file
from napari_hmrf.io.fields import export_field, geometry_of
from napari_hmrf.io.figures import write_result_pictures
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.io.results import measured
from napari_hmrf.io.tables import write_measurements
from napari_hmrf.landmarks import read_points, write_points
from napari_hmrf.solver.solution import Solution

SHAPE = (16, 20, 18)
SIZE = (2.0, 1.3, 0.7)
ORIGIN = (-30.0, 12.0, 41.0)


def oblique():
    turn = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    return turn * np.sign(np.linalg.det(turn))


PLACE = Geometry.of_itk(SHAPE, SIZE, ORIGIN, oblique())


def smooth_image():
    deep, row, col = np.indices(SHAPE) / np.reshape(SHAPE, (3, 1, 1, 1))
    return (40 * np.sin(5 * deep + 3 * row) + 50 * np.cos(6 * col - 2 * row) + 100).astype(
        np.float32
    )


def tissue_in_air():
    """Return the mask of an ellipsoid of tissue in air."""
    away = (np.indices(SHAPE) - (np.reshape(SHAPE, (3, 1, 1, 1)) - 1) / 2) / np.reshape(
        SHAPE, (3, 1, 1, 1)
    )
    return (away**2).sum(axis=0) < 0.4**2


@pytest.fixture(scope="module")
def solution():
    """Return a solution in oblique space: one end is fixed, the other is pulled into the air."""
    tissue = tissue_in_air()
    rows = np.indices(SHAPE)[1]
    y, c = np.zeros((2, *SHAPE, 3))
    c[(rows < 5) | (rows > 14)] = 1
    y[rows > 14] = (1.5, 2.0, -0.6)
    problem = Problem(observed=y, confidence=c, stiffness=tissue.astype(float), spacing=SIZE)
    found = solve(problem, backend="cpu")
    return replace(found, frame=Frame.of_geometry(PLACE, volume=True).as_dict())


def moved(image, solution, **options):
    field = {"spacing": solution.spacing, "tissue": solution.tissue}
    return warp(image, solution.displacement, **field, **options)


def inner(tissue):
    """Return the mask of sites whose 26 neighbours are all tissue."""
    padded = np.pad(tissue, 1)
    return np.all(
        [
            padded[tuple(slice(1 + at, 1 + at + size) for at, size in zip(way, SHAPE, strict=True))]
            for way in np.ndindex(3, 3, 3)
            for way in [np.array(way) - 1]
        ],
        axis=0,
    )


def test_the_place_of_a_volume_is_the_place_of_its_frame(solution):
    found = geometry_of(solution)
    np.testing.assert_allclose(found.spacing, SIZE)
    np.testing.assert_allclose(found.origin, ORIGIN)
    np.testing.assert_allclose(found.direction, PLACE.direction, atol=1e-12)
    film = Frame.at((2.0, *SIZE), ("s", *("mm",) * 3), index=(1, 0, 0, 0), volume=True)
    assert geometry_of(replace(solution, frame=film.as_dict())).spacing == SIZE


def test_simpleitk_and_warp_move_a_volume_alike(solution, tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    path, image = tmp_path / "field.nrrd", smooth_image()
    residual = export_field(path, solution)
    assert residual < 0.05
    there = sitk.GetImageFromArray(image)
    there.SetSpacing(SIZE[::-1])
    there.SetOrigin(ORIGIN)
    there.SetDirection(PLACE.direction.ravel())
    transform = sitk.DisplacementFieldTransform(sitk.ReadImage(str(path), sitk.sitkVectorFloat64))
    seen = sitk.GetArrayFromImage(sitk.Resample(there, there, transform, sitk.sitkLinear))
    ours, ones = moved(image, solution), moved(solution.tissue.astype(float), solution)
    inside = inner(ones > 0.99)
    assert inside.sum() > 300
    # The image changes by at most 15 per voxel; tissue that moved into the air is compared too.
    assert np.abs(seen - ours)[inside].max() < 0.01
    assert (inside & ~solution.tissue).any()
    assert np.abs(ours - image)[inside].max() > 10


def test_the_field_of_a_volume_is_read_back_unchanged(solution, tmp_path):
    pytest.importorskip("SimpleITK")
    path = tmp_path / "field.nii.gz"
    assert export_field(path, solution, forward=True) == 0
    field = read_field(path)
    np.testing.assert_allclose(field.displacement, solution.displacement, atol=1e-4)
    np.testing.assert_allclose(field.spacing, SIZE, rtol=1e-6)
    np.testing.assert_allclose(field.direction, PLACE.direction, atol=1e-6)
    np.testing.assert_allclose(field.origin, ORIGIN, atol=1e-4)


@pytest.mark.parametrize("plane", [(0, 2, 1), (1, 2, 0)])
def test_the_place_of_a_field_does_not_depend_on_the_order_of_its_axes(solution, plane, tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    turned = replace(
        solution,
        displacement=solution.displacement.transpose(*plane, 3)[..., list(plane)],
        tissue=solution.tissue.transpose(plane),
        elasticity=None,
        spacing=tuple(SIZE[axis] for axis in plane),
        frame=replace(Frame.of_geometry(PLACE, volume=True), plane=plane).as_dict(),
    )
    first = sitk.DisplacementFieldTransform(field_image(sitk, solution, tmp_path / "a.mha"))
    other = sitk.DisplacementFieldTransform(field_image(sitk, turned, tmp_path / "b.mha"))
    index = np.random.default_rng(0).uniform(2, np.array(SHAPE) - 3, (30, 3))
    for at in PLACE.to_world(index)[:, ::-1]:
        np.testing.assert_allclose(
            first.TransformPoint(at.tolist()), other.TransformPoint(at.tolist()), atol=1e-5
        )


def field_image(sitk, solution, path):
    export_field(path, solution, forward=True)
    return sitk.ReadImage(str(path), sitk.sitkVectorFloat64)


def test_the_inverse_field_shows_tissue_that_moved_into_the_air(solution):
    tissue, size = solution.tissue, np.array(SIZE)
    back, residual = inverse_displacement(solution.displacement, spacing=SIZE, tissue=tissue)
    assert residual < 0.05
    came = moved(np.where(tissue, 1.0, 0.0), solution) > 0.99
    assert (came & ~tissue).sum() > 10
    origins = np.moveaxis(np.indices(SHAPE), 0, -1) + back / size
    there = moved(smooth_image(), solution)
    expected = there[came]
    looked = warp_by(smooth_image(), origins)[came]
    assert np.mean(np.abs(looked - expected) < 1.5) > 0.97
    far = ~came & ~tissue
    far[:, 3:] = False
    assert not back[far].any(), "air moved"


def warp_by(image, origins):
    from scipy.ndimage import map_coordinates

    return map_coordinates(image, np.moveaxis(origins, -1, 0), order=1, mode="nearest")


def test_images_labels_and_landmarks_move_with_the_result_of_a_volume(solution, tmp_path):
    pytest.importorskip("SimpleITK")
    solution.write(tmp_path / "result.npz")
    scan, labels = smooth_image(), (smooth_image() // 40).astype(np.uint8)
    colours = np.stack([labels, 2 * labels, 3 * labels], axis=-1)
    for name, pixels in {"scan": scan, "labels": labels, "colours": colours}.items():
        write_image(tmp_path / f"{name}.mha", ImageFile(pixels, PLACE, pixels.ndim > 3))
    out = str(tmp_path / "out")
    result = str(tmp_path / "result.npz")
    images = [str(tmp_path / f"{name}.mha") for name in ("scan", "colours")]
    at = np.array([[8.0, 15.0, 9.0], [7.5, 9.25, 8.5]])
    write_points(tmp_path / "voxels.csv", at)
    write_points(tmp_path / "patient.mrk.json", PLACE.to_world(at))
    points = [str(tmp_path / name) for name in ("voxels.csv", "patient.mrk.json")]
    assert main(["apply", result, *images, *points, "-o", out]) == 0
    assert main(["apply", result, str(tmp_path / "labels.mha"), "--labels", "-o", out]) == 0
    read = {
        name: read_image(tmp_path / f"out/{name}.mha") for name in ("scan", "labels", "colours")
    }
    np.testing.assert_array_equal(read["scan"].pixels, moved(scan, solution))
    np.testing.assert_array_equal(read["labels"].pixels, moved(labels, solution, order=0))
    np.testing.assert_array_equal(read["colours"].pixels, moved(colours, solution))
    np.testing.assert_allclose(read["scan"].geometry.origin, ORIGIN)
    goes = moved_points(at, solution.displacement, spacing=SIZE)
    assert np.abs(goes - at).max() > 1
    np.testing.assert_allclose(read_points(tmp_path / "out/voxels.csv").points, goes, atol=1e-6)
    there = read_points(tmp_path / "out/patient.mrk.json").points
    np.testing.assert_allclose(PLACE.to_pixels(there), goes, atol=1e-6)


@pytest.mark.parametrize("ready", [True, False])
def test_the_shell_reports_that_it_prepares_for_volumes(
    solution, ready, tmp_path, capsys, monkeypatch
):
    pytest.importorskip("SimpleITK")
    monkeypatch.setattr(loader, "is_cached", lambda loop: ready)
    solution.write(tmp_path / "result.npz")
    write_image(tmp_path / "scan.nii.gz", ImageFile(smooth_image(), geometry_of(solution)))
    command = ["apply", tmp_path / "result.npz", tmp_path / "scan.nii.gz", "-o", tmp_path / "out"]
    assert main([str(each) for each in command]) == 0
    said = capsys.readouterr().err
    assert said == ("" if ready else f"{PREPARING} ...\n")


def test_an_image_with_another_order_of_axes_is_reordered_to_the_result(solution, tmp_path):
    pytest.importorskip("SimpleITK")
    # The column axis is stored first, as by some scanners.
    turn = np.eye(3)[:, [1, 2, 0]]
    stored = ImageFile(smooth_image(), Geometry.of_itk(SHAPE, SIZE, ORIGIN, turn))
    assert stored.upright.pixels.shape != SHAPE
    write_image(tmp_path / "scan.mha", stored)
    order = [SHAPE.index(size) for size in stored.upright.pixels.shape]
    upright = replace(
        solution,
        displacement=solution.displacement.transpose(*order, 3)[..., order],
        tissue=solution.tissue.transpose(order),
        elasticity=solution.elasticity.mapped(lambda values: values.transpose(order)),
        spacing=stored.upright.geometry.spacing,
        frame=Frame.of_geometry(stored.upright.geometry, volume=True).as_dict(),
    )
    upright.write(tmp_path / "result.npz")
    field = read_field_file(tmp_path / "result.npz")
    apply_field(field, tmp_path / "scan.mha", tmp_path / "out.mha", labels=False)
    seen = read_image(tmp_path / "out.mha").upright
    np.testing.assert_allclose(
        seen.pixels, moved(smooth_image(), solution).transpose(order), atol=1e-4
    )
    labels = ImageFile(
        (smooth_image() > 100).astype(np.uint8), Geometry.of_itk(SHAPE, SIZE, ORIGIN, turn)
    )
    there = solution.tissue & (smooth_image() > 100)
    for axes in ((), (1,), (0, 2)):  # RAS and LPS differ by two reversed axes
        write_image(tmp_path / "labels.mha", labels.reversed_along(axes))
        rows = measured(tmp_path / "result.npz", tmp_path / "labels.mha").rows
        assert rows[1].pixels == there.sum()


def test_measurements_of_a_volume_are_named_for_voxels_and_volumes(solution, tmp_path):
    solution.write(tmp_path / "result.npz")
    write_image(tmp_path / "labels.tif", ImageFile(np.ones(SHAPE, np.uint8)))
    rows = measured(tmp_path / "result.npz", tmp_path / "labels.tif").rows
    path = write_measurements(tmp_path / "rows.csv", rows, "mm", volume=True)
    first, line = path.read_text().splitlines()
    assert first.startswith("label,name,voxels,volume,volume_change_percent,mean_displacement")
    voxels = solution.tissue.sum()
    assert line.startswith(f"1,,{voxels},{float(voxels * np.prod(SIZE))}"[:12])
    assert line.endswith(",mm")


def test_pictures_and_movies_of_a_volume_are_refused(solution, tmp_path):
    with pytest.raises(ProblemError, match="displacement: belongs to a volume"):
        write_result_pictures(tmp_path, solution, smooth_image())
    assert not list(tmp_path.iterdir())
    with pytest.raises(ProblemError, match="displacement: belongs to a volume"):
        write_movie(tmp_path / "a.gif", solution, smooth_image())


def make_study(solution, **changes):
    tissue = Tissue(labels=solution.tissue.astype(np.uint8), materials=(Material(1, "brain", 3.0),))
    c = np.zeros((*SHAPE, 3), np.float32)
    c[0] = 1
    observed = np.where(c > 0, 0.5, 0).astype(np.float32)
    colours = np.stack([(smooth_image() // 2).astype(np.uint8)] * 3, axis=-1)
    return Study(
        changes.get("grid", Grid(SHAPE, SIZE, "millimeter", Frame.of_geometry(PLACE, volume=True))),
        tissue,
        Motion(labels=tissue.labels.astype(np.int32), observed=observed, confidence=c),
        pictures=Pictures(colours, tissue.labels, "scan", "labels"),
    )


def test_a_study_of_a_volume_is_read_back_unchanged(solution, tmp_path):
    study = make_study(solution)
    path = write_study(tmp_path / "case", study, solution)
    assert is_study_file(path)
    saved = read_study(path)
    assert saved.study.grid == study.grid
    assert saved.study.grid.place.plane == (0, 1, 2)
    for one, other in (
        (saved.study.tissue.labels, study.tissue.labels),
        (saved.study.motion.observed, study.motion.observed),
        (saved.study.motion.confidence, study.motion.confidence),
        (saved.study.motion.labels, study.motion.labels),
        (saved.study.pictures.image, study.pictures.image),
        (saved.study.pictures.labels, study.pictures.labels),
        (saved.solution.displacement, solution.displacement),
    ):
        np.testing.assert_array_equal(one, other)
    assert saved.solution.place == study.grid.place
    field = read_field_file(path)
    np.testing.assert_array_equal(field.displacement, solution.displacement)
    np.testing.assert_allclose(field.geometry.direction, PLACE.direction, atol=1e-12)
    assert len(measured(path).rows) == 1


def test_a_volume_with_the_place_of_a_slice_is_refused(solution, tmp_path):
    with pytest.raises(ProblemError, match=r"has 3 axes, but its place has 2"):
        Grid(SHAPE, SIZE, "millimeter", Frame.of_geometry(PLACE, 3))
    odd = replace(solution, frame=Frame.of_geometry(PLACE, 3).as_dict())
    odd.write(tmp_path / "result.npz")
    with pytest.raises((FileFormatError, ValueError)):
        _ = Solution.read(tmp_path / "result.npz").place
