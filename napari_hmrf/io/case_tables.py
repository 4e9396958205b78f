"""Tables of cases: one row for each study or image to solve, with optional parameter sweeps.

A table can have the following columns:

- the ``name`` of the case;
- the input and options of ``napari-hmrf solve``: ``image`` or ``study``, ``labels``, ``maps``,
  ``materials``, ``boundary``, ``targets``, ``rules``, ``forward``, ``confidence``, ``slice``,
  ``spacing``, ``hold-edge``, ``model``, ``plane``, ``tolerance``, ``budget``, ``penalty``,
  ``weight`` and ``cavity``;
- values that replace numbers in the files of the case: ``poisson``, ``growth:TISSUE``,
  ``stiffness:TISSUE``, ``poisson:TISSUE`` and ``amount:BOUNDARY``, in which a tissue or boundary is
  identified by its label or name.

Paths are relative to the folder of the table. If a cell contains several values, separated by
semicolons, there is one case for each value. The column ``slice`` also accepts a range, such as
``3-7``, and ``all``, for example for the time points of a film.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any

from napari_hmrf.arguments import checked_path
from napari_hmrf.checks import convert
from napari_hmrf.errors import ArgumentError, FileFormatError, HmrfError
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.images import read_image, stem_of
from napari_hmrf.io.option_texts import values_of
from napari_hmrf.io.sweeps import NUMBERS, Change
from napari_hmrf.io.table_files import read_table, unknown_column
from napari_hmrf.solver.model_names import as_word

#: Largest size of a table, in bytes; a larger file is not read.
_LARGEST = 2**24
#: Columns in which a cell can contain several values, with one case for each value.
_SWEPT = {
    *("slice", "model", "poisson", "plane", "tolerance", "budget", "penalty", "weight", "cavity")
}
#: Characters that are not allowed in the name of a case.
_FORBIDDEN = re.compile(r'[\\/:*?"<>|\0-\x1f]')
#: Characters with a special meaning in shells or other tools; replaced with "_".
_SPECIAL = re.compile(r"[^\w.-]+")
#: Reserved names: files of a batch, and Windows device names.
_RESERVED = {"summary.csv", *("con", "prn", "aux", "nul")} | {
    f"{port}{number}" for port in ("com", "lpt") for number in range(10)
}


def _column(option: str) -> str:
    return option.replace("_", "-")


_COLUMNS = ("name", "study", *(_column(each.name) for each in fields(Case)))


@dataclass(frozen=True)
class NamedCase:
    """Named case from a row of a table.

    Attributes
    ----------
    name : str
        Name of the case and of the folder with its results.
    case : Case
    changes : tuple of Change
        Changes to numbers in the files of the case.
    cells : mapping of str to str
        Cells of the row, by column title; used to detect changes to the row.
    """

    name: str
    case: Case
    changes: tuple[Change, ...] = ()
    cells: Mapping[str, str] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, str]:
        """Values of the parameters that can be swept, as text, by column title."""
        values = {} if self.case.slice is None else {"slice": str(self.case.slice)}
        for option in ("model", "plane", "tolerance", "budget", "penalty"):
            if (value := getattr(self.case, option)) is not None:
                values[option] = f"{value:g}" if isinstance(value, float) else as_word(value)
        if self.case.weight:
            values["weight"] = "/".join(f"{part:g}" for part in self.case.weight)
        if (cavity := self.case.cavity) is not None:
            numbers = cavity.pressure, cavity.fluid, cavity.level
            values["cavity"] = "/".join(f"{number:g}" for number in numbers)
        for change in self.changes:
            title = f"{change.what}:{change.of}" if change.of else change.what
            parts = change.value if isinstance(change.value, tuple) else (change.value,)
            words = (as_word(part) if isinstance(part, str) else f"{part:g}" for part in parts)
            values[title] = "/".join(words)
        return values

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Paths of the input files and folders of the case."""
        return self.case.inputs


