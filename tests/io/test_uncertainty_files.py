"""Tests of images of the uncertainty."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import FileFormatError, Grid, Material, Motion, ProblemError, Study, Tissue
from napari_hmrf.fields import export_field, grid_of_image, read_field, write_uncertainty
from napari_hmrf.io.images import read_image
from napari_hmrf.posterior import study_uncertainty

sitk = pytest.importorskip("SimpleITK")


def scan():
    """Return an oblique volume with oblong voxels."""
    image = sitk.GetImageFromArray(np.ones((6, 10, 12), np.float32))
    image.SetSpacing((1.0, 1.5, 2.0))
    image.SetOrigin((10.0, -20.0, 5.0))
    turn = np.deg2rad(20)
    image.SetDirection((np.cos(turn), -np.sin(turn), 0, np.sin(turn), np.cos(turn), 0, 0, 0, 1))
    return image


def estimated(grid):
    materials = (Material(1, "brain", 1.0, growth=0.1),)
    tissue = Tissue(labels=np.ones(grid.shape, int), materials=materials)
    return study_uncertainty(Study(grid, tissue, Motion(hold_edge=True)), n=2, backend="cpu")


@pytest.mark.parametrize("slice_index", [None, 3])
def test_the_images_have_the_place_of_the_exported_displacement(tmp_path, slice_index):
    grid = grid_of_image(scan(), slice=slice_index)
    result = estimated(grid)
    paths = write_uncertainty(tmp_path / "sd.nii.gz", result)
    axes = ("plane", "row", "col")[-len(grid.shape) :]
    assert [path.name for path in paths] == ["sd.nii.gz", *(f"sd-{axis}.nii.gz" for axis in axes)]
    export_field(tmp_path / "field.mha", result.solution, forward=True)
    field = read_field(tmp_path / "field.mha")
    for path, values in zip(paths, (result.along, *np.moveaxis(result.sd, -1, 0)), strict=True):
        image = read_image(path)
        np.testing.assert_allclose(image.pixels, values, rtol=1e-6)
        np.testing.assert_allclose(image.geometry.spacing, field.spacing, rtol=1e-6)
        np.testing.assert_allclose(image.geometry.origin, field.origin, atol=1e-4)
        np.testing.assert_allclose(image.geometry.direction, field.direction, atol=1e-6)


def test_values_are_in_mm_and_images_without_a_place_are_pictures_or_at_the_origin(tmp_path):
    result = estimated(Grid((8, 9), (0.1, 0.1), "cm"))
    with pytest.raises(ProblemError, match="has no position in world coordinates"):
        write_uncertainty(tmp_path / "sd.nrrd", result)
    write_uncertainty(tmp_path / "sd.nrrd", result, placed=False)
    image = read_image(tmp_path / "sd.nrrd")
    np.testing.assert_allclose(image.pixels, 10 * result.along, rtol=1e-6)
    np.testing.assert_allclose(image.geometry.spacing, 1.0)
    write_uncertainty(tmp_path / "sd.tif", result)
    np.testing.assert_array_equal(read_image(tmp_path / "sd.tif").pixels, result.along)
    np.testing.assert_array_equal(read_image(tmp_path / "sd-col.tif").pixels, result.sd[..., 1])


def test_formats_that_cannot_store_standard_deviations_are_refused(tmp_path):
    result = estimated(Grid((8, 9), (1, 1), "mm"))
    with pytest.raises(FileFormatError, match="Use one of the suffixes"):
        write_uncertainty(tmp_path / "sd.png", result)
    with pytest.raises(ProblemError, match="n: is 0"):
        write_uncertainty(tmp_path / "sd.tif", replace(result, n=0))
    assert list(tmp_path.iterdir()) == []
