"""Soak test: hundreds of solves, many of them cancelled at random, with a viewer that redraws.

    python benchmarks/soak.py [--solves 500] [--cancels 100] [--size 96]

Requires a display (on Linux without a display: ``sh scripts/headless.sh python
benchmarks/soak.py``). Every solve is started through the dock widget, in turn on the shaders and on
the compiled loops, with the paper's energy and with elastic tissue. Prints the findings, and exits
with 1 if memory grew by more than 5 MiB after the tenth solve, if a result was wrong, if a thread
was left, if the viewer's picture changed, or if closing the viewer during a solve took 2 s.
"""

from __future__ import annotations

import argparse
import gc
import random
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import psutil

from napari_hmrf import BackendError, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends import compute_thread

ENERGIES = ("paper", "elastic")
# Time limit of a deformation in seconds; sufficient to compile all kernels on a busy machine.
_PATIENCE = 240.0


@dataclass
class Findings:
    """Findings of the soak test."""

    finished: int = 0
    cancelled: int = 0
    wrong: int = 0
    megabytes: list[float] = field(default_factory=list)
    cancel_seconds: list[float] = field(default_factory=list)
    picture_changed: bool = False
    threads_left: list[str] = field(default_factory=list)
    close_seconds: float = 0.0

    @property
    def growth(self) -> float:
        """Memory after the last solve minus memory after the tenth solve, in MiB."""
        return self.megabytes[-1] - self.megabytes[min(9, len(self.megabytes) - 1)]

    @property
    def sound(self) -> bool:
        """True if all findings are within the limits."""
        return (
            self.growth <= 5
            and not self.wrong
            and not self.threads_left
            and not self.picture_changed
            and self.close_seconds < 2
        )


def soak(
    solves: int = 500, cancels: int = 100, size: int = 96, seed: int = 0, viewer: Any = None
) -> Findings:
    """Run the soak test in a viewer, and close the viewer during a last solve.

    Parameters
    ----------
    solves : int
        Number of deformations that are started and complete.
    cancels : int
        Number of deformations that are cancelled at a random moment.
    size : int
        Width and height of the phantom, in pixels.
    seed : int
        Seed of the random moments.
    viewer : napari.Viewer, optional
        Visible viewer without layers; by default, a new viewer.
    """
    import napari
    from qtpy.QtWidgets import QApplication

    from napari_hmrf.contributions import phantom_layers
    from napari_hmrf.ui.soft_tissue import SoftTissue

    turns = [(backend, energy) for energy in ENERGIES for backend in _available(size)]
    before = {thread.name for thread in threading.enumerate()}
    dice = random.Random(seed)
    found = Findings()
    viewer = napari.Viewer(show=True) if viewer is None else viewer
    for data in phantom_layers(phantom("expansion", size)):
        viewer._add_layer_from_data(*data)
    widget = SoftTissue(viewer)
    widget.live = False
    viewer.window.add_dock_widget(widget, name="Soft tissue")
    expected = {turn: _deform(widget, turn).displacement for turn in turns}
    camera = viewer.scene.camera if hasattr(viewer, "scene") else viewer.camera
    zoom = camera.zoom
    picture = viewer.screenshot(canvas_only=True, flash=False)
    usual = _seconds(lambda: _deform(widget, turns[-1]))
    plan = [True] * solves + [False] * cancels
    dice.shuffle(plan)
    process = psutil.Process()
    for number, finish in enumerate(plan):
        turn = turns[number % len(turns)]
        camera.zoom = zoom * (1.001 if number % 2 else 1)  # force the canvas to redraw
        if finish:
            solution = _deform(widget, turn)
            found.finished += 1
            found.wrong += not np.array_equal(solution.displacement, expected[turn])
        else:
            _start(widget, turn)
            _pump(dice.uniform(0, usual))
            asked = time.perf_counter()
            widget.cancel()
            compute_thread.submit(lambda: None).result()  # wait until the solve has ended
            found.cancel_seconds.append(time.perf_counter() - asked)
            found.cancelled += 1
        QApplication.processEvents()
        if finish:
            gc.collect()
            found.megabytes.append(process.memory_info().rss / 2**20)
    camera.zoom = zoom
    _deform(widget, turns[-1])
    found.picture_changed = not np.array_equal(
        picture, viewer.screenshot(canvas_only=True, flash=False)
    )
    _start(widget, turns[0])
    found.close_seconds = _seconds(lambda: (viewer.close(), QApplication.processEvents()))
    compute_thread.stop(_PATIENCE)
    after = {thread.name for thread in threading.enumerate()}
    found.threads_left = sorted(name for name in after - before if "hmrf" in name)
    return found


def _available(size: int) -> list[str]:
    names = []
    for name in ("opengl", "cpu"):
        try:
            solve(phantom("expansion", size).problem, SeilerPrior(), backend=name)
        except BackendError as error:
            print(f"without {name}: {error}", file=sys.stderr)
            continue
        names.append(name)
    return names


def _start(widget: Any, turn: tuple[str, str]) -> None:
    device, widget.model = turn
    widget.settings = replace(widget.settings, device=device)
    widget.deform()


def _deform(widget: Any, turn: tuple[str, str]) -> Any:
    _start(widget, turn)
    deadline = time.perf_counter() + _PATIENCE
    while not widget.idle:
        _pump(0.005)
        if time.perf_counter() > deadline:
            raise TimeoutError("a deformation did not end within four minutes")
    return widget.solution


def _pump(seconds: float) -> None:
    from qtpy.QtWidgets import QApplication

    until = time.perf_counter() + seconds
    while True:
        QApplication.processEvents()
        if time.perf_counter() >= until:
            return
        time.sleep(0.001)


def _seconds(work: Any) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soak test and print the findings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--solves", type=int, default=500)
    parser.add_argument("--cancels", type=int, default=100)
    parser.add_argument("--size", type=int, default=96)
    options = parser.parse_args(arguments)
    found = soak(options.solves, options.cancels, options.size)
    tenth = found.megabytes[min(9, len(found.megabytes) - 1)]
    print(f"finished {found.finished}, cancelled {found.cancelled}, wrong results {found.wrong}")
    print(f"memory after the tenth {tenth:.1f} MiB, after the last {found.megabytes[-1]:.1f} MiB")
    if found.cancel_seconds:
        print(
            f"longest until a cancelled solve had ended {1000 * max(found.cancel_seconds):.0f} ms"
        )
    print(f"viewer's picture changed: {found.picture_changed}; threads left: {found.threads_left}")
    print(f"closing the viewer during a solve took {found.close_seconds:.2f} s")
    print("sound" if found.sound else "NOT SOUND")
    return 0 if found.sound else 1


if __name__ == "__main__":
    sys.exit(main())
