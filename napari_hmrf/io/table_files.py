"""Tables in .csv files, compatible with spreadsheets, and in .json files."""

from __future__ import annotations

import codecs
import csv
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from itertools import chain
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from pydantic_core import from_json

from napari_hmrf.arguments import checked_path, checked_target, did_you_mean
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import ArgumentError, FileFormatError
from napari_hmrf.regular_file import read_at_most

#: Suffix of the files.
ENDING = ".csv"
#: Initial characters of cells that a spreadsheet interprets as formulas.
_FORMULA = "=+-@\t\r"
#: First line with which Excel states the separator.
_SEPARATOR_LINE = re.compile(r"\Asep=.\n")
#: Numbers with a decimal comma, also several with slashes or semicolons, or in per cent.
_DECIMALS = re.compile(r"[-+\d,eE/;% ]*,[-+\d,eE/;% ]*")
#: Number with a decimal point or a thousands separator, beside numbers with a decimal comma.
_POINTED = re.compile(r"[-+]?\d+([.,]\d+)*\.\d+(,\d+)?(e[-+]?\d+)?\s*%?", re.IGNORECASE)
#: Known column title for each synonym, suggested if a column is unknown.
SYNONYMS = {
    **dict.fromkeys(
        ("young", "youngs", "young's", "youngs modulus", "young's modulus", "e", "modulus"),
        "stiffness",
    ),
    **dict.fromkeys(("elasticity", "elastic modulus", "kpa", "e modulus", "rigidity"), "stiffness"),
    **dict.fromkeys(("nu", "poisson ratio", "poissons ratio", "poisson's ratio"), "poisson"),
    **dict.fromkeys(("labelvalue", "label value", "id", "index", "value", "key"), "label"),
    **dict.fromkeys(("tissue", "structure", "segment", "label name", "region", "class"), "name"),
    **dict.fromkeys(("strain", "swelling", "expansion"), "growth"),
    **dict.fromkeys(("reference", "citation", "comment", "note"), "source"),
    **dict.fromkeys(("rule", "kind", "motion", "condition"), "action"),
    **dict.fromkeys(("dy", "y", "rows", "down"), "row"),
    **dict.fromkeys(("dx", "x", "column", "columns", "right"), "col"),
    **dict.fromkeys(("dz", "z", "planes", "depth"), "plane"),
    **dict.fromkeys(("distance", "pressure", "by", "size"), "amount"),
    **dict.fromkeys(("weight", "certainty", "sure"), "confidence"),
    **dict.fromkeys(("case", "patient", "subject"), "name"),
    **dict.fromkeys(("file", "scan", "picture", "volume", "path"), "image"),
    **dict.fromkeys(("segmentation", "mask", "seg", "tissues"), "labels"),
    **dict.fromkeys(("mat", "table", "stiffness table"), "materials"),
}


Row = TypeVar("Row")


class Table(NamedTuple, Generic[Row]):
    """Content of a table.

    Attributes
    ----------
    file : str
        Name of the file.
    titles : list of str
        Titles of the columns in lower case, except after a colon; "" for a column without a title.
    rows : list of (str, Row)
        Place of each row in the file, such as "line 3", and its content: the non-empty cells by
        column title, or a dataclass.
    about : dict
        Other values of a .json file, such as the unit.
    """

    file: str
    titles: list[str]
    rows: list[tuple[str, Row]]
    about: dict[str, Any]


