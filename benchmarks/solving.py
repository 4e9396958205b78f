"""Time of solves, compared with another checkout of this repository.

    python benchmarks/solving.py --against FOLDER_OF_ANOTHER_CHECKOUT
    python benchmarks/solving.py --volumes 128 192 --images 1200 --turns 15 --threads 2

The volume is an ellipsoid that fills 41 % of its grid, held at its surface, in which a ball grows;
the image is the sample `expansion`. Both have Poisson's ratio 0.45 and are solved to 0.001 pixels.
A process for each checkout solves the same problem in turn, so that other load on the machine
affects both equally. The relevant result is the ratio of each pair of solves: its geometric mean
with a 95 % confidence interval, for wall-clock time and for processor time. On a busy machine,
processor time is more reliable.

In addition, the report contains the first solve of the process (after a solve of a tiny problem,
which loads the loops) divided by the second solve, and the peak of the memory of the process.
Without another checkout, only the times of this checkout are printed.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from checkouts import CheckoutWorker, Turn, answer, in_turn
from report.memory import peak_megabytes
from scipy import stats

ROOT = Path(__file__).resolve().parent.parent
#: Prefix of lines from a worker to its parent process, because libraries also print.
_ANSWER = "solving: "
# Half axes of the ellipsoid, relative to half of the grid.
_AXES = np.float32((0.98, 0.95, 0.84))
_KINDS = ("volume", "image")


def ellipsoid(size: int) -> Any:
    """Return an ellipsoid held at its surface, in which a ball grows."""
    from napari_hmrf import Problem

    sites = np.moveaxis(np.indices((size,) * 3, dtype=np.float32), 0, -1)
    places = sites * np.float32(2 / size) - 1
    depth = np.linalg.norm(places / _AXES, axis=-1)
    from_middle = places - np.float32((0.15, 0.1, 0))
    r = np.linalg.norm(from_middle, axis=-1)
    skin = (r < 0.25) & (r > 0.25 - 3 / size)
    y, c = np.zeros((2, *depth.shape, 3), dtype=np.float32)
    y[skin], c[skin] = 0.12 * size * from_middle[skin], 1
    c[(depth > 1 - 4 / size) & (depth < 1)] = 1
    return Problem(observed=y, confidence=c, stiffness=np.where(depth < 1, 1.0, 0.0))


def problem_of(kind: str, size: int) -> Any:
    """Return the problem of a kind."""
    if kind == "volume":
        return ellipsoid(size)
    from napari_hmrf.data import phantom

    return phantom("expansion", size=size).problem


def work(kind: str, size: int) -> int:
    """Solve once for each line on the standard input."""
    from napari_hmrf import ElasticPrior, Multigrid, solve

    def turn(problem: Any) -> Turn:
        wall, cpu = time.perf_counter(), time.process_time()
        found = solve(problem, ElasticPrior(0.45), optimizer=Multigrid(), backend="cpu")
        seconds = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
        return {**seconds, "cycles": found.iterations, "peak": peak_megabytes()}

    turn(problem_of(kind, {"volume": 24, "image": 96}[kind]))
    problem = problem_of(kind, size)
    answer(_ANSWER, {})
    for _ in sys.stdin:
        answer(_ANSWER, turn(problem))
    return 0


class Worker(CheckoutWorker):
    """Process that solves a problem in a checkout on request.

    Parameters
    ----------
    checkout : Path
        Root folder of the checkout.
    kind : {"volume", "image"}
    size : int
        Sites along each axis.
    threads : int
        Number of threads of the compiled loops.
    """

    def __init__(self, checkout: Path, kind: str, size: int, threads: int) -> None:
        script, number = Path(__file__).resolve(), str(threads)
        super().__init__(checkout, script, (kind, str(size)), _ANSWER, NUMBA_NUM_THREADS=number)

    def solve(self) -> Turn:
        """Solve the problem."""
        return self.ask({})


def compare(kind: str, size: int, checkouts: list[Path], turns: int, threads: int) -> str:
    """Return the report on a problem."""
    # Both processes measure their first solves before they take turns.
    workers = [Worker(checkout, kind, size, threads) for checkout in checkouts]
    first = [[worker.solve(), worker.solve()] for worker in workers]
    told = in_turn(workers, turns, Worker.solve)
    for worker in workers:
        worker.end()
    lines = [f"{kind} of {size}, {threads} threads:"]
    names = ("this checkout", "the other checkout")
    for name, own, (one, two) in zip(names, told, first, strict=False):
        times = {way: sorted(turn[way] for turn in own) for way in ("wall", "cpu")}
        both = ", ".join(
            f"{way} {values[len(values) // 2]:.3f} s (smallest {values[0]:.3f})"
            for way, values in times.items()
        )
        again = ", ".join(f"{one[way] / two[way]:.2f} ({way})" for way in times)
        lines.append(
            f"  {name}: {both}; {own[0]['cycles']:.0f} cycles; first / second solve {again}; "
            f"{own[-1]['peak'] / 2**10:.2f} GiB"
        )
    if len(workers) > 1:
        for way in ("wall", "cpu"):
            lines.append(f"  {way}: {ratio([[turn[way] for turn in own] for own in told])}")
    return "\n".join(lines)


def ratio(times: list[list[float]]) -> str:
    """Return the ratio of paired times in words: its mean, its interval and that of the least."""
    logs = np.log(times[0]) - np.log(times[1])
    middle = logs.mean()
    low, high = stats.t.interval(0.95, len(logs) - 1, middle, stats.sem(logs))
    mean, low, high = np.exp([middle, low, high])
    return (
        f"{mean:.2f} of the other checkout's time, 95 % interval {low:.2f} to {high:.2f}; "
        f"smallest times {min(times[0]) / min(times[1]):.2f}"
    )


def main() -> int:
    """Print the report on each problem."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--volumes", type=int, nargs="*", default=[64, 128, 192], metavar="SIZE")
    parser.add_argument("--images", type=int, nargs="*", default=[300, 1200], metavar="SIZE")
    parser.add_argument("--against", type=Path, metavar="FOLDER", help="another checkout")
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return work(options.worker[0], int(options.worker[1]))
    checkouts = [ROOT] if options.against is None else [ROOT, options.against.resolve()]
    for kind, sizes in zip(_KINDS, (options.volumes, options.images), strict=True):
        for size in sizes:
            print(compare(kind, size, checkouts, options.turns, options.threads), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
