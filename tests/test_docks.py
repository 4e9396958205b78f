"""Our docks share a place in the window, and napari's menus and command palette find them."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari_hmrf.ui.deform_dock import DeformTissue
from napari_hmrf.ui.motion.grab_dock import GrabAndPull
from napari_hmrf.ui.result.look_dock import LookAtResult
from npe2 import PluginManifest
from patience import LONG_MS
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QDockWidget, QLabel, QTabBar

from napari_hmrf.errors import HmrfError
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.commands import dock

CTRL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
KINDS = [DeformTissue, GrabAndPull, LookAtResult]
#: Of a small screen, what the bars of the desktop and of the window leave.
ROOM = (1366, 700)
#: What napari calls with a path, not without one.
WITH_A_FILE = ("napari-hmrf.open", "napari-hmrf.save")
COMMANDS = PluginManifest.from_distribution("napari-hmrf").contributions.commands


@pytest.fixture
def choose(at_rest):
    """Choose a command in a menu or in the command palette."""
    from napari._app_model import get_app_model

    def chosen(name):
        get_app_model().commands.execute_command(f"napari-hmrf.{name}").result()
        at_rest()

    return chosen


@pytest.fixture
def window(make_napari_viewer, at_rest):
    """A window on a small screen, with an image."""
    viewer = make_napari_viewer(show=True)
    viewer.window.resize(*ROOM)
    viewer.add_image(np.full((40, 40), 100, np.uint8), name="MR")
    at_rest()
    return viewer.window


def in_front(window):
    """The docks of ours of which something is seen."""
    return [
        type(inner)
        for inner in window.dock_widgets.values()
        if type(inner) in KINDS
        and frame_of(inner).isVisible()
        and not frame_of(inner).visibleRegion().isEmpty()
    ]


def tab_titles(main):
    bars = [bar for bar in main.findChildren(QTabBar) if bar.count() == 3]
    return [bar.tabText(number) for bar in bars for number in range(3)]


def frame_of(inner):
    frame = inner.native.parent()
    assert isinstance(frame, QDockWidget)
    return frame


def test_docks_are_tabs_in_one_place_and_the_newest_is_in_front(window, choose):
    for name, kind in zip(("deform", "grab", "look"), KINDS, strict=True):
        choose(name)
        assert in_front(window) == [kind]
    main = window._qt_window
    first = frame_of(dock(DeformTissue))
    assert len(main.tabifiedDockWidgets(first)) == 2
    assert tab_titles(main) == ["Deform tissue", "Grab and pull", "Look at the result"]


def test_all_docks_fit_on_a_small_screen(window, choose, at_rest):
    for name in ("deform", "grab", "look"):
        choose(name)
    for kind in KINDS:
        dock(kind)
        at_rest()
        assert window._qt_window.minimumSizeHint().height() <= ROOM[1]
    assert (window._qt_window.width(), window._qt_window.height()) == ROOM


def test_each_dock_fits_on_a_small_screen(window, at_rest):
    for kind in KINDS:
        inner = dock(kind)
        at_rest()
        assert window._qt_window.minimumSizeHint().height() <= ROOM[1], kind
        assert (window._qt_window.width(), window._qt_window.height()) == ROOM, kind
        window.remove_dock_widget(inner.native)


def corners_seen(viewer):
    """The least and the greatest row and column of the image that are on the canvas."""
    canvas = viewer.window._qt_viewer.canvas
    view = canvas.view
    mapped = (view.transform * view.scene.transform).imap([[0, 0], list(canvas.size[::-1])])
    (left, top), (right, bottom) = mapped[:, :2] / mapped[:, 3:]
    return top, bottom, left, right


def test_an_image_that_was_seen_whole_is_seen_whole_beside_a_dock(make_napari_viewer, at_rest):
    viewer = make_napari_viewer(show=True)
    viewer.window.resize(*ROOM)
    at_rest()
    viewer.add_image(np.full((40, 80), 100, np.uint8), name="MR")
    at_rest()
    dock(DeformTissue, viewer)
    at_rest()
    _, _, left, right = corners_seen(viewer)
    assert left < 0
    assert right > 79


def test_a_view_that_somebody_chose_stays_beside_a_dock(window, at_rest):
    viewer = window._qt_viewer.viewer
    camera = viewer.scene.camera
    camera.zoom *= 3
    camera.center = (0, 10, 12)
    chosen = (camera.zoom, camera.center)
    dock(DeformTissue)
    at_rest()
    assert (camera.zoom, camera.center) == chosen


@pytest.mark.parametrize("kind", KINDS)
def test_each_dock_lists_its_keys(kind, qtbot):
    made = kind(ViewerModel())
    qtbot.addWidget(made.native)
    words = [label.text() for label in made.native.findChildren(QLabel)]
    assert any("Ctrl+" in text and ":" in text for text in words)


def test_a_tab_behind_comes_to_the_front_when_the_menu_chooses_it(window, choose):
    for name in ("deform", "grab", "deform"):
        choose(name)
    assert in_front(window) == [DeformTissue]
    choose("deform")
    assert in_front(window) == [GrabAndPull], "what is seen is hidden, as napari does"
    choose("deform")
    assert in_front(window) == [DeformTissue], "and comes back in front"


def test_a_dock_that_was_put_elsewhere_stays_there(window, choose):
    choose("deform")
    frame_of(dock(DeformTissue)).setFloating(True)
    choose("grab")
    assert set(in_front(window)) == {DeformTissue, GrabAndPull}
    assert not window._qt_window.tabifiedDockWidgets(frame_of(dock(GrabAndPull)))


def test_a_closed_dock_can_be_opened_again(window, choose, at_rest):
    choose("deform")
    choose("grab")
    window.remove_dock_widget(frame_of(dock(GrabAndPull)))
    at_rest()
    assert in_front(window) == [DeformTissue]
    choose("grab")
    assert in_front(window) == [GrabAndPull]


def test_each_command_runs_in_a_window(window, choose, qtbot):
    samples = {"sample_mass_effect": "mass-effect"}
    for name in [each.id for each in COMMANDS if each.id not in WITH_A_FILE]:
        word = name.removeprefix("napari-hmrf.")
        choose(samples.get(word, word.removeprefix("sample_")))
        for inner in list(window.dock_widgets.values()):
            if isinstance(inner, GrabAndPull):
                qtbot.waitUntil(lambda inner=inner: not inner.busy, timeout=LONG_MS)
            window.remove_dock_widget(inner.native)


def test_commands_do_what_they_say(window, choose, qtbot):
    choose("grab_now")
    grab = dock(GrabAndPull)
    assert grab.active
    qtbot.waitUntil(lambda: not grab.busy, timeout=LONG_MS)
    grab.clear()
    choose("grab_now")
    assert not grab.active
    assert in_front(window) == [GrabAndPull]
    before = dock(DeformTissue).live
    choose("live")
    assert dock(DeformTissue).live != before
    choose("deform_now")
    assert "tissue" in dock(DeformTissue).status


def test_the_palette_offers_each_command_that_needs_no_file(window):
    from napari._app_model import get_app_model

    app = get_app_model()
    offered = {
        item.command.id: item.command
        for item in app.menus.get_menu(app.menus.COMMAND_PALETTE_ID)
        if item.command.id.startswith("napari-hmrf.")
    }
    for each in COMMANDS:
        if "sample" in each.id:
            continue
        enabled = offered[each.id].enablement
        assert (enabled is None or enabled.eval({})) == (each.id not in WITH_A_FILE)


TYPED = {
    "deform tissue": "deform",
    "deform now": "deform_now",
    "live mode": "live",
    "pull tissue": "grab_now",
    "grab": "grab",
    "look result": "look",
    "undo tissue": "undo",
    "redo tissue": "redo",
    "play deformation": "play",
}


def test_the_palette_finds_commands_by_what_people_type(window, at_rest):
    main = window._qt_window
    QTest.keyClick(main, Qt.Key.Key_P, CTRL | SHIFT)
    at_rest()
    palette = main._command_palette
    if not palette.isVisible():  # where no window manager gives the window the keyboard
        window._toggle_command_palette()
    for typed, command in TYPED.items():
        palette._line.clear()
        QTest.keyClicks(palette._line, typed)
        found = [each.id for each in palette._list.iter_command()]
        assert f"napari-hmrf.{command}" in found, typed
    palette.hide()


def test_undo_of_the_palette_takes_back_what_was_drawn(window, choose, qtbot):
    choose("grab_now")
    grab = dock(GrabAndPull)
    qtbot.waitUntil(lambda: not grab.busy, timeout=LONG_MS)
    drawn = Drawing((Arrow((20, 20), (2, 0), 3.0),))
    grab.drawing = drawn
    choose("undo")
    assert grab.drawing == Drawing()
    choose("redo")
    assert grab.drawing == drawn


def test_without_a_window_a_command_says_so(monkeypatch):
    monkeypatch.setattr("napari.current_viewer", lambda: None)
    with pytest.raises(HmrfError, match="no napari window"):
        dock(DeformTissue)
