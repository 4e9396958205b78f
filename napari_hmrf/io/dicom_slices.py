"""Order and distances of the slices of a DICOM series, and of the frames of a DICOM file."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.io.decoded import Unreadable

Step = npt.NDArray[np.float64]

#: Largest distance between a pixel and its place on a regular grid, in pixels.
_OFF = 0.1
#: Largest difference between the cosines of two directions that are considered equal.
_TURNED = 1e-3
#: Positions, directions and number of frames in a file of several frames, with explicit or implicit
#: types, and the tag that precedes the pixels. SimpleITK does not give the positions.
_FRAME_POSITIONS, _FRAME_DIRECTIONS, _FRAME_COUNT = (
    re.compile(rb"%b\x00(?:[DI]S..|.\x00\x00\x00)([-+.0-9eE \\]+)" % tag, re.DOTALL)
    for tag in (rb"\x20\x00\x32", rb"\x20\x00\x37", rb"\x28\x00\x08")
)
_PIXELS = b"\xe0\x7f\x10\x00"
#: Rescale slopes and intercepts of frames, and tags of the time between frames.
_RESCALE = re.compile(rb"\x28\x00([\x52\x53])\x10(?:DS..|.\x00\x00\x00)([-+.0-9eE ]+)", re.DOTALL)
_TIMES = re.compile(rb"\x18\x00[\x63\x65]\x10(?:DS|.\x00)")
#: Type of a table of contents in a DICOM file, and size of the start that states it, in bytes.
_CONTENTS, _START = b"1.2.840.10008.1.3.10", 512


class Slice(NamedTuple):
    """Slice of a DICOM series: size, spacing, direction and position as in ITK, and rescaling."""

    path: str
    size: tuple[int, ...]
    spacing: tuple[float, ...]
    direction: tuple[float, ...]
    origin: tuple[float, ...] | None
    rescale: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the file."""
        return Path(self.path).name


def is_dicom(file: Path) -> bool:
    """Return whether a file is a DICOM file, according to its content."""
    return _start_of(file) != b""


def is_contents(file: Path) -> bool:
    """Return whether a file is the table of contents of DICOM files, usually named DICOMDIR."""
    return _CONTENTS in _start_of(file)


def _start_of(file: Path) -> bytes:
    """Return the start of a DICOM file, with the type of its content; b"" for other files."""
    with open(file, "rb") as stream:
        start = stream.read(_START)
    return start if start[128:132] == b"DICM" else b""


def ordered(slices: list[Slice]) -> tuple[list[Slice], Step | None]:
    """Return the slices of a volume in the order of their positions, and the step of a tilt.

    Raises
    ------
    Unreadable
        If the slices are not those of one volume on a regular grid.
    """
    if any(math.prod(each.size[2:]) > 1 for each in slices):
        raise Unreadable("the folder contains files of several frames. Give one of these files")
    _check_alike(slices)
    lost = [each.name for each in slices if each.origin is None]
    if lost:
        raise Unreadable(
            f"{_listed(lost)} {_have(lost)} no position. Give a folder with one volume"
        )
    normal = slices[0].direction[2::3]
    slices = sorted(slices, key=lambda each: float(np.dot(normal, each.origin or ())))
    names = [each.name for each in slices]
    positions = [each.origin or () for each in slices]
    return slices, tilted_step(positions, normal, slices[0].spacing, names)


