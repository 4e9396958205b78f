"""Comma-separated text files with column titles, compatible with spreadsheets."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from napari_hmrf.arguments import checked_target, did_you_mean
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.regular_file import read_at_most

#: Suffix of the files.
ENDING = ".csv"
#: Initial characters of cells that a spreadsheet interprets as formulas.
_FORMULA = "=+-@\t\r"
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


class CsvFile(NamedTuple):
    """Content of a .csv file.

    Attributes
    ----------
    titles : list of str
        Titles of the columns; "" for a column without a title.
    lines : list of (int, dict)
        Number of each line, and its non-empty cells by column title. Lines without any content are
        omitted.
    """

    titles: list[str]
    lines: list[tuple[int, dict[str, str]]]


def text_of(path: Path, largest: int) -> str:
    """Read a text file, and convert its line endings to line feeds.

    Raises
    ------
    FileFormatError
        If the file is larger than `largest` bytes, or is not valid UTF-8.
    OSError
        If the file cannot be opened.
    """
    content = read_at_most(path, largest)
    if content is None:
        raise FileFormatError(f"{path.name} is too large to be a table.")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise FileFormatError(
            f"{path.name} is not UTF-8 text. Give a table as text, such as a .csv."
        ) from None


def read_cells(path: Path, largest: int) -> list[tuple[int, list[str]]]:
    """Return the number and the cells of each line of a .csv file, without surrounding spaces.

    Raises
    ------
    FileFormatError
        If the file is larger than `largest` bytes, or is not comma-separated text in UTF-8.
    OSError
        If the file cannot be opened.
    """
    reader = csv.reader(io.StringIO(text_of(path, largest)), skipinitialspace=True)
    try:
        return [
            (reader.line_num, [_without_apostrophe(cell.strip()) for cell in cells])
            for cells in reader
        ]
    except csv.Error:
        raise FileFormatError(f"{path.name} is not a table of comma-separated text.") from None


def unknown_column(
    file: str, line: int, title: str, known: Sequence[str], others: Mapping[str, str] | None = None
) -> FileFormatError:
    """Return the error for an unknown column.

    Parameters
    ----------
    file : str
        Name of the file.
    line : int
        Number of the line with the column titles.
    title : str
        Title of the unknown column.
    known : sequence of str
        Titles of the valid columns.
    others : mapping of str to str, optional
        Kind of table to which other columns belong, by column title.
    """
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if separator in title:
            return FileFormatError(
                f"{file}: line {line}: the cells are separated by {name}. Save the table with "
                "commas between the cells."
            )
    hint = did_you_mean(title, known, SYNONYMS)
    if title in (others or {}):
        hint = f" It is a column of {(others or {})[title]}."
    return FileFormatError(
        f"{file}: line {line}: there is no column {title!r}.{hint} The columns are "
        f"{', '.join(known)}."
    )


def read_csv(
    path: Path,
    *,
    largest: int,
    check: Callable[[list[str], int], list[str]] = lambda titles, line: titles,
) -> CsvFile:
    """Read a .csv file with column titles in its first non-empty line.

    Parameters
    ----------
    path : Path
    largest : int
        Largest allowed size of the file, in bytes.
    check : callable
        Called with the titles in the file and their line number. Returns the normalized titles, or
        raises an error if a title is unknown or missing.

    Raises
    ------
    FileFormatError
        If the file is not a table, has two columns with the same title, or has a line with more
        cells than columns.
    OSError
        If the file cannot be opened.
    """
    rows = [(number, cells) for number, cells in read_cells(path, largest) if any(cells)]
    line, raw_titles = rows[0] if rows else (1, [])
    titles = check(raw_titles, line)
    for title in filter(None, titles):
        if titles.count(title) > 1:
            raise FileFormatError(f"{path.name} has two columns {title!r}. Remove one of them.")
    lines = []
    for number, cells in rows[1:]:
        if any(cells[len(titles) :]):
            raise FileFormatError(
                f"{path.name}: line {number} has more cells than there are columns. Write decimals "
                "with a point, and put text with a comma in quotation marks."
            )
        filled = {name: cell for name, cell in zip(titles, cells, strict=False) if name and cell}
        if filled:
            lines.append((number, filled))
    return CsvFile(titles, lines)


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
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([_with_apostrophe(title) for title in titles])
    writer.writerows([_with_apostrophe(cell) for cell in row] for row in rows)
    write_whole(target, file.getvalue().encode())
    return target


def _with_apostrophe(cell: Any) -> Any:
    """Add an apostrophe to text that a spreadsheet would interpret as a formula."""
    if not isinstance(cell, str) or not cell.startswith((*_FORMULA, "'")) or _is_number(cell):
        return cell
    return f"'{cell}" if _without_apostrophe(f"'{cell}") == cell else cell


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
