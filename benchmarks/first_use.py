"""First minute on a new computer: from the first click to the first drag, in a real napari window.

    python -m benchmarks.first_use [--against FOLDER_OF_ANOTHER_CHECKOUT] [--own] [--kept] [--whole]

A new process with an empty home folder and an empty cache of compiled code opens napari, chooses
*Brain to pull* from the menu, waits, drags tissue twice, and shows overlays. With `--own`, an image
is open already, and the dock is chosen from the menu. Another thread posts
an event to the window every few milliseconds; a freeze is the time that an event waits for its
answer. During a freeze that thread samples the stack of the GUI thread, so that the table names
the code that takes the time.

With `--kept`, napari is started once more with the folders of the first start. With `--whole`, the
window is then watched until everything is compiled. Processor time is that of the GUI thread:
compare it, or the ratio to another checkout, if the machine is busy. Without a display, run the
command with `sh scripts/headless.sh`.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from qtpy.QtCore import QEvent, QPointF, QTimer

from benchmarks.clock import conditions, now, since
from benchmarks.real_window import Poster, Window
from benchmarks.table import head, line

_ROOT = Path(__file__).resolve().parent.parent
# Menus of the first click.
_SAMPLE = "File", "Open Sample", "napari-hmrf", "Brain to pull"
_OWN = "Plugins", "Soft tissue (napari-hmrf)"
#: Overlays that are shown one after the other, by their names in the table.
_OVERLAYS = {
    "strain": "equivalent",
    "area change": "jacobian",
    "grid": "grid",
    "uncertainty": "uncertainty",
}
# Interval between posted events, and wait after which a freeze is sampled, in seconds.
_ASKING, _FREEZE = 0.005, 0.05
# Number of freezes of a step whose code is listed.
_LISTED = 3
# Longest wait for a picture, and for the end of the compilation, in seconds.
_LATEST, _LONGEST = 180.0, 1800.0
# Events of the mouse per second, and pixels of the image per event.
_MOUSE, _STEP = 60.0, 0.4
_PACKAGE = f"{os.sep}napari_hmrf{os.sep}"
# Prefix of the line with the result, because libraries also print.
_ANSWER = "answer: "
_PROGRAM = """
import sys
import benchmarks
benchmarks.__path__ = [f"{sys.argv[1]}/benchmarks"]
from benchmarks import first_use
first_use.work(sys.argv)
"""


class Freeze(NamedTuple):
    """Wait of an event.

    Attributes
    ----------
    begun, wall, thread : float
        Time of the post, duration of the wait, and processor time of the GUI thread since the
        answer to the event before, in seconds.
    places : Counter of str
        Code that the GUI thread was running, with the number of samples.
    """

    begun: float
    wall: float
    thread: float
    places: Counter[str]


class Watchdog(Poster):
    """Object that records how long the window takes to answer, and where the GUI thread is."""

    def __init__(self) -> None:
        super().__init__(lambda asked: None, _ASKING)
        self.freezes: list[Freeze] = []
        self._gui, self._used = threading.get_ident(), time.thread_time()
        self._places: Counter[str] = Counter()
        self._sampler = threading.Thread(target=self._sample, daemon=True)

    def start(self) -> None:
        """Start watching."""
        super().start()
        self._sampler.start()

    def customEvent(self, event: QEvent) -> None:
        """Record the wait of the oldest event."""
        with self._lock:
            pending, self._pending = self._pending, []
            places, self._places = self._places, Counter()
        used, self._used = self._used, time.thread_time()
        if pending:
            wait = now().wall - pending[0]
            self.freezes.append(Freeze(pending[0], wait, self._used - used, places))

    def _sample(self) -> None:
        while not self._over.wait(_ASKING):
            with self._lock:
                if self._pending and now().wall - self._pending[0] > _FREEZE:
                    self._places[_place(sys._current_frames()[self._gui])] += 1


def _place(frame: FrameType) -> str:
    """Return the innermost frame, and the innermost frames of this package, as text."""
    inner, ours = _name(frame), []
    above: FrameType | None = frame
    while above is not None and len(ours) < 3:
        if _PACKAGE in above.f_code.co_filename:
            ours.append(_name(above))
        above = above.f_back
    return " < ".join(dict.fromkeys([inner, *ours]))


def _name(frame: FrameType) -> str:
    path = frame.f_code.co_filename
    path = path.partition("site-packages" + os.sep)[2] or path
    path = path.partition(_PACKAGE)[2] or path
    return f"{path}:{frame.f_lineno} {frame.f_code.co_name}"


class FirstUse(Window):
    """Window of a new user, who opens a sample and drags its tissue."""

    def __init__(self) -> None:
        super().__init__()
        self._dock: Any = None
        self._watchdog = Watchdog()
        self._results = 0
        #: Times in seconds, and freezes, of each step.
        self.steps: dict[str, dict[str, Any]] = {}
        self.viewer.window.resize(1280, 800)
        self.viewer.show()
        self.wait(2.0)
        self._watchdog.start()
        self.wait(0.5)

    def open_image(self) -> None:
        """Open an image without tissue."""
        row, col = np.indices((300, 300))
        head = np.hypot(row - 150, col - 150) < 130
        self.viewer.add_image(head * (100.0 + 50 * np.sin(row / 9) * np.sin(col / 7)), name="own")
        self.wait(1.0)

    def click(self, titles: Sequence[str]) -> None:
        """Choose an entry of the menus, and wait until tissue can be dragged."""
        action: Any = self.viewer.window._qt_window.menuBar()
        for title in titles:
            menu = action if hasattr(action, "actions") else action.menu()
            menu.aboutToShow.emit() if hasattr(menu, "aboutToShow") else None
            action = next(each for each in menu.actions() if each.text().replace("&", "") == title)
        self.wait(0.5)
        QTimer.singleShot(0, action.trigger)
        self._step("click to image", lambda: bool(self.viewer.layers), frame=True)
        self._step("image to tools", self._has_tools, frame=True)
        self._dock.deformation_changed.connect(self._on_result)
        self._step("rest", self._after(8.0))

    def drag(self, name: str) -> None:
        """Press, move until there is a picture and for a second more, and release."""
        self.settle()
        results, begun = self._results, now().wall

        def place() -> QPointF:
            return self.place_of(150.0 - 0.3 * _STEP * self._moves, 90.0 - _STEP * self._moves)

        def move() -> None:
            self._moves = min(self._moves + 1, 60)
            self.send(QEvent.Type.MouseMove, place())

        self._moves = 0
        self.viewer.mouse_over_canvas = True
        QTimer.singleShot(0, lambda: self.send(QEvent.Type.MouseButtonPress, place()))
        mouse = QTimer()
        mouse.timeout.connect(move)
        mouse.start(round(1000 / _MOUSE))
        self._step(f"{name} to picture", lambda: self._results > results, frame=True)
        self._step(f"{name} goes on", self._after(1.5))
        mouse.stop()
        self.send(QEvent.Type.MouseButtonRelease, place())
        self._step(f"{name} to result", lambda: not self._dock.busy, frame=True)
        self.steps[f"{name} to result"]["since press"] = now().wall - begun

    def show_overlay(self, name: str) -> None:
        """Show an overlay, and hide it again."""
        overlay = _OVERLAYS[name]
        self.settle()
        QTimer.singleShot(0, lambda: setattr(self._dock, "overlay", overlay))
        self._step(name, lambda: self._dock.overlay == overlay and not self._dock.busy, frame=True)
        self._dock.overlay = "nothing"
        self.settle()

    def watch_to_the_end(self) -> None:
        """Watch until no compiled code is missing."""
        from napari_hmrf.compute.compile_cache import compiler

        self._step("until all is compiled", lambda: not compiler.is_compiling(), latest=_LONGEST)

    def end(self) -> dict[str, dict[str, Any]]:
        """Stop watching, and return the steps with their freezes."""
        self._watchdog.stop()
        for found in self.steps.values():
            within = [
                each
                for each in self._watchdog.freezes
                if found["begun"] <= each.begun + each.wall and each.begun < found["ended"]
            ]
            found["freeze"] = max(each.wall for each in within)
            found["freeze, processor"] = max(each.thread for each in within)
            found["all freezes"] = sum(each.wall for each in within if each.wall > _FREEZE)
            found["longest"] = [
                (each.begun - found["begun"], each.wall, each.thread, _shares(each.places))
                for each in sorted(within, key=lambda each: -each.wall)[:_LISTED]
                if each.wall > 2 * _FREEZE
            ]
        return self.steps

    def _has_tools(self) -> bool:
        docks = self.viewer.window.dock_widgets
        self._dock = next((each for name, each in docks.items() if "Soft tissue" in name), None)
        return self._dock is not None and self._dock.active

    def _after(self, seconds: float) -> Callable[[], bool]:
        end = now().wall + seconds
        return lambda: now().wall > end

    def _on_result(self, _: object) -> None:
        self._results += 1

    def _step(
        self,
        name: str,
        condition: Callable[[], bool],
        frame: bool = False,
        latest: float = _LATEST,
    ) -> None:
        """Run the event loop until a condition holds and, if `frame`, the canvas is repainted."""
        begun = now()
        while not condition():
            if since(begun).wall > latest:
                print(f"{name}: not within {latest:g} s", file=sys.stderr)
                break
            self.wait(0.004)
        shown = len(self._shown)
        while frame and len(self._shown) == shown and since(begun).wall < latest:
            self._native.update()
            self.wait(0.004)
        took = since(begun)
        self.steps[name] = {
            "begun": begun.wall,
            "ended": begun.wall + took.wall,
            "wall": took.wall,
            "thread": took.thread,
        }


def _shares(places: Counter[str]) -> list[tuple[str, float]]:
    total = sum(places.values())
    return [(name, count / total) for name, count in places.most_common(5)]


def work(options: Sequence[str]) -> None:
    """Use the window for the first time, and print the times, in a child process."""
    window = FirstUse()
    if "--own" in options:
        window.open_image()
    window.click(_OWN if "--own" in options else _SAMPLE)
    for name in ("first drag", "second drag"):
        window.drag(name)
    for name in _OVERLAYS:
        window.show_overlay(name)
    if "--whole" in options:
        window.watch_to_the_end()
    print(_ANSWER + json.dumps(window.end()), flush=True)
    os._exit(0)  # skip the shutdown of Qt and its windows


def _use(checkout: Path, home: Path, options: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the steps of a process whose home folder is given."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("XDG_", "NAPARI_", "PYTHONDONTWRITE"))
    }
    environment |= {
        "HOME": str(home),
        "USERPROFILE": str(home),
        "NUMBA_CACHE_DIR": str(home / "numba"),
        "PYTHONPATH": os.pathsep.join([str(checkout), str(_ROOT)]),
    }
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, str(_ROOT), *options],
        cwd=home,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    (answer,) = (each for each in done.stdout.splitlines() if each.startswith(_ANSWER))
    found: dict[str, dict[str, Any]] = json.loads(answer.removeprefix(_ANSWER))
    return found


_TITLES = ("step", "time", "GUI thread", "longest freeze", "most GUI thread in one", "all freezes")


def _table(steps: dict[str, dict[str, Any]]) -> str:
    keys = ("wall", "thread", "freeze", "freeze, processor", "all freezes")
    rows = [line([name, *(f"{found[key]:.2f} s" for key in keys)]) for name, found in steps.items()]
    return "\n".join([head(_TITLES), *rows])


def _print(title: str, steps: dict[str, dict[str, Any]]) -> None:
    print(f"\n{title}\n\n{_table(steps)}\n")
    for name, found in steps.items():
        for begun, wall, thread, places in found["longest"]:
            print(f"{name}, after {begun:.2f} s: {wall:.2f} s, {thread:.2f} s of the GUI thread")
            for place, share in places:
                print(f"  {share:4.0%} {place}")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table for each start of napari."""
    from benchmarks.checkouts import checkout

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--against", type=checkout, metavar="FOLDER", help="another checkout")
    parser.add_argument("--own", action="store_true", help="open the dock beside an image")
    parser.add_argument("--kept", action="store_true", help="start once more with the same folders")
    parser.add_argument("--whole", action="store_true", help="watch until all is compiled")
    options = parser.parse_args(arguments)
    given = [f"--{name}" for name in ("own", "whole") if getattr(options, name)]
    print(conditions())
    for folder in filter(None, (_ROOT, options.against)):
        compileall.compile_dir(folder / "napari_hmrf", quiet=2)  # as pip does
        with tempfile.TemporaryDirectory() as home:
            _print(f"First start of {folder.name}", _use(folder, Path(home), given))
            if options.kept:
                _print(f"Next start of {folder.name}", _use(folder, Path(home), given))
    return 0


if __name__ == "__main__":
    sys.exit(main())
