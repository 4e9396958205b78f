"""Routes of one press of Deform, and of one move of a drag, through the modules.

    python scripts/routes.py [--functions]

Each module is printed once, below the module that calls it first: its name, the first line of its
docstring, and the functions that are called in the module, in order. Modules that do not call any
other module are the vocabulary of a step (values, checks, units); their names are printed after
"with". Changes of thread are marked. With ``--functions``, the first call of each function is
printed.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import os
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import napari_hmrf

PACKAGE = Path(napari_hmrf.__file__).parent
#: Longest wait for a result, in seconds.
_LONG = 300.0
#: Width of the column of names, spaces for each level of calls, and the deepest indented level.
_WIDTH, _INDENT, _DEEPEST = 48, 2, 8
#: Largest number of functions that are listed for a module.
_FUNCTIONS = 8


class Stop(NamedTuple):
    """First call of a module, or of a function.

    Attributes
    ----------
    caller : str
        Module of the caller; "" for the first call on a thread.
    """

    module: str
    function: str
    thread: str
    caller: str


class Route:
    """Recorder of calls in the package, on the current thread and on threads that start later.

    Parameters
    ----------
    functions : bool
        True to record each function, False to record only the first function of each module.
    """

    def __init__(self, functions: bool) -> None:
        self.stops: dict[tuple[str, ...], Stop] = {}
        #: Functions that were called in each module, in the order of their first calls.
        self.called: dict[str, list[str]] = {}
        self._functions, self._on = functions, False
        threading.setprofile(self._on_event)

    def record(self, action: Callable[[], object]) -> Route:
        """Run an action, and record its stops in the order of their first calls."""
        self.stops, self.called, self._on = {}, {}, True
        sys.setprofile(self._on_event)
        try:
            action()
        finally:
            sys.setprofile(None)
            self._on = False
        return self

    def _on_event(self, frame: FrameType, event: str, _: Any) -> None:
        if not self._on or event != "call" or frame.f_code.co_name.startswith("<"):
            return
        module = module_of(frame)
        if not module:
            return
        name = frame.f_code.co_qualname.replace("<locals>.", "")
        known = self.called.setdefault(module, [])
        if name not in known:
            known.append(name)
        key = (module, frame.f_code.co_qualname) if self._functions else (module,)
        if key in self.stops:
            return
        above = frame.f_back
        while above is not None and module_of(above) in ("", module):
            above = above.f_back
        caller = "" if above is None else module_of(above)
        self.stops[key] = Stop(module, name, threading.current_thread().name, caller)


def module_of(frame: FrameType) -> str:
    """Return the module of a frame, as a path in the package; "" if it is outside the package."""
    file = frame.f_code.co_filename
    inside = file.startswith(f"{PACKAGE}{os.sep}")
    return file.removeprefix(f"{PACKAGE}{os.sep}").replace(os.sep, "/") if inside else ""


def duty_of(module: str) -> str:
    """Return the first line of a module's docstring."""
    name = "napari_hmrf." + module.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
    documented = inspect.getdoc(importlib.import_module(name)) or ""
    return documented.partition("\n")[0]


def print_route(title: str, route: Route, functions: bool) -> None:
    """Print the stops of a route, each with its functions and its vocabulary below it."""
    stops = list(route.stops.values())
    modules = {stop.module for stop in stops}
    callers = {stop.caller for stop in stops}
    main = [stop for stop in stops if functions or not stop.caller or stop.module in callers]
    print(f"\n{title}: {len(main)} stops, {len(modules)} modules\n")
    depths: dict[str, int] = {}
    thread, level = "", 0
    for stop in stops:
        level = depths[stop.caller] + 1 if stop.caller in depths else level
        depths.setdefault(stop.module, level)
    for stop in main:
        if stop.thread != thread:
            thread = stop.thread
            print(f"-- {thread}")
        indent = " " * _INDENT * min(depths[stop.module], _DEEPEST)
        name = f"{indent}{stop.module}"
        print(f"{name:<{_WIDTH}} {stop.function if functions else duty_of(stop.module)}")
        called = [] if functions else [each for each in route.called[stop.module] if is_step(each)]
        words = [each.module for each in stops if each.caller == stop.module and each not in main]
        rest = [f"and {len(called) - _FUNCTIONS} more"] if len(called) > _FUNCTIONS else []
        print_list(f"{indent}    calls ", [*called[:_FUNCTIONS], *rest])
        print_list(f"{indent}    with ", words)


def is_step(name: str) -> bool:
    """Return whether a function is listed as a step; special methods are not listed."""
    return not name.split(".")[-1].startswith("__")


def print_list(begin: str, names: list[str]) -> None:
    """Print names in lines of at most 120 characters; print nothing for an empty list."""
    if names:
        after = " " * len(begin)
        print(textwrap.fill(", ".join(names), 120, initial_indent=begin, subsequent_indent=after))


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

    print_route("One press of Deform", route.record(deform), options.functions)

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

    print_route("One move of a drag", route.record(move), options.functions)
    pointer.release()
    until(lambda: not dock.busy)
    dock.on_over(closed=True)


if __name__ == "__main__":
    main()
