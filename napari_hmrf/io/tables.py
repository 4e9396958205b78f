"""Tables of materials, boundary rules, measurements and forces.

Materials and boundary rules are read from .csv files. A table of materials has the columns
``label`` and ``stiffness`` and, optionally, ``name``, ``poisson``, ``growth`` and ``source``:

- The stiffness of rigid tissue is the word ``rigid``.
- A growth of 0.1 increases lengths by a tenth; ``0.1/0`` does so along the first axis of a slice
  only.
- The source is a comment, which is ignored.

A table of rules has the columns ``label`` and ``action`` and, optionally, ``name`` and:

- ``row``, ``col`` and, in a volume, ``plane``: displacement of the action "move", or force of the
  action "pull";
- ``amount``: distance of the actions "expand" and "slide" along the outward normal, or pressure of
  the action "press"; it may be omitted for "slide";
- ``confidence``.

Cells that the action of a rule does not use must be empty or have no effect.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pydantic import TypeAdapter

from napari_hmrf.arguments import checked_path
from napari_hmrf.checks import POISSON_RANGE, Flag, Growth, Poisson, Stiffness
from napari_hmrf.errors import FileFormatError
from napari_hmrf.field.directions import Directions
from napari_hmrf.field.elastic_strain import StrainKind
from napari_hmrf.field.held_forces import HeldForce
from napari_hmrf.field.measurement import Measurement
from napari_hmrf.field.units import as_seen
from napari_hmrf.io.csv_files import read_csv, unknown_column, write_csv
from napari_hmrf.tissue.boundary_rules import (
    RIGID,
    Action,
    BoundaryRule,
    Material,
    stiffness_in_words,
)
from napari_hmrf.tissue.tissue_names import KnownTissue, NamedMaterials

#: Largest size of a table, in bytes; a larger file is not read.
_LARGEST = 2**20
#: Titles of measurement columns that differ between slices and volumes.
_OF_IMAGES = {"size": "area", "size_change": "area_change"}
_OF_VOLUMES = {"pixels": "voxels", "size": "volume", "size_change": "volume_change"}
#: Measurements in per cent, for which the column titles contain the unit.
_PER_CENT = ("size_change", "mean_strain", "largest_strain")
#: Titles of the columns of stress, without its unit.
_OF_STRESS = {
    "mean_von_mises": "mean_von_mises_stress",
    "largest_von_mises": "largest_von_mises_stress",
    "mean_pressure": "mean_pressure",
}
#: Measurement that is a column only if the uncertainty is known.
_SD = "mean_displacement_sd"
#: Share of the magnitude of a force below which a component is shown as 0.
_NOISE = 1e-3


class _Column(NamedTuple):
    """Type of a column: a function that converts a cell, and the description of a valid cell."""

    read: Callable[[str], Any]
    right: str


def _number(low: float = -math.inf, high: float = math.inf) -> Callable[[str], float]:
    def read(text: str) -> float:
        value = float(text)
        if not (math.isfinite(value) and low <= value <= high):
            raise ValueError
        return value

    return read


def _label(first: int) -> _Column:
    def read(text: str) -> int:
        value = float(text)  # some spreadsheets write labels in the form 1.0
        if not value.is_integer() or value < first:
            raise ValueError
        return int(value)

    return _Column(read, f"a whole number, {first} or more")


def _action(text: str) -> str:
    if text.casefold() not in get_args(Action):
        raise ValueError
    return text.casefold()


_NAME = _Column(str, "a name")
_LENGTH = _Column(_number(), "a number, a length in the image's unit (press, pull: a pressure)")
_OF_MATERIALS = {
    "label": _label(0),
    "name": _NAME,
    "stiffness": _Column(
        TypeAdapter(Stiffness).validate_python, 'a non-negative number, or "rigid"'
    ),
    "poisson": _Column(
        TypeAdapter(Poisson).validate_python, "a number from {:g} to {:g}".format(*POISSON_RANGE)
    ),
    "growth": _Column(
        TypeAdapter(Growth).validate_python,
        "a number such as 0.2 or 20% (a fifth longer), up to 10, or one for each axis",
    ),
    "slides": _Column(
        TypeAdapter(Flag).validate_python, "yes, if the tissue slides along all other tissue, or no"
    ),
    "source": _Column(str, "the source of the numbers"),
}
_OF_RULES = {
    "label": _label(1),
    "name": _NAME,
    "action": _Column(_action, ", ".join(get_args(Action)[:-1]) + f" or {get_args(Action)[-1]}"),
    **dict.fromkeys(("plane", "row", "col", "amount"), _LENGTH),
    "confidence": _Column(_number(0, 1), "a number from 0 to 1"),
}
#: Columns that each action uses; all columns except plane and confidence are required.
_USED: dict[Action, tuple[str, ...]] = {
    "fixed": ("confidence",),
    "move": ("plane", "row", "col", "confidence"),
    "expand": ("amount", "confidence"),
    "press": ("amount",),
    "pull": ("plane", "row", "col"),
    "slide": ("amount",),
    "remove": (),
}
#: Actions whose distance is 0 by default.
_STILL: tuple[Action, ...] = ("slide",)
#: Values without any effect, which are allowed in unused cells.
_NEUTRAL = {"plane": 0.0, "row": 0.0, "col": 0.0, "amount": 0.0, "confidence": 1.0}
#: Kind of table for each column that occurs in only one kind of table.
_OTHER_TABLES = {
    **{title: "a table of rules" for title in _OF_RULES if title not in _OF_MATERIALS},
    **{title: "a table of materials" for title in _OF_MATERIALS if title not in _OF_RULES},
}
#: Titles of the columns of a table of materials.
MATERIAL_COLUMNS = (*_OF_MATERIALS,)


def value_of(column: str, text: str) -> Any:
    """Convert the text of a cell in a table of materials or rules.

    Parameters
    ----------
    column : str
        Title of the column.
    text : str
        Text of the cell.

    Raises
    ------
    ValueError
        If the cell is invalid; the message describes a valid cell.
    """
    kind = {**_OF_RULES, **_OF_MATERIALS}[column]
    try:
        return kind.read(text)
    except ValueError:
        raise ValueError(kind.right) from None


def read_materials(path: str | os.PathLike[str]) -> tuple[Material, ...]:
    """Read a table of materials from a .csv.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    tuple of Material
        Materials in the order of the table.

    Raises
    ------
    FileFormatError
        If the table is invalid; the message states the line and the error.
    OSError
        If the file cannot be opened.
    """
    rows = _read(path, _OF_MATERIALS, needed=("label", "stiffness"))
    if not any(row["stiffness"] for _, row in rows):
        raise FileFormatError(
            f"{Path(path).name} has no stiffness above 0. Give each tissue a stiffness."
        )
    for _, row in rows:
        row.pop("source", None)
    return tuple(Material(**{"name": f"tissue {row['label']}", **row}) for _, row in rows)


def write_named_materials(path: str | os.PathLike[str], found: NamedMaterials) -> Path:
    """Write the materials of a segmentation to a .csv, in the format of `read_materials`.

    The rows of labels with unknown materials have no stiffness; the user must fill in the stiffness
    or remove these rows.

    Parameters
    ----------
    path : str or path-like
    found : NamedMaterials
        Materials of the segmentation, and labels with unknown materials.

    Raises
    ------
    FileFormatError
        If the name does not end in .csv.
    OSError
        If the file cannot be written.
    """
    known = {
        row.label: (
            stiffness_in_words(row.stiffness),
            f"{row.poisson:g}" if row.is_deformable else "",
            "{0.name}: {0.source}".format(found.tissues[row.label]),
        )
        for row in found.materials
    }
    names = {**{row.label: row.name for row in found.materials}, **found.unknown}
    titles = ["label", "name", "stiffness", "poisson", "source"]
    rows = ([label, names[label], *known.get(label, ("", "", ""))] for label in sorted(names))
    return write_csv(path, titles, rows, what="materials")


def read_rules(path: str | os.PathLike[str]) -> tuple[BoundaryRule, ...]:
    """Read a table of boundary rules from a .csv.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    tuple of BoundaryRule
        Rules in the order of the table.

    Raises
    ------
    FileFormatError, OSError
        As for `read_materials`.
    """
    rows = _read(path, _OF_RULES, needed=("label", "action"))
    return tuple(_rule(row, f"{Path(path).name}: line {line}") for line, row in rows)


def _rule(row: dict[str, Any], where: str) -> BoundaryRule:
    """Return the rule in a row; raise an error if a cell is missing or has no effect."""
    action, label = row["action"], row["label"]
    used = _USED[action]
    needed = [title for title in used if title in ("row", "col", "amount")]
    missing = [title for title in needed if title not in row and action not in _STILL]
    if missing:
        if missing == needed:
            raise FileFormatError(
                f"{where}: the action of label {label} is {action}, but its "
                f"{' and '.join(needed)} {'is' if len(needed) == 1 else 'are'} missing. "
                f"Give {', '.join(title for title in used if title != 'confidence')}"
                f"{'; plane is for volumes' if 'plane' in used else ''}."
            )
        raise FileFormatError(
            f"{where}: {action} has no value in {missing[0]!r}. Give 0 if it has no component "
            "along this axis."
        )
    unused = [title for title, neutral in _NEUTRAL.items() if title not in used]
    for title in unused:
        if row.pop(title, _NEUTRAL[title]) != _NEUTRAL[title]:
            usage = f"uses {' and '.join(needed)}" if needed else "does not use a length"
            raise FileFormatError(
                f"{where}: {title} has no effect on {action}, which {usage}. Leave the cell "
                "empty, or give another action."
            )
    vector: tuple[float, ...] = (row.pop("row", 0.0), row.pop("col", 0.0))
    if "plane" in row:
        vector = (row.pop("plane"), *vector)
    confidence = (row.pop("confidence", 1.0),) * 2
    return BoundaryRule(**row, vector=vector, confidence=confidence)


def named_materials_in_words(found: NamedMaterials) -> str:
    """Return text that lists the labels recognized as each known tissue, and unknown labels."""
    of_tissue: dict[KnownTissue, list[str]] = {}
    for row in found.materials:
        of_tissue.setdefault(found.tissues[row.label], []).append(f"{row.label} {row.name}")
    lines = []
    for tissue, labels in of_tissue.items():
        stiffness = stiffness_in_words(tissue.stiffness, found.unit)
        values = (
            f"{stiffness}, nu {tissue.poisson:g}" if 0 < tissue.stiffness < RIGID else stiffness
        )
        lines.append(f"{tissue.name} ({values}): {', '.join(labels)}")
    if found.unknown:
        labels = [f"{label} {name}" for label, name in found.unknown.items()]
        lines.append(f"unknown (fill in or remove): {', '.join(labels)}")
    return "\n".join(lines)


def measurement_table(
    rows: Sequence[Measurement], *, volume: bool = False
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Convert measurements to the titles and cells of a table.

    Parameters
    ----------
    rows : sequence of Measurement
    volume : bool
        True for measurements of a volume.

    Returns
    -------
    titles : list of str
        Titles of the columns. The titles of strain columns contain the kind of strain, as in
        "mean_elastic_strain_percent", and those of stress its unit, as in
        "mean_von_mises_stress_kPa". Measurements with error bars have the further column
        "mean_displacement_sd".
    cells : list of tuple
        Cells of each row.
    """
    kind = _strain_of(rows).replace("-", "_")
    words = {name: name.replace("strain", f"{kind}_strain") for name in Measurement._fields}
    words |= _OF_VOLUMES if volume else _OF_IMAGES
    words |= {name: f"{title}{_stress_suffix(rows)}" for name, title in _OF_STRESS.items()}
    hidden = {"strain", "stress_unit", "mean_vector", "mean_vector_sd"}
    if not _has_stress(rows):
        hidden |= _OF_STRESS.keys()
    if not has_error_bars(rows):
        hidden.add(_SD)
    names = [name for name in Measurement._fields if name not in hidden]
    if _SD in names:  # beside its mean
        names.remove(_SD)
        names.insert(names.index("mean_displacement") + 1, _SD)
    titles = [f"{words[name]}{'_percent' * (name in _PER_CENT)}" for name in names]
    return titles, [tuple(getattr(row, name) for name in names) for row in rows]


