"""Latency of a drag: the time from a mouse movement to the resulting picture.

    python benchmarks/dragging.py [size ...] [--only window | --only solver]
    python benchmarks/dragging.py --against FOLDER_OF_ANOTHER_CHECKOUT

For each size (by default 300, 600 and 1200 pixels), a patch of the sample brain is dragged in
circles: without a window, until the picture is in memory, and in a napari window with the dock,
until the picture is on the screen. The median and the 95th percentile are printed. For the window,
the work of its thread per movement is printed as well: the number of accesses of this package's
code to the data and metadata of layers, and the number of arrays as large as the image.

With another checkout, two processes take turns of some seconds, so that other load on the machine
affects both checkouts equally; the relevant result is the ratio for each pair of turns. The other
checkout runs its own `benchmarks/dragging.py` if it exists, because the internals of its window may
differ. On a busy machine, processor time is more reliable than wall-clock time. Options:
`--turns 5`, `--seconds 2`, `--kind tissue` (or another kind of `live.py`).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from checkouts import CheckoutWorker, Turn, answer, in_turn

SIZES = (300, 600, 1200)
WAYS = ("solver", "window")
ROOT = Path(__file__).resolve().parent.parent
#: Prefix of lines from a worker to its parent process, because libraries also print.
_ANSWER = "dragging: "
_EVENTS = 60.0
#: Number of functions to list that allocate the most large arrays.
_PLACES = 6


class Clock:
    """Context manager that measures the processor time of this thread and of all threads."""

    def __enter__(self) -> Clock:
        self._begun = time.thread_time(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.thread = time.thread_time() - self._begun[0]
        self.all = time.process_time() - self._begun[1]


def drag_solver(
    size: int, _: str
) -> tuple[Callable[[float], Turn], Callable[[float], Turn] | None]:
    """Return a function that drags without a window for a number of seconds, and None."""
    import live

    drag = live.Drag(size)
    for angle in (0.0, 0.1):  # kernels are compiled and loaded before timing starts
        drag.move(angle)
        drag.live.wait()

    def turn(seconds: float) -> Turn:
        drag.live.cancel()
        drag.move(0.0)
        drag.live.wait()
        for kept in (drag.shown, drag.late, *drag.costs.values()):
            kept.clear()
        moves, begun, pause = 0, time.perf_counter(), threading.Event()
        with Clock() as clock:
            while (now := time.perf_counter() - begun) < seconds:
                drag.move(now)
                moves += 1
                pause.wait(max(0.0, moves / _EVENTS - (time.perf_counter() - begun)))
            drag.live.wait()
        return {"late": drag.late, "moves": moves, "thread": clock.thread, "cpu": clock.all}

    return turn, None


def drag_window(
    size: int, kind: str
) -> tuple[Callable[[float], Turn], Callable[[float], Turn] | None]:
    """Return two functions that drag in a window: one measures time, and one counts work."""
    import live_window
    from counting import Counts, counted

    window = live_window.Window(size, kind)
    window.start()
    window.first()

    def turn(seconds: float, meanwhile: Any = None) -> Turn:
        clock = Clock()
        window.drag(seconds, meanwhile or clock)
        told: Turn = {"late": [*window.late], "moves": window.moves}
        if meanwhile is None:
            told |= {"thread": clock.thread, "cpu": clock.all}
        window.undo()
        return told

    def count(seconds: float) -> Turn:
        counts = Counts()
        told = turn(seconds, counted(size * size, counts))
        return {**told, **vars(counts)}

    return turn, count


def work(way: str, size: int, kind: str) -> int:
    """Perform a drag for each line on the standard input."""
    turn, count = {"solver": drag_solver, "window": drag_window}[way](size, kind)
    turn(1.0)
    answer(_ANSWER, {"ready": True})
    for line in sys.stdin:
        asked = json.loads(line)
        if asked["count"] and count is not None:
            answer(_ANSWER, count(asked["seconds"]))
        else:
            answer(_ANSWER, turn(asked["seconds"]))
    os._exit(0)  # skip the shutdown of Qt and its windows


class Worker(CheckoutWorker):
    """Process that performs drags in a checkout on request.

    Parameters
    ----------
    checkout : Path
        Root folder of the checkout.
    way : {"solver", "window"}
        Drag without or with a window.
    size : int
        Width and height of the image, in pixels.
    kind : str
        Kind of image or brush in the window: one of `live_window.KINDS`.
    """

    def __init__(self, checkout: Path, way: str, size: int, kind: str) -> None:
        own = checkout / "benchmarks" / "dragging.py"
        script = own if own.exists() else Path(__file__).resolve()
        super().__init__(checkout, script, (way, str(size), kind), _ANSWER)

    def drag(self, seconds: float, count: bool = False) -> Turn:
        """Drag for a number of seconds and return the result."""
        return self.ask({"seconds": seconds, "count": count})


def compare(
    way: str, size: int, kind: str, checkouts: list[Path], turns: int, seconds: float
) -> str:
    """Drag in each checkout in turn and return the report."""
    workers = [Worker(checkout, way, size, kind) for checkout in checkouts]
    told = in_turn(workers, turns, lambda worker: worker.drag(seconds))
    counts = [worker.drag(seconds, count=True) for worker in workers if way == "window"]
    for worker in workers:
        worker.end()
    where = f"in a window, {kind}" if way == "window" else "without a window"
    lines = [f"{size} x {size}, {where}"]
    names = ("this", "other")[: len(workers)]
    for name, found in zip(names, told, strict=True):
        late = [lag for turn in found for lag in turn["late"]]
        middle, high = _middle_and_high(late)
        moves, thread, cpu = (
            sum(turn[key] for turn in found) for key in ("moves", "thread", "cpu")
        )
        rate, asked = len(late) / (turns * seconds), moves / (turns * seconds)
        thread, cpu = (1e3 * time / max(len(late), 1) for time in (thread, cpu))
        lag = f"median {middle:6.1f} ms, 95 % below {high:6.1f}"
        lines.append(
            f"    {name:6}from movement to picture: {lag}; {rate:.1f} / s of {asked:.0f} movements"
        )
        lines.append(
            f"{'':10}processor time per picture: {thread:.1f} ms of the dragging thread, "
            f"{cpu:.1f} ms of all threads"
        )
    if len(told) > 1:
        pairs = [
            [mine / its for mine, its in zip(_figures(one), _figures(two), strict=True)]
            for one, two in zip(*told, strict=True)
        ]
        parts = ("median", "95 %", "time of the dragging thread", "time of all threads")
        lines.append(f"    this / other, median of {turns} turns (95 % interval; least to most):")
        lines += [
            f"      {part:30}{_ratio(ratios)}"
            for part, ratios in zip(parts, zip(*pairs, strict=True), strict=True)
        ]
    for name, counted in zip(names, counts, strict=False):
        lines += _counted(name, counted)
    return "\n".join(lines)


def _ratio(ratios: Sequence[float]) -> str:
    """Return the median of ratios, its 95 % interval by the bootstrap, and their range."""
    middle = np.median(ratios)
    interval = scipy.stats.bootstrap((ratios,), np.median, method="percentile", random_state=0)
    low, high = interval.confidence_interval
    return f"{middle:.2f} ({low:.2f} to {high:.2f}; {min(ratios):.2f} to {max(ratios):.2f})"


def _figures(turn: Turn) -> list[float]:
    """Return the quantities of a turn that are compared."""
    pictures = max(len(turn["late"]), 1)
    return [*_middle_and_high(turn["late"]), turn["thread"] / pictures, turn["cpu"] / pictures]


def _counted(name: str, counted: Turn) -> list[str]:
    """Return the lines of the report about the GUI thread's work per movement."""
    moves = max(counted["moves"], 1)
    looks = {
        what: f"{sum(counted[what].values()) / moves:.1f} of {len(counted[what])} layers"
        for what in ("data", "metadata")
    }
    arrays, megabytes = counted["arrays"], counted["megabytes"] / moves
    seen = f"accesses to data {looks['data']}, to metadata {looks['metadata']}"
    made = f"{sum(arrays.values()) / moves:.2f} arrays as large as the image ({megabytes:.1f} MB)"
    lines = [f"    {name:6}GUI thread, per movement: {seen}; {made}"]
    most = sorted(arrays.items(), key=lambda item: -item[1])[:_PLACES]
    lines += [f"{'':10}{count / moves:5.2f} in {place}" for place, count in most]
    return lines


