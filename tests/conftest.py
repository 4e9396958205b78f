"""What tests with a window share; where there is no display they are skipped."""

from __future__ import annotations

import gc
import os
import sys
import threading
from concurrent.futures import Future
from itertools import count

import numpy as np
import pytest
from hypothesis import settings

from napari_hmrf.solver.backends.compile_cache import loader
from napari_hmrf.solver.backends.thread import compute_thread
from tests.support.compile_once import compile_most, compile_once
from tests.support.docks import dock_in, quick
from tests.support.idle import AtRest
from tests.support.napari_caches import (
    check_callbacks_once,
    check_widgets_once,
    collect_little_once,
    draw_letters_once,
    read_manifests_once,
)
from tests.support.screen import Screen
from tests.support.timeouts import LONG, LONG_MS

# However slow a machine is, what is claimed of tissue is so.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
# Whoever needs a loop compiles it: no test is to depend on what another process has done by then.
os.environ["NAPARI_HMRF_COMPILE"] = "here"
# napari reads no settings of the person at this machine, and writes none, which takes long.
os.environ["NAPARI_CONFIG"] = ""
# A window makes hundreds of thousands of objects that stay as long as it does: Python need not look
# so often which of them are garbage.
gc.set_threshold(50_000, 20, 20)
if "PYTEST_XDIST_WORKER" in os.environ:
    # Processes that test side by side leave the cores to each other. What many threads do is asked
    # of processes that tests begin, and by tests that take as many as there are.
    # With a thread of its own Mesa 22.3 crashed, rarely, on a busy machine.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    loader.before_numba()
    import numba

    numba.set_num_threads(1)
    compute_thread.submit(lambda: numba.set_num_threads(1)).result()

_NO_DISPLAY = sys.platform == "linux" and not (
    os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
)
_WINDOWS = {"make_napari_viewer", "make_napari_viewer_proxy"}
#: Files with tests that take longest; of several processes none is to begin one as the last.
_LONG = {
    f"test_{name}.py"
    for name in ("study_file", "trust", "cli", "report", "unsaved", "docks", "soak", "processes")
}

if _NO_DISPLAY:
    # Qt would end the process for want of a display; single widgets do without one.
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")


def pytest_collection_modifyitems(items):
    """Begin with what takes long; skip what needs a window where none can be opened."""
    items.sort(key=lambda item: item.path.name not in _LONG)
    if not _NO_DISPLAY:
        return
    for item in items:
        if _WINDOWS & set(item.fixturenames):
            item.add_marker(pytest.mark.skip(reason="napari needs a display; make test brings one"))


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    """Processes that test side by side share the work of compiling, which is half of a first run.

    A run of so many tests needs nearly all loops.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker is None:
        return
    compile_once()
    if len(session.items) > 1000:
        compile_most(backwards=worker["workerid"] != "gw0")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Have Python look no more for garbage in what was there before a window is opened.

    With each window that napari's fixture closes everything is looked through: modules, compiled
    loops, what tests are made of. What is new since the last one is little.
    """
    if _WINDOWS & set(item.fixturenames):
        read_manifests_once()
        draw_letters_once()
        check_widgets_once()
        check_callbacks_once()
        collect_little_once()
        gc.collect()
        gc.freeze()


@pytest.fixture(scope="session")
def settings_folders(tmp_path_factory):
    """Folders that are not there: to make each, and to look for a name for it, takes long."""
    folder = tmp_path_factory.mktemp("settings")
    return (folder / str(number) for number in count())


@pytest.fixture(autouse=True)
def _no_memory(settings_folders):
    """Nothing is remembered from the person at this machine, from test to test, or for either."""
    from qtpy.QtCore import QSettings

    folder = next(settings_folders)
    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(folder))


@pytest.fixture
def widget(qtbot):
    """The dock beside a viewer without a window, set to be quick."""
    from napari.components import ViewerModel

    from napari_hmrf.ui.soft_tissue import SoftTissue

    check_widgets_once()
    check_callbacks_once()
    found = SoftTissue(ViewerModel())
    qtbot.addWidget(found.native)
    return quick(found)


@pytest.fixture
def docked(unstyled, make_napari_viewer):
    """The dock in the window of a real viewer, set to be quick."""
    return quick(dock_in(make_napari_viewer()))


@pytest.fixture
def busy_thread():
    """Keep the compute thread busy until released, as a long compilation would."""
    release = threading.Event()
    job: Future[bool] = compute_thread.submit(lambda: release.wait(LONG))
    yield release
    release.set()
    job.result(timeout=LONG)


