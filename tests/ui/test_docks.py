"""Tests of the dock in the window, in napari's menus and in the command palette."""

import numpy as np
import pytest
import skimage.data
from npe2 import PluginManifest
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import (
    QAbstractButton,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QDockWidget,
    QLineEdit,
    QSlider,
    QStyle,
    QStyleOptionComboBox,
)

from napari_hmrf import Grid, Motion, Pictures, Study, write_study
from napari_hmrf.contributions import dock
from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.motion.tools import BY_NAME, TOOLS
from napari_hmrf.ui.soft_tissue import SoftTissue
from napari_hmrf.ui.tissue_tables import BoundaryTable
from tests.support.long_work import long_work
from tests.support.screen import Screen, head
from tests.support.timeouts import LONG_MS

#: Largest number of visible controls at the start; a slider and its number count as two.
_AT_START = 24
CTRL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
#: Size of a small screen without the bars of desktop and window.
ROOM = (1366, 700)
#: Commands that napari calls only with a path.
WITH_A_FILE = tuple(
    f"napari-hmrf.{what}" for what in ("open", "open_study", "open_scan", "open_landmarks", "save")
)
COMMANDS = PluginManifest.from_distribution("napari-hmrf").contributions.commands
TYPED = {
    "soft tissue": "soft_tissue",
    "deform now": "deform_now",
    "live mode": "live",
    "pull tissue": "pull",
    "undo tissue": "undo",
    "redo tissue": "redo",
    "play deformation": "play",
}


def registered(name):
    """Return the identifier of a command in napari, which earlier versions make from the title."""
    from napari._app_model import get_app_model

    earlier = {"soft_tissue": "napari-hmrf:Soft tissue"}.get(name)
    return earlier if earlier in get_app_model().commands else f"napari-hmrf.{name}"


@pytest.fixture
def run_command(at_rest):
    """Return a function that runs a command as a menu or the command palette does."""
    from napari._app_model import get_app_model

    def run(name):
        get_app_model().commands.execute_command(registered(name)).result()
        at_rest()

    return run


@pytest.fixture
def window(unstyled, without_controls, styled_window):
    """Return a window without style sheet and layer controls."""
    return styled_window


@pytest.fixture
def styled_window(make_napari_viewer, at_rest):
    """Return a window on a small screen with an image, in napari's style."""
    viewer = make_napari_viewer(show=True)
    viewer.window.resize(*ROOM)
    viewer.add_image(np.full((40, 40), 100, np.uint8), name="MR")
    at_rest()
    return viewer.window


def docks_of(window):
    return [inner for inner in window.dock_widgets.values() if isinstance(inner, SoftTissue)]


def is_seen(inner):
    frame = frame_of(inner)
    return frame.isVisible() and not frame.visibleRegion().isEmpty()


def frame_of(inner):
    frame = inner.native.parent()
    assert isinstance(frame, QDockWidget)
    return frame


def test_a_long_status_or_a_solve_moves_nothing_and_a_click_shows_all_of_it(
    styled_window, at_rest, wait_for
):
    found = dock()
    wait_for(lambda: not found.busy)
    at_rest()
    footer, window = found._form.footer, styled_window._qt_window
    parts = [found._form.result.play, footer.deform, found._form.result.keep]

    def places():
        return [part.native.mapTo(window, part.native.rect().topLeft()) for part in parts]

    found.show_message("One line.")
    at_rest(thread=False)
    before, status = places(), footer._status
    assert not status.is_elided
    assert status.cursor().shape() == Qt.CursorShape.ArrowCursor
    with long_work():
        found.deform()
        at_rest(thread=False)
        assert not found.idle
        assert places() == before
    wait_for(lambda: not found.busy)
    words = "So much has to be said that it takes many lines. " * 20
    found.show_message(words)
    footer.warn("It folds.", "300 folds: show")
    footer.offer("Use large motion")
    found._form.result.show_landmarks("Landmarks: 9.27 px apart before, 0.1 now")
    at_rest(thread=False)
    assert (places(), status.is_elided) == (before, True)
    assert status.cursor().shape() == Qt.CursorShape.PointingHandCursor
    QTest.mouseClick(status, Qt.MouseButton.LeftButton)
    shown = [each for each in QApplication.topLevelWidgets() if each.inherits("QWhatsThat")]
    assert [each.isVisible() for each in shown] == [True]
    assert status.toolTip() == words
    footer.explain("sweep 3 of 70")
    assert status.toolTip() == f"{words}\nsweep 3 of 70"
    QTest.keyClick(shown[0], Qt.Key.Key_Escape)


