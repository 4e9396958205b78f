"""Fixtures shared by tests; tests that need a window are skipped without a display."""

from __future__ import annotations

import gc
import os
import sys
from functools import cache
from itertools import count

import napari
import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - loads the linear algebra whose threads are limited below
from hypothesis import settings
from threadpoolctl import threadpool_limits

from napari_hmrf.compute.compile_cache import loader
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.ui.viewer_dock import Dock
from tests.support import compiled_loops
from tests.support.compile_once import compile_most, compile_once
from tests.support.docks import dock_in, quick
from tests.support.idle import AtRest
from tests.support.long_work import long_work
from tests.support.napari_caches import (
    check_callbacks_once,
    check_widgets_once,
    collect_little_once,
    draw_letters_once,
    enable_menus_of_windows_only,
    freeze_once,
    read_manifests_once,
)
from tests.support.opened import KEY, count_new, opened, summary
from tests.support.pulling import pull
from tests.support.timeouts import LONG_MS

# A slow machine must not fail a test.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
# Compile loops in the process that needs them, so that no test depends on another process.
os.environ["NAPARI_HMRF_COMPILE"] = "here"
# napari neither reads nor writes the user's settings; writing is slow.
os.environ["NAPARI_CONFIG"] = ""
# A window makes hundreds of thousands of long-lived objects, so collect garbage less often.
gc.set_threshold(300_000, 20, 20)
if "PYTEST_XDIST_WORKER" in os.environ:
    # Parallel test processes use one core each. Tests of multithreading start processes of their
    # own, or use all threads explicitly. A rasterizer thread in Mesa 22.3 crashed, rarely, on a
    # busy machine.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    # Threads of linear algebra wait for each other in a loop, which takes up to five times the
    # processor time of one thread.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    threadpool_limits(1, user_api="blas")
    loader.before_numba()
    import numba

    numba.set_num_threads(1)
    compute_thread.submit(lambda: numba.set_num_threads(1)).result()

count_new(Dock, "docks")
enable_menus_of_windows_only()

_NO_DISPLAY = sys.platform == "linux" and not (
    os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
)
#: Shared docks that the current test, or any test, has borrowed: True for the dock in a frame.
_lent, _built = set(), set()
_WINDOWS = {"make_napari_viewer", "make_napari_viewer_proxy"}
#: Files with the slowest tests, which start first in a parallel run.
_LONG = {
    f"test_{name}.py" for name in ("study_file", "cli", "report", "unsaved", "docks", "processes")
}

if _NO_DISPLAY:
    # Qt would end the process without a display, but single widgets do not need a display.
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")


def pytest_sessionstart(session):
    """Fetch the loops that a checkout with equal sources has compiled, before any worker starts."""
    if not hasattr(session.config, "workerinput"):
        compiled_loops.fetch()


def pytest_sessionfinish(session):
    """Delete the shared docks before Qt ends; share the loops that all workers have compiled."""
    for is_framed in _built:
        _shared(is_framed).discard()
    if hasattr(session.config, "workerinput"):
        session.config.workeroutput[KEY] = dict(opened)
    else:
        compiled_loops.share()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """Add the docks and windows of a worker."""
    opened.update(getattr(node, "workeroutput", {}).get(KEY, {}))


def pytest_terminal_summary(terminalreporter):
    """Print how many docks and windows the tests opened."""
    for line in summary():
        terminalreporter.write_line(line)


def pytest_collection_modifyitems(items):
    """Run slow files first, and skip tests of windows if no window can be opened."""
    items.sort(key=lambda item: item.path.name not in _LONG)
    if not _NO_DISPLAY:
        return
    for item in items:
        if _WINDOWS & set(item.fixturenames):
            item.add_marker(pytest.mark.skip(reason="napari needs a display; make test starts one"))


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    """Share the compilation, half of a first run, between parallel test processes.

    A run of more than 1000 tests needs nearly all loops.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker is None:
        return
    compile_once()
    if len(session.items) > 1000:
        compile_most(backwards=worker["workerid"] != "gw0")


@cache
def _shared(is_framed):
    """Return the lender of a dock that all tests of this process share."""
    from tests.support.shared_dock import SharedDock

    return SharedDock(is_framed)


def _shared_dock(is_framed):
    """Borrow a shared dock until the end of the test; return its frame."""
    _lent.add(is_framed)
    _built.add(is_framed)
    return _shared(is_framed).lend()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item):
    """Clean borrowed docks after all fixtures of the test have been torn down."""
    result = yield
    while _lent:
        _shared(_lent.pop()).take_back()
    return result


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Freeze existing objects before a window is opened, to shorten garbage collection.

    napari's fixture collects garbage for each closed window, which would examine modules, compiled
    loops and objects of the tests again.
    """
    if _WINDOWS & set(item.fixturenames):
        count_new(napari.Viewer, "windows")
        read_manifests_once()
        draw_letters_once()
        check_widgets_once()
        check_callbacks_once()
        collect_little_once()
        freeze_once()


