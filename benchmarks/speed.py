"""Elastic speed to 0.01 px of the converged field, against the solvers one could pick instead.

    python benchmarks/speed.py [--quick]

The part of `make report` that says so, alone: a table of times, iterations, errors and memory, the
targets, and what bounds the rest. PyAMG and CalculiX take part where they are installed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from report.page import Settings, load, machine
from report.speed import section


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the section and its targets; 0 whatever they are, as a benchmark is not a test."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, to see whether it runs")
    options = parser.parse_args(arguments)
    before = load()
    print(machine(), "" if before is None else f"; load {before:.1f}", "\n", sep="")
    found = section(Settings(Path.cwd(), options.quick))
    print(found)
    print("\nTargets")
    for target in found.targets:
        print(f"  {target}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
