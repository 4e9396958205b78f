"""Modules that one press of Deform, and one move of a drag, pass through.

    python -m benchmarks.routes

Lists the modules of the packages `ui`, `layers` and `study` that call another module of this
package, in the order of their first calls, and counts them. The others, which are only called,
are values and tools: their number follows.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from napari.viewer import ViewerModel
from qtpy.QtWidgets import QApplication

import napari_hmrf
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.soft_tissue import SoftTissue

_FOLDER = f"{Path(napari_hmrf.__file__).parent}{os.sep}"
_COUNTED = ("ui", "layers", "study")
#: Longest wait for a result, in seconds.
_LONG = 300.0


class Route:
    """Recorder of the modules that call, and are called, on all threads.

    Attributes
    ----------
    callers : dict of str to str or None
        Caller of each module, at its first call; None if the first call on a thread was to it.
    """

    def __init__(self) -> None:
        self.callers: dict[str, str | None] = {}
        self._is_on = False
        threading.setprofile(self._on_event)

    def record(self, action: Callable[[], object]) -> None:
        """Run an action, and record the modules that take part."""
        self.callers, self._is_on = {}, True
        sys.setprofile(self._on_event)
        try:
            action()
        finally:
            sys.setprofile(None)
            self._is_on = False

    def _on_event(self, frame: FrameType, event: str, _: Any) -> None:
        if not self._is_on or event != "call" or frame.f_code.co_name.startswith("<"):
            return
        module = _module_of(frame)
        if module is None or module in self.callers:
            return
        above = frame.f_back
        while above is not None and _module_of(above) in (None, module):
            above = above.f_back
        self.callers[module] = None if above is None else _module_of(above)


def _module_of(frame: FrameType) -> str | None:
    """Return the module of a frame, as a path in the package; None if it is outside."""
    file = frame.f_code.co_filename
    return file.removeprefix(_FOLDER).replace(os.sep, "/") if file.startswith(_FOLDER) else None


def _print(title: str, route: Route) -> None:
    calling = {caller for caller in route.callers.values() if caller is not None}
    counted = [module for module in route.callers if module.split("/")[0] in _COUNTED]
    stops = [each for each in counted if each in calling or route.callers[each] is None]
    print(f"{title}: {len(stops)} modules, and {len(counted) - len(stops)} that are only called")
    for module in stops:
        print(f"    {module}")


def main() -> None:
    """Deform a small image, then drag one of its pixels, and print the modules of both."""
    route = Route()
    app = QApplication.instance() or QApplication([])

    def until(is_done: Callable[[], bool]) -> None:
        ends = time.monotonic() + _LONG
        while not is_done():
            app.processEvents()
            if time.monotonic() > ends:
                raise TimeoutError(f"the solve did not finish within {_LONG:g} s")

    viewer = ViewerModel()
    viewer.add_image(phantom("mass-effect", 64).image, name="head")
    dock = SoftTissue(viewer)
    until(lambda: not dock.busy)
    dock.drawing = Drawing((Arrow((32, 32), (0, 2), 3.0),))
    until(lambda: not dock.busy)
    ended: list[object] = []
    dock.finished.connect(ended.append)

    def deform() -> None:
        dock.deform()
        until(lambda: bool(ended) and not dock.busy)

    route.record(deform)
    _print("Deform", route)

    dock.start()
    until(lambda: not dock.busy)
    pointer = dock._pointer
    pointer.press((32.0, 32.0), 1.0)
    pointer.move((32.0, 33.0))
    until(lambda: not dock._controller.engine.busy)
    seen: list[object] = []
    dock.deformation_changed.connect(seen.append)

    def move() -> None:
        pointer.move((32.0, 34.0))
        until(lambda: bool(seen))

    route.record(move)
    _print("One move of a drag", route)
    pointer.release()
    until(lambda: not dock.busy)
    dock.on_over(closed=True)


if __name__ == "__main__":
    main()
