"""Tables of materials, boundary rules, measurements and forces.

Materials and boundary rules are read from .csv or .json files. A table of materials has the columns
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

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from pydantic import TypeAdapter

from napari_hmrf.arguments import checked_target
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.checks import Choice, Number, Painted, Share, Text, checked
from napari_hmrf.errors import ArgumentError, FileFormatError
from napari_hmrf.io.table_files import Table, read_rows, write_csv
from napari_hmrf.results.measurement import Measurement
from napari_hmrf.solver.elastic_strain import StrainKind
from napari_hmrf.tissue.boundary_rules import (
    Action,
    BoundaryRule,
    Material,
    stiffness_in_words,
)
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.tissue_names import NamedMaterials

_PRESET = TypeAdapter(Preset)
#: Suffix of the files that `write_preset` writes.
ENDING = ".json"
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


@checked
class _RuleRow:
    """Row of a table of rules; a missing cell is None."""

    label: Painted
    action: Annotated[Action, Choice()]
    name: Text = ""
    plane: Number | None = None
    row: Number | None = None
    col: Number | None = None
    amount: Number | None = None
    confidence: Share | None = None


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


def read_preset(path: str | os.PathLike[str]) -> Preset:
    """Read a table of materials from a .csv, or from a .json that `write_preset` wrote.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    Preset
        Materials in the order of the table. The name is that of the file if the file does not
        state one.

    Raises
    ------
    FileFormatError
        If the table is invalid; the message states the line or row and the error.
    OSError
        If the file cannot be opened.
    """
    table = read_rows(path, Material, defaults={"name": ""}, comments=("source",))
    _refuse_duplicates(table)
    rows = [row for _, row in table.rows]
    _refuse_void(rows, table.file)
    named = tuple(row if row.name else replace(row, name=f"tissue {row.label}") for row in rows)
    about = {"name": "", "unit": "", "source": f"the file {table.file}", **table.about}
    about["name"] = about["name"] or Path(table.file).stem
    try:
        return Preset(**about, materials=named)
    except ArgumentError as error:
        raise FileFormatError(f"{table.file}: {error}.") from None


def _refuse_void(materials: Iterable[Material], file: str) -> None:
    if not any(row.stiffness for row in materials):
        raise FileFormatError(f"{file} has no stiffness above 0. Give each tissue a stiffness.")


def write_preset(path: str | os.PathLike[str], preset: Preset) -> Path:
    """Write materials to a .json file, atomically.

    Example of a file::

        {
          "name": "Liver",
          "unit": "kPa",
          "source": "origin of the values",
          "materials": [
            {"label": 1, "name": "liver", "stiffness": 5.4, "poisson": 0.49}
          ]
        }

    The stiffness of rigid tissue is the word ``"rigid"``.

    Parameters
    ----------
    path : str or path-like
        Path of the file; ``.json`` is appended if the name has no suffix. An existing file is
        replaced.
    preset : Preset

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FileFormatError
        If no material has a stiffness, so that the file could not be read again.
    OSError
        If the file cannot be written.
    """
    target = Path(checked_target(path))
    target = target if target.suffix else target.with_suffix(ENDING)
    _refuse_void(preset.materials, target.name)
    write_whole(target, _PRESET.dump_json(preset, indent=2) + b"\n")
    return target


def read_materials(path: str | os.PathLike[str]) -> tuple[Material, ...]:
    """Read the materials of a table; see `read_preset`."""
    return read_preset(path).materials


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
    table = read_rows(path, _RuleRow)
    _refuse_duplicates(table)
    return tuple(_rule(row, f"{table.file}: {place}") for place, row in table.rows)


def _refuse_duplicates(table: Table[Any]) -> None:
    """Raise an error if two rows of a table have the same label."""
    labels = set()
    for place, row in table.rows:
        if row.label in labels:
            raise FileFormatError(
                f"{table.file}: {place}: label {row.label} occurs twice. Remove one of them."
            )
        labels.add(row.label)


def _rule(row: _RuleRow, where: str) -> BoundaryRule:
    """Return the rule in a row; raise an error if a cell is missing or has no effect."""
    action, used = row.action, _USED[row.action]
    needed = [title for title in used if title in ("row", "col", "amount")]
    missing = [title for title in needed if getattr(row, title) is None]
    if missing and action not in _STILL:
        if missing == needed:
            raise FileFormatError(
                f"{where}: the action of label {row.label} is {action}, but its "
                f"{' and '.join(needed)} {'is' if len(needed) == 1 else 'are'} missing. "
                f"Give {', '.join(title for title in used if title != 'confidence')}"
                f"{'; plane is for volumes' if 'plane' in used else ''}."
            )
        raise FileFormatError(
            f"{where}: {action} has no value in {missing[0]!r}. Give 0 if it has no component "
            "along this axis."
        )
    for title, neutral in _NEUTRAL.items():
        if title not in used and getattr(row, title) not in (None, neutral):
            usage = f"uses {' and '.join(needed)}" if needed else "does not use a length"
            raise FileFormatError(
                f"{where}: {title} has no effect on {action}, which {usage}. Leave the cell "
                "empty, or give another action."
            )
    vector = (row.row or 0.0, row.col or 0.0)
    return BoundaryRule(
        row.label,
        action,
        vector=vector if row.plane is None else (row.plane, *vector),
        amount=row.amount or 0.0,
        confidence=(1.0 if row.confidence is None else row.confidence,) * 2,
        name=row.name,
    )


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
    kind = strain_of(rows).replace("-", "_")
    words = {name: name.replace("strain", f"{kind}_strain") for name in Measurement._fields}
    words |= _OF_VOLUMES if volume else _OF_IMAGES
    words |= {name: f"{title}{_stress_suffix(rows)}" for name, title in _OF_STRESS.items()}
    hidden = {"strain", "stress_unit", "mean_vector", "mean_vector_sd"}
    if not has_stress(rows):
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


def has_stress(rows: Sequence[Measurement]) -> bool:
    """Return whether any tissue has a stress."""
    return any(row.mean_von_mises is not None for row in rows)


def _stress_suffix(rows: Sequence[Measurement]) -> str:
    """Return the unit of stress as the end of a column title; "" for relative stress."""
    return f"_{rows[0].stress_unit}" if rows and rows[0].stress_unit else ""


def strain_of(rows: Sequence[Measurement]) -> StrainKind:
    """Return the kind of strain in measurements, which is the same for all tissues."""
    return rows[0].strain if rows else "elastic"


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
