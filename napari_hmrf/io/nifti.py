"""Reader of NIfTI files, with nibabel.

ITK's reader is not used: it replaces NaN by 0, fills the missing part of a truncated file with
arbitrary values, drops the third axis of a field of one slice, reads every field as displacements,
and chooses one of two places that a header states.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.geometry import Geometry
from napari_hmrf.io.decoded import (
    CUT_SHORT,
    MOST_PACKED,
    Decoded,
    Unreadable,
    check_size,
    missing_package,
)

Float64Array = npt.NDArray[np.float64]

#: First bytes of compressed content, and errors of decompression and of reading too few bytes.
_COMPRESSED, _CORRUPT = b"\x1f\x8b", (EOFError, OSError, zlib.error)
#: Length of the longest header, that of NIfTI-2, in bytes.
_LONGEST = 540
#: Number of bytes that are decompressed at a time to reach the checksum.
_PIECE = 2**20
#: Length of each unit, in mm; an unknown unit is assumed to be mm.
MILLIMETRES = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}
#: Largest distance between two places of a pixel that are considered equal, in pixels.
_OFF = 0.1
#: Smallest singular value of the directions of axes that span space.
_FLAT = 1e-6
#: Code of an affine to the coordinates of the scanner.
_SCANNER = 1
#: Code of displacements along right, anterior, superior, and codes of images of vectors.
_DISPLACEMENTS = 1006
_VECTORS = (_DISPLACEMENTS, 1007)
#: Factors that convert right, anterior, superior (NIfTI) to left, posterior, superior (ITK).
_TO_LPS = np.array([-1.0, -1.0, 1.0])


class NiftiHeader(NamedTuple):
    """Content of a NIfTI header that describes the values and their place.

    Attributes
    ----------
    stored : nibabel.Nifti1Header
    kind : numpy.dtype
        Type of the stored values.
    start : int
        Position of the first value in its file, in bytes.
    scaling : (float, float) or (None, None)
        Slope and intercept, if values are scaled.
    shape : tuple of int
        Number of pixels along each spatial axis, ([D,] H, W).
    components : int
        Number of values per pixel.
    geometry : Geometry
    """

    stored: Any
    kind: np.dtype[Any]
    start: int
    scaling: tuple[Any, Any]
    shape: tuple[int, ...]
    components: int
    geometry: Geometry

    @property
    def is_field(self) -> bool:
        """True if the values may be displacements."""
        return self.components == len(self.shape) and self.kind.kind == "f"


def is_nifti(path: Path) -> bool:
    """Return whether a file is a NIfTI file; its header may be an .hdr file beside an .img file."""
    if not _is_pair(path):
        return path.name.lower().endswith((".nii", ".nii.gz"))
    try:
        with _opened(_part(path, ".hdr")) as stream:
            start = stream.read(_LONGEST)
    except _CORRUPT:
        return False
    return bool(start[344:347] == b"ni1" or start[4:7] == b"ni2")


def read_nifti_header(path: Path) -> NiftiHeader:
    """Read the header of a NIfTI file.

    Raises
    ------
    Unreadable
        If the header is damaged, or describes an image of complex numbers or at two places.
    HmrfError
        If nibabel is not installed.
    OSError
        If the file cannot be opened.
    """
    try:
        import nibabel  # optional: nibabel
    except ImportError:
        raise missing_package("nibabel") from None
    one, two = nibabel.nifti1, nibabel.nifti2
    kinds: dict[int, Any] = (
        {348: one.Nifti1PairHeader, 540: two.Nifti2PairHeader}
        if _is_pair(path)
        else {348: one.Nifti1Header, 540: two.Nifti2Header}
    )
    try:
        with _opened(_part(path, ".hdr")) as stream:
            start = stream.read(_LONGEST)
    except _CORRUPT:
        raise Unreadable(CUT_SHORT) from None
    stated = {int.from_bytes(start[:4], order) for order in ("little", "big")}
    length = next((each for each in kinds if each in stated), 0)
    if not length:
        raise Unreadable("")
    if len(start) < length:
        raise Unreadable(CUT_SHORT)
    try:
        kinds[length](start[:length])  # checks the header, but repairs sizes without an error
        header = kinds[length](start[:length], check=False)
        kind, first = header.get_data_dtype(), header.get_data_offset()
        shape = tuple(max(size, 1) for size in header.get_data_shape())
        _require_sizes(header, shape)
        scaling = header.get_slope_inter()
        affines = header.get_qform(coded=True), header.get_sform(coded=True)
        millimetres = MILLIMETRES[header.get_xyzt_units()[0]]
    except (ValueError, OverflowError, KeyError, nibabel.spatialimages.HeaderDataError):
        raise Unreadable("its header is damaged") from None
    if kind.kind not in "iufV" or kind.itemsize > 8 or len(shape) < 2:
        raise Unreadable(
            f"it has {len(shape)} axes and {kind} values. Give an image of real numbers"
        )
    components = len(kind.names or "1")
    if int(header["intent_code"]) in _VECTORS and len(shape) == 5:
        components, shape = shape[4], shape[:4]
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if components == 2 and shape[2:] == (1,):  # two components are a field on two axes
        shape = shape[:2]
    geometry = _geometry(affines, header["pixdim"][1:4], shape[::-1], millimetres)
    return NiftiHeader(header, kind, first, scaling, shape[::-1], components, geometry)


def read_nifti(path: Path) -> Decoded:
    """Read a NIfTI image; vectors are converted to displacements along left, posterior, superior.

    Raises
    ------
    Unreadable
        If the file is damaged or truncated; as for `read_nifti_header`; or if the vectors are
        neither displacements nor positions.
    HmrfError, OSError
        As for `read_nifti_header`.
    """
    header = read_nifti_header(path)
    values = _values(header, _part(path, ".img"))
    if header.is_field:
        values = _as_displacements(header, values)
    text = bytes(header.stored["descrip"]).decode("latin-1").strip("\0 ")
    return Decoded(values, header.components, header.geometry, {"descrip": text})


def _is_pair(path: Path) -> bool:
    return path.suffix.lower() in (".hdr", ".img")


def _part(path: Path, suffix: str) -> Path:
    """Return the file of the header or of the values, if these are two files."""
    if not _is_pair(path):
        return path
    return path.with_suffix(suffix.upper() if path.suffix.isupper() else suffix)


def _opened(path: Path) -> Any:
    """Open a file for reading, decompressed if its content is compressed, whatever its name."""
    with open(path, "rb") as file:
        is_compressed = file.read(len(_COMPRESSED)) == _COMPRESSED
    return gzip.open(path) if is_compressed else open(path, "rb")


def _values(header: NiftiHeader, path: Path) -> npt.NDArray[Any]:
    """Read the values, shape ([D,] H, W[, components]), with the slope and intercept applied."""
    from nibabel.volumeutils import array_from_file  # optional: nibabel

    kind, shape, components = header.kind, header.shape, header.components
    count = math.prod(shape) * components // len(kind.names or "1")
    with _opened(path) as stream:
        ratio = MOST_PACKED if isinstance(stream, gzip.GzipFile) else 1
        check_size(header.start + count * kind.itemsize, path, ratio)
        try:
            values = array_from_file((count,), kind, stream, header.start, mmap=False)
            while stream.read(_PIECE):  # gzip compares its checksum at the end
                pass
        except _CORRUPT:
            raise Unreadable(CUT_SHORT) from None
    if kind.names:
        return values.view(np.uint8).reshape(*shape, components)
    values = values.astype(kind.newbyteorder("="), copy=False)
    slope, intercept = header.scaling
    if slope is not None and (slope, intercept) != (1, 0):
        scaled = np.float64 if kind == np.float64 else np.float32
        values = (values * slope + intercept).astype(scaled)
    if components == 1:
        return values.reshape(shape)
    return np.moveaxis(values.reshape(components, *shape), 0, -1)


def _require_sizes(header: Any, shape: tuple[int, ...]) -> None:
    """Raise an error if the place depends on voxel sizes that are not positive.

    A single voxel along an axis may have the size 0: programs write it for the third axis of a
    picture, and it is read as 1.
    """
    if header["sform_code"] and not header["qform_code"]:
        return
    sizes, reversal = header["pixdim"][1:4], header["pixdim"][0]
    sizes[(sizes == 0) & (np.array((*shape, 1, 1)[:3]) == 1)] = 1
    if not (sizes > 0).all():
        stated = " x ".join(f"{size:g}" for size in sizes)
        raise Unreadable(
            f"its header states the voxel sizes (pixdim) {stated}. Set positive sizes, for example "
            "with nibabel: image.header.set_zooms"
        )
    if reversal not in (-1, 0, 1):
        raise Unreadable(
            f"its header states {reversal:g} as the direction of its third axis (qfac, pixdim[0]). "
            "Set 1 or -1"
        )
    header["pixdim"][0] = reversal or 1  # as in the standard


def _geometry(
    affines: Sequence[tuple[Float64Array | None, int]],
    zooms: npt.NDArray[np.float32],
    shape: tuple[int, ...],
    millimetres: float,
) -> Geometry:
    """Return the grid of an image in patient coordinates.

    `affines` are the qform and the sform, each with its code, and None if the code is 0; `zooms`
    are the sizes of a voxel along x, y and z.
    """
    (qform, _), (sform, code) = affines
    if qform is not None and sform is not None:
        check_places(qform, sform, code, (*shape[::-1], 1)[:3])
    affine = qform if sform is None else sform
    if affine is None:  # as in ITK: at the origin, along left, posterior, superior
        affine = np.diag([*_TO_LPS * zooms, 1.0])
    return lps_geometry(affine, shape, millimetres)


def lps_geometry(affine: Float64Array, shape: Sequence[int], millimetres: float) -> Geometry:
    """Return the grid of an array ([z,] y, x).

    Parameters
    ----------
    affine : ndarray, shape (4, 4)
        Affine from voxels (x, y, z) to positions along right, anterior, superior.
    shape : sequence of int
    millimetres : float
        Unit of length of the affine, in mm.

    Raises
    ------
    Unreadable
        If the affine is singular.
    """
    steps = millimetres * _TO_LPS[:, None] * affine[:3] + 0.0  # no -0.0
    sizes = np.linalg.norm(steps[:, :3], axis=0)
    if not (np.isfinite(steps).all() and (sizes > 0).all()):
        raise Unreadable("its affine is singular. Set an affine that can be inverted")
    if np.linalg.svd(steps[:, :3] / sizes, compute_uv=False)[-1] < _FLAT:
        raise Unreadable("its affine is singular, because its axes lie in one plane")
    # The axes of an array are z, y, x; an image has other axes before them, or has no z.
    n, count = len(shape), min(len(shape), 3)
    placed = np.eye(n + 1)
    placed[-1 - count :, -1 - count :] = np.eye(count + 1)
    placed[-1 - count : -1, -1 - count :] = steps[::-1, [2, 1, 0, 3]][-count:, -1 - count :]
    return Geometry(tuple(shape), placed)


def check_places(qform: Float64Array, sform: Float64Array, code: int, shape: Sequence[int]) -> None:
    """Raise an error if the qform and the sform of a header place an image differently.

    Parameters
    ----------
    qform, sform : ndarray, shape (4, 4)
        Affines from voxels to positions, both stated by the header.
    code : int
        Code of the sform. nibabel uses the sform, and ITK uses it only if its code is 1 (scanner).
    shape : sequence of int
        Number of voxels along x, y and z.

    Raises
    ------
    Unreadable
        If the places differ, or an affine is singular.
    """
    if code == _SCANNER:
        return
    first, second = (lps_geometry(each, shape[::-1], 1.0) for each in (qform, sform))
    apart = first.farthest_from(second) / min(second.spacing)
    if apart > _OFF:
        raise Unreadable(
            f"its header states two places, qform and sform, which are up to {apart:.3g} pixels "
            "apart, and programs differ in which they use. Copy the right one to the other, for "
            "example with nibabel: image.set_qform(image.get_sform(), code=1), or "
            "image.set_sform(image.get_qform(), code=1)"
        )


def _as_displacements(header: NiftiHeader, vectors: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert positions, and displacements along right, anterior, superior, to those in LPS."""
    stored, name = header.stored, header.stored["intent_name"].item().strip()
    parameter = float(stored["intent_p1"])
    is_spm, is_niftyreg = name == b"Mapping", name == b"NREG_TRANS"
    if is_niftyreg and parameter not in (0, 1):
        raise Unreadable(
            "it is a velocity or spline transform of NiftyReg. Convert it to a deformation field, "
            "with reg_transform -def"
        )
    if not (is_spm or is_niftyreg or stored["intent_code"] == _DISPLACEMENTS):
        return vectors
    vectors = vectors * _TO_LPS[: len(header.shape)]
    if is_spm or (is_niftyreg and parameter == 0):
        indices = np.moveaxis(np.indices(header.shape), 0, -1)
        vectors -= header.geometry.to_world(indices)[..., ::-1]
    return vectors
