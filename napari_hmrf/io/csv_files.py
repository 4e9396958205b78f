"""Comma-separated text, as spreadsheets write it: files with titles in their first line."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from napari_hmrf.arguments import checked_path
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.regular_file import read_at_most

ENDING = ".csv"


class CsvFile(NamedTuple):
    """What a file holds.

    Attributes
    ----------
    titles : list of str
        Of the columns; "" of one without.
    lines : list of (int, dict)
        The number of each line, and by title what is in those of its cells that are filled. Lines
        without such a cell are left out.
    """

    titles: list[str]
    lines: list[tuple[int, dict[str, str]]]


def text_of(path: Path, largest: int) -> str:
    """Read a file as text.

    Raises
    ------
    FileFormatError
        If it has more than so many bytes, or is not in UTF-8.
    OSError
        If it cannot be opened.
    """
    content = read_at_most(path, largest)
    if content is None:
        raise FileFormatError(f"{path.name} is too large to be a table.")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise FileFormatError(f"{path.name} is no table of text. Save it in UTF-8.") from None


def read_cells(path: Path, largest: int) -> list[tuple[int, list[str]]]:
    """Read the numbers of lines, and their cells without spaces around them.

    Raises
    ------
    FileFormatError
        If it has more than so many bytes, or is no comma-separated text in UTF-8.
    OSError
        If it cannot be opened.
    """
    reader = csv.reader(io.StringIO(text_of(path, largest)), skipinitialspace=True)
    try:
        return [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error:
        raise FileFormatError(f"{path.name} is no table of comma-separated text.") from None


def read_csv(
    path: Path, *, largest: int, check: Callable[[list[str]], list[str]] = lambda titles: titles
) -> CsvFile:
    """Read a file whose first line names its columns.

    Parameters
    ----------
    path : Path
    largest : int
        In bytes.
    check : callable
        Gets the titles as they are written; raises if one is wrong or missing, and returns them as
        they are meant.

    Raises
    ------
    FileFormatError
        If it is no such file, or has a column twice, or a line with more cells than columns.
    OSError
        If it cannot be opened.
    """
    rows = read_cells(path, largest)
    titles = check(rows[0][1] if rows else [])
    for title in filter(None, titles):
        if titles.count(title) > 1:
            raise FileFormatError(f"{path.name} has two columns {title!r}. Remove one of them.")
    lines = []
    for number, cells in rows[1:]:
        if any(cells[len(titles) :]):
            raise FileFormatError(
                f"{path.name}: line {number} has more cells than there are columns. Write decimals "
                "with a point, and text that holds a comma in quotation marks."
            )
        filled = {name: cell for name, cell in zip(titles, cells, strict=False) if name and cell}
        if filled:
            lines.append((number, filled))
    return CsvFile(titles, lines)


def save_csv(
    path: str | os.PathLike[str],
    titles: Sequence[str],
    rows: Iterable[Iterable[Any]],
    *,
    what: str = "tables",
) -> Path:
    """Write lines under titles, whole or not at all; what is None is left empty.

    Parameters
    ----------
    path : str or path-like
    titles : sequence of str
    rows : iterable of iterables
        A cell for each title.
    what : str
        What they are, for errors.

    Raises
    ------
    FileFormatError
        If its name does not end in .csv.
    OSError
        If it cannot be written.
    """
    target = Path(checked_path(path))
    if target.suffix.lower() != ENDING:
        raise FileFormatError(f"{target.name}: {what} are saved as text. End its name in {ENDING}.")
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(titles)
    writer.writerows(rows)
    write_whole(target, file.getvalue().encode())
    return target
