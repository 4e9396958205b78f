"""Cost of a small edit relative to a cold solve.

    python -m report.warm SIZE REPEATS

Runs in a separate process, like the solvers in `report.contenders`, and prints one line of JSON.
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

from napari_hmrf import Multigrid, Problem, Solution, solve
from napari_hmrf.data import phantom
from report.contenders import PHANTOM, PRIOR, WITHIN
from report.page import Section, Settings, Target, duration

_Timed = tuple[float, Solution]
# Number of solves that are discarded, because the first solves of a process are slower.
_DISCARDED = 3


@dataclass(frozen=True)
class Warmth:
    """Median times, and numbers of cycles.

    Attributes
    ----------
    cold, warm, again : float
        Seconds of a cold start, of a start from the earlier field, and of a start from two earlier
        fields.
    cycles : list of int
        Number of cycles of each of the three solves.
    apart : float
        Largest distance between the fields of the cold and the warm start, in pixels.
    push : float
        Largest observed displacement, in pixels, which is the initial error of a cold start.
    """

    cold: float
    warm: float
    again: float
    cycles: list[int]
    apart: float
    push: float


def add_warm_start(page: Section, settings: Settings) -> None:
    """Add the cost of a small edit to the page."""
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
    first, drag = found.warm / found.cold, found.again / found.cold
    least = math.log(1 / WITHIN) / math.log(found.push / WITHIN)
    page.say(
        f"""**Question.** After an edit (an eighth of the tumour's rim moved by a pixel) at {size}
        x {size}, how long does a solve take that starts from the earlier one, relative to a cold
        solve? In a process of its own: cold {duration(found.cold)} in {found.cycles[0]} cycles,
        warm {duration(found.warm)} in {found.cycles[1]}. The ratio is {first:.2f}, and the two
        fields are at most {found.apart:.0e} px apart. **Conclusion.** A first move saves the
        set-up (the tissue is the same) and the cycles by which the earlier field is closer to
        the solution. At a fixed convergence rate, the cycles from one pixel to {WITHIN:g} px are
        {least:.2f} of the cycles from the {found.push:.1f} px of the whole push, so no such
        iteration can achieve a third. Where the patch was moved before (here by half as much), a
        sum of the earlier fields solves the new problem. Its error is at most the sum of the
        errors of its parts: the solve takes {duration(found.again)} in {found.cycles[2]} cycles,
        {drag:.2f} of a cold solve."""
    )
    page.targets.append(Target(f"warm restart over cold, {size}, first move", first, 1 / 3))
    page.targets.append(Target(f"warm restart over cold, {size}, moved before", drag, 1 / 3))


def main(size: int, repeats: int) -> Warmth:
    """Measure in this process."""
    before = phantom(PHANTOM, size).problem
    times: list[tuple[float, ...]] = []
    for number in range(_DISCARDED + repeats):
        # Stiffness in another unit, so that the set-up of the last problem cannot be reused.
        after = moved_patch(before)
        cold = _timed(
            Problem(
                observed=after.observed,
                confidence=after.confidence,
                stiffness=after.stiffness * (2 + number),
                spacing=after.spacing,
            )
        )
        earlier = _solved(before)
        warm = _timed(moved_patch(before), earlier)
        known = [earlier, _solved(moved_patch(before, 0.5), earlier)]
        again = _timed(moved_patch(before), known)
        times.append((cold[0], warm[0], again[0]))
    found = [cold[1], warm[1], again[1]]
    apart = np.abs(found[0].displacement - found[1].displacement)[before.tissue].max()
    push = float(np.hypot(*before.observed[(before.confidence > 0).all(axis=-1)].T).max())
    medians = [statistics.median(each) for each in zip(*times[_DISCARDED:], strict=True)]
    return Warmth(
        *medians, cycles=[each.iterations for each in found], apart=float(apart), push=push
    )


def _solved(problem: Problem, start: Solution | list[Solution] | None = None) -> Solution:
    return solve(problem, PRIOR, optimizer=Multigrid(WITHIN), backend="cpu", initial=start)


def _timed(problem: Problem, start: Solution | list[Solution] | None = None) -> _Timed:
    started = time.perf_counter()
    found = _solved(problem, start)
    return time.perf_counter() - started, found


def moved_patch(problem: Problem, pixels: float = 1.0) -> Problem:
    """Return the problem with an eighth of its moving boundary moved further down."""
    y = problem.observed.copy()
    moving = (problem.confidence > 0).all(axis=-1) & (np.abs(y).max(axis=-1) > 0)
    place = np.argwhere(moving)
    angle = np.arctan2(*(place - place.mean(axis=0)).T)
    patch = place[np.abs(angle) < np.pi / 8]
    y[patch[:, 0], patch[:, 1], 0] += pixels
    return Problem(
        observed=y,
        confidence=problem.confidence,
        stiffness=problem.stiffness,
        spacing=problem.spacing,
    )


if __name__ == "__main__":
    print(json.dumps(asdict(main(*map(int, sys.argv[1:3])))))
