"""Tests of field files: other tools and this package interpret them alike."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Image

from napari_hmrf import FileFormatError, HmrfError, Problem, ProblemError, solve
from napari_hmrf.cli import main
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.fields import count_folds, read_field, write_field
from napari_hmrf.io.fields import FIELD_SUFFIXES, export_field
from napari_hmrf.layers.slice_view import View, frame_of
from tests.support.exchanged_fields import PLACES, FieldCase, inside, transform_in

sitk = pytest.importorskip("SimpleITK")


@pytest.fixture(params=PLACES)
def case(request):
    return FieldCase(request.param)


def smooth(points):
    """Return a smooth picture, sampled at any points."""
    waves = (np.sin(0.21 * points[..., k] + k) for k in range(points.shape[-1]))
    return 100 * sum(waves)


@pytest.mark.parametrize("suffix", FIELD_SUFFIXES)
def test_simpleitk_moves_an_image_like_the_tissue(case, suffix, tmp_path):
    path = tmp_path / f"field{suffix}"
    assert case.write(path) < 0.02
    back = inverse_displacement(case.displacement, spacing=tuple(case.size)).displacement
    # An image of positions shows the origin of each resampled point.
    for axis in range(case.n):
        there = case.image(case.sites[..., axis])
        moved = sitk.Resample(there, there, transform_in(path), sitk.sitkLinear, np.nan)
        seen = np.squeeze(sitk.GetArrayFromImage(moved))
        expected = case.sites[..., axis] + back[..., axis] / case.size[axis]
        np.testing.assert_allclose(seen[inside(case)], expected[inside(case)], atol=2e-3)


def test_simpleitk_maps_each_point_to_the_origin_of_its_tissue(case, tmp_path):
    path = tmp_path / "field.mha"
    case.write(path)
    transform, here = transform_in(path), case.image(np.zeros(case.shape))
    for site in np.random.default_rng(1).integers(6, np.array(case.shape) - 6, (200, case.n)):
        goes_to = site + case.displacement[tuple(site)] / case.size
        index = [*goes_to[::-1], *[0.0] * (case.axes - case.n)]
        seen = transform.TransformPoint(here.TransformContinuousIndexToPhysicalPoint(index))
        came_from = here.TransformPhysicalPointToContinuousIndex(seen)[: case.n][::-1]
        np.testing.assert_allclose(came_from, site, atol=0.02)


@pytest.mark.parametrize("suffix", FIELD_SUFFIXES)
@pytest.mark.parametrize("forward", [False, True])
def test_a_forward_or_backward_field_is_read_in_the_direction_it_was_written(
    case, suffix, forward, tmp_path
):
    path = tmp_path / f"field{suffix}"
    if forward and suffix == ".h5":
        with pytest.raises(FileFormatError, match=r"field\.h5: this format does not store"):
            case.write(path, forward=True)
        assert not path.exists()
        return
    case.write(path, forward=forward)
    for told in (
        (False, True) if suffix != ".h5" else (False,)
    ):  # The direction stored in the file takes precedence.
        field = read_field(path, forward=told)
        read = field.displacement
        if case.axes > case.n:  # A slice of a volume; three slices in NIfTI.
            read = read[len(read) // 2, ..., 1:]
        away = np.abs(read - case.displacement) / case.size
        assert away[inside(case)].max() < (1e-4 if forward else 0.02)
        assert (field.residual == 0) == forward


@pytest.mark.parametrize("suffix", FIELD_SUFFIXES[:-1])
def test_a_forward_field_is_read_back_unchanged(case, suffix, tmp_path):
    path = tmp_path / f"field{suffix}"
    case.write(path, forward=True)
    field = read_field(path)
    read, size = field.displacement, case.size
    if case.axes > case.n:  # A slice of a volume; three slices in NIfTI.
        np.testing.assert_allclose(read[..., 0], 0, atol=1e-6)
        read = read[len(read) // 2, ..., 1:]
    np.testing.assert_allclose(read / size, case.displacement / size, atol=1e-4)
    np.testing.assert_allclose(field.spacing, case.spacing, rtol=1e-6)
    np.testing.assert_allclose(field.direction, case.direction, atol=1e-6)
    assert field.residual == 0


def test_a_backward_field_is_inverted_on_reading(case, tmp_path):
    path = tmp_path / "field.nrrd"
    case.write(path)
    field = read_field(path)
    read = field.displacement if case.axes == case.n else field.displacement[0, ..., 1:]
    away = np.abs(read - case.displacement) / case.size
    assert away[inside(case)].max() < 0.02
    assert field.residual < 0.02


def test_the_key_of_slicer_stores_the_direction_of_a_field(tmp_path):
    case = FieldCase("3-D")
    for forward, word in ((False, "resampling"), (True, "modeling")):
        path = tmp_path / f"{word}.nrrd"
        case.write(path, forward=forward)
        assert f"displacement field type:={word}".encode() in path.read_bytes()[:2000]
        read = read_field(path).displacement  # The stored direction applies without an argument.
        assert np.abs((read - case.displacement) / case.size)[inside(case)].max() < 0.02


def test_forward_after_inverse_is_the_identity(case):
    back, residual = inverse_displacement(case.displacement, spacing=tuple(case.size))
    again, _ = inverse_displacement(back, spacing=tuple(case.size))
    away = np.abs(again - case.displacement) / case.size
    assert residual < 0.01
    assert away[inside(case)].max() < 0.01


def test_a_gap_beside_static_tissue_is_interpolated_from_its_rim():
    shape, tissue = (12, 16), np.zeros((12, 16), bool)
    tissue[:, 4:12] = True
    d = np.zeros((*shape, 2))
    d[tissue, 1] = 2.0
    back, residual = inverse_displacement(d, spacing=(1.0, 1.0), tissue=tissue)
    assert np.isfinite(back).all()
    assert residual < 1e-6
    np.testing.assert_allclose(back[6, 7:13, 1], -2)  # The current position of the tissue.
    assert (back[6, :4] == 0).all()  # This part never moved.
    assert ((back[6, 4:6, 1] > -2) & (back[6, 4:6, 1] < 0)).all()


@pytest.mark.parametrize(
    ("name", "changes", "error", "sentence"),
    [
        (
            "field.txt",
            {},
            FileFormatError,
            r"field\.txt: fields cannot be written in this format\. Use",
        ),
        ("f.mha", {"displacement": np.zeros((4, 5))}, ProblemError, r"has shape \(4, 5\)\. Pass"),
        ("f.mha", {"displacement": np.zeros((4, 5, 3))}, ProblemError, r"has shape \(4, 5, 3\)"),
        ("f.mha", {"displacement": np.full((4, 5, 2), np.nan)}, ProblemError, "NaN or infinite"),
        (
            "f.mha",
            {"spacing": (1, 0)},
            ProblemError,
            r"spacing: is \(1, 0\)\. Pass positive lengths",
        ),
        ("f.mha", {"spacing": (1, 1, 1, 1)}, ProblemError, r"Pass 2 or 3 lengths"),
        ("f.mha", {"origin": (1, 2, 3)}, ProblemError, r"origin: is \(1, 2, 3\)\. Pass 2 lengths"),
        ("f.mha", {"direction": [[1, 1], [0, 1]]}, ProblemError, "Pass an orthogonal"),
    ],
)
def test_an_invalid_field_is_refused_in_one_sentence_and_no_file_is_written(
    tmp_path, name, changes, error, sentence
):
    given = {"displacement": np.zeros((4, 5, 2)), "spacing": (1, 1), **changes}
    with pytest.raises(error, match=sentence):
        write_field(tmp_path / name, given.pop("displacement"), **given)
    assert not list(tmp_path.iterdir())


def test_two_names_that_itk_confuses_are_refused_in_one_folder(tmp_path):
    d = np.zeros((4, 5, 2))
    write_field(tmp_path / "field.nii.gz", d, spacing=(1, 1))
    with pytest.raises(FileFormatError, match=r"field\.nii: field\.nii\.gz is in the same folder"):
        write_field(tmp_path / "field.nii", d, spacing=(1, 1))


def test_the_field_of_a_slice_lies_at_the_place_of_its_image_in_the_volume(tmp_path):
    turn = np.array([[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]])
    image = Image(
        np.zeros((6, 20, 24), np.uint8),
        scale=(0.3, 0.13, -0.07),
        rotate=turn,
        translate=(4, 5, 6),
        units=("cm", "cm", "cm"),
    )
    frame = frame_of(image, View((1, 2), tuple(image.data_to_world((2, 10, 10)))))
    y, c = np.zeros((2, 20, 24, 2))
    c[0] = c[-1] = 1
    y[-1, :, 1] = 0.1
    solution = solve(Problem(y, c, np.ones((20, 24)), spacing=frame.spacing), backend="cpu")
    path = tmp_path / "field.mha"
    export_field(path, replace(solution, frame=frame.as_dict()), forward=True)
    field = read_field(path, forward=True)
    np.testing.assert_allclose(
        field.displacement[0, ..., 1:], 10 * solution.displacement, atol=1e-9
    )
    file = sitk.ReadImage(str(path))
    for row, col in ((0, 0), (19, 3), (7, 23)):
        at = file.TransformIndexToPhysicalPoint((col, row, 0))
        np.testing.assert_allclose(at[::-1], 10 * np.array(image.data_to_world((2, row, col))))
        goes = np.array(file.GetPixel(col, row, 0))[::-1]
        by = solution.displacement[row, col] / frame.spacing
        to = image.data_to_world((2, row + by[0], col + by[1]))
        np.testing.assert_allclose(at[::-1] + goes, 10 * np.array(to), atol=1e-5)


def test_the_export_of_a_folded_field_reports_pixels_without_an_inverse(tmp_path, capsys):
    shape = (20, 24)
    d = np.zeros((*shape, 2))
    d[8:12, 8:12, 1] = 6.0  # A patch that is pushed through its neighbourhood.
    write_field(tmp_path / "folded.mha", d, spacing=(1, 1), forward=True)
    files = [str(tmp_path / name) for name in ("folded.mha", "back.mha")]
    assert main(["export", *files]) == 0
    folds = count_folds(d, spacing=1)
    assert folds > 5
    said = capsys.readouterr().out
    assert f"However, the tissue folds over itself at {folds} pixels, where no inverse" in said
    write_field(tmp_path / "folded.mha", d / 20, spacing=(1, 1), forward=True)
    assert main(["export", *files, "--force"]) == 0
    assert "folds" not in capsys.readouterr().out


def test_a_file_without_a_field_is_refused(tmp_path):
    path = tmp_path / "image.mha"
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((4, 5))), str(path))
    with pytest.raises(
        FileFormatError, match=r"image\.mha: not a displacement field: 2 axes require 2"
    ):
        read_field(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(FileFormatError, match=r"image\.mha: not a displacement field that can be"):
        read_field(path)
    with pytest.raises(FileNotFoundError, match=r"gone\.mha"):
        read_field(tmp_path / "gone.mha")


def test_an_error_without_simpleitk_names_the_package_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(HmrfError, match=r'pip install "\.\[medical\]"'):
        write_field(tmp_path / "field.mha", np.zeros((4, 5, 2)), spacing=(1, 1))
