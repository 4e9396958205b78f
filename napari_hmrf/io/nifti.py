"""Header of a NIfTI file, which ITK's reader does not respect.

ITK reads vectors on one slice of a volume as vectors of a plane, and loses the third axis with its
length and the place of the slice; ANTs and elastix write such files for one slice. And it fills up
a file that was cut short with arbitrary values.
"""

from __future__ import annotations

import gzip
import math
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

#: Parts of the header, by offsets.
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
#: Bytes that are unpacked at once.
_PIECE = 2**20
#: From right, anterior, superior to left, posterior, superior.
_TO_LPS = np.array([-1.0, -1.0, 1.0])


class NiftiPlace(NamedTuple):
    """Sizes, first pixel's middle and directions of x, y, z, as ITK states them."""

    spacing: npt.NDArray[np.float64]
    origin: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]


def place_in_nifti(path: Path) -> NiftiPlace | None:
    """Read where a .nii or .nii.gz of the first version of the format lies; None of other files."""
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
    """Return whether a .nii or .nii.gz (version 1) has fewer sound bytes than its header says."""
    header = _header(path)
    if header is None:
        return False
    sizes = header["sizes"].astype(int)
    count = math.prod(sizes[1 : 1 + sizes[0]].clip(min=1).tolist())
    needed = int(header["start"]) + count * int(header["bits"]) // 8
    if not path.name.lower().endswith(".gz"):
        return bool(path.stat().st_size < needed)
    there = 0
    try:
        with gzip.open(path, "rb") as file:
            while piece := file.read(_PIECE):
                there += len(piece)
    except (OSError, EOFError, zlib.error):
        return True
    return bool(there < needed)


def _header(path: Path) -> Any:
    """The header, in the order of its bytes; None of another kind of file."""
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
    """Return the rotation of a unit quaternion without its real part, which is not negative."""
    real = math.sqrt(max(0.0, 1.0 - float(vector @ vector)))
    cross = np.cross(np.eye(3), vector)
    turn: npt.NDArray[np.float64] = (
        (2 * real**2 - 1) * np.eye(3) + 2 * np.outer(vector, vector) + 2 * real * cross
    )
    return turn
