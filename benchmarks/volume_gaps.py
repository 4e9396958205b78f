"""Volumes: the longest that whoever cancels may have to wait, in a solve and in what follows.

    python benchmarks/volume_gaps.py [--size 256] [--hard 96] [--backend cpu]

What is computed looks now and then whether it is still wanted. Prints the longest times between two
looks, and after which lines they begin and before which they end: by the clock, which other
programs lengthen, and in CPU seconds of the compute thread, which is one of as many as there are
cores. Loops are compiled before. The hard tissue is a shell a million times as stiff as what is
around it, which takes double precision.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("NAPARI_HMRF_COMPILE", "here")

import numpy as np
from volumes import WITHIN, growing, squeezed_shell

from napari_hmrf import ElasticPrior, Problem, Solution
from napari_hmrf.field.quantities import values_of
from napari_hmrf.fields import Warper
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.solve import run_here
from napari_hmrf.study.study import Pictures

_SHOWN = 3
# Voxels along each side of what loops are compiled with.
_SMALL = 32


class Looks:
    """A cancel flag that is never set, and notes when it is looked at, and where."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float, str]] = []
        self.is_set()

    def is_set(self) -> bool:
        """Note a look."""
        lines = [
            f"{Path(line.filename).stem}:{line.lineno}"
            for line in traceback.extract_stack(limit=8)
            if "napari_hmrf" in line.filename and "thread" not in line.filename
        ]
        self._seen.append((time.perf_counter(), time.thread_time(), " ".join(lines[-4:])))
        return False

    def show(self, title: str) -> None:
        """Print the longest times between two looks."""
        self.is_set()
        gaps = [
            (after[0] - before[0], after[1] - before[1], before[2], after[2])
            for before, after in zip(self._seen, self._seen[1:], strict=False)
        ]
        of_cpu = max(cpu for _, cpu, _, _ in gaps)
        gaps.sort(reverse=True)
        print(
            f"{title}: {len(gaps)} looks; the longest gap {gaps[0][0]:.2f} s, of CPU {of_cpu:.2f}"
        )
        for wall, cpu, before, after in gaps[:_SHOWN]:
            print(f"    {wall:.2f} s, of CPU {cpu:.2f}: {before or 'begins'} to {after or 'ends'}")
        sys.stdout.flush()


def watched(title: str, work: Callable[[Looks], Any]) -> Any:
    """What work on the compute thread returns; prints its gaps, if it has a title."""

    def job() -> Any:
        looks = Looks()
        with compute_thread.unless(looks.is_set):
            found = work(looks)
        if title:
            looks.show(title)
        return found

    return compute_thread.submit(job).result()


def look_at(problem: Problem, backend: str, tissue: str = "", follow: bool = True) -> None:
    """Solve a problem, and do with the solution all that a window does."""

    def solved(looks: Looks) -> Solution:
        return run_here(problem, ElasticPrior(0.45), WITHIN, backend, lambda _: None, looks)

    found = watched(tissue and f"solve, {tissue}", solved)
    if not follow:
        return
    image = np.indices(problem.shape, dtype=np.float32).sum(axis=0)
    warper = Warper(image, spacing=found.spacing)
    pictures = Pictures(image, name="image")
    tasks: dict[str, Callable[[], Any]] = {
        "warp": lambda: warper(found.displacement, found.tissue),
        "layers": lambda: result_layers(found, None, pictures, compute_thread.look),
        "change of volume": lambda: values_of(found, "jacobian"),
        "strain": lambda: values_of(found, "stretch"),
    }
    for name, task in tasks.items():
        watched(tissue and name, lambda _, task=task: task())


def main() -> None:
    """Print all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="voxels along each side")
    parser.add_argument("--hard", type=int, default=96, metavar="SIZE", help="0: not at all")
    parser.add_argument("--backend", default="cpu")
    asked = parser.parse_args()
    look_at(growing(_SMALL), asked.backend)
    look_at(growing(asked.size, free=True), asked.backend, f"{asked.size}^3, a ball held at a cap")
    if asked.hard:
        look_at(squeezed_shell(_SMALL), asked.backend, follow=False)
        hard = f"{asked.hard}^3, a shell a million times as stiff"
        look_at(squeezed_shell(asked.hard), asked.backend, hard, follow=False)


if __name__ == "__main__":
    main()
