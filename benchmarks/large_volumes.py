"""Benchmark of large motion in volumes.

    python -m benchmarks.large_volumes [exact] [calculix]

Measures the distance to an independent Newton's method and to CalculiX.
``python benchmarks/speed.py large-volume`` measures time and memory. Random problems are those of
``python -m benchmarks.campaign large-volumes``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from benchmarks import large_calculix
from napari_hmrf import NeoHookeanPrior, Problem, solve
from validation.oracles.large_motion import large_field


def main() -> None:
    """Print the requested sections, or all sections."""
    parser = argparse.ArgumentParser(description="Benchmark of large motion in volumes.")
    parser.add_argument("names", nargs="*", help=f"{', '.join(_SECTIONS)}; by default all")
    given = parser.parse_args()
    for name, section in _SECTIONS.items():
        if not given.names or name in given.names:
            section()


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