def _check_alike(slices: list[Slice]) -> None:
    """Raise an error if some slices differ from most in size, pixels or direction."""

    def alike(one: Slice, other: Slice) -> bool:
        return (
            one.size[:2] == other.size[:2]
            and np.allclose(one.spacing[:2], other.spacing[:2], rtol=1e-3)
            and np.allclose(one.direction, other.direction, rtol=0, atol=_TURNED)
        )

    groups: list[list[Slice]] = []
    for each in slices:
        group = next((group for group in groups if alike(group[0], each)), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    groups.sort(key=len)
    others = [each.name for group in groups[:-1] for each in group]
    if others:
        raise Unreadable(
            f"{_listed(others)} {_have(others)} another direction, size or pixel size than the "
            "other slices, as scouts have. Move these files to another folder"
        )


def tilted_step(
    positions: Sequence[Sequence[float]],
    normal: npt.ArrayLike,
    spacing: Sequence[float],
    names: Sequence[str],
) -> Step | None:
    """Return the step from a slice to the next if slices are shifted along each other.

    ITK ignores this shift of a tilted gantry.

    Parameters
    ----------
    positions : sequence of sequence of float
        Position of each slice, in the order of the slices.
    normal : array_like, shape (3,)
        Direction perpendicular to the slices.
    spacing : sequence of float
        Pixel size along each axis of a slice.
    names : sequence of str
        Names of the slices, for messages.

    Returns
    -------
    ndarray, shape (3,), or None
        Step along x, y, z of LPS; None if the slices are one above the other.

    Raises
    ------
    Unreadable
        If slices share a position, are missing, or are not in one line.
    """
    at = np.asarray(positions, float)
    depths = at @ normal
    steps = np.diff(depths)
    step = float(np.sort(np.abs(steps))[len(steps) // 2])
    doubled = int((np.abs(steps) <= _OFF * step).sum())
    if doubled:
        raise Unreadable(
            f"{doubled} of {len(depths)} slices are at the position of another slice, so there is "
            "more than one volume. Keep the files of one volume"
        )
    off = at - np.linspace(at[0], at[-1], len(at))
    off_depths = off @ normal
    if np.abs(off_depths).max() > _OFF * abs(depths[-1] - depths[0]) / len(steps):
        far = int(np.abs(np.abs(steps) - step).argmax())
        raise Unreadable(
            f"the distances of its slices differ: most are {step:.4g} mm apart, but {names[far]} "
            f"and {names[far + 1]} are {abs(steps[far]):.4g} mm apart. Add the missing slices, or "
            "resample the volume to equal distances"
        )
    aside = np.linalg.norm(off - np.outer(off_depths, np.asarray(normal)), axis=1)
    if aside.max() > _OFF * min(spacing[:2]):
        far = int(aside.argmax())
        raise Unreadable(
            f"its slices are not in one line: {names[far]} is {aside[far]:.4g} mm beside the line "
            "from the first to the last. Give the slices of one acquisition"
        )
    across = at[-1] - at[0]
    shift = float(np.linalg.norm(across - (across @ normal) * np.asarray(normal)))
    return across / len(steps) if shift > _OFF * min(spacing[:2]) else None


def tilt_of_frames(source: Path) -> Step | None:
    """Return the step from a frame of a DICOM file to the next, as `tilted_step` does.

    Raises
    ------
    Unreadable
        If the frames are not the slices of a volume in order.
    """
    header = source.read_bytes().partition(_PIXELS)[0]
    if _TIMES.search(header):
        raise Unreadable(
            "its frames are times, not slices. Save one frame as a picture, such as a .tif"
        )
    rescale = set(_RESCALE.findall(header))
    if len(rescale) > len({tag for tag, _ in rescale}):
        raise Unreadable(
            "its frames have different rescale slopes. Convert it with dcm2niix, which applies them"
        )
    try:
        positions, directions, counts = (
            [[*map(float, text.split(b"\\"))] for text in found.findall(header)]
            for found in (_FRAME_POSITIONS, _FRAME_DIRECTIONS, _FRAME_COUNT)
        )
    except ValueError:
        return None  # the bytes have another meaning
    across = directions[0] if directions else [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    is_volume = len(positions) > 1 and [len(positions)] in counts
    if not is_volume or len(across) != 6 or any(len(at) != 3 for at in positions):
        return None
    normal = np.cross(across[:3], across[3:])
    steps = np.diff(np.asarray(positions) @ normal)
    if steps.min() < 0 < steps.max():
        raise Unreadable(
            "its frames are not stored in the order of their positions. Convert it with dcm2niix, "
            "which sorts them"
        )
    names = [f"frame {number}" for number in range(1, len(positions) + 1)]
    return tilted_step(positions, normal, (1.0, 1.0), names)


def refuse_damaged(folder: Path, series: str, names: Sequence[str]) -> None:
    """Raise an error if a file of a series is not among the readable files of its folder.

    Parameters
    ----------
    folder : Path
    series : str
        Unique identifier of the series.
    names : sequence of str
        Paths of the files of the series that can be read.
    """
    known = {Path(name).name for name in names}
    for file in sorted(folder.iterdir()):
        if file.name in known or not file.is_file():
            continue
        content = file.read_bytes()
        is_slice = series.encode() in content and _PIXELS in content
        if is_slice or (not content and file.suffix.lower() == ".dcm"):
            raise Unreadable(f"{file.name} is damaged or truncated. Replace this file")


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{', '.join(names[:3])}{more}"


def _have(names: list[str]) -> str:
    return "has" if len(names) == 1 else "have"
