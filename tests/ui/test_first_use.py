"""Tests of the dock with the mouse, as a first-time user would use it."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from npe2 import PluginManager
from qtpy.QtCore import QPoint, QPointF, Qt, QTimer
from qtpy.QtGui import QWheelEvent
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QApplication

from napari_hmrf import Arrow, Drawing
from napari_hmrf.contributions import dock
from napari_hmrf.layers.compat import text_of
from napari_hmrf.ui.motion.motion_messages import EARLY, HERE, RETURNED
from tests.support.docks import quick
from tests.support.person import Person, only
from tests.support.screen import Screen
from tests.support.timeouts import LONG_MS

LEFT = Qt.MouseButton.LeftButton


@pytest.fixture
def click(at_rest):
    """Return a function that clicks a button of a dock in its centre."""

    def clicked(widget, words):
        QTest.mouseClick(Screen(widget).button(words), LEFT)
        at_rest.pass_through()

    return clicked


@pytest.fixture
def deformed(frame, small_sample, run, settle):
    """Return the viewer and a visible dock with a result: gel pushed right by 3 px."""
    small_sample(frame.viewer)
    widget = quick(frame.open())
    frame.show()
    run(widget)
    settle(widget)
    return frame.viewer, widget


def groove(widget, part):
    """Return the slider and the position in its groove for a part of the deformation."""
    slider = Screen(widget).slider
    return slider, QPoint(round(part * (slider.width() - 1)), slider.height() // 2)


def slide(widget, part):
    slider, place = groove(widget, part)
    QTest.mouseClick(slider, LEFT, Qt.KeyboardModifier.NoModifier, place)


def test_tissue_from_brightness_leaves_the_tool_active(pulling_beside, settle):
    _, widget = pulling_beside
    widget.tissue_from_intensity()
    settle(widget)
    assert widget.active


def test_pressing_a_tool_again_leaves_it_active(pulling_beside, at_rest, click):
    person, widget = pulling_beside
    for title in ("Pull", "Hold"):
        click(widget, title)
        button = Screen(widget).button(title)
        key = button.toolTip().rstrip(")")[-1]
        for press in (
            partial(click, widget, title),
            partial(QTest.keyClick, button, Qt.Key.Key_Space),
            partial(person.key, Qt.Key(ord(key))),
        ):
            press()
            at_rest.pass_through()
            assert widget.active
            assert button.isChecked(), title


def test_a_sample_opens_with_the_dock_undeformed_and_invites_to_drag(
    unstyled, without_controls, make_napari_viewer, qtbot, settle, at_rest
):
    viewer = make_napari_viewer(show=True)
    docks = viewer.window.dock_widgets
    before = []
    viewer.layers.events.inserted.connect(lambda _: before.append(len(docks)))
    # As from the menu, in the event loop.
    QTimer.singleShot(0, partial(viewer.open_sample, "napari-hmrf", "brain"))
    qtbot.waitUntil(lambda: len(docks) == 1, timeout=LONG_MS)
    assert before[:2] == [0, 0], "the layers should appear before the dock is built"
    widget = dock(viewer)
    assert len(docks) == 1
    at_rest()
    settle(widget)
    assert widget.active
    assert visible(viewer) == {"Brain", "Motion"}
    assert widget.status.startswith(HERE)
    assert "press Play" not in widget.status
    assert text_of(viewer).text == "Pull: drag tissue here"
    Person(viewer, qtbot).drag((150, 100), (155, 105))
    settle(widget)
    assert only(widget).at == pytest.approx((150, 100), abs=1)
    assert "Brain deformed, elastic" in visible(viewer)
    assert text_of(viewer).text == "Pull"


def test_play_shows_the_motion_of_an_undeformed_sample(frame, settle, at_rest, click):
    PluginManager.instance().discover()  # a window discovers plugins at its start
    widget = frame.open()
    frame.show()
    frame.viewer.open_sample("napari-hmrf", "growth")
    at_rest()
    settle(widget)
    assert "Brain deformed, elastic" not in visible(frame.viewer)
    assert "press Play" in widget.status
    assert "Shown undeformed; at 100 %, tissue moves up to" in Screen(widget).words
    click(widget, "Play")
    assert "Brain deformed, elastic" in visible(frame.viewer)


def visible(viewer):
    """Return the names of the visible layers."""
    return {layer.name for layer in viewer.layers if layer.visible}


@pytest.mark.parametrize("is_held", [False, True])
def test_a_drag_before_the_tissue_is_ready_is_applied_when_it_is(
    open_beside, busy_thread, settle, monkeypatch, is_held
):
    # No progress is told instead, however slow the machine is.
    monkeypatch.setattr("napari_hmrf.ui.solving._PATIENCE", math.inf)
    person, widget = open_beside()
    assert widget.active
    person.drag((10, 40), (11, 42))
    person.drag((20, 50))  # a click, perhaps only to see whether the window responds
    person.press(30, 30)
    person.move(32, 33)
    if not is_held:
        person.release(34, 34)
    assert widget.status == EARLY
    assert not widget.drawing.marks
    busy_thread.set()
    settle(widget)
    if is_held:
        person.release(34, 34)
        settle(widget)
    assert [mark.by for mark in widget.drawing.marks] == [(1, 2), (4, 4)]
    assert widget.solution.displacement[30, 30] == pytest.approx((4, 4), abs=0.05)


def test_a_click_that_only_brings_the_window_to_the_front_draws_nothing(pulling_beside):
    person, widget = pulling_beside
    state, changed = Qt.ApplicationState, QApplication.instance().applicationStateChanged
    for each in (state.ApplicationActive, state.ApplicationInactive, state.ApplicationActive):
        changed.emit(each)
    person.drag((20, 20))
    assert not widget.drawing.marks
    assert widget.status == RETURNED
    person.drag((20, 20), (24, 26))
    assert len(widget.drawing.marks) == 1, "a drag has no effect"


def test_escape_cancels_a_drag_before_the_tissue_is_ready(open_beside, busy_thread, settle):
    person, widget = open_beside()
    person.press(30, 30)
    person.move(32, 33)
    person.key(Qt.Key.Key_Escape)
    busy_thread.set()
    settle(widget)
    person.release(34, 34)
    assert not widget.drawing.marks


def test_controls_of_the_result_show_a_result_hidden_for_painting(deformed, settle, click):
    viewer, widget = deformed
    screen, moved = Screen(widget), viewer.layers["MR deformed, paper"]
    asked = {
        "slider": lambda: slide(widget, 0.5),
        "play": lambda: click(widget, "Play"),
        "overlay": lambda: screen.choose("grid"),
    }
    for what, ask in asked.items():
        screen.click_row("gel")
        screen.cell("gel", "Stiffness").write("nonsense")
        assert not moved.visible, "painting does not show the undeformed image"
        ask()
        widget.pause()
        settle(widget)
        assert moved.visible, what


def test_a_click_in_the_groove_of_the_slider_moves_the_slider(deformed, settle):
    _, widget = deformed
    for part in (0.25, 0.75):
        slide(widget, part)
        settle(widget)
        assert widget.percent == pytest.approx(100 * part, abs=4)


def test_the_status_bar_is_updated_with_the_display(widget, small_sample, settle, run):
    viewer = widget._viewer
    small_sample(viewer)
    widget.settings = replace(widget.settings, sweeps=60)
    run(widget)
    settle(widget)
    viewer.mouse_over_canvas = True
    viewer.cursor.position = (10, 12)
    assert "area change" in str(viewer.status)
    slide(widget, 0.5)
    settle(widget)
    assert "at 100 %: moves" in str(viewer.status)
    widget.rules = (widget.rules[0], replace(widget.rules[1], vector=(0.0, 0.0)))
    run(widget)
    settle(widget)
    assert "moves 0 px" in str(viewer.status)
    widget.undo()
    run(widget)
    settle(widget)
    assert " right)" in str(viewer.status)
    viewer.status = ""  # napari clears the status before it reports that the mouse left the canvas.
    viewer.mouse_over_canvas = False
    assert not viewer.status, "the status describes a place that the mouse has left"
    slide(widget, 0.5)
    settle(widget)
    assert not viewer.status


def test_the_result_of_another_image_is_not_shown_until_that_image_is_chosen(deformed, settle):
    viewer, widget = deformed
    screen = Screen(widget)
    assert "tissue moved up to 3" in screen.words
    other = viewer.add_image(np.full((30, 30), 9.0), name="other")
    widget.image = other
    settle(widget)
    assert "moved up to" not in screen.words
    assert widget.result is None
    assert widget.solution is None
    widget.image = viewer.layers["MR"]
    settle(widget)
    assert "100 %: tissue moved up to 3" in screen.words
    assert widget.result is viewer.layers["MR arrows, paper"]
    assert widget.solution is not None


def test_model_and_tissue_from_brightness_are_undone_step_by_step(widget, small_sample):
    viewer = widget._viewer
    _, tissue, _ = small_sample(viewer)
    widget.settings = replace(widget.settings, sweeps=7)
    whole = widget.settings
    widget.model = "elastic"
    widget.tissue_from_intensity()
    widget.plane = "strain"
    widget.model = "paper"
    assert widget.settings != whole
    widget.undo()
    assert (widget.model, widget.plane, widget.curve is None) == ("elastic", "strain", False)
    widget.undo()
    assert (widget.plane, widget.curve is None) == ("stress", False)
    widget.undo()
    assert (widget.tissue, widget.curve) == (tissue, None)
    for _ in range(3):
        widget.redo()
    assert (widget.model, widget.plane, widget.tissue) == ("paper", "strain", "brightness")
    widget.undo()
    assert widget.model == "elastic"


def test_a_poisson_ratio_above_the_limit_is_refused_with_a_message(pulling_beside, settle):
    _, widget = pulling_beside
    widget.drawing = Drawing((Arrow((20, 20), (2, 0), 4.0),))
    settle(widget)
    before = widget.solution
    field = widget._form.model.poisson
    field.native.selectAll()
    QTest.keyClicks(field.native, "0.6")
    QTest.keyClick(field.native, Qt.Key.Key_Return)
    settle(widget)
    assert field.value == 0.6
    assert "0.499" in widget.status
    assert widget.solution is before


def test_the_wheel_scrolls_the_dock_without_changing_a_field(frame, chequered, settle, at_rest):
    frame.viewer.add_image(chequered, name="MR")
    widget = frame.open()
    widget.make_layers()
    settle(widget)
    frame.show()
    model = widget._form.model.model.native
    before = widget.model, widget.fields.radius.value, widget.percent, widget.rules
    screen = Screen(widget)
    action = screen.cell("holds", "Action").box
    for field in (model, widget.fields.radius.native, screen.slider, action):
        turn = QWheelEvent(
            QPointF(5, 5), QPointF(field.mapToGlobal(QPoint(5, 5))), QPoint(0, -120),
            QPoint(0, -120), Qt.MouseButton.NoButton, Qt.KeyboardModifier.NoModifier,
            Qt.ScrollPhase.NoScrollPhase, False,
        )  # fmt: skip
        QApplication.sendEvent(field, turn)
    at_rest.pass_through()
    now = widget.model, widget.fields.radius.value, widget.percent, widget.rules
    assert now == before
    screen.cell("holds", "Action").choose("moves")
    assert screen.cell("moves", "Action").chosen() == "moves", "the name contradicts the action"


def test_undo_of_a_choice_selects_none_if_the_earlier_layer_was_removed(widget, small_sample):
    viewer = widget._viewer
    _, tissue, _ = small_sample(viewer)
    stiffness = viewer.add_image(np.ones((8, 8)), name="stiff")
    widget.tissue = stiffness
    viewer.layers.remove(tissue)
    widget.undo()
    assert widget.tissue is None
    widget.redo()
    assert widget.tissue is stiffness


def test_a_second_click_removes_the_marks_of_folds(deformed, run, settle, click):
    viewer, widget = deformed
    widget.rules = (widget.rules[0], replace(widget.rules[1], vector=(0.0, -40.0)))
    widget.settings = replace(widget.settings, sweeps=60)
    run(widget)
    click(widget, "\u26a0")
    settle(widget)
    assert viewer.layers["MR folds, paper"].visible
    assert viewer.layers[-1].name == "MR folds, paper", "a layer covers the marks of folds"
    viewer.layers["MR folds, paper"].visible = False
    assert ": show" in Screen(widget).button("\u26a0").text(), "there are no marks to hide"
    click(widget, "\u26a0")
    settle(widget)
    assert viewer.layers["MR folds, paper"].visible
    assert Screen(widget).button("\u26a0").text().endswith("Hide the folds")
    click(widget, "\u26a0")
    settle(widget)
    assert "MR folds, paper" not in viewer.layers
    assert widget.overlay == "nothing"


def test_an_error_message_is_shown_until_the_next_action(
    widget, small_sample, settle, busy_thread, qtbot
):
    small_sample(widget._viewer)
    widget.live = True
    widget.materials = (*widget.materials[:1], replace(widget.materials[1], stiffness=30.0))
    qtbot.waitUntil(lambda: widget.status.startswith("Updating"), timeout=LONG_MS)
    Screen(widget).cell("gel", "Stiffness").write("nonsense")
    said = widget.status
    assert said.endswith("or \"rigid\", not 'nonsense'. The value is still 30.")
    busy_thread.set()
    settle(widget)
    assert widget.status == said, "the result of an earlier edit replaced the message"
    Screen(widget).cell("gel", "Stiffness").write("40")
    settle(widget)
    assert widget.status.startswith("Tissue moved")


def test_a_message_reports_the_effect_of_a_removed_layer(widget, small_sample, settle):
    viewer = widget._viewer
    image, tissue, boundary = small_sample(viewer)
    widget.drawing = Drawing((Arrow((10, 10), (1, 0), 3.0),))
    settle(widget)
    for layer, words in (
        (tissue, "'Tissue' was deleted with its stiffness values"),
        (boundary, "'Boundary' was deleted: it no longer holds or moves tissue."),
        (image, "'MR' was deleted. Its drawing is kept"),
    ):
        viewer.layers.remove(layer)
        settle(widget)
        assert widget.status.startswith(words)
    viewer.add_image(np.ones((8, 9)), name="next")
    settle(widget)
    assert "was deleted" not in widget.status
