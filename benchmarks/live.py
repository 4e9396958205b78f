"""Update rate of the tissue while a patch is dragged.

    python benchmarks/live.py [size ...]
    python benchmarks/live.py --napari [size ...] [--kind grey colour stack pin move tissue]

The first command measures without a window, the second in a napari window with the dock (see
`live_window.py`). The load from other processes during the measurement is also printed.

A simulated hand moves a patch of tissue for some seconds, at the refresh rate of a screen. The
output lists the picture updates per second, the time from a movement to its picture, and the time
of each stage of an update: drawing the arrow into the observations, checking the problem, solving
it, and warping the picture. Two more values are the time of a slider change, which only warps the
picture, and the time until the first picture.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from napari_hmrf import ElasticPrior, LiveSolver, Problem
from napari_hmrf.data import phantom
from napari_hmrf.field.live_warp import Warper
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.live_solver import Update
from napari_hmrf.tissue.drawing import Arrow, Canvas, Drawing, Rendering

#: Required updates per second on two idle cores.
GOALS = {300: 20, 1200: 5}
SIZES = (300, 600, 1200)
STAGES = ("draw", "check", "solve", "warp")
#: Brushes that paint in a window instead of pulling.
BRUSHES = ("pin", "move", "tissue")
#: Kinds of images in a window: grey, colour, or a slice of a stack; brushes use the grey image.
KINDS = ("grey", "colour", "stack", *BRUSHES)
_SECONDS = 4.0
_EVENTS = 60.0
_TURN = 2.0  # seconds per revolution of the hand
_QUIET = 0.1  # number of cores that other processes may use


class Drag:
    """Drag of a patch of the brain image, in colours, by a simulated mouse."""

    def __init__(self, size: int) -> None:
        drawn = phantom("mass-effect", size)
        self.problem = drawn.problem
        self._size = size
        base = Canvas.blank(drawn.image.shape[:2], self.problem.spacing)
        base.observed[...], base.confidence[...] = self.problem.observed, self.problem.confidence
        self._rendering = Rendering(base)
        self._warper = Warper(np.stack([drawn.image] * 3, axis=-1), spacing=(1, 1))
        self.costs: dict[str, list[float]] = {stage: [] for stage in STAGES}
        self.shown: list[Update] = []
        self.late: list[float] = []
        self._moved: dict[int, float] = {}
        self.live = LiveSolver(self._show, ElasticPrior())

    def move(self, seconds: float) -> None:
        """Move the mouse to its position after a number of seconds."""
        angle = 2 * math.pi * seconds / _TURN
        reach = 0.03 * self._size
        by = (reach * math.sin(angle), reach * (1 - math.cos(angle)))
        arrow = Arrow((0.5 * self._size, 0.3 * self._size), by, 0.04 * self._size)
        now = time.perf_counter()
        self._moved[self.live.submit(lambda: self._read(Drawing((arrow,))))] = now

    def _read(self, drawing: Drawing) -> Problem:
        self._timed("draw", lambda: self._rendering.show(drawing))
        canvas = self._rendering.canvas
        made: Problem = self._timed(
            "check",
            lambda: Problem(
                observed=canvas.observed,
                confidence=canvas.confidence,
                stiffness=self.problem.stiffness,
            ),
        )
        return made

    def _show(self, update: Update) -> None:
        if update.solution is None:
            raise SystemExit(f"the problem of the benchmark was refused: {update.error}")
        solution = update.solution
        self.costs["solve"].append(solution.provenance.seconds)
        self._timed("warp", lambda: self._warper(solution.displacement, solution.tissue))
        self.shown.append(update)
        self.late.append(time.perf_counter() - self._moved[update.number])

    def slide(self) -> float:
        """Show half of the last deformation, as a slider does, and return the time in seconds."""
        solution = self.shown[-1].solution
        assert solution is not None

        def half() -> float:
            begun = time.perf_counter()
            self._warper(solution.displacement, solution.tissue, 0.5)
            return time.perf_counter() - begun

        return min(compute_thread.submit(half).result() for _ in range(5))

    def _timed(self, stage: str, job: Callable[[], Any]) -> Any:
        begun = time.perf_counter()
        result = job()
        self.costs[stage].append(time.perf_counter() - begun)
        return result


def measure(size: int) -> str:
    """Drag for some seconds and return the report."""
    drag = Drag(size)
    for angle in (0.0, 0.1):  # kernels are compiled and loaded before timing starts
        drag.move(angle)
        drag.live.wait()
    drag.live.cancel()
    drag.move(0.0)
    drag.live.wait()
    first = drag.late[-1]
    for kept in (drag.shown, drag.late, *drag.costs.values()):
        kept.clear()
    events, begun = 0, time.perf_counter()
    pause = threading.Event()
    while (now := time.perf_counter() - begun) < _SECONDS:
        drag.move(now)
        events += 1
        pause.wait(max(0.0, events / _EVENTS - (time.perf_counter() - begun)))
    drag.live.wait()
    seconds = time.perf_counter() - begun
    rate, asked = len(drag.shown) / seconds, goal_of(size)
    cycles = [update.solution.iterations for update in drag.shown if update.solution]
    lines = [
        f"{size} x {size}: {rate:.1f} updates/s{asked} of {events / seconds:.0f} movements/s",
        f"    {np.mean(cycles):.1f} cycles each",
        f"    from movement to picture: {_spread(drag.late)}",
        *(f"    {stage:6}{_spread(costs)}" for stage, costs in drag.costs.items()),
        f"    slider: {1e3 * drag.slide():.1f} ms, first picture: {1e3 * first:.0f} ms",
    ]
    drag.live.close()
    return "\n".join(lines)


def goal_of(size: int) -> str:
    """Return the required updates per second as a phrase, or "" if there is no requirement."""
    return f" (required: {GOALS[size]})" if size in GOALS else ""


def _spread(seconds: list[float]) -> str:
    low, middle, high = 1e3 * np.percentile(seconds, (0, 50, 95))
    return f"median {middle:6.1f} ms, least {low:6.1f}, 95 % below {high:6.1f}"


def in_window(sizes: Sequence[int], kinds: Sequence[str], arguments: Sequence[str]) -> int:
    """Measure in a napari window, on a virtual display if there is no display."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.getenv("WAYLAND_DISPLAY")):
        if shutil.which("xvfb-run") is None:
            print("There is no display or xvfb-run. Install: sudo apt-get install xvfb xauth")
            return 1
        script = Path(__file__).resolve().parent.parent / "scripts" / "headless.sh"
        return subprocess.call(["sh", str(script), sys.executable, __file__, *arguments])
    import live_window

    for size in sizes:
        for kind in kinds:
            with load():
                asked = goal_of(size)
                print(live_window.measure(size, kind, _SECONDS, _spread, asked), flush=True)
    return 0


