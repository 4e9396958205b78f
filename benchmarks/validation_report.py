"""Validation report: a Markdown page with pictures, all produced by one run of this script.

    python benchmarks/validation_report.py [--out FOLDER] [--quick] [--only speed levels ...]

The run takes about ten minutes on two idle cores. Comparisons with programs that are not installed
are omitted, and the page says so (PyAMG and SimpleITK come with ``pip install -e ".[report]"``,
CalculiX is the system package `calculix-ccx`). With --only, the page contains only these sections.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import paper
import peers
from report import (
    analytic,
    bricks,
    finite_elements,
    levels,
    load_cases,
    metropolis,
    registration,
    resection,
)
from report.page import Section, Settings, write_page

OUT = Path(__file__).resolve().parent.parent / "docs" / "validation"
#: Sections in the order of execution. Speed is first, before the machine becomes warm.
SECTIONS: dict[str, Callable[[Settings], Section]] = {
    "speed": peers.section,
    "paper": paper.section,
    "levels": levels.section,
    "metropolis": metropolis.section,
    "finite-elements": finite_elements.section,
    "registration": registration.section,
    "analytic": analytic.section,
    "volumes": bricks.section,
    "loads": load_cases.section,
    "resection": resection.section,
}
ORDER = (
    "paper",
    "levels",
    "metropolis",
    "finite-elements",
    "registration",
    "analytic",
    "volumes",
    "loads",
    "resection",
    "speed",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page; always return 0, because a report is not a test."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--quick", action="store_true", help="small sizes, for a quick check")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--note", default="", help="remark about this run, for the reader")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    settings = Settings(options.out, options.quick, options.note)
    begun = time.perf_counter()
    done: dict[str, Section] = {}
    for name, make in SECTIONS.items():
        if name in options.only:
            started = time.perf_counter()
            done[name] = make(settings)
            print(f"{name}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    sections = [done[name] for name in ORDER if name in done]
    page = options.out / "README.md"
    write_page(page, sections, settings, begun)
    for target in (target for section in sections for target in section.targets):
        print(target)
    print(f"written: {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
