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
from napari_hmrf.io.fields import export_field
from napari_hmrf.layers.slice_view import View, frame_of
from tests.support.exchanged_fields import FieldCase, inside, transform_in

sitk = pytest.importorskip("SimpleITK")

#: Places and formats, each of them once; a slice in NIfTI is stored as three slices.
FILES = [
    ("slice", ".nii.gz"),
    ("3-D", ".nii"),
    ("2-D", ".mha"),
    ("slice", ".nrrd"),
    ("3-D", ".h5"),
]


@pytest.mark.parametrize(("name", "suffix"), FILES)
def test_simpleitk_moves_an_image_like_the_tissue(name, suffix, tmp_path):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    assert case.write(path) < 0.02
    back = inverse_displacement(case.displacement, spacing=tuple(case.size)).displacement
    # An image of positions shows the origin of each resampled point.
    for axis in range(case.n):
        there = case.image(case.sites[..., axis])
        moved = sitk.Resample(there, there, transform_in(path), sitk.sitkLinear, np.nan)
        seen = np.squeeze(sitk.GetArrayFromImage(moved))
        expected = case.sites[..., axis] + back[..., axis] / case.size[axis]
        np.testing.assert_allclose(seen[inside(case)], expected[inside(case)], atol=2e-3)


@pytest.mark.parametrize(("name", "suffix"), FILES)
def test_a_forward_or_backward_field_is_read_in_the_direction_it_was_written(
    name, suffix, tmp_path
):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    for forward in (True, False):
        if forward and suffix == ".h5":
            with pytest.raises(FileFormatError, match=r"field\.h5: this format does not store"):
                case.write(path, forward=True)
            assert not path.exists()
            continue
        case.write(path, forward=forward)
        # The direction stored in the file takes precedence.
        field = read_field(path, forward=not forward and suffix != ".h5")
        read = field.displacement
        if case.axes > case.n:  # A slice of a volume; three slices in NIfTI.
            np.testing.assert_allclose(read[..., 0], 0, atol=1e-5)
            read = read[len(read) // 2, ..., 1:]
        away = np.abs(read - case.displacement) / case.size
        assert away[inside(case)].max() < (1e-4 if forward else 0.02)
        assert field.residual < (1e-12 if forward else 0.02)
        np.testing.assert_allclose(field.spacing, case.spacing, rtol=1e-6)
        np.testing.assert_allclose(field.direction, case.direction, atol=1e-6)


def test_the_key_of_slicer_stores_the_direction_of_a_field(tmp_path):
    for forward, word in ((False, "resampling"), (True, "modeling")):
        path = tmp_path / f"{word}.nrrd"
        write_field(path, np.zeros((4, 5, 2)), spacing=(1, 1), forward=forward)
        assert f"displacement field type:={word}".encode() in path.read_bytes()[:2000]


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


def test_an_invalid_field_is_refused_and_no_file_is_written(tmp_path):
    zeros = np.zeros((4, 5, 2))
    for changes in (
        {"displacement": np.zeros((4, 5))},
        {"displacement": np.zeros((4, 5, 3))},
        {"displacement": np.full((4, 5, 2), np.nan)},
        {"spacing": (1, 0)},
        {"spacing": (1, 1, 1, 1)},
        {"origin": (1, 2, 3)},
        {"direction": [[1, 1], [0, 1]]},
    ):
        (field,) = changes
        with pytest.raises(ProblemError) as refused:
            write_field(tmp_path / "f.mha", **{"displacement": zeros, "spacing": (1, 1), **changes})
        assert refused.value.field == field
    with pytest.raises(FileFormatError, match=r"field\.txt"):
        write_field(tmp_path / "field.txt", zeros, spacing=(1, 1))
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
    solution = solve(
        Problem(observed=y, confidence=c, stiffness=np.ones((20, 24)), spacing=frame.spacing),
        backend="cpu",
    )
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
