"""Reading and writing of landmark files in the formats of other tools.

================  ==========================================================================
BigWarp .csv      pairs: ``Pt-0,true,moving x,y[,z],target x,y[,z]``, in the unit of the image;
                  a further column with standard deviations is optional
Slicer .mrk.json  one list of points, with its coordinate system, LPS or RAS
Slicer .fcsv      one list of points, in the format of earlier Slicer versions
napari .csv       one list of points: ``index,axis-0,axis-1[,axis-2][,sd]``, in pixels
================  ==========================================================================

All points in this module have coordinates in axis order, ([z,] y, x). Points from files with
patient coordinates are in mm, with the axes pointing to superior, posterior and left, as in layers
with patient coordinates.
"""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, checked_target, did_you_mean
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError, ProblemError
from napari_hmrf.field.units import unit_factor
from napari_hmrf.io.table_files import csv_text, read_cells, split_cells, text_of
from napari_hmrf.real_arrays import as_numbers

Points = npt.NDArray[np.float64]

#: Suffixes of landmark files.
POINT_SUFFIXES = (".csv", ".mrk.json", ".fcsv")
# Numbers of columns of BigWarp's format in two and three dimensions; one more is added to its
# columns for standard deviations.
_PAIR_COLUMNS = 6, 7, 8, 9
#: Texts of BigWarp's column that states whether a pair is in use, and a title of this column.
_ACTIVE = "true", "false"
_TITLE = "active"
#: Largest size of a file, in bytes; a larger file is not read.
_LARGEST = 2**26
#: Factors that convert the coordinates of each system to left, posterior, superior.
_TO_LPS = {
    "LPS": (1.0, 1.0, 1.0),
    "1": (1.0, 1.0, 1.0),
    "RAS": (-1.0, -1.0, 1.0),
    "0": (-1.0, -1.0, 1.0),
}
_SLICER_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v1.0.3.json#"
)


class LandmarkFile(NamedTuple):
    """Content of a landmark file.

    Attributes
    ----------
    points : ndarray, shape (N, n), float64
        Positions of the landmarks, in the order ([z,] y, x).
    targets : ndarray, shape (N, n), or None
        Target positions of the landmarks; None if the file contains only one list of points.
    names : tuple of str
        Names of the landmarks; empty if the file contains no names.
    unit : {"mm", "pixel", ""}
        Unit of the coordinates; "" if the file does not state the unit.
    sd : ndarray, shape (N,), float64, or None
        Standard deviations of the landmarks, in the unit of the coordinates; 0 for exact landmarks.
        None if the file contains no standard deviations.
    """

    points: Points
    targets: Points | None = None
    names: tuple[str, ...] = ()
    unit: str = ""
    sd: npt.NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        pairs = "" if self.targets is None else " with targets"
        unit = f", {self.unit}" if self.unit else ""
        unit += "" if self.sd is None else ", sd"
        return f"LandmarkFile({len(self.points)} points{pairs}{unit})"


