"""Tests of volumes that are solved from files in the shell."""

import numpy as np
import pytest

from napari_hmrf import BoundaryRule, ElasticPrior, ProblemError, read_study, solve
from napari_hmrf.cli import main
from napari_hmrf.data import head_phantom
from napari_hmrf.field.frame import PATIENT_AXES
from napari_hmrf.fields import write_field
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.fields import geometry_of
from napari_hmrf.io.images import ImageFile, read_image, write_image
from napari_hmrf.io.tables import read_rules
from napari_hmrf.landmarks import write_points
from napari_hmrf.study.ground import build_problem

sitk = pytest.importorskip("SimpleITK")

MATERIALS = (
    "label,name,stiffness,poisson\n0,outside,0,\n1,brain,1,\n2,ventricles,0.1,\n3,tumour,4,\n"
)
RULES = "label,action,amount,name\n1,fixed,,skull\n2,expand,6,tumour rim\n"
#: Directions of a sagittal scan: the first axis points left, and rows point to the feet.
SIDEWAYS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.fixture(scope="module")
def head():
    return head_phantom(38, growth=6.0)


@pytest.fixture(scope="module")
def files(head, tmp_path_factory):
    """Write a head with its labels in axial and in sagittal order, and its tables."""
    folder = tmp_path_factory.mktemp("head")
    shape = head.image.shape
    place = Geometry.of_itk(shape, head.spacing, (-70.0, -90.0, -70.0), np.eye(3))
    from_side = shape[2], shape[0], shape[1]
    turned = Geometry.of_itk(from_side, head.spacing, (-70.0, -90.0, 66.0), SIDEWAYS)
    images = {"t1": head.image, "labels": head.tissue_labels, "rim": head.boundary_labels}
    for name, pixels in images.items():
        write_image(folder / f"{name}.nii.gz", ImageFile(pixels, place))
        from_side = pixels[::-1].transpose(2, 0, 1)
        write_image(folder / f"{name}-side.mha", ImageFile(from_side, turned))
    (folder / "m.csv").write_text(MATERIALS)
    (folder / "r.csv").write_text(RULES)
    return folder


def solved(folder, out, *more, image="t1.nii.gz"):
    command = ["solve", folder / image, "-o", out, "--backend", "cpu", *more]
    assert main([str(each) for each in command]) == 0
    return read_study(out / f"{image.partition('.')[0]}.study")


@pytest.fixture(scope="module")
def grown(files):
    given = ("--labels", files / "labels.nii.gz", "--materials", files / "m.csv")
    rim = ("--boundary", files / "rim.nii.gz", "--rules", files / "r.csv")
    return files / "out", solved(files, files / "out", *given, *rim)


def test_the_shell_and_python_give_the_same_field_of_a_volume(head, grown):
    out, (study, solution) = grown
    problem = build_problem(study).problem
    for name in ("observed", "confidence", "stiffness"):
        found, expected = getattr(problem, name), getattr(head.problem, name)
        np.testing.assert_allclose(found, expected, atol=1e-4)
    d = solve(head.problem, ElasticPrior(0.45), backend="cpu").displacement
    np.testing.assert_allclose(solution.displacement, d, atol=0.01 * head.spacing[0])
    assert study.grid.unit == "millimeter"
    assert study.grid.place.plane == (0, 1, 2)
    assert study.grid.place.axis_labels == tuple(PATIENT_AXES)
    seen = read_image(out / "t1 deformed.nii.gz")
    assert seen.pixels.shape == head.image.shape
    assert (seen.pixels != head.image).any()
    np.testing.assert_allclose(seen.geometry.origin, (-70, -90, -70))


