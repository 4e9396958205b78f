"""Markdown tables of the benchmarks: written as a whole, row by row, or into a page.

This module imports no other benchmark, so that programs in other folders can use it too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def markdown(titles: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table; see `cell` for the format of its values."""
    return "\n".join([head(titles), *(line(row) for row in rows)])


def head(titles: Sequence[str]) -> str:
    """Return the first two lines of a table."""
    return f"{line(titles)}\n|{' --- |' * len(titles)}"


def line(values: Iterable[Any]) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(cell(value) for value in values)} |"


def cell(value: Any) -> str:
    """Return a value as text: numbers with three significant digits, and None as "-"."""
    if value is None:
        return "-"
    if isinstance(value, float | np.floating):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)


def duration(seconds: float) -> str:
    """Return a time as text."""
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.2f} s"


def replace(page: Path, table: str) -> None:
    """Replace the table of a Markdown page that has the same titles.

    Raises
    ------
    ValueError
        If the page has no such table.
    """
    lines = page.read_text(encoding="utf-8").splitlines()
    titles = table.splitlines()[0]
    if titles not in lines:
        raise ValueError(f"{page} has no table with the titles {titles}")
    begin = end = lines.index(titles)
    while end < len(lines) and lines[end].startswith("|"):
        end += 1
    lines[begin:end] = table.splitlines()
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