def read_points(path: str | os.PathLike[str]) -> LandmarkFile:
    """Read a landmark file.

    Parameters
    ----------
    path : str or path-like
        Path with one of the suffixes in `POINT_SUFFIXES`.

    Returns
    -------
    LandmarkFile
        Named tuple of points, targets, names, unit and standard deviations.

    Raises
    ------
    FileFormatError
        If the file is not a valid landmark file; the message states the error and its location.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    suffix, name = _suffix(source), source.name
    parse: Callable[[], LandmarkFile]
    if suffix == ".csv":
        parse = partial(_parse_csv, read_cells(source, _LARGEST))
    else:
        text = text_of(source, _LARGEST)
        parse = partial(_parse_markups if suffix == ".mrk.json" else _parse_fiducials, text)
    try:
        landmarks = parse()
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        reason = (
            str(error)
            if isinstance(error, _InvalidContent)
            else "it is damaged, or has another format"
        )
        raise FileFormatError(f"{name}: not a landmark file: {reason}.") from None
    for points in (landmarks.points, landmarks.targets, landmarks.sd):
        if points is not None and not np.isfinite(points).all():
            raise FileFormatError(
                f"{name}: not a landmark file: it contains NaN or infinite values."
            )
    if landmarks.sd is not None and (landmarks.sd < 0).any():
        number = int(np.flatnonzero(landmarks.sd < 0)[0]) + 1
        raise FileFormatError(
            f"{name}: landmark {number} has a negative standard deviation. Use a length, or 0 if "
            "the landmark is exact."
        )
    return landmarks


def read_pairs(path: Path, targets: Path | None = None) -> tuple[LandmarkFile, Points]:
    """Read landmarks and their targets, from one file or from two.

    Parameters
    ----------
    path : Path
        Pairs of BigWarp, or one list of points.
    targets : Path, optional
        List with the targets of these points, in the same order.

    Returns
    -------
    file : LandmarkFile
    targets : ndarray, shape (N, n)

    Raises
    ------
    ProblemError
        If there is not one target for each landmark, in the same unit and order.
    FileFormatError, OSError
        As for `read_points`.
    """
    file = read_points(path)
    if targets is None:
        if file.targets is None:
            raise ProblemError(
                path.name,
                "contains landmarks without target positions. Give pairs of BigWarp, or a second "
                "file with --targets.",
            )
        return file, file.targets
    if file.targets is not None:
        raise ProblemError(path.name, "contains pairs of landmarks. Leave out --targets.")
    other = read_points(targets)
    if other.targets is not None or (len(other.points), other.unit) != (
        len(file.points),
        file.unit,
    ):
        raise ProblemError(
            targets.name,
            f"contains {other}, but {path.name} contains {file}. Give one target for each point.",
        )
    common = {*file.names} & {*other.names}
    if any(file.names.index(name) != other.names.index(name) for name in common):
        raise ProblemError(
            targets.name, f"has the points of {path.name} in another order. Sort them alike."
        )
    return file, other.points


def is_landmark_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a landmark file of 3D Slicer or BigWarp.

    Slicer files are recognized by their suffix, and BigWarp files by the second column of their
    first line, also if a spreadsheet has changed the separators, the encoding or the titles.
    """
    name = os.fsdecode(path).lower()
    if not name.endswith(".csv"):
        return name.endswith(POINT_SUFFIXES)
    try:
        first = _filled(split_cells(Path(path), _LARGEST)[1])[:1]
    except (OSError, FileFormatError):
        return False
    return any(len(row) > 1 and row[1].casefold() in (*_ACTIVE, _TITLE) for row in first)


def write_points(
    path: str | os.PathLike[str],
    points: npt.ArrayLike,
    targets: npt.ArrayLike | None = None,
    *,
    names: Sequence[str] = (),
    sd: npt.ArrayLike | None = None,
) -> Path:
    """Write landmarks atomically, in the format given by the suffix of the path.

    Parameters
    ----------
    path : str or path-like
        Path with one of the suffixes in `POINT_SUFFIXES`. With ``.csv``, the file has BigWarp's
        format if there are `targets`, and otherwise napari's format. With the other suffixes, it
        has a format of 3D Slicer, which does not support `targets`.
    points : array_like, shape (N, 2) or (N, 3)
        Positions of the landmarks, in the order ([z,] y, x); for 3D Slicer in mm, as returned by
        `read_points`.
    targets : array_like, shape (N, 2) or (N, 3), optional
        Target positions of the landmarks.
    names : sequence of str, optional
        Names of the landmarks; by default "Pt-0", "Pt-1", and so on.
    sd : float or array_like, shape (N,), optional
        Standard deviations of the landmarks, in the unit of the coordinates, as a last column of a
        ``.csv`` file; 0 for exact landmarks.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    ProblemError
        If an argument is invalid; the message names the argument.
    FileFormatError
        If the suffix is unknown, or the format does not support targets or standard deviations.
    OSError
        If the file cannot be written.
    """
    target = Path(checked_target(path))
    suffix = _suffix(target)
    starts = _checked("points", points)
    ends = None if targets is None else _checked("targets", targets)
    if ends is not None and ends.shape != starts.shape:
        raise ProblemError(
            "targets",
            f"have shape {ends.shape}, but the points have shape {starts.shape}. Pass one target "
            "for each point.",
        )
    spreads = None if sd is None else _checked_spreads(sd, len(starts))
    labels = [*names, *(f"Pt-{number}" for number in range(len(names), len(starts)))]
    if suffix == ".csv":
        text = _as_csv(starts, ends, labels, spreads)
    elif spreads is not None:
        raise FileFormatError(
            f"{target.name}: this format stores no standard deviations. Save the landmarks as .csv."
        )
    elif ends is not None:
        raise FileFormatError(
            f"{target.name}: this format stores only one list of points. Save the landmarks and "
            "their targets in two files, or as .csv."
        )
    else:
        text = (_as_markups if suffix == ".mrk.json" else _as_fiducials)(_in_space(starts), labels)
    write_whole(target, text.encode())
    return target