def read_cases(path: str | os.PathLike[str]) -> tuple[NamedCase, ...]:
    """Read a table of cases.

    Parameters
    ----------
    path : str or path-like
        A .csv file.

    Returns
    -------
    tuple of NamedCase
        Cases in the order of the table.

    Raises
    ------
    FileFormatError
        If the table is invalid; the message states the line and the error. The input files of a
        case are checked only when the case is solved.
    OSError
        If the table cannot be opened.
    """
    source = Path(checked_path(path))
    table = read_table(source, _LARGEST)
    cases: dict[str, NamedCase] = {}
    for title in filter(None, map(_title, table.titles)):
        kind, _, of = title.partition(":")
        if not (title in _COLUMNS or (kind in NUMBERS and of)):
            known = [*_COLUMNS, *(f"{kind}:NAME" for kind in NUMBERS)]
            raise unknown_column(table.file, title, known)
    for place, row in table.rows:
        where = f"{table.file}: {place}"
        cells = {_title(title): str(cell) for title, cell in row.items()}
        for case in _cases_of(cells, source.parent, where):
            folder = case.name.casefold()  # some file systems ignore case
            if folder in cases:
                raise FileFormatError(
                    f"{where}: there is already a case {cases[folder].name!r}. Give each case a "
                    "different name."
                )
            cases[folder] = case
    if not cases:
        raise FileFormatError(
            f"{table.file} has no rows. Give the column titles, and a case below."
        )
    return tuple(cases.values())


def _title(cell: str) -> str:
    """Return the title of a column with hyphens; the name after a colon is unchanged."""
    kind, colon, of = cell.partition(":")
    return f"{kind.replace('_', '-')}{colon}{of}"


def _cases_of(cells: dict[str, str], folder: Path, where: str) -> Iterator[NamedCase]:
    """Yield one case for each combination of the swept values in a row."""
    image = cells.get("image") or cells.get("study")
    if image is None or ("image" in cells and "study" in cells):
        raise FileFormatError(f"{where}: the line must have either an image or a study. Give one.")
    swept = {title: text for title, text in cells.items() if ":" in title or title in _SWEPT}
    values = {title: _values(title, text, folder / image) for title, text in swept.items()}
    # Other rows may use the same image, so the default name includes all values of the row.
    named_after = [title for title in values if "name" not in cells or len(values[title]) > 1]
    for chosen in product(*values.values()):
        chosen_values = dict(zip(values, chosen, strict=True))
        base = cells.get("name", stem_of(image))
        if not base or _FORBIDDEN.search(base) or base[0] in ".-=+@~" or base[-1] == ".":
            raise FileFormatError(
                f"{where}: {base!r} is not a valid folder name. Give another name."
            )
        parts = [base, *(f"{title}-{chosen_values[title]}" for title in named_after)]
        name = "_".join(_plain_name(part) for part in parts)
        if name.casefold() in _RESERVED:
            raise FileFormatError(f"{where}: {name!r} is a reserved file name. Give another name.")
        yield _named_case(name, {**cells, **chosen_values}, folder, where)


def _plain_name(text: str) -> str:
    """Return text for a folder name, without characters that must be quoted in a shell."""
    text = text.replace(":", "-").replace("%", "percent")
    return _SPECIAL.sub("_", text).strip("_") or "_"


def _values(title: str, text: str, image: Path) -> list[str]:
    """Return the values of a cell, each as text."""
    parts = [part.strip() for part in text.split(";") if part.strip()]
    if title != "slice":
        return parts or [text]
    values: list[str] = []
    for part in parts:
        if part.casefold() == "all":
            values += map(str, range(_slices(image)))
        elif ends := re.fullmatch(r"(\d+)\s*-\s*(\d+)", part):
            values += map(str, range(int(ends[1]), int(ends[2]) + 1))
        else:
            values.append(part)
    return values or [text]


def _slices(image: Path) -> int:
    """Return the number of slices of an image, or 1 if the image cannot be read.

    If the image cannot be read, the error is reported when the case is solved.
    """
    try:
        file = read_image(image, resample=True)  # keeps the number of slices
    except (HmrfError, OSError):
        return 1
    return len(file.pixels) if file.ndim == 3 else 1


def _named_case(name: str, cells: dict[str, str], folder: Path, where: str) -> NamedCase:
    texts: dict[str, Any] = {}
    changes: list[Change] = []
    try:
        for title, text in cells.items():
            kind, _, of = title.partition(":")
            if of or title == "poisson":
                changes.append(Change(kind, convert(NUMBERS[kind], text, title), of))
            elif title == "maps":
                texts["maps"] = [part.strip() for part in text.split(";")]
            elif title != "name":
                texts["image" if title == "study" else title.replace("-", "_")] = text
        values = values_of(Case, texts, _column)
    except ArgumentError as error:
        raise FileFormatError(f"{where}: {error}.") from None
    if "study" in cells and "model" in values:
        changes.insert(0, Change("model", values.pop("model")))
    case = Case(**{option: _in_folder(value, folder) for option, value in values.items()})
    return NamedCase(name, case, tuple(changes), cells)


def _in_folder(value: Any, folder: Path) -> Any:
    """Return a value, in which paths are relative to a folder."""
    if isinstance(value, tuple):
        return tuple(_in_folder(each, folder) for each in value)
    return folder / value if isinstance(value, Path) else value
