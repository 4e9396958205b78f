"""Tests of exchanged fields with transformix, run if itk-elastix is installed."""

import numpy as np
import pytest

from napari_hmrf.field.inverse_field import inverse_displacement
from tests.support.exchanged_fields import PLACES, FieldCase, check_field_file, inside, sitk

itk = pytest.importorskip("itk")
if not hasattr(itk, "TransformixFilter"):
    pytest.skip("itk is installed without elastix", allow_module_level=True)


def transformix(case, field, image, folder, suffix="mha"):
    """Move an image by a file of vectors, write the field of that motion and return the image."""
    size = [str(count) for count in (*case.shape[::-1], 1)[: case.axes]]
    parameters = itk.ParameterObject.New()
    parameters.AddParameterMap(
        {
            "Transform": ["DeformationFieldTransform"],
            "DeformationFieldFileName": [str(field)],
            "DeformationFieldInterpolationOrder": ["1"],
            "NumberOfParameters": ["0"],
            "InitialTransformParameterFileName": ["NoInitialTransform"],
            "HowToCombineTransforms": ["Compose"],
            "FixedImageDimension": [str(case.axes)],
            "MovingImageDimension": [str(case.axes)],
            "FixedInternalImagePixelType": ["float"],
            "MovingInternalImagePixelType": ["float"],
            "Size": size,
            "Index": ["0"] * case.axes,
            "Spacing": [repr(float(each)) for each in case.spacing[::-1]],
            "Origin": [repr(float(each)) for each in case.origin],
            "Direction": [repr(float(each)) for each in case.direction.T.ravel()],
            "UseDirectionCosines": ["true"],
            "ResampleInterpolator": ["FinalLinearInterpolator"],
            "Resampler": ["DefaultResampler"],
            "DefaultPixelValue": ["-1"],
            "ResultImageFormat": [suffix],
            "ResultImagePixelType": ["float"],
        }
    )
    filter_ = itk.TransformixFilter.New(itk.imread(str(image), itk.F))
    filter_.SetTransformParameterObject(parameters)
    filter_.SetComputeDeformationField(True)
    filter_.SetOutputDirectory(str(folder))
    filter_.SetLogToConsole(False)
    filter_.Update()
    return np.squeeze(itk.array_from_image(filter_.GetOutput()))


def picture(case, axis, folder):
    """Write an image of the position of each pixel along an axis, and return its path."""
    path = folder / f"picture-{axis}.mha"
    sitk.WriteImage(case.image(case.sites[..., axis].astype(np.float32)), str(path))
    return path


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "mha", "nrrd"])
@pytest.mark.parametrize("name", PLACES)
def test_a_deformation_field_written_by_transformix_is_read(name, suffix, tmp_path):
    case, field = FieldCase(name), tmp_path / "given.mha"
    sitk.WriteImage(case.vectors(np.float32), str(field))
    transformix(case, field, picture(case, 0, tmp_path), tmp_path, suffix)
    check_field_file(case, tmp_path / f"deformationField.{suffix}")


@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".nrrd"])
@pytest.mark.parametrize("name", PLACES)
def test_transformix_moves_an_image_like_the_tissue(name, suffix, tmp_path):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    case.write(path)
    back = inverse_displacement(case.displacement, spacing=tuple(case.size)).displacement
    for axis in range(case.n):
        seen = transformix(case, path, picture(case, axis, tmp_path), tmp_path)
        expected = case.sites[..., axis] + back[..., axis] / case.size[axis]
        np.testing.assert_allclose(seen[inside(case)], expected[inside(case)], atol=0.02)
