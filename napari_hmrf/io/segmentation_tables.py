"""Reading of tables with the label names of segmentations, as written by other tools.

=========================  ====================================================================
TotalSegmentator, nnU-Net  .json: a class map, or a `dataset.json` with the key `labels`
any tool, 3D Slicer        .csv: a column of labels and a column of names
FreeSurfer, 3D Slicer      .txt, .ctbl: label, name, and a colour as four numbers
ITK-SNAP                   .txt: label, six numbers, and the name in quotation marks
3D Slicer                  .nrrd, .seg.nrrd: segments in the header of the label image
=========================  ====================================================================
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from napari_hmrf.arguments import checked_path
from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.table_files import Table, read_table, text_of, unknown_column
from napari_hmrf.io.tables import read_preset
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.tissue_names import NamedMaterials, materials_by_name

#: Largest size of a table, or of the header of an image, in bytes.
_LARGEST = 2**22
#: Largest number of names listed in an error message.
_LISTED = 4
#: Titles of label columns in a .csv, in lower case.
_LABELS = "label", "labelvalue", "label value", "value", "index", "id", "no.", "key", "intensity"
#: Titles of name columns in a .csv, in lower case.
_NAMES = "name", "label name", "labelname", "structure", "segment", "tissue", "region", "class"
#: Columns that occur only in tables of materials.
_OF_MATERIALS = "stiffness", "poisson", "growth", "slides", "source"
#: Other columns in tables of label names: colours, descriptions, and terms of 3D Slicer.
_OTHER_COLUMNS = re.compile(
    r"(colou?r[ _]?)?(r|g|b|a|red|green|blue|alpha)|colou?r|hex|opacity|visib(le|ility)"
    r"|[a-z]+_(codingscheme|codevalue|codemeaning)|(description|comment|abbreviation|acronym)s?"
)
#: Row of a colour table of FreeSurfer or 3D Slicer: label, name, four colour values and, in recent
#: FreeSurfer tables, a tissue type.
_COLOUR_ROW = re.compile(r'\s*(\d+)\s+"?(\S.*?)"?((?:\s+[\d.]+){4,5})\s*$')
#: Row of label descriptions of ITK-SNAP: label, six numbers, and the name in quotation marks.
_SNAP_ROW = re.compile(r'\s*(\d+)((?:\s+[\d.]+){6})\s+"([^"]*)"\s*$')
_NUMBERED = re.compile(r"\s*\d+\s+\S")
_SEGMENT = re.compile(r"Segment(\d+)_(LabelValue|Name|Layer):=(.*)")

#: Suffixes of the files.
ENDINGS = ".csv", ".json", ".txt", ".ctbl", ".nrrd"


def read_label_names(path: str | os.PathLike[str]) -> dict[int, str]:
    """Read the label names of a segmentation.

    Parameters
    ----------
    path : str or path-like
        Class map of TotalSegmentator or `dataset.json` of nnU-Net (.json); .csv with a column of
        labels and a column of names; `FreeSurferColorLUT.txt` of FreeSurfer; label descriptions of
        ITK-SNAP (.txt); colour table (.ctbl, .txt) or segmentation (.seg.nrrd) of 3D Slicer.

    Returns
    -------
    dict of int to str
        Name of each label, which `materials_by_name` can convert to a material.

    Raises
    ------
    FileFormatError
        If the file is not such a table, has an unknown column or an invalid line, or has different
        names for the same label.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    ending = source.suffix.lower()
    if ending == ".csv":
        rows = _of_cells(read_table(source, _LARGEST))
    elif ending == ".json":
        rows = _of_json(_text(source, ending), source.name)
    elif ending == ".nrrd":
        rows = _of_segments(_text(source, ending), source.name)
    else:
        rows = _of_lines(_text(source, ending), source.name)
    names: dict[int, str] = {}
    for label, name in rows:
        if names.setdefault(label, name) != name:
            raise FileFormatError(
                f"{source.name}: label {label} occurs twice, as {names[label]!r} and {name!r}. "
                "Remove one of them."
            )
    if not names:
        raise FileFormatError(
            f"{source.name} contains no label names. Give a material file saved by napari-hmrf, a "
            "class map (.json), a .csv with the columns label and name, a colour table of "
            "FreeSurfer or 3D Slicer, label descriptions of ITK-SNAP, or a .seg.nrrd."
        )
    return names


