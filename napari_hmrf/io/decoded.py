"""Medical image in memory, and reasons why a file cannot be read as one."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy.typing as npt

from napari_hmrf.errors import HmrfError
from napari_hmrf.extras import how_to_install
from napari_hmrf.geometry import Geometry

#: Largest compression ratio of a file: the limit of deflate.
MOST_PACKED = 1032
#: Reason for rejecting a file with fewer values than its header states, or with a wrong checksum.
CUT_SHORT = "it is damaged or truncated"


class Unreadable(Exception):
    """Error for a file that could not be read; the message is the reason, as a clause, or ""."""


class Decoded(NamedTuple):
    """Image, or field of vectors along the axes x, y[, z] of LPS.

    Attributes
    ----------
    pixels : ndarray, shape ([D,] H, W[, components])
    components : int
        Number of values per pixel.
    geometry : Geometry
    metadata : dict of str to str
        Metadata in the file.
    """

    pixels: npt.NDArray[Any]
    components: int
    geometry: Geometry
    metadata: dict[str, str]

    @property
    def ndim(self) -> int:
        """Number of spatial axes."""
        return self.geometry.ndim


def check_size(needed: int, file: Path, ratio: int = MOST_PACKED) -> None:
    """Raise an error, before memory is allocated, if a file is too small for its values.

    Parameters
    ----------
    needed : int
        Size of the values that the header states, in bytes.
    file : Path
        File that contains the values.
    ratio : int
        Largest compression ratio.

    Raises
    ------
    Unreadable
        If the file cannot contain the values.
    """
    if needed > ratio * file.stat().st_size:
        raise Unreadable(CUT_SHORT)


def missing_package(name: str) -> HmrfError:
    """Return the error for a missing optional package, with the command that installs it."""
    return HmrfError(
        f"medical files are read and written by {name}, which is not installed: "
        f"{how_to_install('medical')}."
    )