def test_the_dock_fits_on_a_small_screen_without_cut_texts(
    styled_window, small_sample, at_rest, wait_for
):
    found = dock()
    at_rest()
    native = styled_window._qt_window
    assert native.minimumSizeHint().height() <= ROOM[1]
    assert (native.width(), native.height()) == ROOM
    form, footer, result = found._form, found._form.footer, found._form.result
    screen, most_fields = Screen(found), max(TOOLS, key=lambda tool: len(tool.fields)).name
    assert len(screen.controls) <= _AT_START, [each.toolTip() for each in screen.controls]
    width = found.native.width()
    for name in ("pull", most_fields):
        found.tool = name
        at_rest(thread=False)
        fields = [getattr(found.fields, each) for each in BY_NAME[name].fields if name != "pull"]
        strip = [result.play, result.slider, result.before, result.overlay]
        strip += [footer.undo, footer.redo, result.keep, found.fields.radius]
        shown = [each.native for each in (form.image, *fields, *strip)]
        shown += [result.how_far, footer.clear, form.motion.more]
        titles = [each for each in form.sections.values() if each.isVisible() and name == "pull"]
        tools = [*form.motion.tools.values()][: 4 if name == "pull" else None]
        for part in (*tools, *shown, *titles):
            assert part.visibleRegion().boundingRect() == part.rect(), (name, part)
    screen.press("Model")
    at_rest.until(lambda: form.model.plane.native.isVisible())
    assert found.native.width() == width, "the dock changes its width"
    screen.press("Model")
    found._viewer.layers["MR"].data = np.arange(1600, dtype=np.float32).reshape(40, 40)
    screen.press("Tissue and stiffness")
    screen.press("Tissue from brightness")
    found.tool = "tissue"
    found.start()
    wait_for(lambda: not found.busy)
    at_rest()
    assert found.native.width() < 360, "the dock is wider than usual"
    assert_not_cut(form.tissue.editor.joined.native, found.fields.preset.native)
    points = form.tissue.editor.points.native
    assert points.fontMetrics().horizontalAdvance(points.text()) + 4 <= points.width()
    small_sample(found._viewer)
    found.image = found._viewer.layers["MR [1]"]
    found.rules = (*found.rules, BoundaryRule(3, "expand", amount=-2.5), BoundaryRule(4, "remove"))
    screen.press("Boundary and gravity")
    at_rest()
    boundaries = found.native.findChild(BoundaryTable)
    assert sum(not boundaries.isColumnHidden(at) for at in range(boundaries.columnCount())) == 7
    bars = boundaries.horizontalScrollBar(), boundaries.verticalScrollBar()
    at_rest.until(lambda: not any(bar.maximum() for bar in bars))
    for table in form.tables:
        assert_headers_not_cut(table)
    assert_not_cut(*boundaries.findChildren(QComboBox))


def assert_not_cut(*boxes):
    """Assert that the chosen texts of menus fit into their boxes."""
    for box in boxes:
        looks = QStyleOptionComboBox()
        box.initStyleOption(looks)
        style = QStyle.ComplexControl.CC_ComboBox, looks, QStyle.SubControl.SC_ComboBoxEditField
        room = box.style().subControlRect(*style, box).width()
        assert box.fontMetrics().horizontalAdvance(box.currentText()) <= room, box.currentText()


