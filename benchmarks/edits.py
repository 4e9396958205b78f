"""What the window's thread does for a press of Deform, and for each step of a brush.

    python benchmarks/edits.py [size ...]

The sample brain, by default of 300 pixels, is deformed as elastic tissue; then tissue is painted, a
step of the brush at a time, while the result follows. Counted is how often this package's code
looks at the data and the metadata of layers, and how many arrays as large as the image it makes, on
the window's thread alone. How fast the machine is matters little: on a slow one what waits for a
pause may come once more. No display is needed.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace

# Before napari comes: what is compiled here and now, and a Qt without a display.
os.environ.setdefault("NAPARI_HMRF_COMPILE", "here")
os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import numpy as np
from counting import Counts, counted
from napari.components import ViewerModel
from napari.layers import Layer
from qtpy.QtWidgets import QApplication

from napari_hmrf.contributions import phantom_layers
from napari_hmrf.data import phantom
from napari_hmrf.ui.soft_tissue import SoftTissue

_STEPS = 20
_PLACES = 6
#: So long after an edit whatever waits for it to be over has begun.
_REST = 1.0
_BETWEEN = 0.05


class Painter:
    """Somebody who deforms the sample brain and paints on it."""

    def __init__(self, size: int) -> None:
        self._size, self._app = size, QApplication.instance() or QApplication([])
        self._viewer = ViewerModel()
        self._dock = SoftTissue(self._viewer)
        for made in phantom_layers(phantom("mass-effect", size)):
            self._viewer.add_layer(Layer.create(*made))
        self._dock.live = False
        self._dock.settings = replace(self._dock.settings, device="cpu")
        self._dock.model = "elastic"
        self._ended: list[object] = []
        self._dock.finished.connect(self._ended.append)
        self.press()

    def press(self) -> None:
        """Press Deform, and wait until all is over."""
        before = len(self._ended)
        self._dock.deform()
        self._live(lambda: len(self._ended) > before)
        self._live()

    def paint(self) -> None:
        """Paint a line, a step at a time, and wait until the result has followed."""
        tissue = self._viewer.layers["Tissue"]
        column = np.array([self._size // 2])
        for step in range(_STEPS):
            tissue.data_setitem((np.array([self._size // 3 + step]), column), 3)
            self._live(seconds=_BETWEEN)
        self._live()
        self._live(lambda: not self._dock.busy)

    def follow(self) -> None:
        """Have the result follow every edit."""
        self._dock.live = True
        self._live()
        self._live(lambda: not self._dock.busy)

    def _live(self, over: Callable[[], bool] | None = None, seconds: float = _REST) -> None:
        """Let Qt work until something is so, or for a while."""
        end = time.monotonic() + seconds
        while not over() if over is not None else time.monotonic() < end:
            self._app.processEvents()
            time.sleep(0.002)


def report(size: int) -> str:
    """Count; what is to be printed."""
    painter = Painter(size)
    lines = [f"{size} x {size}, on the window's thread"]
    for what, action, times in (
        ("a press of Deform", painter.press, 1),
        ("a step of the brush, followed", painter.paint, _STEPS),
    ):
        if action == painter.paint:
            painter.follow()
        counts = Counts()
        with counted(size * size, counts):
            action()
        data, metadata, arrays = (
            each.total() / times for each in (counts.data, counts.metadata, counts.arrays)
        )
        looks = f"looks at data {data:.1f}, at metadata {metadata:.1f}"
        made = f"{arrays:.1f} arrays as large as the image ({counts.megabytes / times:.1f} MB)"
        lines.append(f"    {what}: {looks}; {made}")
        most = counts.arrays.most_common(_PLACES)
        lines += [f"{'':8}{count / times:6.2f} in {place}" for place, count in most]
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Print what was counted for each size."""
    for size in [int(each) for each in arguments] or [300]:
        print(report(size), flush=True)
    os._exit(0)  # Qt and its widgets need no farewell


if __name__ == "__main__":
    main(sys.argv[1:])