def has_error_bars(rows: Sequence[Measurement]) -> bool:
    """Return whether measurements have error bars of the mean displacement."""
    return any(row.mean_displacement_sd is not None for row in rows)


def _vector_table(
    rows: Sequence[Measurement], *, volume: bool
) -> tuple[list[str], list[tuple[float | None, ...]]]:
    """Return the columns of the mean displacement along each axis; none without error bars."""
    if not has_error_bars(rows):
        return [], [() for _ in rows]
    axes = ("plane", "row", "col")[-3 if volume else -2 :]
    titles = [f"mean_displacement_{axis}{sd}" for axis in axes for sd in ("", "_sd")]
    empty: tuple[float | None, ...] = (None,) * len(titles)
    cells = []
    for row in rows:
        pairs = zip(row.mean_vector, row.mean_vector_sd, strict=True)
        cells.append((*chain.from_iterable(pairs),) or empty)
    return titles, cells


def _has_stress(rows: Sequence[Measurement]) -> bool:
    """Return whether any tissue has a stress."""
    return any(row.mean_von_mises is not None for row in rows)


def _stress_suffix(rows: Sequence[Measurement]) -> str:
    """Return the unit of stress as the end of a column title; "" for relative stress."""
    return f"_{rows[0].stress_unit}" if rows and rows[0].stress_unit else ""


