"""Tests of the preparation of a new computer in the dock, and of the first import of the dock."""

import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from qtpy.QtCore import QTimer

from napari_hmrf.compute.compile_cache import sets
from napari_hmrf.compute.compile_cache.stage import Progress
from napari_hmrf.ui import opening, preparation
from tests.support.screen import Screen
from tests.support.timeouts import LONG, LONG_MS

IMAGE = ["elastic", "pictures", "slipping", "rigid", "large-motion"]


@pytest.fixture
def computer(monkeypatch):
    """Return a new computer: the compiled sets, and the sets that were requested."""
    made = SimpleNamespace(compiled=set(), requested=[])
    compiler = SimpleNamespace(
        IDLE="--idle",
        request=lambda *jobs, priority: made.requested.append([*jobs]),
        compile_meanwhile=lambda: None,
        is_compiling=lambda: True,
        progress=lambda *jobs: Progress(len(made.compiled & {*jobs}) / len(jobs), 20.0),
    )
    monkeypatch.setattr(preparation, "compiler", compiler)
    monkeypatch.setattr(preparation, "_INTERVAL", 0)
    monkeypatch.setattr(
        preparation,
        "are_compiled",
        lambda job: ({job} if job else {*sets.COSTS}) <= made.compiled,
    )
    return made


def test_a_bar_shows_until_the_sets_that_the_image_needs_are_compiled(
    computer, new_dock, open_beside, qtbot
):
    _, widget = open_beside()
    bar = Screen(widget).bar
    qtbot.waitUntil(lambda: not bar.isHidden(), timeout=LONG_MS)
    assert bar.text() == "Preparing for this computer, once: about 20 s left"
    assert bar.value() == 0
    assert computer.requested == [IMAGE]
    computer.compiled |= {*IMAGE[:4]}
    qtbot.waitUntil(lambda: bar.value() == 80, timeout=LONG_MS)
    computer.compiled.add(IMAGE[4])
    qtbot.waitUntil(bar.isHidden, timeout=LONG_MS)


def test_the_sets_of_a_volume_and_of_two_images_are_requested(computer, new_dock, frame, qtbot):
    widget = frame.open()
    widget.image = frame.viewer.add_image(np.ones((8, 9, 10)), name="one")
    widget.extent = "volume"
    volume = ["volume", "volume-large-motion"]
    qtbot.waitUntil(lambda: computer.requested[-1:] == [volume], timeout=LONG_MS)
    widget.compare_with = frame.viewer.add_image(np.ones((8, 9, 10)), name="two")
    pair = [*volume, "volume-data"]
    qtbot.waitUntil(lambda: computer.requested[-1] == pair, timeout=LONG_MS)


def test_the_window_is_painted_while_the_dock_is_imported(monkeypatch, tmp_path, qtbot):
    name = "module_of_the_dock_that_takes_long"
    painted = threading.Event()
    monkeypatch.setattr(threading, "painted", painted, raising=False)
    source = f"import threading\nassert threading.painted.wait({LONG})\n"
    (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(opening, "_DOCK", name)
    monkeypatch.setattr(opening, "_HEAVY", (name,))
    QTimer.singleShot(0, opening.load)
    QTimer.singleShot(0, painted.set)
    qtbot.waitUntil(lambda: painted.is_set() and not _is_importing(), timeout=LONG_MS)
    assert sys.modules.pop(name)


def _is_importing():
    return any(each.name == "napari-hmrf imports" for each in threading.enumerate())
