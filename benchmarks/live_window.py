"""Drag in a real napari window, for `live.py --napari`; the same drag as in `live.py`.

A separate thread posts mouse events to the canvas at the rate of an ordinary mouse. An event that
the window has not yet processed is replaced by the next event, as Qt does with real events. Each
displayed result is identified by its drawing, and is counted once Qt has shown the repainted canvas
on the screen. Another thread posts a request to the window every few milliseconds; the window is
blocked while it does not answer.
"""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, get_args

import napari
import numpy as np
from qtpy.QtCore import QEvent, QEventLoop, QObject, QPoint, QPointF, Qt, QTimer
from qtpy.QtGui import QMouseEvent
from qtpy.QtWidgets import QApplication

from napari_hmrf.data import phantom
from napari_hmrf.field.live_warp import Warper
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Rendering
from napari_hmrf.tissue.drawing.marks import Action
from napari_hmrf.ui.motion.arrows import ArrowsLayer

_WINDOW = (1500, 950)
_MOUSE = 100.0  # events per second
_ASKING = 0.003  # interval between requests to the window, in seconds
_SHORT = 0.005  # longest delay that does not count as blocked, in seconds
_LEFT = Qt.MouseButton.LeftButton
_TURN = 2.0


class Window:
    """Window with an image of tissue, in which drags are simulated.

    Attributes
    ----------
    late : list of float
        Seconds from each movement to its picture on the screen, in the last drag.
    costs : dict of str to list of float
        Seconds of each stage, in the last drag.
    moves : int
        Number of movements that the window processed, in the last drag.
    """

    def __init__(self, size: int, kind: str) -> None:
        self._size, self._kind = size, kind
        self.costs: dict[str, list[float]] = defaultdict(list)
        self.late: list[float] = []
        self.viewer = napari.Viewer(show=False)
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
        _, self._widget = self.viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
        self.viewer.show()
        self._widget.image, self._widget.tissue = shown, tissue
        self._canvas: Any = self.viewer.window._qt_viewer.canvas
        self._native = self._canvas.native
        self.viewer.mouse_over_canvas = True
        # Docks request space when they are added. The canvas should have the same size each time.
        self.wait(1.0)
        self.viewer.window.resize(*_WINDOW)
        self.wait(1.0)
        self.viewer.reset_view()
        self.wait(0.5)
        self._moved: dict[int, tuple[object, float]] = {}
        self._event_time = 0.0
        self._seen: object = None
        self._composing = 0.0
        self.moves = 0
        self._widget.deformation_changed.connect(self._on_seen)
        self._native.frameSwapped.connect(self._on_swapped)
        self._native.aboutToCompose.connect(self._on_compose)

    @property
    def canvas_size(self) -> tuple[int, int]:
        """Width and height of the canvas, in pixels."""
        return self._native.width(), self._native.height()

    def drag(
        self, seconds: float, meanwhile: AbstractContextManager[Any] | None = None
    ) -> tuple[float, int, list[float], list[float]]:
        """Drag for a number of seconds.

        Parameters
        ----------
        seconds : float
            Duration of the drag.
        meanwhile : context manager, optional
            Context that is active while the mouse moves, but not when it is pressed or released.

        Returns
        -------
        seconds : float
            Actual duration.
        events : int
            Number of mouse movements.
        waits : list of float
            Response times of the window to requests, in seconds.
        blocks : list of float
            Durations in which the window was blocked, in seconds.
        """
        self.start()
        drawn = self._widget.study_model.changed
        drawn.connect(self._on_drawing)
        mouse = _Poster(self._on_mouse, 1 / _MOUSE, compress=True)
        questions = _Poster(lambda asked: None, _ASKING)
        with self._timed():
            self._press()
            self.wait(0.5)
            self._clear()
            begun = self._begun = time.perf_counter()
            with meanwhile or nullcontext():
                mouse.start()
                questions.start()
                self.wait(seconds)
                mouse.stop()
                questions.stop()
            took = time.perf_counter() - begun
            self._send(QEvent.Type.MouseButtonRelease, self._place(took), _LEFT)
            self.settle()
        drawn.disconnect(self._on_drawing)
        return took, mouse.posted, questions.waits, questions.blocks

    def start(self) -> None:
        """Start pulling, as the button does, and wait until loops are compiled."""
        self._widget.start()
        if self._kind in get_args(Action):
            self._widget.tool = self._kind
            self._widget.fields.by_col.value = 0.02 * self._size
        self.settle()

    def first(self) -> float:
        """Return the time from the first press to the first deformed picture, in seconds."""
        self._press()
        begun, seen = time.perf_counter(), []
        self._widget.deformation_changed.connect(seen.append)
        self._send(QEvent.Type.MouseMove, self._place(0.1), _LEFT)
        while not seen:
            QApplication.processEvents()
        took = time.perf_counter() - begun
        self._widget.deformation_changed.disconnect(seen.append)
        self._send(QEvent.Type.MouseButtonRelease, self._place(0.1), _LEFT)
        self.settle()
        self._widget.undo()
        self.settle()
        return took

    def undo(self) -> None:
        """Undo the last drag, so that the next drag starts from the original tissue."""
        self._widget.undo()
        self.settle()

    def settle(self) -> None:
        """Wait until there are no pending results."""
        self.wait(0.3)
        while self._widget.busy:
            self.wait(0.1)

    def wait(self, seconds: float) -> None:
        """Run the event loop of the window for a number of seconds."""
        loop = QEventLoop()
        QTimer.singleShot(round(1000 * seconds), loop.quit)
        loop.exec()

    def close(self) -> None:
        """Close the window."""
        self.viewer.close()

    def _press(self) -> None:
        self._send(QEvent.Type.MouseButtonPress, self._place(0.0), _LEFT)

    def _clear(self) -> None:
        for kept in (*self.costs.values(), self.late):
            kept.clear()
        self._seen, self.moves = None, 0

    def _place(self, seconds: float) -> tuple[float, float]:
        """Return the position of the hand, which moves in a circle as in `live.py`."""
        angle, reach = 2 * math.pi * seconds / _TURN, 0.03 * self._size
        at = (0.5 * self._size, 0.3 * self._size)
        return at[0] + reach * math.sin(angle), at[1] + reach * (1 - math.cos(angle))

    def _send(self, kind: QEvent.Type, place: tuple[float, float], button: Any) -> None:
        view = self._canvas.view
        x, y = (view.transform * view.scene.transform).map(place[::-1])[:2]
        there = QPoint(round(x), round(y))
        pressed = Qt.MouseButton.NoButton if kind == QEvent.Type.MouseButtonRelease else button
        changed = Qt.MouseButton.NoButton if kind == QEvent.Type.MouseMove else button
        event = QMouseEvent(
            kind, QPointF(there), QPointF(self._native.mapToGlobal(there)), changed, pressed,
            Qt.KeyboardModifier.NoModifier,
        )  # fmt: skip
        QApplication.sendEvent(self._native, event)

    def _on_mouse(self, moved: float) -> None:
        self._event_time = moved
        self.moves += 1
        self._send(QEvent.Type.MouseMove, self._place(moved - self._begun), _LEFT)

    def _on_drawing(self, _: object, drawing: object) -> None:
        self._moved[id(drawing)] = (drawing, self._event_time)

    def _on_seen(self, seen: Any) -> None:
        self._seen = seen.study.motion.drawing

    def _on_compose(self) -> None:
        self._composing = time.perf_counter()

    def _on_swapped(self) -> None:
        now = time.perf_counter()
        if self._composing:
            self.costs["window put together"].append(now - self._composing)
        known = self._moved.pop(id(self._seen), None)
        self._seen = None
        if known is not None:
            self.late.append(now - known[1])

    @contextmanager
    def _timed(self) -> Iterator[None]:
        """Measure the time of each stage."""
        wrapped = [
            (Rendering, "show", "drawing"),
            (Ground, "statement", "problem"),
            (Warper, "__call__", "warp"),
            (ResultLayers, "show", "image layer"),
            (ArrowsLayer, "show", "arrows layer"),
            (type(self._native), "paintGL", "canvas drawn"),
        ]
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in wrapped]
        for owner, name, stage in wrapped:
            setattr(owner, name, self._clocked(getattr(owner, name), stage))
        solved = self._widget.deformation_changed.connect(self._on_solved)
        try:
            yield
        finally:
            self._widget.deformation_changed.disconnect(solved)
            for owner, name, method in before:
                setattr(owner, name, method)

    def _clocked(self, method: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def clocked(*arguments: Any, **named: Any) -> Any:
            begun = time.perf_counter()
            try:
                return method(*arguments, **named)
            finally:
                self.costs[stage].append(time.perf_counter() - begun)

        return clocked

    def _on_solved(self, seen: Any) -> None:
        if seen.solution is not None:
            self.costs["solve"].append(seen.solution.provenance.seconds)


class _Poster(QObject):
    """Object that posts events to the GUI thread at a constant rate, from a separate thread.

    Parameters
    ----------
    answer : callable
        Function called on the GUI thread with the time of the post.
    pause : float
        Interval between posts, in seconds.
    compress : bool
        True if a pending post is replaced by the next post; False if all posts are answered.
    """

    _KIND = QEvent.Type(QEvent.registerEventType())

    def __init__(
        self, answer: Callable[[float], None], pause: float, compress: bool = False
    ) -> None:
        super().__init__()
        self._answer, self._pause, self._compress = answer, pause, compress
        self._lock = threading.Lock()
        self._waiting: list[float] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.posted = 0
        self.waits: list[float] = []
        self.blocks: list[float] = []

    def start(self) -> None:
        """Start posting."""
        self._thread.start()

    def stop(self) -> None:
        """Stop posting."""
        self._over.set()
        self._thread.join()

    def customEvent(self, event: QEvent) -> None:
        """Answer the pending posts."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        now = time.perf_counter()
        self.waits += [now - posted for posted in waiting]
        if now - waiting[0] > _SHORT:
            self.blocks.append(now - waiting[0])
        self._answer(waiting[-1])

    def _run(self) -> None:
        begun = time.perf_counter()
        while not self._over.wait(
            max(0.0, (self.posted + 1) * self._pause - (time.perf_counter() - begun))
        ):
            self.posted += 1
            with self._lock:
                told = bool(self._waiting)
                now = time.perf_counter()
                self._waiting = [now] if self._compress else [*self._waiting, now]
            if not told:
                QApplication.postEvent(self, QEvent(self._KIND))


def measure(
    size: int, kind: str, seconds: float, spread: Callable[[list[float]], str], asked: str = ""
) -> str:
    """Drag in a window for a number of seconds and return the report."""
    window = Window(size, kind)
    window.start()
    first = window.first()
    took, events, waits, blocks = window.drag(seconds)
    rate = len(window.late) / took
    width, height = window.canvas_size
    title = f"{size} x {size} in napari, {kind}: {rate:.1f} updates/s{asked} of "
    lines = [
        f"{title}{events / took:.0f} movements/s, on a canvas of {width} x {height}",
        f"    from movement to the screen: {spread(window.late)}",
        f"    window blocked {len(blocks)} times: {spread(blocks or [0.0])}",
        f"    delay of a click:     {spread(waits)}",
        *(
            f"    {stage:20}{spread(costs)}, {len(costs) / took:5.1f} / s"
            for stage, costs in window.costs.items()
            if costs
        ),
        f"    first picture: {1e3 * first:.0f} ms",
    ]
    window.close()
    return "\n".join(lines)