def read_rows(
    path: str | os.PathLike[str],
    kind: type[Row],
    *,
    defaults: Mapping[str, Any] | None = None,
    comments: Sequence[str] = (),
) -> Table[Row]:
    """Read a .csv or .json table, with rows that are dataclasses and check their values.

    Parameters
    ----------
    path : str or path-like
    kind : type
        `checked` dataclass with a field for each column.
    defaults : mapping of str to object, optional
        Values of missing cells, in addition to the defaults of `kind`.
    comments : sequence of str
        Titles of columns that are ignored.

    Raises
    ------
    FileFormatError
        If the table is invalid; the message states the line and the error.
    OSError
        If the file cannot be opened.
    """
    table = read_table(path)
    known = [*(field.name for field in fields(kind)), *comments]  # type: ignore[arg-type]
    for title in filter(None, table.titles):
        if title not in known:
            raise unknown_column(table.file, title, known)
    if not table.rows:
        raise FileFormatError(
            f"{table.file} has no rows. Give the column titles {', '.join(known)}, and a row below."
        )
    rows: list[tuple[str, Row]] = []
    for place, cells in table.rows:
        values = {title: cell for title, cell in cells.items() if title not in comments}
        try:
            rows.append((place, kind(**{**(defaults or {}), **values})))
        except ArgumentError as error:
            raise FileFormatError(f"{table.file}: {place}: {error}.") from None
    return Table(table.file, table.titles, rows, table.about)


def read_table(path: str | os.PathLike[str], largest: int = 2**20) -> Table[dict[str, Any]]:
    """Read a .json table, or a .csv table with column titles in its first non-empty line.

    A .json table is a list of objects, or an object in which one value is such a list.

    Raises
    ------
    FileFormatError
        If the file is larger than `largest` bytes, is not a table, has two columns with the same
        title, or has a line with more cells than columns.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    if source.suffix.lower() == ".json":
        return _json_table(source.name, text_of(source, largest))
    lines = [(number, cells) for number, cells in read_cells(source, largest) if any(cells)]
    titles = [_title(cell) for cell in (lines[0][1] if lines else [])]
    for title in filter(None, titles):
        if titles.count(title) > 1:
            raise FileFormatError(f"{source.name} has two columns {title!r}. Remove one of them.")
    rows = []
    for number, cells in lines[1:]:
        if any(cells[len(titles) :]):
            raise FileFormatError(
                f"{source.name}: line {number} has more cells than there are columns. Write "
                "decimals with a point, and put text with a comma in quotation marks."
            )
        filled = {name: cell for name, cell in zip(titles, cells, strict=False) if name and cell}
        if filled:
            rows.append((f"line {number}", filled))
    return Table(source.name, titles, rows, {})


def _json_table(file: str, text: str) -> Table[dict[str, Any]]:
    try:
        content = from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise FileFormatError(f"{file} is not valid JSON: {error}.") from None
    about = dict(content) if isinstance(content, dict) else {"rows": content}
    lists = [key for key, value in about.items() if isinstance(value, list)]
    rows = about.pop(lists[0]) if len(lists) == 1 else None
    if rows is None or not all(isinstance(row, dict) for row in rows):
        raise FileFormatError(
            f'{file} is not a table. Give a list of rows, such as [{{"label": 1, ...}}, ...].'
        )
    filled = [
        {_title(name): value for name, value in row.items() if value is not None} for row in rows
    ]
    places = [(f"row {number}", row) for number, row in enumerate(filled, 1)]
    return Table(file, list(dict.fromkeys(chain.from_iterable(filled))), places, about)


def _title(cell: str) -> str:
    kind, colon, of = cell.partition(":")
    return f"{kind.strip().casefold()}{colon}{of.strip()}"


def text_of(path: Path, largest: int) -> str:
    """Read a text file in UTF-8 or UTF-16, and convert its line endings to line feeds.

    Raises
    ------
    FileFormatError
        If the file is larger than `largest` bytes, or is not text.
    OSError
        If the file cannot be opened.
    """
    content = read_at_most(path, largest)
    if content is None:
        raise FileFormatError(f"{path.name} is too large to be a table.")
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_wide else "utf-8-sig")
    except UnicodeDecodeError:
        raise FileFormatError(
            f"{path.name} is not UTF-8 text. Save it as text in UTF-8, such as 'CSV UTF-8'."
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_cells(path: Path, largest: int) -> list[tuple[int, list[str]]]:
    """Return the number and the cells of each line of a .csv file, without surrounding spaces.

    Cells are separated by commas, semicolons or tabs. Between semicolons and tabs, decimal commas
    are converted to points.

    Raises
    ------
    FileFormatError
        As for `split_cells`; or if the file has numbers with decimal commas and numbers with
        points, of which the latter may be thousands separators.
    OSError
        If the file cannot be opened.
    """
    separator, lines = split_cells(path, largest)
    if separator == ",":
        return lines
    _refuse_two_signs(path.name, lines)
    return [(number, list(map(_with_decimal_points, cells))) for number, cells in lines]


def split_cells(path: Path, largest: int) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the separator of a .csv file, and its lines as for `read_cells`, with numbers as text.

    Raises
    ------
    FileFormatError
        As for `text_of`, or if the file is not a table.
    OSError
        If the file cannot be opened.
    """
    text = text_of(path, largest)
    text = _SEPARATOR_LINE.sub("\n", text)
    first = text.lstrip().partition("\n")[0]
    separator = max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=separator != "\t")
    try:
        return separator, [(reader.line_num, list(map(_plain_cell, cells))) for cells in reader]
    except csv.Error:
        raise FileFormatError(f"{path.name} is not a table of comma-separated text.") from None


