"""Random pulls by mouse in a real napari window: folds, reach, and time to the picture at rest.

    python -m benchmarks.pulls [number] [--share 0.25] [--steps 12] [--seed 0]

A hand grabs tissue of the sample brain (300 x 300 pixels) at a random point and moves it in a
straight line, in a random direction, by up to a share of the width of the image, in about half a
second. The picture at rest must not fold, and the grabbed point must be within a pixel of the
mouse, or the status line must say how far it is from its target. The table gives the time from the
release to the first picture that is like this, and to the picture at rest, to which the solve
converges. Each pull is undone before the next. Without a display, run the command with
`sh scripts/headless.sh`.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from qtpy.QtCore import QEvent

from benchmarks.clock import conditions, now, since
from benchmarks.real_window import Window
from benchmarks.table import head, line

_WINDOW = (1366, 768)
# Time between two moves of the mouse, in seconds.
_PACE = 0.04
# Longest wait for a result, in seconds.
_LATEST = 600.0
# Distance of the grabbed point from the mouse that counts as reached, in pixels.
_REACHED = 1.0


@dataclass(frozen=True)
class Pull:
    """A pull and its result.

    Attributes
    ----------
    at, by : tuple of float
        Grabbed pixel, and motion of the mouse in pixels.
    first : float
        Time from the release of the button to the first picture without folds in which the
        grabbed point is within a pixel of the mouse, or to the picture at rest.
    change : float
        Largest change of any pixel from that picture to the picture at rest, in pixels.
    seconds : float
        Time from the release of the button to the picture at rest.
    longest : float
        Longest time without a new picture after the release, in seconds.
    processor : float
        Processor time of all threads from the release to the picture at rest, in seconds.
    folds : int
        Folded pixels at rest.
    missing : float
        Distance of the grabbed point from its target, in pixels.
    model, status : str
        Model of the result, and the line in the window.
    """

    at: tuple[float, float]
    by: tuple[float, float]
    first: float
    change: float
    seconds: float
    longest: float
    processor: float
    folds: int
    missing: float
    model: str
    status: str

    @property
    def is_right(self) -> bool:
        """True if no pixel folds, and the point is reached or the window says that it is not."""
        return self.folds == 0 and (
            self.missing <= _REACHED or "short of its target" in self.status
        )


def _distance(displacement: np.ndarray, pixel: tuple[int, ...], target: np.ndarray) -> float:
    return float(np.linalg.norm(target - displacement[pixel]))


class PulledWindow(Window):
    """Window with the sample brain, which is pulled by a mouse."""

    def __init__(self) -> None:
        super().__init__()
        self.viewer.open_sample("napari-hmrf", "brain")
        self.viewer.show()
        docks = self.viewer.window.dock_widgets
        self._dock: Any = next(each for name, each in docks.items() if "Soft tissue" in name)
        self.viewer.mouse_over_canvas = True
        self.resize(*_WINDOW)
        self._dock.start()
        self.settle()

    def pull(self, at: tuple[float, float], by: tuple[float, float], steps: int) -> Pull | None:
        """Pull tissue by mouse, and undo the pull; None if there is no tissue at the point."""
        dock, pixel = self._dock, tuple(round(each) for each in at)
        self.send(QEvent.Type.MouseButtonPress, self.place_of(*at))
        for step in range(1, steps + 1):
            self.wait(_PACE)
            there = [float(a + b * step / steps) for a, b in zip(at, by, strict=True)]
            self._native._last_time = 0.0  # vispy drops moves in quick succession
            self.send(QEvent.Type.MouseMove, self.place_of(*there))
        pictures: list[tuple[float, np.ndarray]] = []
        began = now()

        def keep(shown: Any) -> None:
            if shown.solution is not None and shown.solution.count_folds() == 0:
                pictures.append((since(began).wall, shown.solution.displacement))

        dock.deformation_changed.connect(keep)
        self.send(QEvent.Type.MouseButtonRelease, self.place_of(*there))
        while dock.busy:
            if since(began).wall > _LATEST:
                raise SystemExit(f"no result of the pull at {at} by {by}")
            self.wait(0.01)
        took, solution = since(began), dock.solution
        dock.deformation_changed.disconnect(keep)
        if solution is None or not dock.drawing.marks:
            return None
        target, rest = np.asarray(dock.drawing.marks[0].by), solution.displacement
        shown = [(0.0, rest), *pictures, (took.wall, rest)]
        longest = max(later[0] - earlier[0] for earlier, later in pairwise(shown))
        first, change = took.wall, 0.0
        for seconds, displacement in pictures:
            if _distance(displacement, pixel, target) <= _REACHED:
                first, change = seconds, float(np.abs(displacement - rest).max())
                break
        made = Pull(
            at,
            by,
            first,
            change,
            took.wall,
            longest,
            took.processor,
            solution.count_folds(),
            _distance(rest, pixel, target),
            solution.provenance.model,
            dock.status,
        )
        dock.undo()
        self.settle()
        return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Print each pull that is not right, and the times of all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("number", nargs="?", type=int, default=300)
    parser.add_argument("--share", type=float, default=0.25, help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=12, help="moves of the mouse in a pull")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true", help="print every pull")
    options = parser.parse_args(arguments)
    print(conditions())
    window, random = PulledWindow(), np.random.default_rng(options.seed)
    size = 300
    tissue = np.argwhere(window.viewer.layers["Tissue"].data > 0)
    pulls: list[Pull] = []
    while len(pulls) < options.number:
        row, col = tissue[random.integers(len(tissue))]
        angle, length = random.uniform(0, 2 * math.pi), random.uniform(0, options.share * size)
        by = (length * math.sin(angle), length * math.cos(angle))
        made = window.pull((float(row), float(col)), by, options.steps)
        if made is None:
            continue
        pulls.append(made)
        if options.verbose or not made.is_right:
            print(f"{len(pulls)}: {made}", flush=True)
    first, seconds = ([getattr(each, name) for each in pulls] for name in ("first", "seconds"))
    large = sum(each.model == "large motion" for each in pulls)
    reached = sum(each.missing <= _REACHED for each in pulls)
    right = sum(each.is_right for each in pulls)
    print(head(("pulls", "right", "reached", "large motion", "median of all threads")))
    processor = float(np.median([each.processor for each in pulls]))
    print(line([len(pulls), right, reached, large, f"{processor:.2f} s"]))
    print(head(("time after the release", "median", "95 %", "longest")))
    rows = {
        "to the first picture that is right": first,
        "to the picture at rest": seconds,
        "longest without a picture": [each.longest for each in pulls],
    }
    for name, values in rows.items():
        middle, most = np.percentile(values, (50, 95))
        print(line([name, *(f"{each:.2f} s" for each in (middle, most, max(values)))]))
    middle, most = np.percentile([each.change for each in pulls], (50, 95))
    print(f"change from the first to the last of these: {middle:.2g} px, 95 % {most:.2g} px")
    os._exit(0 if right == len(pulls) else 1)  # skip the shutdown of Qt and its windows


if __name__ == "__main__":
    main()
