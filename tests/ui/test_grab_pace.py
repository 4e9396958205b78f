"""Tests of the pace of dragged tissue: the newest drawing is shown without blocking the window."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QApplication

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver import preparation
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.problem import Problem
from napari_hmrf.study import engine
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.jobs import Jobs
from napari_hmrf.ui.solving import PacedEngine
from tests.support.person import by_name
from tests.support.study_reader import read_ground
from tests.support.timeouts import LONG, LONG_MS


def pulled(by):
    return Drawing((Arrow((20, 20), (0, by), 4),))


class Follower:
    """Engine that follows drawings on an image, and the results it has shown."""

    def __init__(self, image, **how):
        self.study = replace(read_ground(image, **how).study, optimizer=Multigrid(TOLERANCE))
        self.shown = []
        self.jobs = Jobs()
        self.engine = PacedEngine(self.jobs, self.shown.append, lambda done: None)

    def follow(self, drawing):
        motion = replace(self.study.motion, drawing=drawing)
        self.engine.submit(replace(self.study, motion=motion))


@pytest.fixture
def image():
    from napari.layers import Image

    return Image(np.random.default_rng(1).integers(90, 200, (48, 48)).astype(np.uint8))


@pytest.fixture
def make_follower(qtbot):
    """Return a function that makes a follower of drawings on an image."""
    made = []

    def make(image, **how):
        made.append(Follower(image, **how))
        return made[-1]

    yield make
    for each in made:
        each.engine.close()
        each.jobs.release()


@pytest.fixture
def follower(image, make_follower):
    return make_follower(image)


@pytest.fixture
def solver_at_work():
    """Occupy the compute thread until the returned event is set."""
    begun, over = threading.Event(), threading.Event()
    compute_thread.submit(lambda: (begun.set(), over.wait(60)))
    assert begun.wait(60)
    yield over
    over.set()


@pytest.fixture
def wait_for_follower(at_rest):
    """Return a function that waits until a follower has shown the last drawing."""
    return lambda follower: at_rest.until(
        lambda: not (follower.engine.busy or follower.jobs.busy())
    )


def test_the_newest_drawing_is_shown_last(follower, wait_for_follower):
    for by in range(0, 40, 3):
        follower.follow(pulled(by / 10))
        if by % 7 == 0:
            QApplication.processEvents()
    wait_for_follower(follower)
    seen = follower.shown[-1]
    assert seen.study.motion.drawing == pulled(3.9)
    assert seen.solution.displacement[20, 20] == pytest.approx((0, 3.9), abs=0.02)
    order = [seen.study.motion.drawing.marks[0].by[1] for seen in follower.shown]
    assert order == sorted(order), "an older drawing was shown after a newer one"


def test_only_the_last_of_the_drawings_made_during_a_solve_is_solved(
    follower, wait_for_follower, monkeypatch
):
    solved, first_begun, others_drawn = [], threading.Event(), threading.Event()
    check = Problem.__init__

    def recorded(self, *, observed, **options):
        solved.append(round(float(observed.max()), 1))
        if solved[-1] == 0.1:
            first_begun.set()
            assert others_drawn.wait(LONG)
        check(self, observed=observed, **options)

    monkeypatch.setattr(Problem, "__init__", recorded)
    follower.follow(pulled(0.1))
    assert first_begun.wait(LONG)
    for by in range(2, 10):
        follower.follow(pulled(by / 10))
    others_drawn.set()
    wait_for_follower(follower)
    first, last = 0.1, 0.9
    assert [by for by in solved if by not in (0, 1)] == [first, last], (
        "compilation solves for 0 and 1"
    )
    assert [seen.study.motion.drawing for seen in follower.shown] == [pulled(0.1), pulled(0.9)]


def test_a_newer_drawing_waits_until_the_earlier_result_is_painted(follower, wait_for_follower):
    follower.follow(pulled(1))
    assert compute_thread.submit(lambda: True).result(LONG)
    follower.follow(pulled(2))
    assert compute_thread.submit(lambda: True).result(LONG)
    assert follower.engine.busy, "the engine is idle although the result is not painted"
    assert not follower.shown
    wait_for_follower(follower)
    assert [seen.study.motion.drawing for seen in follower.shown] == [pulled(1), pulled(2)]


def test_a_slow_drawing_is_replaced_by_a_newer_one(
    follower, wait_for_follower, monkeypatch, solver_at_work
):
    monkeypatch.setattr(engine, "patience_for", lambda *_: 0.0)
    follower.follow(pulled(1))
    follower.follow(pulled(2))
    solver_at_work.set()
    wait_for_follower(follower)
    assert [seen.study.motion.drawing for seen in follower.shown] == [pulled(2)]


def test_a_removed_drawing_is_not_shown_after_its_solve(image, wait_for_follower, make_follower):
    follower = make_follower(image, hold_edge=False)
    follower.follow(pulled(2))
    follower.follow(Drawing())
    wait_for_follower(follower)
    assert follower.shown[-1].solution is None
    assert np.array_equal(follower.shown[-1].image, image.data)
    follower.follow(pulled(2))
    wait_for_follower(follower)
    assert follower.shown[-1].solution is not None, "the next drawing was not solved"


def test_an_error_is_shown_only_if_the_drawing_is_still_current(
    follower, wait_for_follower, solver_at_work
):
    beyond = Drawing((Arrow((20, 20), (0, 1e6), 4),))
    follower.follow(beyond)
    follower.follow(pulled(1))
    solver_at_work.set()
    wait_for_follower(follower)
    assert [seen.error for seen in follower.shown] == [None]
    follower.follow(beyond)
    wait_for_follower(follower)
    assert "the image is only" in str(follower.shown[-1].error)
    follower.follow(pulled(2))
    wait_for_follower(follower)
    assert follower.shown[-1].solution is not None


def test_a_cancelled_result_is_not_shown(follower, wait_for_follower):
    follower.follow(pulled(1))
    compute_thread.submit(lambda: None).result(LONG)
    follower.engine.cancel()
    assert not follower.engine.busy
    wait_for_follower(follower)
    assert not follower.shown
    follower.follow(pulled(2))
    wait_for_follower(follower)
    assert [seen.study.motion.drawing for seen in follower.shown] == [pulled(2)]


def test_an_error_while_showing_a_result_does_not_stop_the_next_drawing(
    image, make_follower, wait_for_follower, monkeypatch, qtbot
):
    follower = make_follower(image)
    show, failures = follower.shown.append, [RuntimeError("a layer of another plugin")]

    def fail_once(moved):
        if failures:
            raise failures.pop()
        show(moved)

    monkeypatch.setattr(follower.engine, "_show", fail_once)
    with qtbot.captureExceptions() as raised:
        follower.follow(pulled(1))
        wait_for_follower(follower)
    assert len(raised) == 1
    follower.follow(pulled(2))
    wait_for_follower(follower)
    assert [answer.study.motion.drawing for answer in follower.shown] == [pulled(2)]


def test_arrows_follow_the_mouse_during_a_solve(pulling_beside, qtbot, solver_at_work):
    person, _ = pulling_beside
    person.press(30, 30)
    person.move(34, 40)
    arrows = by_name(person.viewer, "Motion")
    qtbot.waitUntil(lambda: len(arrows.data) > 0 and arrows.data[:, 0].max() > 40, timeout=LONG_MS)
    solver_at_work.set()
    person.release(34, 40)


@pytest.mark.usefixtures("thumbnails")
def test_events_of_layers_are_emitted_only_after_a_drag(pulling_beside, settle, qtbot):
    person, widget = pulling_beside
    picture = by_name(person.viewer, "MR deformed, elastic")
    told, thumbnails, seen = [], [], []
    person.press(30, 30)
    person.move(32, 32)
    qtbot.waitUntil(lambda: not widget.busy, timeout=LONG_MS)
    picture.events.data.connect(lambda event: told.append(event.value))
    picture.events.thumbnail.connect(lambda event: thumbnails.append(event))
    widget.deformation_changed.connect(seen.append)
    for step in range(1, 4):
        person.move(32 + step, 32)
        qtbot.waitUntil(lambda step=step: len(seen) >= step, timeout=LONG_MS)
        assert np.array_equal(picture.data, seen[-1].image)
    assert not told
    assert not thumbnails
    person.release(35, 32)
    settle(widget)
    assert np.array_equal(told[-1], seen[-1].image)
    assert thumbnails
    assert np.array_equal(by_name(person.viewer, "MR").data, widget.study.pictures.image)


def test_an_array_set_by_other_code_is_not_written(pulling_beside, qtbot):
    person, widget = pulling_beside
    person.press(30, 30)
    person.move(32, 32)
    qtbot.waitUntil(lambda: not widget.busy, timeout=LONG_MS)
    picture = by_name(person.viewer, "MR deformed, elastic")
    theirs = np.zeros_like(picture.data)
    picture.data = theirs
    person.move(34, 34)
    qtbot.waitUntil(lambda: picture.data.any(), timeout=LONG_MS)
    assert not theirs.any()
    person.release(34, 34)


def test_the_cursor_emits_no_positions_during_a_drag(pulling_beside):
    person, _ = pulling_beside
    layer, positions = by_name(person.viewer, "Motion"), []
    person.viewer.cursor.events.position.connect(lambda event: positions.append(event.value))
    for end in (lambda: person.release(34, 34), lambda: person.key(Qt.Key.Key_Escape)):
        person.press(30, 30)
        assert layer.cursor == "pointing"
        positions.clear()
        person.move(34, 34)
        assert not positions
        end()
        assert layer.cursor == "circle"
        assert positions, "the status bar was not updated after the drag"


def test_the_first_drag_compiles_no_loop(wait_for_follower, make_follower):
    from napari.layers import Image

    from napari_hmrf.field.interpolation import look_up
    from napari_hmrf.field.triangle_raster import rasterise_displaced

    def compiled():
        kernels = look_up, rasterise_displaced
        return [sorted(map(str, each.compiled.signatures)) for each in kernels], set(
            preparation._prepared
        )

    image = Image(np.random.default_rng(2).normal(size=(40, 44)).astype(np.float32))
    follower = make_follower(image, hold_edge=False)
    follower.engine.rehearse(follower.study)
    wait_for_follower(follower)
    before = compiled()
    follower.follow(Drawing((Arrow((20, 20), (0, 2), 4, 0.5),)))
    wait_for_follower(follower)
    assert compiled() == before


def test_a_waiting_user_is_told_the_reason_and_a_way_to_stop(
    open_beside, settle, qtbot, solver_at_work
):
    _, widget = open_beside()
    compute_thread.stage = "cycle 16, error 1.7e-11 px"
    widget.start()
    qtbot.waitUntil(lambda: "waiting for a computation" in widget.status, timeout=LONG_MS)
    assert "only that program can stop" in widget.status
    assert "cycle" not in widget.status
    compute_thread.stage = f"{PREPARING}: about 5 s left"
    qtbot.waitUntil(lambda: f"({PREPARING}: about 5 s left)" in widget.status, timeout=LONG_MS)
    solver_at_work.set()
    settle(widget)
    assert widget.status.startswith("Drag tissue")
    widget.stop()
    widget.start()
    assert widget.status.startswith("Drag tissue")


def test_unconstrained_tissue_is_ready_after_compilation(
    image, wait_for_follower, make_follower, solver_at_work, at_rest
):
    follower = make_follower(image, hold_edge=False)
    follower.follow(Drawing())
    at_rest(thread=False)
    assert follower.engine.busy
    assert not follower.shown
    solver_at_work.set()
    wait_for_follower(follower)
    assert [seen.solution for seen in follower.shown] == [None]