def assert_headers_not_cut(table):
    """Assert that the titles of the visible columns of a table fit."""
    header = table.horizontalHeader()
    elides = header.textElideMode() != Qt.TextElideMode.ElideNone
    for column in range(1, table.columnCount()):
        title = head(table, column)
        lines = [title] if elides else title.split("\n")  # Qt elides two lines as one
        width = max(map(header.fontMetrics().horizontalAdvance, lines))
        assert width <= header.sectionSize(column) or table.isColumnHidden(column), title


@pytest.mark.usefixtures("new_dock")
def test_every_field_and_button_has_a_tooltip(open_beside):
    _, found = open_beside()
    without = []
    for kind in (QAbstractButton, QComboBox, QAbstractSpinBox, QSlider, QLineEdit):
        for part in found.native.findChildren(kind):
            owner = part
            while not owner.toolTip() and owner.parent() is not found.native:
                owner = owner.parent()
            # Buttons without a text: the corner of a table, and hidden warnings.
            unused = isinstance(part, QAbstractButton) and not part.text().strip("⚠ ")
            if not owner.toolTip() and not unused:
                without.append((part.objectName(), getattr(part, "text", str)()))
    assert not without


def corners_seen(viewer):
    """Return the first and last row, and the first and last column, shown on the canvas."""
    canvas = viewer.window._qt_viewer.canvas
    view = canvas.view
    mapped = (view.transform * view.scene.transform).imap([[0, 0], list(canvas.size[::-1])])
    (left, top), (right, bottom) = mapped[:, :2] / mapped[:, 3:]
    return top, bottom, left, right


def test_a_new_dock_keeps_the_view_of_a_whole_image_or_of_a_part(window, at_rest, tmp_path):
    viewer = window._qt_viewer.viewer
    viewer.layers[0].data = np.full((40, 80), 100, np.uint8)
    viewer.reset_view()
    at_rest()
    opened = dock()
    at_rest()
    _, _, left, right = corners_seen(viewer)
    assert left < 0
    assert right > 79
    window.remove_dock_widget(frame_of(opened))
    camera = camera_of(viewer)
    camera.zoom *= 3
    camera.center = (0, 10, 12)
    chosen = (camera.zoom, camera.center)
    opened = dock()
    at_rest()
    assert (camera.zoom, camera.center) == chosen
    image = np.tile(np.arange(240, dtype=np.uint8), (200, 1))
    pull = Drawing((Arrow(at=(100, 100), by=(5, 10), radius=8),))
    study = Study(Grid((200, 240), (1, 1)), motion=Motion(drawing=pull), pictures=Pictures(image))
    viewer.open(write_study(tmp_path / "case", study), plugin="napari-hmrf")
    at_rest(thread=False)
    assert opened.drawing == pull, "the study is not in the dock"
    top, bottom, left, right = corners_seen(viewer)
    assert max(top, left) < 0
    assert bottom > 199
    assert right > 239


def test_the_dock_lists_its_keys_until_a_click(frame):
    made = frame.open()
    frame.show()
    Screen(made).press("?")
    (shown,) = (each for each in QApplication.topLevelWidgets() if each.inherits("QWhatsThat"))
    assert "Ctrl+Z: undo" in Screen(made).button("?").toolTip()
    QTest.mouseClick(shown, Qt.MouseButton.LeftButton)
    assert not shown.isVisible()


def test_each_tool_has_an_icon_a_tool_tip_and_a_key_and_the_active_tool_is_checked(widget):
    widget._viewer.add_image(np.full((40, 40), 100, np.uint8))
    widget.tool = "pin"
    widget.start()
    screen, pictures = Screen(widget), set()
    for tool in TOOLS:
        button = screen.button(tool.title)
        pictures.add(button.icon().pixmap(20).toImage().constBits().asstring(1600))
        assert button.toolTip().startswith(tool.hint)
        assert button.toolTip().endswith(f"({tool.key})")
        assert button.isChecked() == (tool.name == "pin")
    assert len(pictures) == len(TOOLS)