class _InvalidContent(ValueError):
    """Error for an invalid landmark file; the message is for the user."""


def _suffix(path: Path) -> str:
    suffix = next((each for each in POINT_SUFFIXES if path.name.lower().endswith(each)), "")
    if not suffix:
        raise FileFormatError(
            f"{path.name}: not the name of a landmark file. Use one of the suffixes "
            f"{', '.join(POINT_SUFFIXES)}."
        )
    return suffix


def _checked(name: str, values: npt.ArrayLike) -> Points:
    points = as_numbers(name, values).astype(np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not np.isfinite(points).all():
        raise ProblemError(
            name, f"have shape {points.shape}. Pass finite numbers of shape (N, 2) or (N, 3)."
        )
    return points


def _checked_spreads(sd: npt.ArrayLike, count: int) -> npt.NDArray[np.float64]:
    spreads = as_numbers("sd", sd).astype(np.float64)
    fits = spreads.shape in ((), (count,))
    if not fits or not (np.isfinite(spreads) & (spreads >= 0)).all():
        raise ProblemError(
            "sd",
            f"has shape {spreads.shape}. Pass one length, or {count} lengths; 0 for exact "
            "landmarks.",
        )
    return np.broadcast_to(spreads, count)


def _in_space(points: Points) -> Points:
    """Return points in three dimensions; 2-D points get a first coordinate of 0."""
    return np.pad(points, ((0, 0), (3 - points.shape[1], 0)))


def _filled(lines: Sequence[tuple[int, list[str]]]) -> list[list[str]]:
    return [cells for _, cells in lines if any(cells)]


def _parse_csv(lines: Sequence[tuple[int, list[str]]]) -> LandmarkFile:
    rows = _filled(lines)
    if not rows:
        raise _InvalidContent("it is empty")
    if rows[0][0].casefold() == "index":  # napari's format
        titles = [title.casefold() for title in rows[0][1:]]
        has_sd = titles[-1:] == ["sd"]
        titles = titles[: len(titles) - has_sd]
        axes = [f"axis-{axis}" for axis in range(3)]
        unknown = next((title for title in titles if title not in axes), None)
        if unknown is not None:
            hint = did_you_mean(unknown, axes)
            raise _InvalidContent(
                f"line 1: there is no column {unknown!r}.{hint} The columns are index, axis-0, "
                "axis-1 and, in a volume, axis-2; the last column may be sd"
            )
        if titles != axes[: len(titles)] or len(titles) < 2:
            raise _InvalidContent(
                "line 1: the columns must be index, axis-0, axis-1 and, in a volume, axis-2"
            )
        places = [row[1 : 1 + len(titles)] for row in rows[1:]]
        points = np.array(places, float).reshape(len(rows) - 1, -1)
        spreads = _spreads([row[1 + len(titles)] for row in rows[1:]]) if has_sd else None
        return LandmarkFile(points, unit="pixel", sd=spreads)
    columns = len(rows[0])
    n = (columns - 2) // 2
    if columns not in _PAIR_COLUMNS or any(len(row) != columns for row in rows):
        raise _InvalidContent(
            "it has neither the column titles of napari's format nor the columns of BigWarp's "
            "format: name, active, and 2 x 2 or 2 x 3 numbers; a further column may contain "
            "standard deviations"
        )
    for number, row in enumerate(rows, 1):
        if row[1].casefold() not in _ACTIVE:
            raise _InvalidContent(
                f"landmark {number}: the second column is {row[1][:40]!r}, but must be true or "
                "false. BigWarp's files have no column titles"
            )
    active = [row for row in rows if row[1].casefold() == "true"]
    for number, row in enumerate(active, 1):
        if wrong := next((cell for cell in row[2 : 2 + 2 * n] if not _is_finite(cell)), None):
            raise _InvalidContent(
                f"active landmark {number} ({row[0]}) has the coordinate {wrong[:40]!r}. Use "
                "finite numbers with a decimal point, or set the landmark to false"
            )
    places = [row[2 : 2 + 2 * n] for row in active]
    numbers = np.array(places, float).reshape(len(active), 2, n)[..., ::-1]
    spreads = _spreads([row[-1] for row in active]) if columns % 2 else None
    names = tuple(row[0] for row in active)
    return LandmarkFile(numbers[:, 0], numbers[:, 1], names, sd=spreads)


def _is_finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _spreads(cells: Sequence[str]) -> npt.NDArray[np.float64]:
    """Return a column of standard deviations, with 0 for empty cells."""
    return np.array([cell or "0" for cell in cells], float)


def _as_csv(
    points: Points,
    targets: Points | None,
    names: Sequence[str],
    sd: npt.NDArray[np.float64] | None,
) -> str:
    last = [[]] * len(points) if sd is None else [[spread] for spread in sd.tolist()]
    if targets is None:
        axes = [f"axis-{axis}" for axis in range(points.shape[1])]
        titles = ["index", *axes, *["sd"] * (sd is not None)]
        rows = zip(points.tolist(), last, strict=True)
        return csv_text([titles, *([n, *point, *end] for n, (point, end) in enumerate(rows))])
    pairs = np.concatenate([points[:, ::-1], targets[:, ::-1]], axis=1).tolist()
    lines = zip(names, pairs, last, strict=True)
    return csv_text([name, "true", *pair, *end] for name, pair, end in lines)


def _parse_markups(text: str) -> LandmarkFile:
    lists = json.loads(text)["markups"]
    if len(lists) != 1:
        raise _InvalidContent(f"it contains {len(lists)} lists of points; save only one of them")
    markups: Mapping[str, Any] = lists[0]
    points = [
        (str(each.get("label", "")), each["position"])
        for each in markups["controlPoints"]
        if each.get("positionStatus", "defined") == "defined"
    ]
    if "coordinateSystem" not in markups:
        raise _InvalidContent(
            "it has no coordinateSystem, so that its points may be in LPS or RAS. Add the one that "
            "is right"
        )
    unit = markups.get("coordinateUnits", "mm")
    unit = unit[0] if isinstance(unit, list) else unit  # a code, its scheme and its meaning
    factor = unit_factor(str(unit), "millimeter")
    if not math.isfinite(factor):
        raise _InvalidContent(f"its points are in {unit!r}, which is not a unit of length")
    return _slicer_landmarks(points, markups["coordinateSystem"], factor)


def _as_markups(points: Points, names: Sequence[str]) -> str:
    listed = [
        {"id": str(number + 1), "label": name, "position": point[::-1], "positionStatus": "defined"}
        for number, (name, point) in enumerate(zip(names, points.tolist(), strict=True))
    ]
    markups = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": listed,
    }
    return json.dumps({"@schema": _SLICER_SCHEMA, "markups": [markups]}, indent=1) + "\n"


