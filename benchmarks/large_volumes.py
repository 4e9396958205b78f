"""Benchmark of large motion in volumes.

    python -m benchmarks.large_volumes [exact] [calculix]

``--random 1000`` solves random problems; ``--first 400 --random 200`` solves a part of them.

Measures the distance to an independent Newton's method and to CalculiX, and failures on random
problems. ``python benchmarks/speed.py large-volume`` measures time and memory.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from benchmarks import large_calculix, random_large_volumes
from napari_hmrf import NeoHookeanPrior, Problem, solve
from validation.oracles.large_motion import large_field

# Default number of random problems.
_FEW = 40


def main() -> None:
    """Print the requested sections, or all sections."""
    parser = argparse.ArgumentParser(description="Benchmark of large motion in volumes.")
    parser.add_argument("names", nargs="*", help=f"{', '.join(_SECTIONS)}; by default all")
    parser.add_argument("--random", type=int, default=0, metavar="COUNT")
    parser.add_argument("--first", type=int, default=0, help="number of the first random problem")
    given = parser.parse_args()
    everything = not given.names and not given.random
    for name, section in _SECTIONS.items():
        if everything or name in given.names:
            section()
    count = _FEW if everything else given.random
    if count:
        random_large_volumes.run(given.first, count)


def exact() -> None:
    """Print the largest distance of any site from an independent method, in voxels."""
    size, worst = 16, 0.0
    y = np.zeros((size, size, size, 3))
    c = np.zeros_like(y)
    c[0] = c[-1] = 1
    m = np.ones((size, size, size))
    m[:, : size // 2] = 5
    for name, end in (("pulled by 20 %", [0.2 * size, 0, 0]), ("sheared", [0, 0.2 * size, 0])):
        y[-1] = end
        for poisson in (0.3, 0.45):
            problem = Problem(observed=y, confidence=c, stiffness=m)
            prior = NeoHookeanPrior(poisson)
            found = solve(problem, prior, backend="cpu")
            off = float(np.abs(found.displacement - large_field(problem, prior, 4)).max())
            worst = max(worst, off)
            print(f"{name:16} nu {poisson:4} error {off:.5f} voxel", flush=True)
    print(f"worst {worst:.5f} voxel", flush=True)


_SECTIONS: dict[str, Callable[[], None]] = {"exact": exact, "calculix": large_calculix.run}


if __name__ == "__main__":
    main()
