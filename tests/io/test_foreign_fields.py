"""Tests of fields written by other tools, which are read to 1e-4 of a pixel.

The files here have the layout that these tools write. `test_ants` and `test_elastix` test the tools
themselves if they are installed.
"""

import gzip
import math
import struct

import numpy as np
import pytest

from napari_hmrf import FileFormatError
from napari_hmrf.contributions import open_scan
from napari_hmrf.fields import read_field
from tests.support.exchanged_fields import FieldCase, check_field_file
from validation.studies.damaged import make_field

sitk = pytest.importorskip("SimpleITK")


@pytest.mark.parametrize(
    ("name", "suffix", "kind"),
    [
        ("2-D", ".nii.gz", np.float32),
        ("3-D", ".nii", np.float64),
        ("slice", ".mha", np.float32),
        ("3-D", ".mhd", np.float64),
        ("slice", ".nrrd", np.float64),
        ("2-D", ".nhdr", np.float32),
    ],
)
def test_a_vector_image_written_by_simpleitk_is_read(name, suffix, kind, tmp_path):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    sitk.WriteImage(case.vectors(kind), str(path))
    check_field_file(case, path)


@pytest.mark.parametrize(
    ("name", "suffix", "composite"),
    [("2-D", ".h5", False), ("3-D", ".h5", True), ("slice", ".tfm", False), ("3-D", ".tfm", True)],
)
def test_a_transform_written_by_simpleitk_is_read(name, suffix, composite, tmp_path):
    case, path = FieldCase(name), tmp_path / f"field{suffix}"
    transform = sitk.DisplacementFieldTransform(case.vectors())
    if composite:
        transform = sitk.CompositeTransform([transform])
    sitk.WriteTransform(transform, str(path))
    check_field_file(case, path)


def test_a_warp_after_an_affine_map_is_read_as_their_composition(tmp_path):
    case, path = FieldCase("slice"), tmp_path / "Composite.h5"
    shift = sitk.TranslationTransform(3, [0.3, -0.2, 0.1])
    whole = sitk.CompositeTransform([shift, sitk.DisplacementFieldTransform(case.vectors())])
    sitk.WriteTransform(whole, str(path))
    moved = case.whole + (case.direction.T @ shift.GetOffset())[::-1]
    read = read_field(path, forward=True).displacement
    assert np.abs((read - moved) / case.spacing).max() < 1e-4


def test_a_transform_without_a_field_is_refused(tmp_path):
    affine = sitk.AffineTransform(2)
    chain = sitk.CompositeTransform([affine])
    transforms = {
        "affine.h5": affine,
        "affine.tfm": affine,
        "affine.mat": affine,
        "chain.h5": chain,
    }
    for name, transform in transforms.items():
        sitk.WriteTransform(transform, str(tmp_path / name))
        with pytest.raises(FileFormatError, match=rf"{name}.*no field, but AffineTransform"):
            read_field(tmp_path / name)
    path = str(tmp_path / "affine.h5")
    with pytest.raises(FileFormatError, match="no field"):
        open_scan(path)(path)


def test_a_field_of_fsl_is_refused_with_its_reason(tmp_path):
    path = str(tmp_path / "warp.nii.gz")
    sitk.WriteImage(sitk.Image([5, 6, 7, 3], sitk.sitkFloat32), path)
    for read in (read_field, open_scan(path)):
        with pytest.raises(FileFormatError, match=r"warp\.nii\.gz.*FSL"):
            read(path)


#: Header that transformix writes before the numbers of a deformationField.mha.
METAIMAGE = """ObjectType = Image
NDims = {n}
BinaryData = True
BinaryDataByteOrderMSB = False
CompressedData = False
TransformMatrix = {matrix}
Offset = {offset}
CenterOfRotation = {zeros}
ElementSpacing = {spacing}
DimSize = {size}
ElementNumberOfChannels = {n}
ElementType = MET_FLOAT
ElementDataFile = LOCAL
"""


def words(values):
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def test_a_deformation_field_of_transformix_is_read(tmp_path):
    case, path = FieldCase("slice"), tmp_path / "deformationField.mha"
    vectors = case.vectors(np.float32)
    header = METAIMAGE.format(
        n=case.axes,
        matrix=words(case.direction.T),  # In the order of the axes.
        offset=words(case.origin),
        zeros=words(np.zeros(case.axes)),
        spacing=words(case.spacing[::-1]),
        size=words(vectors.GetSize()),
    )
    path.write_bytes(header.encode() + sitk.GetArrayFromImage(vectors).tobytes())
    check_field_file(case, path)


def rotation_as_quaternion(turn):
    """Return the vector part of the quaternion of a rotation, whose real part is positive."""
    real = np.sqrt(1 + np.trace(turn)) / 2
    skew = turn - turn.T
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (4 * real)


