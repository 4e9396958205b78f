"""The first picture in napari's window: what ``python benchmarks/first.py --window`` measures.

Everything is done as a person does it: by commands of the palette, found by their titles, and by
the mouse. A picture counts once Qt has put the canvas, painted anew, on the screen.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import napari
import numpy as np
from napari.layers import Image
from npe2 import PluginManager
from qtpy.QtCore import QEvent, QEventLoop, QPointF, Qt, QTimer
from qtpy.QtGui import QMouseEvent
from qtpy.QtWidgets import QApplication

#: What is done, by name: the end of the command's title.
WAYS = {"button": "deform now", "mouse": "start or stop pulling tissue with the mouse"}
_PLUGIN, _SAMPLE = "napari-hmrf", "mass-effect"
_LEFT, _NONE = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
# Seconds from the command to the press of the mouse, and between its movements; and when there is
# no picture any more to come.
_REACH, _PAUSE, _MOST = 1.0, 1 / 60, 300.0


def measure(way: str) -> dict[str, float]:
    """Open a window with sample tissue, and wait for it to move.

    Parameters
    ----------
    way : str
        One of `WAYS`.

    Returns
    -------
    dict of str to float
        Seconds: ``"command"`` until the command is done with, ``"first"`` from the button, or from
        the press of the mouse, to the first picture of tissue that has moved, and ``"blocked"``
        the longest time meanwhile in which the window answered nothing.
    """
    viewer = napari.Viewer(show=False)
    viewer.open_sample(_PLUGIN, _SAMPLE)
    viewer.show()
    _wait(2.0)
    watch, begun = _Watch(viewer), time.perf_counter()
    watch.begin()
    _command(WAYS[way])()
    took = time.perf_counter() - begun
    if way == "mouse":
        _wait(_REACH)
        begun = time.perf_counter()
        watch.begin()
        _Hand(viewer).drag(watch)
    while not watch.seen and time.perf_counter() < begun + _MOST:
        _wait(_PAUSE)
        watch.turn()
    if not watch.seen:
        raise SystemExit(f"there was no picture after {_MOST:.0f} s")
    found = {"command": took, "first": watch.seen - begun, "blocked": watch.blocked}
    viewer.close()
    return found


def _command(title: str) -> Callable[[], object]:
    """The command of ours whose title ends so."""
    manifest = PluginManager.instance().get_manifest(_PLUGIN)
    (found,) = (each for each in manifest.contributions.commands if each.title.endswith(title))
    return found.exec


def _wait(seconds: float) -> None:
    """Let the window do what it does."""
    loop = QEventLoop()
    QTimer.singleShot(round(1000 * seconds), loop.quit)
    loop.exec()


class _Watch:
    """Looks for a picture in which tissue has moved, and for how long the window stands still."""

    def __init__(self, viewer: Any) -> None:
        self.seen = self.blocked = 0.0
        images = [layer for layer in viewer.layers if isinstance(layer, Image)]
        self._known = [np.asarray(layer.data).copy() for layer in images]
        self._moved, self._last = False, 0.0
        viewer.layers.events.inserted.connect(lambda event: self._follow(event.value))
        for layer in images:
            self._follow(layer)
        viewer.window._qt_viewer.canvas.native.frameSwapped.connect(self._on_swapped)

    def begin(self) -> None:
        """Look from now on."""
        self.blocked, self._last = 0.0, time.perf_counter()

    def turn(self) -> None:
        """The window answers."""
        now = time.perf_counter()
        self.blocked, self._last = max(self.blocked, now - self._last), now

    def _follow(self, layer: Any) -> None:
        if isinstance(layer, Image):
            layer.events.set_data.connect(lambda: self._look(layer))
            self._look(layer)

    def _look(self, layer: Any) -> None:
        values = np.asarray(layer.data)
        alike = (each for each in self._known if each.shape == values.shape)
        self._moved |= layer.visible and not any(np.array_equal(values, each) for each in alike)

    def _on_swapped(self) -> None:
        if self._moved and not self.seen:
            self.seen = time.perf_counter()


class _Hand:
    """A mouse that drags the middle of the tissue."""

    def __init__(self, viewer: Any) -> None:
        self._canvas = viewer.window._qt_viewer.canvas
        self._viewer = viewer
        viewer.mouse_over_canvas = True

    def drag(self, watch: _Watch) -> None:
        """Press, and lead in a circle until there is a picture."""
        begun = time.perf_counter()
        self._send(QEvent.Type.MouseButtonPress, 0.0)
        while not watch.seen and time.perf_counter() < begun + _MOST:
            _wait(_PAUSE)
            watch.turn()
            self._send(QEvent.Type.MouseMove, time.perf_counter() - begun)
        self._send(QEvent.Type.MouseButtonRelease, time.perf_counter() - begun)

    def _send(self, kind: QEvent.Type, seconds: float) -> None:
        size = min(self._viewer.layers[0].data.shape[-2:])
        reach = 0.03 * size
        row, col = (
            0.5 * size + reach * math.sin(seconds),
            0.3 * size + reach * (1 - math.cos(seconds)),
        )
        view, native = self._canvas.view, self._canvas.native
        x, y = (view.transform * view.scene.transform).map([col, row])[:2]
        place = QPointF(round(x), round(y))
        pressed = _NONE if kind == QEvent.Type.MouseButtonRelease else _LEFT
        changed = _NONE if kind == QEvent.Type.MouseMove else _LEFT
        event = QMouseEvent(
            kind, place, QPointF(native.mapToGlobal(place.toPoint())), changed, pressed,
            Qt.KeyboardModifier.NoModifier,
        )  # fmt: skip
        QApplication.sendEvent(native, event)


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1])))
