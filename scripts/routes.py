"""Print the modules that one press of Deform, and one move of a drag, pass through, in order.

    python scripts/routes.py [--functions]

Each line has the module, the first function that is called there, and the first line of the
module's docstring. Thread changes are marked. With ``--functions``, every first call of a function.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import napari_hmrf

PACKAGE = Path(napari_hmrf.__file__).parent
#: Seconds to wait for a result.
_LONG = 300.0
_WIDTHS = 44, 34


class Stop(NamedTuple):
    """First call of a module, or of a function."""

    module: str
    function: str
    thread: str


class Route:
    """Recorder of the calls in the package, on all threads that start later.

    Parameters
    ----------
    functions : bool
        Whether to record every function, rather than the first one of each module.
    """

    def __init__(self, functions: bool) -> None:
        self.stops: dict[tuple[str, ...], Stop] = {}
        self._functions, self._on = functions, False
        threading.setprofile(self._on_event)

    def record(self, action: Callable[[], object]) -> list[Stop]:
        """Return the stops of an action, in the order of their first calls."""
        self.stops, self._on = {}, True
        sys.setprofile(self._on_event)
        try:
            action()
        finally:
            sys.setprofile(None)
            self._on = False
        return list(self.stops.values())

    def _on_event(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if not self._on or event != "call" or not code.co_filename.startswith(str(PACKAGE)):
            return
        if code.co_name.startswith("<"):
            return
        module = str(Path(code.co_filename).relative_to(PACKAGE))
        key = (module, code.co_qualname) if self._functions else (module,)
        if key not in self.stops:
            name = code.co_qualname.replace("<locals>.", "")
            self.stops[key] = Stop(module, name, threading.current_thread().name)


def duty_of(module: str) -> str:
    """Return the first line of a module's docstring."""
    name = "napari_hmrf." + module.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
    documented = inspect.getdoc(importlib.import_module(name)) or ""
    return documented.partition("\n")[0]


def print_route(title: str, stops: list[Stop]) -> None:
    """Print the stops of a route, one in a line."""
    modules = {stop.module for stop in stops}
    print(f"\n{title}: {len(modules)} modules\n")
    thread = ""
    for stop in stops:
        if stop.thread != thread:
            thread = stop.thread
            print(f"-- {thread}")
        first, second = _WIDTHS
        print(f"{stop.module:<{first}} {stop.function[:second]:<{second}} {duty_of(stop.module)}")


def main() -> None:
    """Deform a small image, then drag one of its pixels, and print both routes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--functions", action="store_true", help="list every function")
    options = parser.parse_args()
    route = Route(options.functions)

    from napari.viewer import ViewerModel
    from qtpy.QtWidgets import QApplication

    from napari_hmrf.samples.phantoms import phantom
    from napari_hmrf.tissue.drawing import Arrow, Drawing
    from napari_hmrf.ui.soft_tissue import SoftTissue

    app = QApplication.instance() or QApplication([])

    def until(done: Callable[[], bool]) -> None:
        ends = time.monotonic() + _LONG
        while not done():
            app.processEvents()
            if time.monotonic() > ends:
                raise TimeoutError("the tissue did not come to rest")

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

    print_route("One press of Deform", route.record(deform))

    dock.start()
    until(lambda: not dock.busy)
    pointer = dock._pointer
    pointer.press((32.0, 32.0), 1.0)
    pointer.move((32.0, 33.0))
    until(lambda: not dock._controller.engine.busy)
    seen: list[object] = []
    dock.seen.connect(seen.append)

    def move() -> None:
        pointer.move((32.0, 34.0))
        until(lambda: bool(seen))

    print_route("One move of a drag", route.record(move))
    pointer.release()
    until(lambda: not dock.busy)
    dock.on_over(closed=True)


if __name__ == "__main__":
    main()
