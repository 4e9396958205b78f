"""Where a NIfTI image lies by its own header, for what ITK's reader drops.

ITK reads vectors on one slice of a volume as vectors of a plane, and with the third axis go its
length and where the slice is. Such files are what ANTs and elastix make of one slice.
"""

from __future__ import annotations

import gzip
import math
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

#: The part of the header that says where the image lies, by offsets.
_HEADER = np.dtype(
    {
        "names": ["length", "zooms", "by_rotation", "by_matrix", "turn", "offset", "matrix"],
        "formats": ["i4", ("f4", 8), "i2", "i2", ("f4", 3), ("f4", 3), ("f4", (3, 4))],
        "offsets": [0, 76, 252, 254, 256, 268, 280],
        "itemsize": 348,
    }
)
#: From right, anterior, superior to left, posterior, superior.
_TO_LPS = np.array([-1.0, -1.0, 1.0])


class NiftiPlace(NamedTuple):
    """Sizes, first pixel's middle and directions of x, y, z, as ITK states them."""

    spacing: npt.NDArray[np.float64]
    origin: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]


def place_in_nifti(path: Path) -> NiftiPlace | None:
    """Read where a .nii or .nii.gz of the first version of the format lies; None of other files."""
    opened: Any = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opened(path, "rb") as file:
            start = file.read(_HEADER.itemsize)
    except (OSError, EOFError, zlib.error):
        return None
    if len(start) < _HEADER.itemsize:
        return None
    header = np.frombuffer(start, _HEADER)[0]
    if header["length"] != _HEADER.itemsize:
        header = np.frombuffer(start, _HEADER.newbyteorder())[0]
    if header["length"] != _HEADER.itemsize:
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


def _rotation(vector: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Of a quaternion of length 1, without its real part, which is not negative."""
    real = math.sqrt(max(0.0, 1.0 - float(vector @ vector)))
    cross = np.cross(np.eye(3), vector)
    turn: npt.NDArray[np.float64] = (
        (2 * real**2 - 1) * np.eye(3) + 2 * np.outer(vector, vector) + 2 * real * cross
    )
    return turn