@pytest.fixture(scope="session")
def settings_folders(tmp_path_factory):
    """Return paths of folders that do not exist, because making a temporary folder per test is
    slow."""
    folder = tmp_path_factory.mktemp("settings")
    return (folder / str(number) for number in count())


@pytest.fixture(autouse=True)
def _no_memory(settings_folders):
    """Isolate the settings of each test from other tests and from the user."""
    from qtpy.QtCore import QSettings

    folder = next(settings_folders)
    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(folder))


@pytest.fixture
def new_dock():
    """Discard the shared docks, so that the test gets a new dock."""
    for is_framed in _built:
        _shared(is_framed).discard()


@pytest.fixture
def without_child(monkeypatch):
    """Read and write DICOM and HDF5 in this process, because a child takes a second to start."""
    from napari_hmrf.io import itk_files

    monkeypatch.setattr(
        itk_files, "call_in_child", lambda _, function, *args, **options: function(*args, **options)
    )


@pytest.fixture
def widget(qtbot):
    """Return the shared dock beside a viewer without a window, with fast settings."""
    return quick(_shared_dock(is_framed=False).open())


@pytest.fixture
def busy_thread():
    """Occupy the compute thread until released, as a long compilation would."""
    with long_work() as release:
        yield release


@pytest.fixture
def small_sample():
    """Return a function that adds a painted example: tissue fixed left and pushed right."""
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
    """Return a function that presses Deform and returns the first value that `finished` emits."""

    def deform(widget):
        said = []
        widget.finished.connect(said.append)
        widget.deform()
        qtbot.waitUntil(lambda: bool(said), timeout=LONG_MS)
        widget.finished.disconnect(said.append)
        return said[0]

    return deform


@pytest.fixture
def wait_for(qtbot, at_rest):
    """Return a function that processes events and delayed calls until a condition is true."""

    def run(condition):
        if not condition():
            at_rest(thread=False)
        return condition()

    return lambda condition: qtbot.waitUntil(lambda: run(condition), timeout=LONG_MS)


@pytest.fixture
def at_rest(qtbot):
    """Return a helper that processes all pending work of the windows."""
    return AtRest(qtbot)


@pytest.fixture
def every_pass_a_batch(monkeypatch):
    """Make shaders check for the end after every pass, for results independent of the load."""
    from napari_hmrf.solver.backends.opengl.context import pace

    monkeypatch.setattr(pace, "BATCH_SECONDS", 0.0)


@pytest.fixture
def made(monkeypatch):
    """Return the list of OpenGL objects made; `left` counts those not yet released."""
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
    """Open windows in Qt's style, because applying napari's style sheet is slow."""
    monkeypatch.setattr("napari._qt.qt_main_window.get_stylesheet", lambda *_, **__: "")


@pytest.fixture
def without_controls(monkeypatch):
    """Open windows without napari's panel of controls for each layer."""
    from qtpy.QtWidgets import QFrame

    made = "napari._qt.layer_controls.qt_layer_controls_container.create_qt_layer_controls"
    monkeypatch.setattr(made, lambda _: QFrame())


@pytest.fixture
def open_window(unstyled, make_napari_viewer, chequered, qtbot, at_rest):
    """Return a function that opens a window with the dock beside an image."""
    from tests.support.person import Person

    def opened(data=None, *, is_small=False, **place):
        viewer = make_napari_viewer(show=True)
        if is_small:  # software OpenGL draws a volume for seconds
            viewer.window._qt_window.resize(800, 600)
        viewer.add_image(chequered if data is None else data, name="MR", **place)
        widget = dock_in(viewer)
        at_rest(thread=False)
        return Person(viewer, qtbot), widget

    return opened


@pytest.fixture
def frame(qtbot):
    """Return a viewer without a window, with a frame that the shared dock opens in."""
    return _shared_dock(is_framed=True)


@pytest.fixture
def open_beside(frame, chequered, at_rest):
    """Return a function that opens the dock beside an image in a viewer without a window."""
    from tests.support.windowless import Touch

    def opened(data=None, **place):
        frame.viewer.add_image(chequered if data is None else data, name="MR", **place)
        widget = frame.open()
        at_rest(thread=False)
        return Touch(frame.viewer, frame), widget

    return opened


@pytest.fixture
def chequered():
    """Return a chequered image."""
    rows, cols = np.indices((64, 64))
    return (120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8)


@pytest.fixture
def pulling(open_window, settle):
    """Return a simulated user and the dock, with the *Pull* tool active."""
    person, widget = open_window()
    return person, pull(widget, settle)


@pytest.fixture
def pulling_beside(open_beside, settle):
    """Return a simulated user and the dock, with the *Pull* tool active, without a window."""
    touch, widget = open_beside()
    return touch, pull(widget, settle)


@pytest.fixture
def settle(at_rest):
    """Return a function that waits until the result of the last edit is drawn."""
    return lambda widget: at_rest.until(lambda: not widget.busy)