def _strain_of(rows: Sequence[Measurement]) -> StrainKind:
    """Return the kind of strain in measurements, which is the same for all tissues."""
    return rows[0].strain if rows else "elastic"


def measurements_in_words(
    rows: Sequence[Measurement], unit: str, *, volume: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Format measurements as text for display.

    Parameters
    ----------
    rows : sequence of Measurement
    unit : str
        Unit of length.
    volume : bool
        True for measurements of a volume, which have different column titles.

    Returns
    -------
    titles : list of str
        Titles of the columns.
    cells : list of list of str
        Cells of each row.
    """
    size, content, site = ("volume", "³", "voxels") if volume else ("area", "²", "px")
    kind = _strain_of(rows)
    columns = {
        "tissue": "name",
        "label": "label",
        f"{size} ({unit}{content})": "size",
        f"{size} change (%)": "size_change",
        f"moved, mean ({unit})": "mean_displacement",
        f"moved, most ({unit})": "largest_displacement",
        f"{kind} strain, mean (%)": "mean_strain",
        f"{kind} strain, most (%)": "largest_strain",
        f"folds ({site})": "folds",
    }
    if _has_stress(rows):
        unit_of_stress = rows[0].stress_unit or "relative"
        columns |= {
            f"von Mises, mean ({unit_of_stress})": "mean_von_mises",
            f"von Mises, most ({unit_of_stress})": "largest_von_mises",
            f"pressure, mean ({unit_of_stress})": "mean_pressure",
        }
    axes = 3 if volume else 2
    return [*columns], [[_in_words(row, name, axes) for name in columns.values()] for row in rows]


def forces_in_words(
    rows: Sequence[HeldForce], ways: Directions, stiffness: str, unit: str
) -> tuple[list[str], list[list[str]]]:
    """Format the forces on constrained tissue as text for display.

    Parameters
    ----------
    rows : sequence of HeldForce
    ways : Directions
        Directions of the force components on the screen.
    stiffness : str
        Unit of stiffness; "" if unknown.
    unit : str
        Unit of length.

    Returns
    -------
    titles : list of str
        Titles of the columns.
    cells : list of list of str
        Cells of each row.
    """
    volume = len(ways.order) == 3
    content, site = ("²", "voxel") if volume else ("", "pixel")
    of = f"{stiffness or 'relative'} {unit}{content}"
    titles = ["what", f"around {site}", f"{site}s", f"force ({of})", "which way"]
    cells = []
    for row in rows:
        size = math.hypot(*row.force)
        parts = (part if abs(part) > _NOISE * size else 0.0 for part in ways.to_display(row.force))
        seen = tuple(float(f"{part:.3g}") for part in parts)
        where = ", ".join(f"{round(along)}" for along in row.centre)
        what = "moved" if row.moves else "held"
        cells.append([what, where, f"{row.sites}", f"{size:.3g}", ways.step(seen)])
    return titles, cells


def _in_words(row: Measurement, name: str, axes: int) -> str:
    """Format a measurement with four digits; show large numbers in full and tiny values as 0."""
    value = getattr(row, name)
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    if name in _OF_STRESS:
        return f"{value:.4g}"
    if name != "size":
        pixel = (row.size / row.pixels) ** (1 / axes)
        value = as_seen(value, [pixel if name.endswith("displacement") else 1.0])
    if name == "mean_displacement" and row.mean_displacement_sd:
        return _with_error_bar(value, row.mean_displacement_sd)
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _with_error_bar(value: float, sd: float) -> str:
    """Format a value with its standard deviation, with two significant digits of the latter."""
    decimals = max(0, 1 - math.floor(math.log10(sd)))
    return f"{value:.{decimals}f} ± {sd:.{decimals}f}"


def write_measurements(
    path: str | os.PathLike[str],
    rows: Sequence[Measurement],
    unit: str = "",
    *,
    volume: bool = False,
) -> Path:
    """Write measurements to a .csv, with a row for each tissue.

    Measurements with error bars also have the mean displacement along each axis, with its standard
    deviation. Tissues without error bars have empty cells there.

    Parameters
    ----------
    path : str or path-like
    rows : sequence of Measurement
    unit : str
        Unit of length, written to an additional last column; "" omits the column.
    volume : bool
        True for measurements of a volume, which have different column titles.

    Raises
    ------
    FileFormatError
        If the name does not end in .csv.
    OSError
        If the file cannot be written.
    """
    more = {"unit": unit} if unit else {}
    titles, cells = measurement_table(rows, volume=volume)
    of_axes, vectors = _vector_table(rows, volume=volume)
    lines = (
        ["" if cell is None else cell for cell in (*row, *vector, *more.values())]
        for row, vector in zip(cells, vectors, strict=True)
    )
    return write_csv(path, [*titles, *of_axes, *more], lines, what="measurements")


def _read(
    path: str | os.PathLike[str], columns: dict[str, _Column], needed: tuple[str, ...]
) -> list[tuple[int, dict[str, Any]]]:
    """Return the rows of a table, as values by column title, and their line numbers.

    Empty cells are omitted.
    """
    source = Path(checked_path(path))
    file, known = source.name, ", ".join(columns)

    def check(written: list[str], line: int) -> list[str]:
        titles = [title.casefold() for title in written]
        unknown = [title for title in titles if title and title not in columns]
        if unknown:
            raise unknown_column(file, line, unknown[0], [*columns], _OTHER_TABLES)
        missing = [name for name in needed if name not in titles]
        if missing:
            raise FileFormatError(
                f"{file}: line {line} lacks the column {missing[0]!r}. Give the column titles, "
                f"separated by commas: {known}."
            )
        return titles

    lines = read_csv(source, largest=_LARGEST, check=check).lines
    if not lines:
        raise FileFormatError(f"{file} has no lines below the column titles. Add a line.")
    rows = [(number, _values(line, f"{file}: line {number}", columns)) for number, line in lines]
    labels = []
    for number, row in rows:
        lacking = [name for name in needed if name not in row]
        if lacking:
            raise FileFormatError(
                f"{file}: line {number} has no value in {lacking[0]!r}. Give "
                f"{columns[lacking[0]].right}."
            )
        if row["label"] in labels:
            raise FileFormatError(
                f"{file}: line {number}: label {row['label']} occurs twice. Remove one of them."
            )
        labels.append(row["label"])
    return rows


def _values(cells: dict[str, str], where: str, columns: dict[str, _Column]) -> dict[str, Any]:
    """Convert the cells of a row, and return their values by column title."""
    row = {}
    for title, text in cells.items():
        try:
            row[title] = columns[title].read(text)
        except ValueError:
            raise FileFormatError(
                f"{where}: {title} is {text[:40]!r}. Give {columns[title].right}."
            ) from None
    return row
