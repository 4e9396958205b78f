"""Campaigns: long tests outside the regular test suite, with a summary of their results.

    python scripts/campaigns.py                                      # run the campaigns
    python scripts/campaigns.py --page docs/validation/campaigns.md  # also write the summary

The campaigns are marked with `pytest.mark.campaign`. They repeat claims of regular tests for
additional cases, and run examples, notebooks, the code in the documentation, and the wheel.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
HEAD = """# Campaigns

Campaigns are long tests: further cases of short tests, the examples, the code in the documentation,
the notebooks and the wheel. `make campaigns` wrote this page.

| test | passed | skipped | failed |
| --- | ---: | ---: | ---: |
"""


def run(report: Path) -> int:
    """Run the campaigns and return the exit status of pytest."""
    command = [sys.executable, "-m", "pytest", "-m", "campaign", f"--junitxml={report}"]
    return subprocess.run(command, cwd=ROOT, env={**os.environ, "CI": ""}).returncode


def count(report: Path) -> dict[str, list[int]]:
    """Count the passed, skipped and failed cases of each test in a JUnit report of pytest."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for case in ElementTree.parse(report).iter("testcase"):
        if not case.get("classname"):
            continue  # a skipped module: its library is not installed
        name = case.get("name", "").partition("[")[0]
        outcomes = {child.tag for child in case}
        which = 2 if outcomes & {"failure", "error"} else 1 if "skipped" in outcomes else 0
        counts[f"{case.get('classname', '').rpartition('.')[2]}: {name}"][which] += 1
    return dict(counts)


def page_of(counts: dict[str, list[int]]) -> str:
    """Return the summary page, which has a row for each test."""
    rows = [
        f"| `{name}` | {' | '.join(map(str, each))} |\n" for name, each in sorted(counts.items())
    ]
    return HEAD + "".join(rows)


def main() -> int:
    """Run the command; return 1 if a test failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--page", type=Path, help="file to which the summary is written")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        status = run(report)
        page = page_of(count(report))
    print(page)
    if options.page:
        options.page.write_text(page, encoding="utf-8")
    return int(status != 0)


if __name__ == "__main__":
    sys.exit(main())
