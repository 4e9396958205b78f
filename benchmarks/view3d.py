"""Time of one picture while tissue is dragged in the 3-D view, in a head at 1 mm.

    python benchmarks/view3d.py [--moves 20] [--shape 181 217 181]
    python benchmarks/view3d.py --napari [--canvas 700 800]

A patch on the surface of a synthetic head is dragged in small steps. The first command prints the
times without a window: of the whole update from the movement to the picture, of its solve on the
coarse grid, and of its warp, for a surface and for an oblique cut plane. The goal for
solve and warp together is 100 ms.

With --napari, the same drag runs in a window, and the time from the movement to the canvas on the
screen is printed as well, for each rendering. Without a GPU, Mesa draws the canvas on the
processor, which takes longer than everything else.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf import Arrow, Drawing, Grid, Motion, Study, Tissue
from napari_hmrf.field.moved_pictures import MovedPictures
from napari_hmrf.field.volume_preview import CutPlane
from napari_hmrf.study.drag_preview import as_dragged, drag_preview
from napari_hmrf.study.engine import Deformation, Engine
from napari_hmrf.study.study import Pictures

#: Size of a head at 1 mm, in voxels.
SHAPE = (181, 217, 181)
#: Goal for solve and warp of one picture, in milliseconds.
GOAL = 100.0
#: Longest wait for a picture, in seconds.
_LATEST = 300.0
#: Radius of the dragged patch, and length of each step, in millimetres.
_RADIUS, _STEP = 10.0, 0.5

Costs = dict[str, list[float]]


def head(shape: Sequence[int]) -> npt.NDArray[np.uint8]:
    """Return a synthetic head: textured brain in bright skin, in black air."""
    z, y, x = np.ogrid[tuple(slice(-1, 1, size * 1j) for size in shape)]
    radius = np.sqrt((z / 0.85) ** 2 + (y / 0.9) ** 2 + (x / 0.8) ** 2)
    brain = 120 + 40 * np.sin(9 * z) * np.sin(11 * y) * np.sin(10 * x)
    values = np.where(radius < 0.9, brain, np.where(radius < 1, 230, 0))
    image: npt.NDArray[np.uint8] = values.astype(np.uint8)
    return image


def without_window(shape: Sequence[int], moves: int) -> None:
    """Print the times of the engine for a surface and for a cut plane."""
    image = head(shape)
    middle = tuple(size / 2 for size in shape)
    at = (middle[0], middle[1], 0.12 * shape[2])
    grid, tissue = Grid(tuple(shape), (1.0, 1.0, 1.0)), Tissue(stiffness=np.float32(image > 0))
    pictures = Pictures(image=image)
    cut = CutPlane(middle, (1.0, 0.3, 0.2))
    for name, plane in (("surface", None), ("oblique cut plane", cut)):
        costs: Costs = defaultdict(list)
        ready, answers = threading.Event(), list[Deformation]()

        def deliver(
            moved: Deformation, ready: threading.Event = ready, answers: Any = answers
        ) -> None:
            answers.append(moved)
            ready.set()

        warp = MovedPictures.volume
        MovedPictures.volume = _clocked(warp, costs["warp"])  # type: ignore[method-assign]
        engine = Engine(deliver, "a benchmark")
        try:
            for move in range(moves + 2):
                by = (0.0, _STEP * move, 2 * _STEP * move)
                drawing = Drawing((Arrow(at, by, _RADIUS),))
                study = Study(
                    grid, tissue, Motion(hold_edge=True, drawing=drawing), pictures=pictures
                )
                begun = time.perf_counter()
                engine.submit(as_dragged(study), preview=drag_preview(study, cut=plane))
                if not ready.wait(_LATEST):
                    raise SystemExit("There was no picture in time.")
                ready.clear()
                costs["movement to picture"].append(time.perf_counter() - begun)
                solution = answers[-1].solution
                if solution is None:
                    raise SystemExit(f"The study was refused: {answers[-1].error}")
                costs["solve"].append(solution.provenance.seconds)
        finally:
            engine.close()
            MovedPictures.volume = warp  # type: ignore[method-assign]
        costs["solve + warp"] = [a + b for a, b in zip(costs["solve"], costs["warp"], strict=True)]
        sites = " x ".join(map(str, solution.displacement.shape[:3]))
        first = 1e3 * costs["movement to picture"][0]
        print(f"{' x '.join(map(str, shape))} voxels, {sites} sites, {name}:")
        print(f"    first picture: {first:.0f} ms")
        for stage in ("movement to picture", "solve", "warp", "solve + warp"):
            goal = f" (goal: {GOAL:.0f})" if stage == "solve + warp" else ""
            print(f"    {stage:20}{_spread(costs[stage][2:])}{goal}", flush=True)


def in_window(shape: Sequence[int], moves: int, canvas: tuple[int, int]) -> None:
    """Print the times in a napari window, including the times to draw the canvas."""
    import napari
    from qtpy.QtCore import QEvent, QPointF, Qt
    from qtpy.QtGui import QMouseEvent
    from qtpy.QtWidgets import QApplication

    viewer = napari.Viewer(show=True)
    layer = viewer.add_image(head(shape), name="head")
    _, dock = viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    dock.extent = "volume"
    viewer.dims.ndisplay = 3
    viewer.window.resize(canvas[0] + 700, canvas[1] + 50)
    display: Any = viewer.window._qt_viewer.canvas
    native = display.native

    def wait_until(condition: Callable[[], bool], seconds: float = _LATEST) -> None:
        end = time.perf_counter() + seconds
        while not condition() and time.perf_counter() < end:
            QApplication.processEvents()
            time.sleep(0.002)

    wait_until(lambda: False, 2.0)
    dock.start()
    wait_until(lambda: not dock.busy and not dock._controller.engine.at_work)
    viewer.reset_view()
    centre = np.array(shape) / 2

    def send(kind: QEvent.Type, away: float) -> None:
        view, (_, row, col) = display.view, centre + np.array([0, away, 0])
        x, y, _, w = (view.transform * view.scene.transform).map((col, row, centre[0]))
        place = QPointF(round(x / w), round(y / w))
        left, none = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
        pressed = none if kind == QEvent.Type.MouseButtonRelease else left
        changed = none if kind == QEvent.Type.MouseMove else left
        there = QPointF(native.mapToGlobal(place.toPoint()))
        modifiers = Qt.KeyboardModifier.NoModifier
        native._last_time = 0.0  # vispy drops moves in quick succession
        event = QMouseEvent(kind, place, there, changed, pressed, modifiers)
        QApplication.sendEvent(native, event)

    for name, look in (
        ("iso", {"rendering": "iso", "iso_threshold": 60}),
        ("mip", {"rendering": "mip"}),
        ("plane", {"depiction": "plane"}),
    ):
        for setting, value in look.items():
            setattr(layer, setting, value)
        layer.plane.position, layer.plane.normal = tuple(centre), (1, 0.3, 0.2)
        costs: Costs = defaultdict(list)
        seen, swapped = list[Any](), list[float]()
        on_swapped = partial(_note_time, swapped)
        native.frameSwapped.connect(on_swapped)
        connection = dock.deformation_changed.connect(seen.append)
        send(QEvent.Type.MouseButtonPress, 0.0)
        for move in range(moves + 2):
            before, begun = len(seen), time.perf_counter()
            send(QEvent.Type.MouseMove, 1.0 + move)
            wait_until(partial(_is_longer, seen, before))
            costs["movement to answer"].append(time.perf_counter() - begun)
            wait_until(partial(_is_longer, swapped, len(swapped)))
            costs["movement to screen"].append(time.perf_counter() - begun)
            if seen[-1].solution is not None:
                costs["solve"].append(seen[-1].solution.provenance.seconds)
        send(QEvent.Type.MouseButtonRelease, 1.0 + moves)
        dock.deformation_changed.disconnect(connection)
        wait_until(lambda: not dock.busy)
        native.frameSwapped.disconnect(on_swapped)
        dock.undo()
        wait_until(lambda: not dock.busy)
        print(f"{name}, canvas of {native.width()} x {native.height()}:")
        for stage, each in costs.items():
            print(f"    {stage:20}{_spread(each[2:] or each)}", flush=True)
    viewer.close()


def _note_time(times: list[float]) -> None:
    times.append(time.perf_counter())


def _is_longer(values: Sequence[Any], count: int) -> bool:
    return len(values) > count


def _clocked(method: Callable[..., Any], costs: list[float]) -> Callable[..., Any]:
    def clocked(*arguments: Any, **named: Any) -> Any:
        begun = time.perf_counter()
        try:
            return method(*arguments, **named)
        finally:
            costs.append(time.perf_counter() - begun)

    return clocked


def _spread(seconds: Sequence[float]) -> str:
    low, middle, high = 1e3 * np.percentile(seconds, (0, 50, 95))
    return f"median {middle:6.1f} ms, least {low:6.1f}, 95 % below {high:6.1f}"


def main(arguments: Sequence[str]) -> int:
    """Print the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--shape", type=int, nargs=3, default=SHAPE)
    parser.add_argument("--canvas", type=int, nargs=2, default=(700, 800))
    parser.add_argument("--napari", action="store_true", help="drag in a napari window")
    options = parser.parse_args(arguments)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    print(f"load {load:.1f} on {os.cpu_count()} cores")
    if options.napari:
        in_window(options.shape, options.moves, tuple(options.canvas))
    else:
        without_window(options.shape, options.moves)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