def test_the_result_of_a_volume_is_replayed_exported_applied_and_measured(grown, files, capsys):
    out, (_, solution) = grown
    study = str(out / "t1.study")
    assert main(["replay", study]) == 0
    assert "the fields are bit-for-bit identical" in capsys.readouterr().out
    assert main(["export", study, str(out / "field.mha")]) == 0
    field = sitk.ReadImage(str(out / "field.mha"))
    volume = sitk.ReadImage(str(files / "t1.nii.gz"))
    assert field.GetSize() == volume.GetSize()
    np.testing.assert_allclose(field.GetOrigin(), volume.GetOrigin(), atol=1e-4)
    tumour = str(files / "labels.nii.gz")
    assert main(["apply", study, tumour, "--labels", "-o", str(out / "moved")]) == 0
    before, after = (read_image(each).pixels == 3 for each in (tumour, out / "moved/labels.nii.gz"))
    assert 1.3 * before.sum() < after.sum() < 1.3**3 * before.sum()
    table = out / "measured.csv"
    assert main(["measure", study, "-o", str(table)]) == 0
    assert "volume_change" in capsys.readouterr().out
    titles, *rows = table.read_text().splitlines()
    assert titles.split(",")[2:5] == ["voxels", "volume", "volume_change_percent"]
    assert [row.split(",")[1] for row in rows] == ["brain", "ventricles", "tumour"]
    assert float(rows[2].split(",")[4]) > 20
    assert solution.tissue.any()


def test_a_sagittal_volume_is_reordered_together_with_its_labels(grown, files):
    _, (_, expected) = grown
    given = ("--labels", files / "labels-side.mha", "--materials", files / "m.csv")
    rim = ("--boundary", files / "rim-side.mha", "--rules", files / "r.csv")
    study, solution = solved(files, files / "side", *given, *rim, image="t1-side.mha")
    assert study.grid.place.axis_labels == tuple(PATIENT_AXES)
    # Its first axis points to the feet.
    d = solution.displacement[::-1] * (-1, 1, 1)
    far = np.linalg.norm(d - expected.displacement, axis=-1)
    assert far.max() < 0.5, "the fields differ by more than the choice between equally near normals"
    assert far.mean() < 0.005
    assert geometry_of(solution).origin == pytest.approx((-70, -90, 66))


def test_maps_and_labels_without_a_place_have_the_voxels_of_the_image(files, head):
    bare = head.tissue_labels[::-1].transpose(2, 0, 1)
    write_image(files / "bare.tif", ImageFile(bare))
    case = Case(files / "t1-side.mha", labels=files / "bare.tif", hold_edge=True)
    np.testing.assert_array_equal(read_case(case).tissue.labels, head.tissue_labels[::-1])
    maps = [files / f"map{label}.mha" for label in (1, 3)]
    place = read_image(files / "t1.nii.gz").geometry
    for path, label in zip(maps, (1, 3), strict=True):
        likely = (head.tissue_labels == label).astype(np.float32)
        write_image(path, ImageFile(likely, place))
    found = read_case(Case(files / "t1.nii.gz", maps=maps, hold_edge=True)).tissue.labels
    assert (found == 2)[head.tissue_labels == 3].all()
    assert not found[head.tissue_labels == 0].any()


@pytest.mark.parametrize("image", ["t1.nii.gz", "t1-side.mha"])
def test_landmarks_in_physical_units_move_tissue_between_slices(files, image):
    where, should = [[0.0, 10.0, 20.0]], [[8.0, 10.0, 16.0]]
    write_points(files / "pairs.csv", where, should)
    volume = read_image(files / image)
    study = read_case(Case(files / image, boundary=files / "pairs.csv", hold_edge=True))
    (mark,) = study.motion.drawing.marks
    # BigWarp's points are in the unit of the image, relative to the first voxel, in file axes.
    first = volume.geometry.to_world(np.array(where) / volume.geometry.spacing)
    last = volume.geometry.to_world(np.array(should) / volume.geometry.spacing)
    upright = volume.upright.geometry
    np.testing.assert_allclose([mark.source], upright.to_pixels(first), atol=1e-6)
    np.testing.assert_allclose([mark.target], upright.to_pixels(last), atol=1e-6)


def test_a_field_is_observed_in_a_whole_volume_or_at_its_edges(files, head):
    d = np.zeros((*head.image.shape, 3))
    d[..., 0] = 1.5
    place = read_image(files / "t1.nii.gz").geometry
    write_field(files / "field.mha", d, **place.as_itk, forward=True)
    back = files / "back.nii.gz"
    write_field(back, d, **place.as_itk)
    study = read_case(Case(files / "t1.nii.gz", boundary=back))
    known = study.motion.confidence > 0
    assert known.mean() > 0.7
    inside = np.s_[4:-4, 4:-4, 4:-4]
    np.testing.assert_allclose(study.motion.observed[inside][..., 0], 1.5, atol=0.05)
    edges = read_case(Case(files / "t1.nii.gz", boundary=back, confidence="edges"))
    assert 0.05 < edges.motion.confidence.mean() < 0.15
    mask = Case(files / "t1.nii.gz", boundary=back, confidence=files / "labels.nii.gz")
    assert not read_case(mask).motion.confidence[0].any()