def _middle_and_high(seconds: list[float]) -> tuple[float, float]:
    if not seconds:
        return float("nan"), float("nan")
    middle, high = 1e3 * np.percentile(seconds, (50, 95))
    return float(middle), float(high)


def main(arguments: list[str]) -> int:
    """Print the results for each size."""
    parser = argparse.ArgumentParser(
        description="Measure the time from a mouse movement to its picture."
    )
    parser.add_argument("sizes", nargs="*", type=int, metavar="size", default=SIZES)
    parser.add_argument("--only", choices=WAYS)
    parser.add_argument("--against", type=Path, metavar="FOLDER")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--kind", default="grey", help="one of the kinds of `live.py --napari`")
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.worker:
        way, size, kind = options.worker
        return work(way, int(size), kind)
    ways = (options.only,) if options.only else WAYS
    if "window" in ways and not _has_display():
        if shutil.which("xvfb-run") is None:
            print("There is no display or xvfb-run. Install: sudo apt-get install xvfb xauth")
            return 1
        script = ROOT / "scripts" / "headless.sh"
        return subprocess.call(["sh", str(script), sys.executable, __file__, *arguments])
    checkouts = [ROOT]
    if options.against is not None:
        if not (options.against / "napari_hmrf").is_dir():
            parser.error(f"{options.against} is not a checkout of this repository")
        checkouts.append(options.against.resolve())
    for size in options.sizes:
        for way in ways:
            asked = (way, size, options.kind, checkouts, options.turns, options.seconds)
            print(compare(*asked), flush=True)
    return 0


def _has_display() -> bool:
    shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform != "linux" or bool(shown)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
