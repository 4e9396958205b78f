"""Tests of exchanged fields with ANTs, run if antspyx is installed."""

import numpy as np
import pytest

from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.fields import read_field
from tests.support.exchanged_fields import PLACES, FieldCase, check_field_file, inside

ants = pytest.importorskip("ants")


@pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".mha", ".nrrd", ".h5"])
@pytest.mark.parametrize("name", PLACES)
def test_ants_moves_an_image_like_the_tissue(name, suffix, tmp_path):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    case.write(path)
    back = inverse_displacement(case.displacement, spacing=tuple(case.size)).displacement
    for axis in range(case.n):
        values = case.sites[..., axis]
        there = ants.from_numpy(
            np.ascontiguousarray((values if case.n == case.axes else values[np.newaxis]).T),
            origin=case.origin,
            spacing=case.spacing[::-1],
            direction=case.direction,
        )
        moved = ants.apply_transforms(there, there, [str(path)], interpolator="linear")
        seen = np.squeeze(moved.numpy().T)
        expected = values + back[..., axis] / case.size[axis]
        np.testing.assert_allclose(seen[inside(case)], expected[inside(case)], atol=0.02)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".mha", ".nrrd"])
@pytest.mark.parametrize("name", PLACES)
def test_a_field_written_by_ants_is_read(name, suffix, tmp_path):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    vectors = case.whole[..., ::-1] @ case.direction.T
    image = ants.from_numpy(
        np.ascontiguousarray(vectors.transpose(*range(case.axes)[::-1], case.axes)),
        origin=case.origin,
        spacing=case.spacing[::-1],
        direction=case.direction,
        has_components=True,
    )
    ants.image_write(image, str(path))
    check_field_file(case, path)


def test_a_warp_of_an_ants_registration_moves_an_image_as_ants_does():
    case = FieldCase("2-D")
    rows, cols = np.moveaxis(case.sites, -1, 0)
    pictures = [
        100 * np.exp(-(((rows - 22) / 9) ** 2) - ((cols - at) / 12) ** 2) for at in (30, 33)
    ]
    place = {"spacing": case.spacing[::-1], "origin": case.origin, "direction": case.direction}
    fixed, moving = (ants.from_numpy(np.ascontiguousarray(each.T), **place) for each in pictures)
    found = ants.registration(fixed, moving, "SyNOnly", initial_transform="Identity")
    warp = next(each for each in found["fwdtransforms"] if each.endswith(".nii.gz"))
    field = read_field(warp, forward=True)
    assert np.abs(field.displacement[22, 30] / case.size - (0, 3)).max() < 1
    for axis, values in enumerate((rows, cols)):
        there = ants.from_numpy(np.ascontiguousarray(values.T), **place)
        moved = ants.apply_transforms(fixed, there, [warp], interpolator="linear").numpy().T
        expected = values + field.displacement[..., axis] / case.size[axis]
        np.testing.assert_allclose(moved[inside(case)], expected[inside(case)], atol=1e-4)
