"""Parser of NIfTI headers, for what ITK's reader does not handle.

ITK reads a vector field on a single slice of a volume as a 2-D field: it drops the third axis, and
therefore the thickness and the place of the slice. ANTs and elastix write such files. ITK fills the
missing part of a truncated file with arbitrary values, and replaces NaN and infinite values by 0.
It reads every field as displacements, chooses one of two places that a header states, and does not
say why it cannot read a file.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.geometry import Geometry

#: Fields of the header used in this module, with their offsets in bytes.
_HEADER = np.dtype(
    {
        "names": [
            *("length", "sizes", "parameter", "intent", "pixel", "bits", "zooms", "start"),
            *("by_rotation", "by_matrix", "turn", "offset", "matrix", "kind", "magic"),
        ],
        "formats": [
            *("i4", ("i2", 8), "f4", "i2", "i2", "i2", ("f4", 8), "f4"),
            *("i2", "i2", ("f4", 3), ("f4", 3), ("f4", (3, 4)), "S16", "S4"),
        ],
        "offsets": [0, 40, 56, 68, 70, 72, 76, 108, 252, 254, 256, 268, 280, 328, 344],
        "itemsize": 348,
    }
)
#: Largest position of the values that is no sign of damage, in bytes.
_FARTHEST = 2**40
#: Number of bytes decompressed at a time.
_PIECE = 2**20
#: First bytes of compressed content, and length of the header of NIfTI-2.
_COMPRESSED, _SECOND_VERSION = b"\x1f\x8b", 540
#: Largest distance between two places of a pixel that are considered equal, in pixels.
_OFF = 0.1
#: Code of an affine to the coordinates of the scanner.
_SCANNER = 1
#: NumPy's types of real pixels, by the codes of NIfTI.
_REAL = {16: "f4", 64: "f8"}
#: Factors that convert right, anterior, superior (NIfTI) to left, posterior, superior (ITK).
_TO_LPS = np.array([-1.0, -1.0, 1.0])


def geometry_in_nifti(path: Path) -> Geometry | None:
    """Read the grid of a NIfTI-1 file; return None if there is no valid NIfTI-1 header."""
    header = _header(path)
    if header is None:
        return None
    steps = _steps_by_matrix(header) if header["by_matrix"] else _steps_by_rotation(header)
    spacing = np.linalg.norm(steps[:, :3], axis=0)
    if not (np.isfinite(steps).all() and (spacing > 0).all()):
        return None
    affine = np.eye(4)
    affine[:3] = (_TO_LPS[:, None] * steps)[::-1, [2, 1, 0, 3]]
    return Geometry(_shape(header)[::-1], affine)


def _steps_by_matrix(header: Any) -> npt.NDArray[np.float64]:
    """Return the affine of the sform, shape (3, 4)."""
    return np.asarray(header["matrix"], np.float64)


def _steps_by_rotation(header: Any) -> npt.NDArray[np.float64]:
    """Return the affine of the qform, shape (3, 4), or of the zooms alone if there is no qform."""
    zooms = header["zooms"].astype(float)
    turn = np.eye(3) if not header["by_rotation"] else _rotation(header["turn"].astype(float))
    turn[:, 2] *= -1 if zooms[0] < 0 else 1
    offset = header["offset"].astype(float) * bool(header["by_rotation"])
    return np.column_stack([turn * zooms[1:4], offset])


def fault_in_nifti(path: Path) -> str:
    """Return why a NIfTI file cannot be read rightly, with a remedy, or "" if nothing is known."""
    header_file = path.with_suffix(".hdr") if path.suffix.lower() == ".img" else path
    is_compressed = _is_compressed(header_file)
    if is_compressed and not path.name.lower().endswith(".gz"):
        return f"its content is compressed. Rename it to {path.name}.gz"
    start = _start(header_file)
    if int.from_bytes(start[:4], "little") == _SECOND_VERSION or (
        int.from_bytes(start[:4], "big") == _SECOND_VERSION
    ):
        return (
            "it is a NIfTI-2 file. Save it as NIfTI-1, for example with nibabel.Nifti1Image(data, "
            "affine)"
        )
    header = _header(header_file)
    if header is None or header["magic"] not in (b"n+1", b"ni1"):
        return ""
    return fault_of_places(
        _steps_by_rotation(header),
        _steps_by_matrix(header),
        (int(header["by_rotation"]), int(header["by_matrix"])),
        _shape(header),
    )


def _shape(header: Any) -> tuple[int, ...]:
    """Return the number of voxels along x, y and z."""
    return tuple(header["sizes"][1:4].astype(int).clip(min=1).tolist())


def fault_of_places(
    qform: npt.NDArray[np.float64],
    sform: npt.NDArray[np.float64],
    codes: tuple[int, int],
    shape: Sequence[int],
) -> str:
    """Return why the two affines of a header do not give the place of an image, or "".

    Parameters
    ----------
    qform, sform : ndarray, shape (3 or 4, 4)
        Affines from voxels to positions.
    codes : (int, int)
        Codes of qform and sform; 0 if the header does not state the affine. If both are stated,
        nibabel uses sform, and ITK uses it only if its code is 1 (scanner).
    shape : sequence of int
        Number of voxels along each axis.

    Returns
    -------
    str
        Clause with a remedy.
    """
    if not codes[1]:
        return ""
    affines = (np.vstack([each[:3], [0.0, 0.0, 0.0, 1.0]]) for each in (qform, sform))
    first, second = (Geometry(tuple(shape), affine) for affine in affines)
    if not (np.isfinite(second.affine).all() and min(second.spacing) > 0):
        return ""
    try:
        second.right_angled()
    except ValueError as error:
        return str(error)
    if codes[0] and codes[1] != _SCANNER:
        apart = first.farthest_from(second) / min(second.spacing)
        if apart > _OFF:
            return (
                f"its header states two places, qform and sform, which are up to {apart:.3g} pixels"
                " apart, and programs differ in which they use. Copy the right one to the other, "
                "for example with nibabel: image.set_qform(image.get_sform(), code=1), or "
                "image.set_sform(image.get_qform(), code=1)"
            )
    return ""


def holds_positions(path: Path) -> bool | None:
    """Return the kind of a NIfTI vector field of another program.

    Returns
    -------
    bool or None
        True if the vectors are positions along right, anterior, superior in mm, as SPM and
        NiftyReg write; False if they are displacements along these directions, as NiftyReg also
        writes; None if ITK reads the field rightly.

    Raises
    ------
    ValueError
        If the field is neither; the message is the reason, as a clause.
    """
    header = _header(path)
    if header is None:
        return None
    name = header["kind"].decode("ascii", "replace").strip()
    if name == "Mapping":
        return True
    if name != "NREG_TRANS":
        return None
    if header["parameter"] not in (0, 1):
        raise ValueError(
            "it is a velocity or spline transform of NiftyReg. Convert it to a deformation field, "
            "with reg_transform -def"
        )
    return bool(header["parameter"] == 0)


def not_finite(path: Path) -> npt.NDArray[np.floating] | None:
    """Return the stored values of an image of real numbers, in the order of the file.

    Returns
    -------
    ndarray or None
        None if all values are finite, or the file is not a NIfTI-1 file of real numbers.
    """
    header = _header(path)
    code = None if header is None else _REAL.get(int(header["pixel"]))
    if header is None or code is None or not _starts_in_file(header):
        return None
    order = ">" if header.dtype["length"].byteorder == ">" else "<"
    kind, start = np.dtype(order + code), int(header["start"])
    count = _count(header)
    opened: Any = gzip.open if _is_compressed(path) else open
    with opened(path, "rb") as file:
        file.seek(start)
        values = np.frombuffer(file.read(count * kind.itemsize), kind)
    return None if len(values) < count or np.isfinite(values).all() else values


def is_cut_short(path: Path) -> bool:
    """Return whether a NIfTI-1 file is truncated or its compressed content is damaged."""
    header = _header(path)
    if header is None:
        return False
    if not _starts_in_file(header):
        return True
    needed = int(header["start"]) + _count(header) * int(header["bits"]) // 8
    if not _is_compressed(path):
        return bool(path.stat().st_size < needed)
    count_read = 0
    try:
        with gzip.open(path, "rb") as file:
            while piece := file.read(_PIECE):
                count_read += len(piece)
    except (OSError, EOFError, zlib.error):
        return True
    return bool(count_read < needed)


def _count(header: Any) -> int:
    """Return the number of values of a file."""
    sizes = header["sizes"].astype(int)
    return math.prod(sizes[1 : 1 + sizes[0]].clip(min=1).tolist())


def _is_compressed(path: Path) -> bool:
    try:
        with open(path, "rb") as file:
            return file.read(len(_COMPRESSED)) == _COMPRESSED
    except OSError:
        return False


def _start(path: Path) -> bytes:
    """Return the first bytes of a file, decompressed; b"" if it cannot be read."""
    opened: Any = gzip.open if _is_compressed(path) else open
    try:
        with opened(path, "rb") as file:
            start: bytes = file.read(_HEADER.itemsize)
    except (OSError, EOFError, zlib.error):
        return b""
    return start


def _header(path: Path) -> Any:
    """Return the NIfTI-1 header of a file, in either byte order, or None for other files."""
    start = _start(path)
    if len(start) < _HEADER.itemsize:
        return None
    for kind in (_HEADER.newbyteorder("<"), _HEADER.newbyteorder(">")):
        header = np.frombuffer(start, kind)[0]
        if header["length"] == _HEADER.itemsize:
            return header
    return None


def _starts_in_file(header: Any) -> bool:
    """Return whether the values start at a position that a file may have; the number may be NaN."""
    return bool(0 <= header["start"] < _FARTHEST)


def _rotation(vector: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rotation matrix of a unit quaternion with a non-negative real part.

    Parameters
    ----------
    vector : ndarray, shape (3,)
        Imaginary part of the quaternion.
    """
    real = math.sqrt(max(0.0, 1.0 - float(vector @ vector)))
    cross = np.cross(np.eye(3), vector)
    turn: npt.NDArray[np.float64] = (
        (2 * real**2 - 1) * np.eye(3) + 2 * np.outer(vector, vector) + 2 * real * cross
    )
    return turn
