"""How much of a cold solve a small edit costs.

    python -m report.warm SIZE REPEATS

A process of its own, as the solvers have that are held against each other; it prints one line of
JSON.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from napari_hmrf import Multigrid, Problem, Solution, phantom, solve
from napari_hmrf.earlier import KEPT
from report.contenders import PHANTOM, PRIOR, WITHIN
from report.page import Section, Settings, Target, duration

_Timed = tuple[float, Solution]
# Steps of a drag, of a pixel each.
_STEPS = 8
# A warm process's first few are slower.
_DISCARDED = 3


@dataclass(frozen=True)
class Warmth:
    """Median seconds, and cycles.

    Attributes
    ----------
    cold, warm : float
        Of a solve from nothing, and from the earlier field.
    drag : float
        Of a step of a drag after the first, from the fields before: the mean of all steps.
    cycles : list of int
        Of the first two.
    drag_cycles : list of int
        Of the drag's steps.
    apart : float
        The largest distance of a field that began with earlier ones from the cold one of the same
        problem, in pixels.
    """

    cold: float
    warm: float
    drag: float
    cycles: list[int]
    drag_cycles: list[int]
    apart: float


def add_warm_start(page: Section, settings: Settings) -> None:
    """Say how much a small edit costs."""
    size = settings.choose(300, 48)
    command = [sys.executable, "-m", "report.warm", str(size), "25"]
    done = subprocess.run(
        command, cwd=Path(__file__).parent.parent, capture_output=True, text=True, check=False
    )
    if done.returncode:
        page.say(
            f"*The warm start failed: {(done.stderr.strip() or 'no message').splitlines()[-1]}*"
        )
        return
    found = Warmth(**json.loads(done.stdout.splitlines()[-1]))
    first, drag = found.warm / found.cold, found.drag / found.cold
    reach = float(np.abs(phantom(PHANTOM, size).problem.y).max())
    least = math.log(1 / WITHIN) / math.log(reach / WITHIN)
    page.say(
        f"""**Asked.** After an edit (an eighth of the tumour's rim moved by a pixel) at {size} x
        {size}, how much of a cold solve is a solve that starts with the earlier one? In a process
        of its own, cold {duration(found.cold)} in {found.cycles[0]} cycles, warm
        {duration(found.warm)} in {found.cycles[1]}: {first:.2f} of it. The edit is then the first
        step of a drag: in the next {len(found.drag_cycles)}, of a pixel each, a step is
        {duration(found.drag)} in the mean, {drag:.2f} of a cold solve, with
        {" ".join(map(str, found.drag_cycles))} cycles. No field is further than
        {found.apart:.0e} px from the cold one. **Reading.** On a first move the set-up is saved
        (the tissue is the same), and little else can be: an iteration that takes the same part of
        the error in each cycle needs ln({1 / WITHIN:g}) / ln({reach / WITHIN:g}) = {least:.2f} of a
        cold solve's cycles to bring an error of one pixel down to {WITHIN:g} px, where the cold one
        begins with {reach:.2g} px. Where the patch was moved before, the fields before tell how
        tissue answers: a sum of them solves the new problem, and is wrong by no more than the sum
        of what each is wrong by. Where that is within the tolerance no cycle is needed, but to see
        in double precision that it is so."""
    )
    page.targets.append(Target(f"warm restart over cold, {size}, first move", first, 1 / 3))
    page.targets.append(Target(f"warm restart over cold, {size}, moved before", drag, 1 / 3))


def main(size: int, repeats: int) -> Warmth:
    """Measure here."""
    before = phantom(PHANTOM, size).problem
    cold: list[_Timed] = []
    warm: list[list[_Timed]] = []
    for number in range(_DISCARDED + repeats):
        # Stiffness in another unit: what was set up for the last problem is of no use to this.
        after = moved_patch(before)
        cold.append(_timed(Problem(after.y, after.c, after.m * (2 + number), after.spacing)))
        known, steps = [_solved(before)], []
        for pixels in range(1, 1 + _STEPS):
            steps.append(_timed(moved_patch(before, pixels), known))
            known = [steps[-1][1], *known][:KEPT]
        warm.append(steps)
    at_rest = [_solved(moved_patch(before, pixels)) for pixels in range(1, 1 + _STEPS)]
    apart = [
        np.abs(step[1].displacement - each.displacement).max()
        for step, each in zip(warm[-1], at_rest, strict=True)
    ]
    seconds = np.array([[step[0] for step in steps] for steps in warm[_DISCARDED:]])
    cycles = [step[1].iterations for step in warm[-1]]
    return Warmth(
        cold=statistics.median(each[0] for each in cold[_DISCARDED:]),
        warm=float(np.median(seconds[:, 0])),
        drag=float(np.median(seconds[:, 1:], axis=0).mean()),
        cycles=[cold[-1][1].iterations, cycles[0]],
        drag_cycles=cycles[1:],
        apart=float(max(apart)),
    )


def _solved(problem: Problem, start: Solution | list[Solution] | None = None) -> Solution:
    return solve(problem, PRIOR, Multigrid(WITHIN), backend="cpu", start=start)


def _timed(problem: Problem, start: Solution | list[Solution] | None = None) -> _Timed:
    started = time.perf_counter()
    found = _solved(problem, start)
    return time.perf_counter() - started, found


def moved_patch(problem: Problem, pixels: float = 1.0) -> Problem:
    """The problem with an eighth of its moving boundary moved further down."""
    y = problem.y.copy()
    moving = (problem.c > 0).all(axis=-1) & (np.abs(y).max(axis=-1) > 0)
    place = np.argwhere(moving)
    angle = np.arctan2(*(place - place.mean(axis=0)).T)
    patch = place[np.abs(angle) < np.pi / 8]
    y[patch[:, 0], patch[:, 1], 0] += pixels
    return Problem(y, problem.c, problem.m, problem.spacing)


if __name__ == "__main__":
    print(json.dumps(asdict(main(*map(int, sys.argv[1:3])))))