def main(arguments: Sequence[str]) -> int:
    """Print the results for each size."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sizes", nargs="*", type=int, metavar="size", default=SIZES)
    parser.add_argument("--napari", action="store_true", help="drag in a napari window")
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=KINDS[:1])
    options = parser.parse_args(arguments)
    if options.napari:
        return in_window(options.sizes, options.kind, arguments)
    for size in options.sizes:
        with load():
            print(measure(size), flush=True)
    return 0


@contextmanager
def load() -> Iterator[None]:
    """Print how many cores other processes used meanwhile; load makes results 2-3 times worse."""
    others, begun = _others(), time.perf_counter()
    yield
    busy = (_others() - others) / (time.perf_counter() - begun)
    quiet = "" if busy < _QUIET else "; the machine was NOT idle, so the times are too long"
    print(f"    others used {busy:.2f} of {os.cpu_count()} cores{quiet}", flush=True)


def _others() -> float:
    """Return the processor time of all processes except this process and its display."""
    times = psutil.cpu_times()
    total = sum(times) - times.idle - getattr(times, "iowait", 0.0)
    total -= getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)
    ours = sum(psutil.Process().cpu_times()[:2])
    display = os.environ.get("DISPLAY", "")
    for process in psutil.process_iter(["name", "cmdline", "cpu_times"]):
        known = process.info
        if known["name"] in ("Xvfb", "Xorg") and display in (known["cmdline"] or ()):
            ours += sum(known["cpu_times"][:2])
    return float(total - ours)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
