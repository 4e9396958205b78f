"""Time from a mouse movement to the picture on the screen, in a real napari window.

    python -m benchmarks.window [size ...] [--kinds grey colour stack pin move tissue]
    python -m benchmarks.window [size ...] --kinds iso mip plane
    python -m benchmarks.window [size ...] --against FOLDER_OF_ANOTHER_CHECKOUT

A hand drags a patch of the sample brain in a circle. Another thread posts its mouse events at the
rate of an ordinary mouse; an event that the window has not processed yet is replaced by the next
event, as Qt does with real events. A picture counts once Qt has shown the repainted canvas on the
screen. The delay of a click is the time until the window answers a request that is posted every few
milliseconds. `pin`, `move` and `tissue` paint with a brush instead of pulling. `speed drag`
measures a drag without a window.

For the other kinds, which are renderings of the 3-D view, the surface of a head is dragged by one
movement at a time. Without a GPU, Mesa draws the canvas on the processor, which takes longer than
everything else.

With another checkout, windows of both take turns of some seconds; see `speed`. Without a
display, run the command with `sh scripts/headless.sh`.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from qtpy.QtCore import QEvent, QPointF
from qtpy.QtWidgets import QApplication

from benchmarks.checkouts import Turn, checkout, in_turn, ratio, serve, start_workers
from benchmarks.clock import conditions, now, since
from benchmarks.real_window import Poster, Window
from benchmarks.speed import textured_head
from benchmarks.table import head, line
from napari_hmrf.data import phantom
from napari_hmrf.tissue.drawing.marks import Action

SIZES, VOLUME_SIZES = (300, 1200), (96,)
#: Kinds of images, and brushes on a grey image.
KINDS = ("grey", "colour", "stack", "pin", "move", "tissue")
#: Renderings of the 3-D view, as settings of the image layer.
RENDERINGS: dict[str, dict[str, Any]] = {
    "iso": {"rendering": "iso", "iso_threshold": 60},
    "mip": {"rendering": "mip"},
    "plane": {"depiction": "plane"},
}
_WINDOW = (1500, 950)
# Events of the mouse per second, and seconds of one turn of the hand.
_MOUSE, _TURN = 100.0, 2.0
# Interval between requests to the window, in seconds.
_ASKING = 0.003
# Longest wait for a picture, in seconds.
_LATEST = 300.0


class ImageWindow(Window):
    """Window with an image, in which drags last some seconds.

    Parameters
    ----------
    size : int
        Width and height of the image, in pixels.
    kind : str
        One of `KINDS`.
    """

    def __init__(self, size: int, kind: str) -> None:
        self._size, self._kind = size, kind
        self._moved: dict[int, tuple[object, float]] = {}
        self._seen: object = None
        self._begun = self._event_time = 0.0
        self._late: list[float] = []
        super().__init__()
        drawn = phantom("mass-effect", size)
        image, m = drawn.image, drawn.problem.stiffness
        if kind == "colour":
            image = np.stack([np.uint8(255 * image / image.max())] * 3, axis=-1)
        elif kind == "stack":
            image, m = (np.stack([np.zeros_like(each), each, each]) for each in (image, m))
        shown = self.viewer.add_image(image, name="MR")
        tissue = self.viewer.add_image(m, name="stiffness", visible=False)
        if kind == "stack":
            self.viewer.dims.set_current_step(0, 1)
        self._dock = self.add_dock()
        self._dock.image, self._dock.tissue = shown, tissue
        self.viewer.mouse_over_canvas = True
        self.resize(*_WINDOW)
        self._dock.deformation_changed.connect(self._on_result)
        # Earlier versions have another name for the session.
        session = getattr(self._dock, "session", None) or self._dock.study_model
        session.changed.connect(self._on_drawing)
        self.drag(1.0)  # compiled loops are loaded

    def drag(self, seconds: float) -> Turn:
        """Drag for a number of seconds, undo the drag, and return the measured times."""
        self._dock.start()
        if self._kind in get_args(Action):
            self._dock.tool = self._kind
            self._dock.fields.by_col.value = 0.02 * self._size
        self.settle()
        mouse = Poster(self._on_mouse, 1 / _MOUSE, compress=True)
        questions = Poster(lambda asked: None, _ASKING)
        self._begun = now().wall
        self.send(QEvent.Type.MouseButtonPress, self._place(0.0))
        self.wait(0.5)
        self._late.clear()
        self._seen = None
        began = now()
        self._begun = began.wall
        mouse.start()
        questions.start()
        self.wait(seconds)
        mouse.stop()
        questions.stop()
        took = since(began)
        pictures = max(len(self._late), 1)
        found = {
            "late": self._late.copy(),
            "rate": len(self._late) / took.wall,
            "thread": took.thread / pictures,
            "all": took.processor / pictures,
            "click": questions.waits,
        }
        self.send(QEvent.Type.MouseButtonRelease, self._place(took.wall))
        self.settle()
        self._dock.undo()
        self.settle()
        return found

    def _place(self, seconds: float) -> QPointF:
        """Return the position of the hand on the canvas, which moves in a circle."""
        angle, reach = 2 * math.pi * seconds / _TURN, 0.03 * self._size
        row = 0.5 * self._size + reach * math.sin(angle)
        col = 0.3 * self._size + reach * (1 - math.cos(angle))
        return self.place_of(row, col)

    def _on_mouse(self, moved: float) -> None:
        self._event_time = moved
        self.send(QEvent.Type.MouseMove, self._place(moved - self._begun))

    def _on_drawing(self, _: object, drawing: object) -> None:
        self._moved[id(drawing)] = (drawing, self._event_time)

    def _on_result(self, result: Any) -> None:
        self._seen = result.study.motion.drawing

    def _on_frame(self, at: float) -> None:
        # A result is known by its drawing.
        known = self._moved.pop(id(self._seen), None)
        self._seen = None
        if known is not None:
            self._late.append(at - known[1])


class VolumeWindow(Window):
    """Window with the 3-D view of a head, in which the hand makes one movement at a time.

    Parameters
    ----------
    size : int
        Number of voxels from front to back.
    rendering : str
        One of `RENDERINGS`.
    """

    def __init__(self, size: int, rendering: str) -> None:
        super().__init__()
        image = textured_head(size)
        self._centre = np.array(image.shape) / 2
        layer = self.viewer.add_image(image, name="head")
        self._dock = self.add_dock()
        self._dock.extent = "volume"
        self.viewer.dims.ndisplay = 3
        self.resize(1400, 850)
        self._dock.start()
        self.settle()
        self.viewer.reset_view()
        for setting, value in RENDERINGS[rendering].items():
            setattr(layer, setting, value)
        layer.plane.position, layer.plane.normal = tuple(self._centre), (1, 0.3, 0.2)
        self._results: list[Any] = []
        self._dock.deformation_changed.connect(self._results.append)
        self.drag(0.5)

    def drag(self, seconds: float) -> Turn:
        """Move for a number of seconds, undo the drag, and return the measured times."""
        self.send(QEvent.Type.MouseButtonPress, self._place(0))
        late: list[float] = []
        began = now()
        while len(late) < 3 or since(began).wall < seconds:
            moved, results = now(), len(self._results)
            self._native._last_time = 0.0  # vispy drops moves in quick succession
            self.send(QEvent.Type.MouseMove, self._place(1 + len(late) % 20))
            self._wait_until(partial(_is_longer, self._results, results))
            self._wait_until(partial(_is_longer, self._shown, len(self._shown)))
            late.append(since(moved).wall)
        took = since(began)
        found = {
            "late": late,
            "rate": len(late) / took.wall,
            "thread": took.thread / len(late),
            "all": took.processor / len(late),
            "click": [],
        }
        self.send(QEvent.Type.MouseButtonRelease, self._place(1 + len(late) % 20))
        self.settle()
        self._dock.undo()
        self.settle()
        return found

    def _place(self, away: float) -> QPointF:
        """Return the position on the canvas of a point beside the middle of the head."""
        return self.place_of(*(self._centre + np.array([0, away, 0])))

    def _wait_until(self, condition: Callable[[], bool]) -> None:
        began = now()
        while not condition():
            if since(began).wall > _LATEST:
                raise SystemExit("there was no picture")
            QApplication.processEvents()
            time.sleep(0.002)


def _is_longer(values: Sequence[Any], count: int) -> bool:
    return len(values) > count


def work(kind: str, size: str) -> None:
    """Drag on request, in a worker."""
    window: Any = (VolumeWindow if kind in RENDERINGS else ImageWindow)(int(size), kind)
    serve({}, lambda request: window.drag(request["seconds"]))
    os._exit(0)  # skip the shutdown of Qt and its windows


_TITLES = ("window", "size", "pictures / s", "to the screen", "95 % within", "click", "95 % within")
_TITLES += ("GUI thread a picture", "all threads a picture")
_BESIDE = ("this / other", "median time to the screen", "GUI thread a picture")
_BESIDE += ("all threads a picture", "control, all threads")


def compare(kind: str, size: int, against: Path | None, turns: int, seconds: float) -> list[str]:
    """Drag in each checkout in turn, and return the lines of the tables."""
    workers = start_workers("benchmarks.window", (kind, str(size)), against)
    try:
        answers = in_turn(workers, {"seconds": seconds}, turns, math.inf)
    finally:
        for worker in workers:
            worker.end()
    lines = []
    names = (kind, f"{kind}, other checkout", f"{kind}, this checkout again")
    for name, found in zip(names, answers, strict=False):
        late, click = ([each for turn in found for each in turn[key]] for key in ("late", "click"))
        rate, *costs = (float(np.median([turn[key] for turn in found])) for key in _FIGURES)
        cells = [name, size, f"{rate:.1f}", *_spread(late), *_spread(click)]
        lines.append(line([*cells, *(f"{1e3 * cost:.1f} ms" for cost in costs)]))
    if len(answers) > 1:
        middle = [[float(np.median(turn["late"])) for turn in found] for found in answers]
        thread, every = ([[turn[key] for turn in found] for found in answers] for key in _COSTS)
        figures = (middle[:2], thread[:2], every[:2], (every[2], every[0]))
        ratios = (str(ratio(*each)) for each in figures)
        lines += ["", head(_BESIDE), line([f"{kind}, {size}", *ratios])]
    return lines


_COSTS = ("thread", "all")
_FIGURES = ("rate", *_COSTS)


def _spread(seconds: list[float]) -> list[str]:
    """Return the median and the 95th percentile as text."""
    if not seconds:
        return ["-", "-"]
    return [f"{1e3 * each:.1f} ms" for each in np.percentile(seconds, (50, 95))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table for each kind and size."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sizes", nargs="*", type=int, metavar="size")
    parser.add_argument("--kinds", nargs="+", choices=(*KINDS, *RENDERINGS), default=KINDS[:1])
    parser.add_argument("--against", type=checkout, metavar="FOLDER", help="another checkout")
    parser.add_argument("--turns", type=int, default=5, help="default: %(default)s")
    parser.add_argument("--seconds", type=float, default=2.0, help="time of a turn")
    options = parser.parse_args(arguments)
    print(conditions())
    titles = f"\n{head(_TITLES)}"
    if options.against is None:
        print(titles)
    for kind in options.kinds:
        for size in options.sizes or (VOLUME_SIZES if kind in RENDERINGS else SIZES):
            lines = compare(kind, size, options.against, options.turns, options.seconds)
            if options.against is not None:
                print(titles)
            print("\n".join(lines), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