@pytest.fixture
def small_sample():
    """Add a small painted example to a viewer: a block of tissue, held left and pushed right."""
    from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, TISSUE, layer_metadata
    from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

    def add(viewer, shape=(20, 24), **place):
        image = (np.indices(shape[-2:]).sum(axis=0) % 5 * 50).astype(np.uint8)
        tissue = np.zeros(shape, np.uint8)
        tissue[..., 2:-2, 2:-2] = 1
        boundary = np.zeros(shape, np.uint8)
        boundary[..., 2:-2, 2] = 1
        boundary[..., 2:-2, -3] = 2
        materials = (Material(0, "air", 0.0), Material(1, "gel", 20.0))
        rules = (BoundaryRule(1, "fixed"), BoundaryRule(2, "move", vector=(0.0, 3.0)))
        return (
            viewer.add_image(
                np.broadcast_to(image, shape).copy(),
                name="MR",
                metadata=layer_metadata(IMAGE),
                **place,
            ),
            viewer.add_labels(
                tissue, name="Tissue", metadata=layer_metadata(TISSUE, materials, "kPa"), **place
            ),
            viewer.add_labels(
                boundary, name="Boundary", metadata=layer_metadata(BOUNDARY, rules), **place
            ),
        )

    return add


@pytest.fixture
def run(qtbot):
    """Press Deform and wait for the end; what `finished` said."""

    def deform(widget):
        said = []
        widget.finished.connect(said.append)
        widget.deform()
        qtbot.waitUntil(lambda: bool(said), timeout=LONG_MS)
        widget.finished.disconnect(said.append)
        return said[0]

    return deform


@pytest.fixture
def wait_for(qtbot):
    """Let the window live until something is so."""
    return lambda condition: qtbot.waitUntil(condition, timeout=LONG_MS)


@pytest.fixture
def at_rest(qtbot):
    """Let the windows do all they have to do."""
    return AtRest(qtbot)


@pytest.fixture
def every_pass_a_batch(monkeypatch):
    """How often shaders look whether to go on does not depend on how busy the machine is."""
    from napari_hmrf.solver.backends.opengl.context import pace

    monkeypatch.setattr(pace, "BATCH_SECONDS", 0.0)


@pytest.fixture
def made(monkeypatch):
    """Every texture and framebuffer that is made; `left` of it says how many OpenGL still has."""
    import moderngl

    from napari_hmrf.solver.backends.opengl.context.device import the_device
    from tests.support.opengl import on_compute_thread, require_opengl

    require_opengl()
    on_compute_thread(the_device)
    objects = []

    def noted(make):
        def note(ctx, *args, **kwargs):
            objects.append(make(ctx, *args, **kwargs))
            return objects[-1]

        return note

    for kind in ("texture", "depth_texture", "framebuffer", "buffer"):
        monkeypatch.setattr(moderngl.Context, kind, noted(getattr(moderngl.Context, kind)))
    return objects


@pytest.fixture
def unstyled(monkeypatch):
    """Windows in Qt's own style: of napari's, each widget is measured and painted by many rules."""
    monkeypatch.setattr("napari._qt.qt_main_window.get_stylesheet", lambda *_, **__: "")


@pytest.fixture
def without_controls(monkeypatch):
    """Windows in which napari has no panel of controls for each layer."""
    from qtpy.QtWidgets import QFrame

    made = "napari._qt.layer_controls.qt_layer_controls_container.create_qt_layer_controls"
    monkeypatch.setattr(made, lambda _: QFrame())


@pytest.fixture
def open_window(unstyled, make_napari_viewer, chequered, qtbot, at_rest):
    """Open a window with the dock beside an image."""
    from tests.support.person import Person

    def opened(data=None, **place):
        viewer = make_napari_viewer(show=True)
        viewer.add_image(chequered if data is None else data, name="MR", **place)
        widget = dock_in(viewer)
        at_rest(thread=False)
        return Person(viewer, qtbot), widget

    return opened


@pytest.fixture
def frame(qtbot):
    """A viewer without a window, and a frame for docks beside it."""
    from tests.support.windowless import Frame

    check_widgets_once()
    check_callbacks_once()
    return Frame(qtbot)


@pytest.fixture
def open_beside(qtbot, chequered, at_rest):
    """Open the dock beside an image in a viewer without a window."""
    from tests.support.windowless import Frame, Touch

    check_widgets_once()
    check_callbacks_once()
    frames = []  # which live as long as the test

    def opened(data=None, **place):
        frame = Frame(qtbot)
        frames.append(frame)
        frame.viewer.add_image(chequered if data is None else data, name="MR", **place)
        widget = frame.open()
        at_rest(thread=False)
        return Touch(frame.viewer, frame), widget

    return opened


@pytest.fixture
def chequered():
    """An image of squares."""
    rows, cols = np.indices((64, 64))
    return (120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8)


@pytest.fixture
def pulling(open_window, settle):
    """Somebody with *Pull* in the hand."""
    person, widget = open_window()
    return person, pull(widget, settle)


@pytest.fixture
def pulling_beside(open_beside, settle):
    """Somebody with *Pull* in the hand, and no window."""
    touch, widget = open_beside()
    return touch, pull(widget, settle)


def pull(widget, settle):
    """Have *Pull* be in the hand, and wait until the tissue is known."""
    if not widget.active:
        Screen(widget).press("Pull")
    assert widget.active
    settle(widget)
    return widget


@pytest.fixture
def settle(at_rest):
    """Wait until the tissue has followed, and its displacement is drawn."""
    return lambda widget: at_rest.until(lambda: not widget.busy)
