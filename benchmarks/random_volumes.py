"""Random small volumes of every kind, compared with a direct solve.

    python benchmarks/random_volumes.py [--random 300] [--seed 0]

Exits with 1 if a distance exceeds the reported error.

The matrix of the direct solve consists of elements by scikit-fem, or is that of the paper's model.
Every second volume is solved as if it were too large for a factorization, so that cycles and
factorizations are both tested. Half of the volumes are stored without their void, as large volumes
are.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np

from napari_hmrf import ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.errors import ConvergenceError, ProblemError
from napari_hmrf.solver.backends.cpu import layout
from napari_hmrf.solver.backends.direct.factors import Factors
from validation.oracles.elasticity import direct_solution
from validation.oracles.paper import solve_exactly

TOLERANCE = 0.01
#: Outcome of a volume with a wrong solution.
WRONG = "are WRONG"
# Tolerance for the rounding of values that are stored in single precision.
_ROUNDED = 1e-6


def random_volume(seed: int) -> tuple[Any, ...]:
    """Return a random displacement, confidence, stiffness, spacing and Poisson's ratio."""
    draw = np.random.default_rng(seed)
    shape = tuple(draw.integers(2, 14, 3))
    size, ratio = draw.integers(1, 5), 10 ** draw.choice([0, 0.3, 0.7, 1, 2, 3, 4, 5, 6])
    coarse = draw.random(tuple(-(-extent // size) for extent in shape))
    blobs = np.kron(coarse, np.ones((size, size, size)))[tuple(map(slice, shape))]
    m = np.where(blobs > draw.uniform(0, 0.7), ratio, 1.0) if draw.random() < 0.5 else ratio**blobs
    if draw.random() < 0.5:
        m[blobs < draw.uniform(0, 0.3)] = 0
    held = draw.random(shape) < draw.choice([0.002, 0.02, 0.2])
    held[[0, -1][: draw.integers(3)]] = True
    y, c = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    c[held] = 1
    y[held] = draw.normal(size=3) + draw.integers(2) * draw.normal(size=(held.sum(), 3)) / 2
    spacing = (1.0, 1.0, 1.0) if draw.random() < 0.5 else tuple(draw.uniform(0.5, 2, 3))
    poisson = draw.choice([0, 0.3, 0.45, 0.49, 0.499])
    each = (draw.random(shape) * 0.499).astype(np.float32)
    nu = each if draw.random() < 0.2 else float(poisson)
    if draw.random() < 0.2:
        m[(blobs > draw.uniform(0.8, 0.98)) & (m > 0) & ~held] = np.inf
    return y * spacing, c, m, spacing, nu


def judged(seed: int, paper: bool = False) -> tuple[str, str]:
    """Return the outcome of a random volume, and a remark or ""."""
    y, c, m, spacing, poisson = random_volume(seed)
    try:
        problem = Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)
        prior = SeilerPrior() if paper else ElasticPrior(poisson)
        with ExitStack() as as_large:
            if seed % 2:
                as_large.enter_context(patch.object(Factors, "fit", staticmethod(lambda *_: False)))
            if seed % 4 > 1:
                as_large.enter_context(patch.dict(layout._FEW, {3: 0}))
            found = solve(problem, prior, optimizer=Multigrid(TOLERANCE), backend="cpu")
    except ProblemError:
        return "have no unique solution", ""
    except ConvergenceError as error:
        return "are refused, because cycles cannot bound the error", f"volume {seed}: {error}"
    truth = solve_exactly(problem, "centred") if paper else direct_solution(problem, prior)
    apart = np.abs(found.displacement - truth)[problem.tissue].max() / problem.unit
    assert found.convergence is not None
    if apart > found.convergence.error + _ROUNDED:
        return WRONG, f"volume {seed}: {apart:.2g}, reported {found.convergence.error:.2g}"
    return f"are correct, by {found.convergence.way}", ""


def judge(seeds: range, paper: bool = False) -> tuple[str, int]:
    """Return a text with the outcomes of random volumes, and the number of wrong solutions."""
    became: Counter[str] = Counter()
    remarks = []
    for seed in seeds:
        what, remark = judged(seed, paper)
        became[what] += 1
        remarks += [remark] if remark else []
    told = ", ".join(f"{count} {what}" for what, count in became.most_common())
    model = " in the paper's model" if paper else ""
    return "\n".join([f"{len(seeds)} random volumes{model}: {told}.", *remarks]), became[WRONG]


def main() -> int:
    """Print the outcomes; return 1 if a solution is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--random", type=int, default=300, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.random)
    outcomes = [judge(seeds, paper) for paper in (False, True)]
    print("\n".join(text for text, _ in outcomes))
    return min(1, sum(wrong for _, wrong in outcomes))


if __name__ == "__main__":
    sys.exit(main())
