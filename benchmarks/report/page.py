"""Page of the report: its sections, and their conversion to Markdown."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clock import load, machine
from table import markdown


@dataclass(frozen=True)
class Target:
    """Required value of a result, and the measured value."""

    claim: str
    found: float
    bound: float
    at_least: bool = False

    @property
    def met(self) -> bool:
        """True if the target was met."""
        return self.found >= self.bound if self.at_least else self.found <= self.bound

    def __str__(self) -> str:
        """Return a line for the list of targets."""
        sign = ">=" if self.at_least else "<="
        verdict = "met   " if self.met else "MISSED"
        return f"{verdict}  {self.claim}: {self.found:.3g} ({sign} {self.bound:g})"


@dataclass(frozen=True)
class Settings:
    """Size of the report, and its output folder.

    Attributes
    ----------
    out : Path
        Existing output folder.
    quick : bool
        True for small sizes, to test that the report runs; its results are not meaningful.
    note : str
        Remark about this run, for the reader.
    """

    out: Path
    quick: bool = False
    note: str = ""

    def choose(self, full: Any, quick: Any) -> Any:
        """Return the first argument, or the second for a quick report."""
        return quick if self.quick else full


@dataclass
class Section:
    """Section of the page: paragraphs, tables and pictures in order, and checked targets."""

    title: str
    blocks: list[str] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)

    def say(self, text: str) -> None:
        """Add a paragraph; line breaks and indentation are ignored."""
        self.blocks.append(" ".join(text.split()))

    def missing(self, tool: str, how: str) -> None:
        """Add a line that a tool is not installed, with an installation instruction."""
        self.blocks.append(f"*{tool} is not installed here, so its part is left out: {how}.*")

    def table(self, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Add a table; numbers are formatted with three significant digits."""
        self.blocks.append(markdown(header, rows))

    def picture(self, path: Path, caption: str) -> None:
        """Add a picture from the folder of the page."""
        self.blocks.append(f"![{caption}]({path.name})")

    def __str__(self) -> str:
        """Return the section as Markdown."""
        return "\n\n".join([f"## {self.title}", *self.blocks])


def write_page(path: Path, sections: Sequence[Section], settings: Settings, begun: float) -> None:
    """Write the page with its header, the targets of all sections, and the sections."""
    targets = [target for section in sections for target in section.targets]
    met = sum(target.met for target in targets)
    minutes = (time.perf_counter() - begun) / 60
    busy = load()
    lines = [
        "# Validation report",
        "Made by `make report`; every number and picture below is from that one run.",
        f"{machine()}. {time.strftime('%Y-%m-%d')}, {minutes:.1f} minutes"
        + (f", load at the end {busy:.1f}." if busy is not None else "."),
    ]
    if settings.quick:
        lines.append("**A quick report: sizes are tiny, and its numbers are not meaningful.**")
    if settings.note:
        lines.append(f"**{settings.note}**")
    lines += [
        (
            f"{met} of {len(targets)} targets were met. The section that measures a missed target "
            "explains it."
        ),
        "```text\n" + "\n".join(str(target) for target in targets) + "\n```",
        *(str(section) for section in sections),
    ]
    path.write_text("\n\n".join(lines) + "\n", encoding="utf-8")