def _refuse_two_signs(file: str, lines: list[tuple[int, list[str]]]) -> None:
    """Raise an error if numbers contain commas and points: one of them may mark thousands."""
    numbers = [(number, cell) for number, cells in lines for cell in cells]
    pointed = next((each for each in numbers if _POINTED.fullmatch(each[1])), None)
    if pointed and ("," in pointed[1] or any(_DECIMALS.fullmatch(cell) for _, cell in numbers)):
        raise FileFormatError(
            f"{file}: line {pointed[0]} contains {pointed[1]}, and the file also has decimal "
            "commas, so that the point may separate thousands. Write numbers without a separator "
            "of thousands, and with one decimal sign."
        )


def _with_decimal_points(cell: str) -> str:
    return cell.replace(",", ".") if _DECIMALS.fullmatch(cell) else cell


def unknown_column(file: str, title: str, known: Sequence[str]) -> FileFormatError:
    """Return the error for an unknown column, with the most similar known column."""
    hint = did_you_mean(title, known, SYNONYMS)
    return FileFormatError(
        f"{file}: there is no column {title!r}.{hint} The columns are {', '.join(known)}."
    )


def write_csv(
    path: str | os.PathLike[str],
    titles: Sequence[str],
    rows: Iterable[Iterable[Any]],
    *,
    what: str = "tables",
) -> Path:
    """Write a table to a .csv file, atomically.

    Text that a spreadsheet would interpret as a formula is written with a leading apostrophe, which
    `read_cells` removes. Numbers are written unchanged.

    Parameters
    ----------
    path : str or path-like
    titles : sequence of str
        Titles of the columns.
    rows : iterable of iterables
        Cells of each row, one per column; None for an empty cell.
    what : str
        Kind of content, for error messages.

    Raises
    ------
    FileFormatError
        If the name does not end in .csv.
    OSError
        If the file cannot be written.
    """
    target = Path(checked_target(path))
    if target.suffix.lower() != ENDING:
        raise FileFormatError(
            f"{target.name}: {what} are saved as comma-separated text. End the name in {ENDING}."
        )
    text = csv_text([_with_apostrophe(cell) for cell in row] for row in chain([titles], rows))
    write_whole(target, text.encode())
    return target


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Return rows as comma-separated text."""
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(rows)
    return file.getvalue()


def _with_apostrophe(cell: Any) -> Any:
    """Add an apostrophe to text that a spreadsheet would interpret as a formula."""
    if not isinstance(cell, str) or not cell.startswith((*_FORMULA, "'")) or _is_number(cell):
        return cell
    return f"'{cell}" if _without_apostrophe(f"'{cell}") == cell else cell


def _plain_cell(cell: str) -> str:
    return _without_apostrophe(cell.strip())


def _without_apostrophe(cell: str) -> str:
    """Remove the apostrophe that `_with_apostrophe` added to a cell."""
    rest = cell.lstrip("'")
    marked = cell.startswith("'") and rest.startswith((*_FORMULA,)) and not _is_number(rest)
    return cell[1:] if marked else cell


def _is_number(text: str) -> bool:
    """Return whether text represents a number, such as -0.5."""
    try:
        float(text)
    except ValueError:
        return False
    return True
