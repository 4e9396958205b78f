"""Tests of image files and of the place that they store."""

import numpy as np
import pytest

from napari_hmrf import FileFormatError
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.images import ImageFile, read_image, write_image

sitk = pytest.importorskip("SimpleITK")

TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
VOLUME = Geometry.of_itk((5, 12, 9), (3.0, 0.5, 0.7), (-10.0, 20.0, 5.0), TURN)


def pixels(shape, kind=np.uint8):
    return np.random.default_rng(4).integers(0, 200, shape).astype(kind)


@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".nrrd"])
@pytest.mark.parametrize(("shape", "kind"), [((5, 12, 9), np.int16), ((12, 9), np.float32)])
def test_a_scan_is_read_back_with_its_place(tmp_path, suffix, shape, kind):
    before = ImageFile(pixels(shape, kind), VOLUME)
    after = read_image(write_image(tmp_path / f"scan{suffix}", before))
    assert after.pixels.dtype == kind
    np.testing.assert_array_equal(after.pixels, before.pixels)
    np.testing.assert_allclose(after.geometry.affine, VOLUME.affine, atol=1e-5)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("shape", [(12, 9), (12, 9, 3)])
def test_a_picture_is_read_back_unchanged(tmp_path, suffix, shape):
    before = ImageFile(pixels(shape), colours=len(shape) > 2)
    after = read_image(write_image(tmp_path / f"photo{suffix}", before))
    np.testing.assert_array_equal(after.pixels, before.pixels)
    assert (after.colours, after.geometry) == (before.colours, None)


def test_a_file_without_an_image_is_refused_in_one_sentence(tmp_path):
    for name in ("broken.nii.gz", "broken.png"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(FileFormatError, match=rf"{name}: cannot be read as an image"):
            read_image(tmp_path / name)
    empty = tmp_path / "series"
    empty.mkdir()
    with pytest.raises(FileFormatError, match=r"series: the folder contains no DICOM image"):
        read_image(empty)
    with pytest.raises(FileNotFoundError, match=r"gone\.png"):
        read_image(tmp_path / "gone.png")


def test_pixels_that_a_format_does_not_support_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match=r"a\.png: float64 pixels .* Use \.tif or \.nrrd"):
        write_image(tmp_path / "a.png", ImageFile(np.zeros((4, 5))))
    with pytest.raises(FileFormatError, match=r"a\.txt: images cannot be written in this"):
        write_image(tmp_path / "a.txt", ImageFile(np.zeros((4, 5))))
    assert not list(tmp_path.iterdir())