def nifti(case, *, by_matrix, order="<"):
    """Return the bytes of a field with intent 1007 in the layout of ITK's writer."""
    vectors = sitk.GetArrayFromImage(case.vectors(np.float32))
    steps = np.diag([-1.0, -1, 1]) @ case.direction * case.spacing[::-1]
    turn, side = steps / case.spacing[::-1], 1.0
    if np.linalg.det(turn) < 0:
        turn, side = turn * [1, 1, -1], -1.0
    origin = np.array(case.origin) * [-1, -1, 1]
    header = bytearray(352)
    struct.pack_into(order + "i", header, 0, 348)
    struct.pack_into(order + "8h", header, 40, 5, *case.shape[::-1], 1, 1, 3, 1, 1)
    struct.pack_into(order + "4h", header, 68, 1007, 16, 32, 0)
    struct.pack_into(order + "8f", header, 76, side, *case.spacing[::-1], 1, 1, 0, 0)
    struct.pack_into(order + "3f", header, 108, 352, 1, 0)
    struct.pack_into("b", header, 123, 2)
    struct.pack_into(order + "2h", header, 252, int(not by_matrix), int(by_matrix))
    struct.pack_into(order + "3f", header, 256, *rotation_as_quaternion(turn))
    struct.pack_into(order + "3f", header, 268, *origin)
    struct.pack_into(order + "12f", header, 280, *np.column_stack([steps, origin]).ravel())
    header[344:348] = b"n+1\0"
    return bytes(header) + np.moveaxis(vectors, -1, 0).astype(order + "f4").tobytes()


@pytest.mark.parametrize(
    ("suffix", "by_matrix", "order", "side"),
    [(".nii", True, "<", 1), (".nii", False, ">", 1), (".nii.gz", False, "<", -1)],
)
def test_one_slice_in_nifti_retains_its_place_in_the_volume(
    suffix, by_matrix, order, side, tmp_path
):
    case, path = FieldCase("slice"), tmp_path / f"deformationField{suffix}"
    case.direction *= side  # -1 for axes of a left-handed system
    content = nifti(case, by_matrix=by_matrix, order=order)
    path.write_bytes(gzip.compress(content) if suffix == ".nii.gz" else content)
    assert sitk.ReadImage(str(path)).GetDimension() == 2, "ITK's reader drops an axis"
    check_field_file(case, path)


def test_a_nifti_file_without_vectors_is_refused_as_a_field(tmp_path):
    path, case = tmp_path / "field.nii", FieldCase("slice")
    content = bytearray(nifti(case, by_matrix=True))
    struct.pack_into("<h", content, 68, 0)  # A fifth axis of scalars instead of vectors.
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"field\.nii: not a displacement field"):
        read_field(path)


@pytest.mark.usefixtures("child_process")
@pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".mha", ".nrrd", ".h5", ".tfm"])
def test_a_truncated_file_is_refused_as_a_field(suffix, tmp_path):
    """Test truncation; `make damaged` tests thousands of files of each format."""
    whole, cut = tmp_path / f"a{suffix}", tmp_path / f"cut{suffix}"
    make_field(whole)
    content = whole.read_bytes()
    whole.unlink()
    for share in (0, 0.3, 0.98):
        cut.write_bytes(content[: int(share * len(content))])
        with pytest.raises(FileFormatError, match=rf"cut\{suffix}: not a displacement field"):
            read_field(cut)


@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr"])
def test_a_flipped_bit_in_compressed_values_is_refused(suffix, tmp_path):
    path = tmp_path / f"field{suffix}"
    vectors = FieldCase("slice").vectors(np.float32)
    sitk.WriteImage(vectors, str(path), useCompression=True)
    (values,) = {*tmp_path.iterdir()} - {path} or {path}
    content = bytearray(values.read_bytes())
    content[-10] ^= 1
    values.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"it is damaged or truncated"):
        read_field(path)


@pytest.mark.parametrize("start", [-8.0, math.nan, 1e30])
def test_a_field_whose_values_start_nowhere_is_refused(tmp_path, start):
    path = tmp_path / "field.nii"
    content = bytearray(nifti(FieldCase("slice"), by_matrix=True))
    struct.pack_into("<f", content, 108, start)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="damaged"):
        read_field(path)


def test_an_impossible_size_in_a_header_allocates_no_memory(tmp_path):
    path = tmp_path / "field.nii"
    content = bytearray(nifti(FieldCase("slice"), by_matrix=True))
    struct.pack_into("<h", content, 46, 32_000)  # The number of slices, which would need 1 GB.
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"field\.nii: not a displacement field that can"):
        read_field(path)
