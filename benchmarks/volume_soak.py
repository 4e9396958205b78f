"""Memory after thousands of solves of small volumes of varying shape.

    python benchmarks/volume_soak.py [--solves 5000] [--seed 0]

Volumes of 108 shapes are solved in turn as elastic tissue on the compiled loops, by factorization;
in every tenth volume, observations may slip. The memory after each pass over the shapes is printed.
Exits with 1 if memory grew by more than 100 MB after the first pass.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Sequence

import numpy as np
import psutil

from napari_hmrf import ElasticPrior, Problem, solve

#: Largest accepted growth of memory, in MB.
MOST = 100.0
#: Shapes of the volumes, in voxels.
SHAPES = tuple(itertools.product((4, 6, 8, 10, 12, 13), (5, 7, 9, 11, 12, 13), (4, 8, 13)))
_SLIPS = 10


def volume(shape: tuple[int, ...], seed: int) -> Problem:
    """Return random tissue with one end fixed and the opposite end pulled.

    Parameters
    ----------
    shape : tuple of int
        Shape of the volume, (D, H, W).
    seed : int
        Seed of the stiffness.
    """
    m = 10 ** np.random.default_rng(seed).uniform(0, 3, shape)
    y, c = np.zeros((2, *shape, 3))
    c[0] = c[-1] = 1
    y[-1, ..., 0] = 1
    return Problem(observed=y, confidence=c, stiffness=m)


def passes(solves: int, seed: int = 0) -> list[float]:
    """Return the memory of the process after each pass over all shapes, in MB.

    Parameters
    ----------
    solves : int
        Number of solves.
    seed : int
        Seed of the first volume.
    """
    process, sizes = psutil.Process(), list[float]()
    for number in range(solves):
        penalty = 5.0 if number % _SLIPS == 0 else math.inf
        problem = volume(SHAPES[number % len(SHAPES)], seed + number)
        solve(problem, ElasticPrior(0.3, penalty=penalty), backend="cpu")
        if (number + 1) % len(SHAPES) == 0 or number + 1 == solves:
            sizes.append(process.memory_info().rss / 1e6)
    return sizes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the solves and print the memory after each pass."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--solves", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    begun = time.perf_counter()
    sizes = passes(options.solves, options.seed)
    print("MB after each pass: " + ", ".join(f"{size:.0f}" for size in sizes))
    growth = max(sizes) - sizes[0]
    print(
        f"{options.solves} solves of {len(SHAPES)} shapes in {time.perf_counter() - begun:.0f} s: "
        f"memory grew by {growth:.0f} MB after the first pass"
    )
    return 0 if growth <= MOST else 1


if __name__ == "__main__":
    sys.exit(main())