def tissue_table(path: str | os.PathLike[str]) -> NamedMaterials | Preset:
    """Read the materials in a table, or look up materials for the label names in a table.

    Parameters
    ----------
    path : str or path-like
        Material file of `write_preset`, .csv with the column `stiffness`, or table of label names
        as for `read_label_names`. A .csv is a table of label names if it has columns of labels and
        names, and all its other columns are colours, descriptions or terms of other tools.

    Returns
    -------
    Preset or NamedMaterials
        Preset if the table contains materials; named materials if it contains label names.

    Raises
    ------
    FileFormatError
        As for `read_materials`, `read_preset` and `read_label_names`; or if the table contains
        only label names, and no label name has a known stiffness.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    ending = source.suffix.lower()
    is_table = {".csv": lambda: not _is_of_names(source), ".json": lambda: _is_preset_file(source)}
    if ending in is_table and is_table[ending]():
        return read_preset(source)
    found = materials_by_name(read_label_names(source), name=source.stem)
    if not any(row.stiffness for row in found.materials):
        names = list(dict.fromkeys(found.unknown.values()))
        listed = ", ".join(names[:_LISTED]) + " ..." * (len(names) > _LISTED)
        raise FileFormatError(
            f"{source.name} contains no stiffness, and none of its names ({listed}) is a tissue "
            "with a published stiffness. Give a .csv with the columns label, name and stiffness."
        )
    return found


def _text(source: Path, ending: str) -> str:
    """Return the text of a table, or of the header of a .nrrd image."""
    if ending == ".nrrd":
        with open(source, "rb") as file:
            head = file.read(_LARGEST).partition(b"\n\n")[0]
        return head.replace(b"\r", b"").decode("utf-8", errors="replace")
    return text_of(source, _LARGEST)


def _is_of_names(source: Path) -> bool:
    """Return whether a .csv is a table of label names, according to its columns."""
    titles = read_table(source, _LARGEST).titles
    has_columns = [any(title in titles for title in known) for known in (_LABELS, _NAMES)]
    return all(has_columns) and not any(map(_is_foreign_column, titles))


def _is_foreign_column(title: str) -> bool:
    """Return whether a column does not occur in tables of label names."""
    known = not title or title in (*_LABELS, *_NAMES) or _OTHER_COLUMNS.fullmatch(title) is not None
    return not known


def _is_preset_file(source: Path) -> bool:
    """Return whether a .json is a table of materials; also True if the file is not valid JSON."""
    try:
        content = from_json(text_of(source, _LARGEST))
    except ValueError:
        return True
    return not isinstance(content, dict) or "materials" in content


def _of_cells(table: Table[dict[str, Any]]) -> Iterable[tuple[int, str]]:
    for title in filter(_is_foreign_column, table.titles):
        if title in _OF_MATERIALS:
            raise FileFormatError(
                f"{table.file}: a table of label names has no column {title!r}. Use the file as a "
                "table of materials, or remove the column."
            )
        raise unknown_column(table.file, title, ["label", "name", *_OF_MATERIALS])
    label_title, name_title = (
        next((title for title in known if title in table.titles), None)
        for known in (_LABELS, _NAMES)
    )
    if label_title is None or name_title is None:
        return
    for place, cells in table.rows:
        written = cells.get(label_title, "")
        label = _as_label(written)
        if label is None:
            raise FileFormatError(
                f"{table.file}: {place}: {label_title} is {written[:40]!r}. Give a whole number, 0 "
                "or more."
            )
        yield label, cells.get(name_title, "")


def _of_json(text: str, file: str) -> Iterable[tuple[int, str]]:
    """Return the labels and names in a JSON mapping, which may be nested.

    The mapping can be from labels to names or from names to labels.
    """
    try:
        content = from_json(text)
    except ValueError:
        return ()
    return _of_mapping(content, file)


def _of_mapping(content: Any, file: str) -> Iterable[tuple[int, str]]:
    if not isinstance(content, Mapping):
        return ()
    if isinstance(content.get("labels"), Mapping):
        return _of_mapping(content["labels"], file)
    rows = [_of_pair(key, value) for key, value in content.items()]
    understood = [row for row in rows if row is not None]
    if len(understood) == len(rows):
        return understood
    inner = [value for value in content.values() if isinstance(value, Mapping)]
    if len(inner) == 1 and not understood:
        return _of_mapping(inner[0], file)
    if understood or inner:
        key = next(key for key, row in zip(content, rows, strict=True) if row is None)
        raise FileFormatError(
            f"{file}: {key!r} is {json.dumps(content[key])[:40]}. Give a name for each label, as "
            'in {"1": "liver"}, or a label for each name.'
        )
    return ()


def _of_pair(key: str, value: Any) -> tuple[int, str] | None:
    """Return the label and name of a pair given in either order, or None for any other pair."""
    if isinstance(value, bool) or not isinstance(value, str | int):
        return None
    label, name = (_as_label(key), str(value)) if _is_name(value) else (_as_label(value), key)
    return None if label is None or not _is_name(name) else (label, name)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and _as_label(value) is None


def _of_lines(text: str, file: str) -> Iterable[tuple[int, str]]:
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("#"):
            continue
        if snap := _SNAP_ROW.match(line):
            yield int(snap[1]), snap[3]
        elif row := _COLOUR_ROW.match(line):
            yield int(row[1]), row[2]
        elif _NUMBERED.match(line):
            raise FileFormatError(
                f"{file}: line {number} is {line.strip()[:40]!r}. Give a label, a name and four "
                "numbers for the colour, or begin the line with #."
            )


def _of_segments(text: str, file: str) -> Iterable[tuple[int, str]]:
    """Yield the label and name of each segment of a label image."""
    segments: dict[str, dict[str, str]] = {}
    for line in takewhile(str, text.splitlines()):
        if match := _SEGMENT.match(line):
            segments.setdefault(match[1], {})[match[2]] = match[3].strip()
    layers = {each.get("Layer", "0") for each in segments.values()}
    if len(layers) > 1:
        raise FileFormatError(
            f"{file}: the segmentation has {len(layers)} layers, because segments overlap, so that "
            "a label has several names. Export it in 3D Slicer as a labelmap, in which every voxel "
            "has one label."
        )
    for each in segments.values():
        label = _as_label(each.get("LabelValue", ""))
        if label is not None:
            yield label, each.get("Name", "")


def _as_label(value: Any) -> int | None:
    """Convert a number or text to a label; return None if it is not a whole number >= 0."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return int(number) if number.is_integer() and number >= 0 else None