def test_a_rule_may_move_tissue_between_the_planes_of_a_volume(tmp_path):
    (tmp_path / "r.csv").write_text("label,action,plane,row,col\n1,move,2,1,-1\n2,fixed,,,\n")
    assert read_rules(tmp_path / "r.csv") == (
        BoundaryRule(1, "move", vector=(2.0, 1.0, -1.0)),
        BoundaryRule(2, "fixed"),
    )


def test_a_stack_without_a_place_is_a_volume_in_voxels(tmp_path):
    stack = np.random.default_rng(0).integers(100, 200, (6, 8, 9), dtype=np.uint8)
    write_image(tmp_path / "stack.tif", ImageFile(stack))
    seen = np.zeros(stack.shape, np.uint8)
    seen[2:4, 3:5, 3:5] = 1
    write_image(tmp_path / "seen.tif", ImageFile(seen))
    (tmp_path / "r.csv").write_text("label,action,row,col\n1,move,0.2,0\n")
    how = ["--boundary", tmp_path / "seen.tif", "--rules", tmp_path / "r.csv", "--hold-edge"]
    study, solution = solved(tmp_path, tmp_path / "out", *how, image="stack.tif")
    assert study.grid.unit == "pixel"
    assert solution.displacement.shape == (6, 8, 9, 3)
    assert read_image(tmp_path / "out" / "stack deformed.tif").pixels.shape == (6, 8, 9)


def test_the_paper_model_of_a_volume_reports_unconnected_tissue(tmp_path, capsys):
    labels, seen = np.zeros((5, 12, 14), np.uint8), np.zeros((5, 12, 14), np.uint8)
    labels[:, :, :6], labels[:, :, 8:] = 1, 1
    seen[:, :3, :6], seen[:, -3:, :6] = 1, 2
    for name, pixels in (("labels", labels), ("seen", seen)):
        write_image(tmp_path / f"{name}.tif", ImageFile(pixels))
    (tmp_path / "m.csv").write_text("label,stiffness\n0,0\n1,3\n")
    (tmp_path / "r.csv").write_text("label,action,row,col\n1,fixed,,\n2,move,0.5,0\n")
    options = ["--labels", tmp_path / "labels.tif", "--materials", tmp_path / "m.csv"]
    options += ["--boundary", tmp_path / "seen.tif", "--rules", tmp_path / "r.csv"]
    solved(tmp_path, tmp_path / "out", *options, "--model", "paper", image="labels.tif")
    assert "note: a piece of tissue touches no boundary (360 voxels)" in capsys.readouterr().out


def test_an_image_at_another_place_or_of_another_size_is_refused_by_name(files, head):
    place = Geometry.at_origin(head.image.shape, head.spacing, "millimeter")
    write_image(files / "far.mha", ImageFile(head.tissue_labels, place))
    with pytest.raises(ProblemError, match=r"far\.mha: is not in the same place as the image"):
        read_case(Case(files / "t1.nii.gz", labels=files / "far.mha"))
    write_image(files / "small.mha", ImageFile(head.tissue_labels[1:], place))
    with pytest.raises(ProblemError, match=r"small\.mha: is 29 x 38 x 30, but the image is 30 x"):
        read_case(Case(files / "t1.nii.gz", labels=files / "small.mha"))


def test_labels_with_reversed_axes_are_laid_as_the_image(files, head):
    place = read_image(files / "t1.nii.gz").geometry
    labels = ImageFile(head.tissue_labels, place).reversed_along((1, 2))
    write_image(files / "turned.nii.gz", labels)
    case = Case(files / "t1.nii.gz", labels=files / "turned.nii.gz", hold_edge=True)
    np.testing.assert_array_equal(read_case(case).tissue.labels, head.tissue_labels)