def test_menu_and_palette_show_and_hide_one_dock_which_may_float_and_be_closed(
    window, run_command, at_rest, wait_for
):
    run_command("live")
    (inner,) = docks_of(window)
    assert is_seen(inner)
    slice_is = inner._form.model.plane.native
    assert slice_is.visibleRegion().isEmpty()
    Screen(inner).press("Model")
    wait_for(lambda: slice_is.visibleRegion().boundingRect() == slice_is.rect())
    run_command("soft_tissue")
    assert not is_seen(inner), "the menu did not hide the visible dock"
    run_command("soft_tissue")
    assert docks_of(window) == [inner]
    assert is_seen(inner)
    frame_of(inner).setFloating(True)
    run_command("live")
    assert docks_of(window) == [inner]
    assert frame_of(inner).isFloating()
    window.remove_dock_widget(frame_of(inner))
    at_rest()
    assert not docks_of(window)
    run_command("soft_tissue")
    (inner,) = docks_of(window)
    assert is_seen(inner)
    assert inner.image.name == "MR"


@pytest.mark.campaign
def test_each_command_runs_in_a_window(window, run_command, qtbot, monkeypatch):
    slices = np.random.default_rng(0).integers(0, 900, (10, 64, 64)).astype(np.uint16)
    monkeypatch.setattr(skimage.data, "brain", lambda: slices)  # which would be downloaded
    samples = {"sample_mass_effect": "mass-effect"}
    words = [
        each.id.removeprefix("napari-hmrf.") for each in COMMANDS if each.id not in WITH_A_FILE
    ]
    for word in sorted(words, key=lambda word: "sample" in word):
        if "sample" in word:  # Samples are large images, so close the docks.
            for inner in docks_of(window):
                window.remove_dock_widget(inner.native)
        run_command(samples.get(word, word.removeprefix("sample_")))
        for inner in docks_of(window):
            qtbot.waitUntil(lambda inner=inner: not inner.busy, timeout=LONG_MS)


def test_the_palette_offers_commands_which_have_the_described_effect(
    window, run_command, at_rest, qtbot
):
    from napari._app_model import get_app_model

    app, main = get_app_model(), window._qt_window
    offered = {
        item.command.id: item.command
        for item in app.menus.get_menu(app.menus.COMMAND_PALETTE_ID)
        if item.command.id.startswith("napari-hmrf")
    }
    for each in COMMANDS:
        if "sample" in each.id:
            continue
        enabled = offered[registered(each.id.removeprefix("napari-hmrf."))].enablement
        assert (enabled is None or enabled.eval({})) == (each.id not in WITH_A_FILE)
    QTest.keyClick(main, Qt.Key.Key_P, CTRL | SHIFT)
    at_rest()
    palette = main._command_palette
    if (
        not palette.isVisible()
    ):  # Without a window manager the window does not get the keyboard focus.
        window._toggle_command_palette()
    for typed, command in TYPED.items():
        palette._line.clear()
        QTest.keyClicks(palette._line, typed)
        found = [each.id for each in palette._list.iter_command()]
        assert registered(command) in found, typed
    palette.hide()
    run_command("pull")
    inner = dock()
    assert inner.active
    qtbot.waitUntil(lambda: not inner.busy, timeout=LONG_MS)
    run_command("pull")
    assert not inner.active
    before = inner.live
    run_command("live")
    assert inner.live != before
    with qtbot.waitSignal(inner.finished, timeout=LONG_MS):
        run_command("deform_now")
    inner.drawing = drawn = Drawing((Arrow((20, 20), (2, 0), 3.0),))
    run_command("undo")
    assert inner.drawing == Drawing()
    run_command("redo")
    assert inner.drawing == drawn
    with qtbot.waitSignal(inner.finished, timeout=LONG_MS):
        run_command("deform_now")
    run_command("play")
    assert inner.playing
    run_command("play")
    assert not inner.playing


def test_a_command_without_a_window_raises_an_error(monkeypatch):
    monkeypatch.setattr("napari.current_viewer", lambda: None)
    with pytest.raises(HmrfError, match="No napari window"):
        dock()
