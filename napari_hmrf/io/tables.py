"""Tables of materials and of boundary rules as comma-separated text, as spreadsheets write it.

Materials have the columns ``label,stiffness`` and, if wanted, ``name``, ``poisson`` and ``growth``
(0.1: a tenth longer; ``0.1/0``: along rows only); the stiffness of what moves as one is the word
``rigid``. Rules have ``label,action`` and, if wanted, ``name``, ``row`` and ``col`` (how far what
moves goes, or how strongly it is pulled; in a volume ``plane``, too), ``amount`` (by how much what
expands grows, or the pressure) and ``confidence``.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from napari_hmrf.arguments import checked_path
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.field.directions import Directions
from napari_hmrf.field.held_forces import HeldForce
from napari_hmrf.field.measurement import Measurement
from napari_hmrf.field.units import as_seen
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material, read_stiffness

T = TypeVar("T")
#: Larger files are no tables of ours, and are not read.
_LARGEST = 2**20
#: What the measurements of a volume are called, of which these differ.
_OF_VOLUMES = {"pixels": "voxels", "area": "volume", "area_change": "volume_change"}
#: Of measurements, those in per cent: their columns say so.
_PER_CENT = ("area_change", "mean_strain", "largest_strain")
_MATERIALS = TypeAdapter(tuple[Material, ...])
_RULES = TypeAdapter(tuple[BoundaryRule, ...])


def read_materials(path: str | os.PathLike[str]) -> tuple[Material, ...]:
    """Read a table of materials from a .csv.

    Raises
    ------
    FileFormatError
        Saying what is wrong with which line.
    OSError
        If it cannot be opened.
    """

    def row(cells: dict[str, str]) -> dict[str, Any]:
        named: dict[str, Any] = {"name": f"tissue {cells.get('label')}", **cells}
        if "/" in cells.get("growth", ""):
            named["growth"] = cells["growth"].split("/")
        return {**named, "stiffness": read_stiffness(cells["stiffness"])}

    return _read(path, _MATERIALS, row, needed=("label", "stiffness"))


def read_rules(path: str | os.PathLike[str]) -> tuple[BoundaryRule, ...]:
    """Read a table of boundary rules from a .csv.

    Raises
    ------
    FileFormatError, OSError
        As of `read_materials`.
    """

    def row(cells: dict[str, str]) -> dict[str, Any]:
        across = [cells.pop("plane")] if "plane" in cells else []
        vector = (*across, cells.pop("row", 0), cells.pop("col", 0))
        confidence = (cells.pop("confidence", 1),) * 2
        return {**cells, "vector": vector, "confidence": confidence}

    return _read(path, _RULES, row, needed=("label", "action"))


def measurement_titles(*, volume: bool) -> list[str]:
    """What the columns of measurements are called, of a slice or of a volume."""
    words = _OF_VOLUMES if volume else {}
    return [
        f"{words.get(name, name)}{'_percent' * (name in _PER_CENT)}" for name in Measurement._fields
    ]


def measurements_in_words(
    rows: Sequence[Measurement], unit: str, *, volume: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Say measurements for people to read.

    Parameters
    ----------
    rows : sequence of Measurement
    unit : str
        Of lengths.
    volume : bool
        Whether they are of a volume: its columns are called so.

    Returns
    -------
    titles : list of str
        Of the columns.
    cells : list of list of str
        Of each row.
    """
    size, content, site = ("volume", "³", "voxels") if volume else ("area", "²", "px")
    columns = {
        "tissue": "name",
        "label": "label",
        f"{size} ({unit}{content})": "area",
        f"{size} change (%)": "area_change",
        f"moved, mean ({unit})": "mean_displacement",
        f"moved, most ({unit})": "largest_displacement",
        "strain, mean (%)": "mean_strain",
        "strain, most (%)": "largest_strain",
        f"folds ({site})": "folds",
    }
    axes = 3 if volume else 2
    return [*columns], [[_in_words(row, name, axes) for name in columns.values()] for row in rows]


def forces_in_words(
    rows: Sequence[HeldForce], ways: Directions, stiffness: str, unit: str
) -> tuple[list[str], list[list[str]]]:
    """Say what it takes to hold and to move tissue, for people to read.

    Parameters
    ----------
    rows : sequence of HeldForce
    ways : Directions
        Along which forces are told.
    stiffness, unit : str
        The unit of stiffness, "" if that is not known, and that of lengths.

    Returns
    -------
    titles : list of str
        Of the columns.
    cells : list of list of str
        Of each row.
    """
    volume = len(ways.order) == 3
    content, site = ("²", "voxel") if volume else ("", "pixel")
    of = f"{stiffness or 'stiffness'} {unit}{content}"
    titles = ["what", f"around {site}", f"{site}s", f"force ({of})", "which way"]
    cells = []
    for row in rows:
        seen = tuple(float(f"{part:.3g}") for part in ways.seen(row.force))
        size = math.hypot(*row.force)
        where = ", ".join(f"{round(along)}" for along in row.centre)
        what = "moved" if row.moves else "held"
        cells.append([what, where, f"{row.sites}", f"{size:.3g}", ways.step(seen)])
    return titles, cells


def _in_words(row: Measurement, name: str, axes: int) -> str:
    """Four digits; of large areas all before the point, and nothing of what nobody sees."""
    value = getattr(row, name)
    if not isinstance(value, float):
        return str(value)
    if name != "area":
        pixel = (row.area / row.pixels) ** (1 / axes)
        value = as_seen(value, [pixel if name.endswith("displacement") else 1.0])
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def save_measurements(
    path: str | os.PathLike[str],
    rows: Sequence[Measurement],
    unit: str = "",
    *,
    volume: bool = False,
) -> Path:
    """Write measurements to a .csv, a line for each tissue.

    Parameters
    ----------
    path : str or path-like
    rows : sequence of Measurement
    unit : str
        Of lengths, for a last column; without it there is none.
    volume : bool
        Whether they are of a volume: its columns are called so.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    target = Path(checked_path(path))
    file = io.StringIO()
    more = {"unit": unit} if unit else {}
    titles = measurement_titles(volume=volume)
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*titles, *more])
    writer.writerows([*row, *more.values()] for row in rows)
    write_whole(target, file.getvalue().encode())
    return target


def _read(
    path: str | os.PathLike[str], kind: TypeAdapter[T], row: Any, needed: tuple[str, ...]
) -> T:
    source = Path(checked_path(path))
    if source.stat().st_size > _LARGEST:
        raise FileFormatError(f"{source.name} is too large to be a table.")
    try:
        lines = [*csv.DictReader(io.StringIO(source.read_text("utf-8-sig")), skipinitialspace=True)]
    except (csv.Error, UnicodeDecodeError):
        raise FileFormatError(f"{source.name} is no table of comma-separated text.") from None
    missing = [name for name in needed if not lines or name not in lines[0]]
    if missing:
        raise FileFormatError(
            f"{source.name} lacks the column {missing[0]!r}. Its first line names the columns."
        )
    cells = [
        {key: text.strip() for key, text in line.items() if key and text and text.strip()}
        for line in lines
    ]
    try:
        return kind.validate_python([row(each) for each in cells])
    except KeyError as error:
        raise FileFormatError(f"{source.name} has a line without {error}.") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        number, where = first["loc"][0], " ".join(str(part) for part in first["loc"][1:2])
        raise FileFormatError(
            f"{source.name}: line {int(number) + 2}: {where}: {first['msg']}, not "
            f"{str(first['input'])[:40]!r}."
        ) from None
