"""Random tissue with necks, flaps and islands beside gaps of void, compared with direct solves.

    python benchmarks/gaps.py [--small 4000] [--large 1000] [--volumes 1000] [--first 0] [--shaders]

The tissue is smoothed noise above a threshold, held at one side and moved at the other. A weak
rotation of a flap costs so little energy that an error estimate may miss it. Small images have 16
to 49 pixels a side, large images 200 to 600, and volumes 8 to 17 voxels. Each problem is solved at
tolerances of 0.01 and 0.001, and compared with a direct solve by SuperLU, with elements by
scikit-fem. A violation is an error above 1.05 times the larger of the reported error and the
tolerance. Exits with 1 if there are violations.

With ``PYTHONPATH`` set to another checkout, the figures are those of that checkout.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from napari_hmrf import ElasticPrior, Multigrid, solve
from napari_hmrf.errors import HmrfError
from validation.oracles.elasticity import direct_solution
from validation.problems import tissue_with_gaps

PRIOR = ElasticPrior(0.3)
TOLERANCES = 0.01, 0.001
#: Largest accepted ratio of the error to the larger of the reported error and the tolerance.
BOUND = 1.05
#: Number of axes, range of sides and number of problems of each kind.
_KINDS = {
    "small": (2, (16, 50), 4000),
    "large": (2, (200, 601), 1000),
    "volumes": (3, (8, 18), 1000),
}


class Outcome(NamedTuple):
    """Comparison of one solve with a direct solve; errors and tolerance in pixels."""

    seed: int
    error: float
    reported: float
    tolerance: float
    cycles: int
    way: str
    seconds: float

    @property
    def is_violation(self) -> bool:
        """True if the error exceeds the report and the tolerance."""
        return not self.error <= BOUND * max(self.reported, self.tolerance)


def compare(
    seed: int, axes: int, sides: tuple[int, int], backends: Sequence[str]
) -> Iterator[tuple[str, Outcome]]:
    """Yield the backend and the outcome of each solve of a random problem."""
    problem, exact = tissue_with_gaps(seed, axes, sides), None
    if not problem.known.any():
        return
    for backend in backends:
        for tolerance in TOLERANCES:
            begun = time.perf_counter()
            found = solve(problem, PRIOR, optimizer=Multigrid(tolerance), backend=backend)
            seconds = time.perf_counter() - begun
            if exact is None:
                exact = direct_solution(problem, PRIOR)
            off = np.linalg.norm(found.displacement - exact, axis=-1)
            error, of = float(off.max()), found.convergence
            assert of is not None
            cycles, way = found.iterations, of.way
            yield backend, Outcome(seed, error, of.error, tolerance, cycles, way, seconds)


def summary(name: str, outcomes: Sequence[Outcome]) -> str:
    """Return a line for each tolerance."""
    lines = []
    for tolerance in TOLERANCES:
        some = [each for each in outcomes if each.tolerance == tolerance]
        by_cycles = [each for each in some if each.way == "cycles" and each.error > 0]
        ratios = [each.reported / each.error for each in by_cycles]
        under = sum(each.error > BOUND * each.reported for each in by_cycles)
        lines.append(
            f"{name}, tolerance {tolerance:g}: {sum(each.is_violation for each in some)} of "
            f"{len(some)} beyond {BOUND} of the larger of report and tolerance ({under} beyond "
            f"{BOUND} of the report); median of report over error "
            f"{np.median(ratios) if ratios else np.nan:.2f}; {len(some) - len(by_cycles)} by "
            f"another way than cycles; {sum(each.cycles for each in by_cycles)} cycles, "
            f"{sum(each.seconds for each in some):.0f} s"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, (_, _, count) in _KINDS.items():
        parser.add_argument(
            f"--{name}", type=int, default=count, help=f"number; {count} by default"
        )
    parser.add_argument("--first", type=int, default=0, help="number of the first problem")
    parser.add_argument("--shaders", action="store_true", help="also solve images by shaders")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore", UserWarning)  # notes about assumptions
    outcomes: dict[str, list[Outcome]] = defaultdict(list)
    refused, last = 0, time.perf_counter()
    for kind, (axes, sides, _) in _KINDS.items():
        backends = ("cpu", "opengl") if options.shaders and axes == 2 else ("cpu",)
        for seed in range(options.first, options.first + getattr(options, kind)):
            try:
                for backend, outcome in compare(seed, axes, sides, backends):
                    outcomes[f"{kind}, {backend}"].append(outcome)
                    if outcome.is_violation:
                        print(f"VIOLATION, {kind}, {backend}: {outcome}", flush=True)
            except HmrfError as error:
                refused += 1
                print(f"refused, {kind}, {seed}: {error}", flush=True)
            if time.perf_counter() - last > 60:
                last = time.perf_counter()
                print(f"{kind}, {seed}", file=sys.stderr, flush=True)
    for name, each in outcomes.items():
        print(summary(name, each))
    print(f"{refused} problems refused")
    return 1 if any(one.is_violation for each in outcomes.values() for one in each) else 0


if __name__ == "__main__":
    sys.exit(main())
