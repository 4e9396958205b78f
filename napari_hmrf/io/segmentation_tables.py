"""Tables of what the labels of a segmentation are called, as other tools write them.

========================  ====================================================================
TotalSegmentator, nnU-Net  .json: a class map, or a `dataset.json` with its `labels`
any tool, 3D Slicer        .csv: a column of labels, and one of names
FreeSurfer, 3D Slicer      .txt, .ctbl: label, name and four numbers of a colour
ITK-SNAP                   .txt: label, six numbers, and the name in quotation marks
3D Slicer                  .nrrd, .seg.nrrd: the segments in the header of the label image
========================  ====================================================================
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from napari_hmrf.arguments import checked_path
from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.csv_files import read_cells, text_of
from napari_hmrf.io.material_tables import FORMAT, load_materials
from napari_hmrf.io.tables import read_materials
from napari_hmrf.io.tissue_names import NamedMaterials, materials_by_name
from napari_hmrf.regular_file import read_at_most
from napari_hmrf.tissue.material_presets import Preset

#: Larger files are no tables, and are not read; of an image only so much is its header.
_LARGEST = 2**22
#: What columns of a .csv are called.
_LABELS = "label", "labelvalue", "label value", "value", "index", "id", "no.", "key", "intensity"
_NAMES = "name", "label name", "labelname", "structure", "segment", "tissue", "region", "class"
# A label, its name, and red, green, blue and alpha; or what ITK-SNAP has between the two.
_COLOUR_ROW = re.compile(r'\s*(\d+)\s+"?(\S.*?)"?((?:\s+[\d.]+){4})\s*$')
_SNAP_ROW = re.compile(r'\s*(\d+)((?:\s+[\d.]+){6})\s+"([^"]*)"\s*$')
_SEGMENT = re.compile(r"Segment(\d+)_(LabelValue|Name|Layer):=(.*)")

ENDINGS = ".csv", ".json", ".txt", ".ctbl", ".nrrd"


def read_label_names(path: str | os.PathLike[str]) -> dict[int, str]:
    """Read what the labels of a segmentation are called.

    Parameters
    ----------
    path : str or path-like
        A class map of TotalSegmentator or a `dataset.json` of nnU-Net (.json); a .csv with a column
        of labels and one of names; FreeSurfer's `FreeSurferColorLUT.txt`, label descriptions of
        ITK-SNAP (.txt), a colour table of 3D Slicer (.ctbl, .txt), or its segmentation itself
        (.seg.nrrd).

    Returns
    -------
    dict of int to str
        By label; `materials_by_name` makes materials of it.

    Raises
    ------
    FileFormatError
        If it is no such table, or a label is there twice.
    OSError
        If it cannot be opened.
    """
    source = Path(checked_path(path))
    ending = source.suffix.lower()
    if ending == ".csv":
        rows = _of_cells([cells for _, cells in read_cells(source, _LARGEST)])
    else:
        read = {".json": _of_json, ".nrrd": _of_segments}.get(ending, _of_lines)
        rows = read(_text(source, ending))
    names: dict[int, str] = {}
    for label, name in rows:
        if names.setdefault(label, name) != name:
            raise FileFormatError(
                f"{source.name}: label {label} is there twice, as {names[label]!r} and {name!r}. "
                "Remove one of them."
            )
    if not names:
        raise FileFormatError(
            f"{source.name} names no labels. Give a file of materials that was saved here, a class "
            "map (.json), a .csv with the columns label and name, a colour table of FreeSurfer or "
            "3D Slicer, label descriptions of ITK-SNAP, or a .seg.nrrd."
        )
    return names


def tissue_table(path: str | os.PathLike[str]) -> NamedMaterials | Preset:
    """Read materials from any table: with their stiffness, or by the names of a segmentation.

    Parameters
    ----------
    path : str or path-like
        A file of `save_materials` or a .csv with a column `stiffness`; else as of
        `read_label_names`.

    Returns
    -------
    Preset or NamedMaterials
        A preset if the file itself says how stiff each tissue is.

    Raises
    ------
    FileFormatError, OSError
        As of `read_materials`, `load_materials` and `read_label_names`; or if no stiffness is known
        for any of the names.
    """
    source = Path(checked_path(path))
    ending = source.suffix.lower()
    if ending == ".csv" and not _is_of_names(source):
        return Preset(source.stem, "", f"the file {source.name}", read_materials(source))
    if ending == ".json" and (source.stat().st_size > _LARGEST or _is_ours(source)):
        return load_materials(source)
    found = materials_by_name(read_label_names(source), name=source.stem)
    if not any(row.stiffness for row in found.materials):
        some = ", ".join(list(found.unknown.values())[:4])
        raise FileFormatError(
            f"{source.name}: of none of its labels ({some} ...) is a stiffness known. Give a table "
            "with the columns label, name and stiffness."
        )
    return found


def _text(source: Path, ending: str) -> str:
    """The text of a table, or of the header of an image."""
    if ending == ".nrrd":
        with open(source, "rb") as file:
            head = file.read(_LARGEST).partition(b"\n\n")[0]
        return head.replace(b"\r", b"").decode("utf-8", errors="replace")
    return text_of(source, _LARGEST)


def _is_of_names(source: Path) -> bool:
    """Whether a .csv names labels, and does not say how stiff they are."""
    titles = _titles([cells for _, cells in read_cells(source, _LARGEST)])
    there = [any(title in titles for title in known) for known in (_LABELS, _NAMES)]
    return "stiffness" not in titles and all(there)


def _is_ours(source: Path) -> bool:
    """Whether a .json says that it is a file of materials, or nothing that can be read."""
    try:
        content = json.loads(read_at_most(source, _LARGEST) or b"")
    except ValueError:
        return True
    return (
        not isinstance(content, dict) or "materials" in content or content.get("format") == FORMAT
    )


def _titles(rows: Sequence[Sequence[str]]) -> list[str]:
    return [title.casefold() for title in rows[0]] if rows else []


def _of_cells(rows: Sequence[Sequence[str]]) -> Iterable[tuple[int, str]]:
    titles = _titles(rows)
    label_at, name_at = (
        next((titles.index(title) for title in known if title in titles), None)
        for known in (_LABELS, _NAMES)
    )
    if label_at is None or name_at is None:
        return
    for row in rows[1:]:
        if len(row) > max(label_at, name_at) and (label := _whole(row[label_at])) is not None:
            yield label, row[name_at]


def _of_json(text: str) -> Iterable[tuple[int, str]]:
    """Both ways round, name by label or label by name, alone or under a word."""
    try:
        content = json.loads(text)
    except ValueError:
        return ()
    return _of_mapping(content)


def _of_mapping(content: Any) -> Iterable[tuple[int, str]]:
    if not isinstance(content, Mapping):
        return ()
    if isinstance(content.get("labels"), Mapping):
        return _of_mapping(content["labels"])
    pairs = [(key, value) for key, value in content.items() if isinstance(value, str | int)]
    rows = [
        (label, str(name))
        for key, value in pairs
        for label, name in [(_whole(key), value) if _is_name(value) else (_whole(value), key)]
        if label is not None
    ]
    if rows:
        return rows
    inner = [found for value in content.values() if (found := list(_of_mapping(value)))]
    return inner[0] if len(inner) == 1 else ()


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and _whole(value) is None


def _of_lines(text: str) -> Iterable[tuple[int, str]]:
    for line in text.splitlines():
        if line.lstrip().startswith("#"):
            continue
        if snap := _SNAP_ROW.match(line):
            yield int(snap[1]), snap[3]
        elif row := _COLOUR_ROW.match(line):
            yield int(row[1]), row[2]


def _of_segments(text: str) -> Iterable[tuple[int, str]]:
    """Of a segmentation of several layers the first, as only that is an image of labels."""
    segments: dict[str, dict[str, str]] = {}
    for line in takewhile(str, text.splitlines()):
        if found := _SEGMENT.match(line):
            segments.setdefault(found[1], {})[found[2]] = found[3].strip()
    for each in segments.values():
        label = _whole(each.get("LabelValue", ""))
        if label is not None and each.get("Layer", "0") == "0":
            yield label, each.get("Name", "")


def _whole(value: Any) -> int | None:
    """A label, which some tools write as text."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return int(number) if number.is_integer() and number >= 0 else None