def _parse_fiducials(text: str) -> LandmarkFile:
    system, columns, points = "", ["id", "x", "y", "z"], []
    for line in text.splitlines():
        key, _, value = line.lstrip("# ").partition("=")
        if line.startswith("#"):
            if key.strip() == "CoordinateSystem":
                system = value.strip()
            elif key.strip() == "columns":
                columns = [name.strip() for name in value.split(",")]
        elif line.strip():
            row = dict(zip(columns, next(csv.reader([line])), strict=False))
            points.append((row.get("label", ""), [row["x"], row["y"], row["z"]]))
    if not system:
        raise _InvalidContent(
            "it has no line '# CoordinateSystem = LPS' or '# CoordinateSystem = RAS'. Add the one "
            "that is right; versions of 3D Slicer before 4 wrote RAS"
        )
    return _slicer_landmarks(points, system)


def _as_fiducials(points: Points, names: Sequence[str]) -> str:
    head = (
        "# Markups fiducial file version = 5.0\n"
        "# CoordinateSystem = LPS\n"
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    )
    named = enumerate(zip(names, points.tolist(), strict=True), 1)
    return head + csv_text(
        [number, x, y, z, 0, 0, 0, 1, 1, 1, 0, name, "", ""] for number, (name, (z, y, x)) in named
    )


def _slicer_landmarks(
    points: Sequence[tuple[str, Sequence[Any]]], system: Any, factor: float = 1.0
) -> LandmarkFile:
    """Return points of a file of 3D Slicer, whose unit is a number of millimetres."""
    if str(system) not in _TO_LPS:
        raise _InvalidContent(
            f"its coordinate system is {system!r}. Save it with 3D Slicer in LPS or RAS"
        )
    places = np.array([place for _, place in points], float).reshape(len(points), 3)
    return LandmarkFile(
        (factor * places * _TO_LPS[str(system)])[:, ::-1],
        names=tuple(n for n, _ in points),
        unit="mm",
    )
