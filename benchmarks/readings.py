"""The two readings of "U_total at a site", solved exactly and compared with finite elements.

    python benchmarks/readings.py [--sizes 64 128 256]

Both readings are solved by a sparse direct method in float64, so the table compares the models and
not the progress of an iteration. docs/method.md cites the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from validation.oracles.elasticity import direct_solution
from validation.oracles.paper import solve_exactly

BAR_LENGTHS = (8, 64, 256, 1200)
PHANTOMS = ("expansion", "mass-effect")


def bar_strain_ratio(length: int, ratio: float, reading: str) -> float:
    """Return the strain ratio of the soft and stiff halves of a bar with prescribed ends."""
    m = np.ones((1, length))
    m[:, : length // 2] = ratio
    y, c = np.zeros((1, length, 2)), np.zeros((1, length, 2))
    c[:, [0, -1]] = 1
    y[0, -1, 1] = 1
    along = solve_exactly(Problem(observed=y, confidence=c, stiffness=m), reading)[0, :, 1]
    middle = length // 2
    return float((along[-1] - along[middle]) / (along[middle - 1] - along[0]))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    sizes = parser.parse_args(arguments).sizes
    print("RMSD to finite elements in px, and the field's own rms, for image sizes", *sizes)
    for name in PHANTOMS:
        rows: dict[str, list[float]] = {"centred": [], "blanket": [], "rms of the field": []}
        for size in sizes:
            problem = phantom(name, size).problem
            truth = direct_solution(problem, ElasticPrior(0.3))
            for reading in ("centred", "blanket"):
                found = solve_exactly(problem, reading)
                rows[reading].append(rmsd(found, truth, problem.tissue))
            rows["rms of the field"].append(rmsd(truth, 0 * truth, problem.tissue))
        for label, values in rows.items():
            print(f"  {name:12} {label:18}", "  ".join(f"{value:6.3f}" for value in values))
    print("\nStrain ratio of a bar whose halves have stiffness ratio 5 (truth: 5), by length in px")
    print(f"  {'':12} {'':18}", "  ".join(f"{length:6d}" for length in BAR_LENGTHS))
    for reading in ("centred", "blanket"):
        ratios = [bar_strain_ratio(length, 5.0, reading) for length in BAR_LENGTHS]
        print(f"  {'bar':12} {reading:18}", "  ".join(f"{ratio:6.2f}" for ratio in ratios))
    return 0


if __name__ == "__main__":
    sys.exit(main())
