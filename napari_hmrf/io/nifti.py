"""Parser of NIfTI headers, for two cases that ITK's reader does not handle.

ITK reads a vector field on a single slice of a volume as a 2-D field: it drops the third axis, and
therefore the thickness and the place of the slice. ANTs and elastix write such files. ITK also
fills the missing part of a truncated file with arbitrary values.
"""

from __future__ import annotations

import gzip
import math
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

#: Fields of the header used in this module, with their offsets in bytes.
_HEADER = np.dtype(
    {
        "names": [
            *("length", "sizes", "bits", "zooms", "start"),
            *("by_rotation", "by_matrix", "turn", "offset", "matrix"),
        ],
        "formats": [
            *("i4", ("i2", 8), "i2", ("f4", 8), "f4"),
            *("i2", "i2", ("f4", 3), ("f4", 3), ("f4", (3, 4))),
        ],
        "offsets": [0, 40, 72, 76, 108, 252, 254, 256, 268, 280],
        "itemsize": 348,
    }
)
#: Number of bytes decompressed at a time.
_PIECE = 2**20
#: Factors that convert right, anterior, superior (NIfTI) to left, posterior, superior (ITK).
_TO_LPS = np.array([-1.0, -1.0, 1.0])


class NiftiPlace(NamedTuple):
    """Place of a NIfTI image in ITK's convention, in LPS, with the axes in the order x, y, z.

    Attributes
    ----------
    spacing : ndarray, shape (3,)
        Voxel size along each axis, in mm.
    origin : ndarray, shape (3,)
        Centre of the first voxel, in mm.
    direction : ndarray, shape (3, 3)
        Direction matrix: its columns are the directions of the axes.
    """

    spacing: npt.NDArray[np.float64]
    origin: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]


def place_in_nifti(path: Path) -> NiftiPlace | None:
    """Read the place from a NIfTI-1 file; return None if there is no valid NIfTI-1 header."""
    header = _header(path)
    if header is None:
        return None
    zooms = header["zooms"].astype(float)
    steps = header["matrix"].astype(float)
    if not header["by_matrix"]:
        turn = np.eye(3) if not header["by_rotation"] else _rotation(header["turn"].astype(float))
        turn[:, 2] *= -1 if zooms[0] < 0 else 1
        offset = header["offset"].astype(float) * bool(header["by_rotation"])
        steps = np.column_stack([turn * zooms[1:4], offset])
    spacing = np.linalg.norm(steps[:, :3], axis=0)
    if not (np.isfinite(steps).all() and (spacing > 0).all()):
        return None
    return NiftiPlace(spacing, _TO_LPS * steps[:, 3], _TO_LPS[:, None] * (steps[:, :3] / spacing))


def is_cut_short(path: Path) -> bool:
    """Return whether a NIfTI-1 file is truncated or its compressed content is damaged."""
    header = _header(path)
    if header is None:
        return False
    sizes = header["sizes"].astype(int)
    count = math.prod(sizes[1 : 1 + sizes[0]].clip(min=1).tolist())
    needed = int(header["start"]) + count * int(header["bits"]) // 8
    if not path.name.lower().endswith(".gz"):
        return bool(path.stat().st_size < needed)
    count_read = 0
    try:
        with gzip.open(path, "rb") as file:
            while piece := file.read(_PIECE):
                count_read += len(piece)
    except (OSError, EOFError, zlib.error):
        return True
    return bool(count_read < needed)


def _header(path: Path) -> Any:
    """Return the NIfTI-1 header of a file, in either byte order, or None for other files."""
    opened: Any = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opened(path, "rb") as file:
            start = file.read(_HEADER.itemsize)
    except (OSError, EOFError, zlib.error):
        return None
    if len(start) < _HEADER.itemsize:
        return None
    for kind in (_HEADER.newbyteorder("<"), _HEADER.newbyteorder(">")):
        header = np.frombuffer(start, kind)[0]
        if header["length"] == _HEADER.itemsize:
            return header
    return None


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
