"""Tests of unsaved work: the question before closing, autosave and crash recovery."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.settings import get_settings
from qtpy.QtCore import QEvent, QFile, QObject, QSettings
from qtpy.QtWidgets import QApplication, QFileDialog, QLabel, QMessageBox

from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    Motion,
    Pictures,
    Study,
    atomic_write,
    contributions,
    read_study,
    write_study,
)
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.io import recovery
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.docks import dock_in, quick
from tests.support.long_work import long_work
from tests.support.screen import Screen
from tests.support.timeouts import LONG
from tests.support.windowless import Touch

DRAWING = Drawing((Arrow(at=(30, 30), by=(2.0, 5.0), radius=4.0),))
OTHER = Drawing((Arrow(at=(20, 40), by=(-3.0, 1.0), radius=4.0),))


class Answers:
    """Simulated answers to the questions of a dock."""

    def __init__(self, dock, *answers):
        self.questions, self._answers = [], list(answers)
        dock.prompt = self

    def __call__(self, question):
        self.questions.append(question)
        return self._answers.pop(0)


@pytest.fixture(autouse=True)
def no_question_of_napari():
    before = get_settings().application.confirm_close_window
    get_settings().application.confirm_close_window = False
    yield
    get_settings().application.confirm_close_window = before


class CloseBlocker(QObject):
    """Event filter that blocks and counts closing, because napari's fixture closes the window."""

    def __init__(self, window):
        super().__init__()
        self._window, self.passed = window, 0
        window.installEventFilter(self)

    def eventFilter(self, watched, event):
        if event.type() != QEvent.Type.Close:
            return False
        self.passed += 1
        event.ignore()
        return True

    def remove(self):
        if self._window is not None:
            self._window.removeEventFilter(self)
        self._window = None


@pytest.fixture
def window(unstyled, without_controls, make_napari_viewer, at_rest):
    """Return a function that opens a window with an image of several slices, and the dock.

    The close events of the window are counted and blocked. With `shown=False` nothing is drawn.
    """
    doors = []

    def opened(name="MR", slices=3, shown=False):
        viewer = make_napari_viewer(show=shown)
        doors.append(CloseBlocker(viewer.window._qt_window))
        rows, cols = np.indices((64, 64))
        data = (120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8)
        viewer.add_image(np.stack([data] * slices) if slices else data, name=name)
        dock = dock_in(viewer)
        dock.live = False
        dock.door = doors[-1]
        at_rest()
        return viewer, dock

    yield opened
    for door in doors:
        door.remove()


@pytest.fixture
def press_close(at_rest):
    """Return a function that presses X and returns whether the window would close."""

    def pressed(dock):
        before = dock.door.passed
        window = dock.native.window()
        (window.windowHandle() if window.isVisible() else window).close()
        at_rest()
        return dock.door.passed > before

    return pressed


@pytest.fixture
def dock(frame, at_rest):
    """Return an idle dock without live mode, beside an empty viewer without a window."""
    made = frame.open()
    made.live = False
    at_rest()
    return made


@pytest.fixture
def photo(dock, frame, at_rest):
    """Return an image in the viewer of the dock."""
    image = frame.viewer.add_image(np.full((64, 64), 100, np.uint8), name="photo")
    at_rest()
    return image


@pytest.fixture
def new_dock(qtbot, wait_for):
    """Return a function that makes a new dock, which offers abandoned work."""

    def made(viewer):
        dock = SoftTissue(viewer)
        qtbot.addWidget(dock.native)
        dock.live = False
        wait_for(lambda: not dock.busy)
        return dock

    return made


def settings():
    """Return the folder of the persistent settings."""
    kind = QSettings.Format.IniFormat, QSettings.Scope.UserScope
    return Path(QSettings(*kind, "napari-hmrf", "napari-hmrf").fileName()).parent


def autosaved_files():
    """Return the autosaved files, which lie beside the persistent settings."""
    return sorted((settings() / "unsaved").glob("*.study"))


def test_closing_asks_once_about_unsaved_edits_even_after_the_dock_was_closed(
    window, press_close, at_rest, monkeypatch
):
    viewer, dock = window(shown=True)
    door, native = dock.door, viewer.window._qt_window
    dock.drawing = DRAWING
    dock.undo()
    asked = Answers(dock)
    assert press_close(dock)
    assert asked.questions == [], "an undone edit is unsaved"
    dock.redo()
    at_rest()
    asked = Answers(dock, "cancel", "cancel")
    assert not press_close(dock)
    native.close()  # File > Close Window calls this method.
    at_rest()
    assert (door.passed, dock.drawing, dock.unsaved) == (1, DRAWING, True)
    assert len(asked.questions) == 2, "a press of X asked more or fewer than one question"
    assert "'MR slice 1'" in asked.questions[0]
    viewer.window.remove_dock_widget(dock.native)
    at_rest.until(lambda: len(autosaved_files()) == 1)
    shown, answers = [], QMessageBox.StandardButton
    monkeypatch.setattr(
        QMessageBox, "question", lambda *given: (shown.append(given[2:4]), answers.Discard)[1]
    )
    native.close()
    at_rest()
    ((question, offered),) = shown
    assert "'MR slice 1'" in question
    assert offered == answers.Save | answers.Discard | answers.Cancel
    assert door.passed == 2
    assert not autosaved_files()


def test_a_script_closes_the_window_during_a_solve_without_a_wait_or_a_question(
    window, run, at_rest
):
    viewer, dock = window()
    dock.device = "cpu"
    dock.drawing = DRAWING
    run(dock)
    at_rest.until(lambda: not dock.busy)
    dock.play()
    asked = Answers(dock)
    dock.door.remove()
    with long_work():
        dock.deform()
        after_it = compute_thread.submit(lambda: None)
        viewer.close()
        assert not after_it.done(), "closing waited for the solve"
        at_rest(thread=False)
    at_rest()
    assert asked.questions == []
    assert not autosaved_files()


def test_undone_and_saved_edits_are_not_unsaved_and_paint_is(
    dock, photo, frame, at_rest, tmp_path, monkeypatch
):
    dock.drawing = DRAWING
    dock.undo()
    assert not dock.unsaved
    dock.redo()
    path = dock.save_study(tmp_path / "case")
    dock.undo()
    dock.redo()
    assert not dock.unsaved, "undo and redo changed the saved state"
    offered = []
    monkeypatch.setattr(
        QFileDialog, "getSaveFileName", lambda *said: (offered.append(said[2]), ("", ""))[1]
    )
    Screen(dock).press("Save study ...")
    assert offered == [str(path)]
    dock.make_layers()
    at_rest()
    assert not dock.unsaved
    tissue = frame.viewer.layers["Tissue"]
    frame.viewer.layers.selection.active = tissue
    tissue.fill((5, 5), 1)
    assert dock.unsaved
    dock.undo()
    assert not dock.unsaved
    dock.redo()
    assert dock.unsaved
    at_rest.until(lambda: len(autosaved_files()) == 1)


def test_one_answer_saves_all_slices_and_the_volume_and_the_next_answer_saves_there_again(
    window, press_close, at_rest, tmp_path, monkeypatch
):
    files, is_cancelled = [], True

    def choose(*_):
        if is_cancelled:
            return "", ""
        files.append(tmp_path / f"{len(files)}.study")
        return str(files[-1]), ""

    def saved():
        studies = [read_study(file).study for file in files]
        return [(each.grid.shape, each.motion.drawing) for each in studies]

    monkeypatch.setattr(QFileDialog, "getSaveFileName", choose)
    viewer, dock = window(slices=40)
    for number, drawing in ((0, DRAWING), (2, OTHER)):
        viewer.dims.set_current_step(0, number)
        dock.drawing = drawing
    viewer.dims.order = (1, 0, 2)
    at_rest()
    dock.drawing = DRAWING
    dock.extent = "volume"
    at_rest()
    dock.drawing = ball = Drawing((Arrow((1, 30, 30), (0.0, 3.0, 0.0), 5.0),))
    asked = Answers(dock, "save", "save", "save")
    assert not press_close(dock), "the window closed without a file name"
    is_cancelled = False
    assert press_close(dock)
    expected = [((64, 64), DRAWING), ((64, 64), OTHER), ((40, 64), DRAWING), ((40, 64, 64), ball)]
    assert saved() == expected
    assert len(asked.questions) == 2
    dock.drawing = Drawing()
    assert press_close(dock)
    assert asked.questions[-1].endswith(f"Saving replaces '{files[-1].name}'.")
    assert saved() == [*expected[:3], ((40, 64, 64), Drawing())]
    assert not autosaved_files()


def test_a_message_names_the_extent_of_a_saved_study_and_what_is_not_saved(
    dock, frame, at_rest, tmp_path
):
    frame.viewer.add_image(np.full((3, 64, 64), 90, np.uint8), name="MR")
    at_rest()
    dock.drawing = DRAWING
    dock.extent = "volume"
    at_rest()
    dock.drawing = Drawing((Arrow(at=(1, 30, 30), by=(0.0, 2.0, 5.0), radius=0.5),))
    dock.save_study(tmp_path / "all.study")
    assert dock.status.startswith("Saved the study of the whole volume as all.study")
    assert dock.status.endswith("Not saved yet: slice 1. Each has a file of its own.")
    dock.extent = "slice"
    at_rest.until(lambda: not dock.busy)
    dock.save_study(tmp_path / "flat.study")
    assert dock.status.startswith("Saved the study of slice 1 as flat.study")
    assert "Not saved yet" not in dock.status


def test_only_the_window_with_edits_asks_and_quitting_asks_before_any_window_closes(
    window, make_napari_viewer, press_close, wait_for, at_rest
):
    _, first = window(shown=True)
    first.drawing = DRAWING
    viewer = make_napari_viewer(show=True)
    other = viewer.window._qt_window
    other.activateWindow()
    wait_for(lambda: QApplication.focusWindow() is other.windowHandle())
    asked = Answers(first, "cancel", "discard")
    other.close(quit_app=True)
    at_rest()
    assert len(asked.questions) == 1
    assert (first.door.passed, first.drawing, other.isVisible()) == (0, DRAWING, True)
    second = contributions.dock(viewer)
    assert second is contributions.dock(viewer)
    assert second is not first, "two viewers have one dock"
    second.door = CloseBlocker(other)
    assert press_close(second)
    assert len(asked.questions) == 1, "the window without edits asked"
    second.door.remove()
    assert press_close(first)
    assert len(asked.questions) == 2


def test_work_of_a_viewer_closed_at_a_prompt_can_be_recovered(
    window, wait_for, at_rest, monkeypatch
):
    viewer, dock = window()
    dock.drawing = DRAWING
    at_rest.until(lambda: len(autosaved_files()) == 1)
    asked = Answers(dock)
    dock.door.remove()
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    viewer.close()
    assert asked.questions == []
    (file,) = autosaved_files()
    assert read_study(file).study.motion.drawing == DRAWING


def test_opening_a_study_preserves_the_unsaved_edits_of_another_image(
    dock, photo, wait_for, tmp_path
):
    saved = Pictures(np.full((40, 44), 90, np.uint8), name="saved")
    study = Study(Grid((40, 44), (1, 1)), motion=Motion(drawing=OTHER), pictures=saved)
    dock.drawing = DRAWING
    dock.open_study(write_study(tmp_path / "other", study))
    wait_for(lambda: not dock.busy)
    assert dock.drawing == OTHER
    assert dock.unsaved, "the earlier drawing is not unsaved"
    dock.image = photo
    wait_for(lambda: not dock.busy)
    assert dock.drawing == DRAWING
    dock.save_study(tmp_path / "photo")
    assert not dock.unsaved


def test_edits_are_autosaved_but_not_during_a_drag(dock, photo, frame, at_rest):
    touch = Touch(frame.viewer)
    dock.start()
    at_rest()
    assert not autosaved_files()
    touch.press(30, 30)
    touch.move(36, 38)
    at_rest()
    assert not autosaved_files()
    touch.release(36, 38)
    at_rest.until(lambda: len(autosaved_files()) == 1)
    study, _ = read_study(autosaved_files()[0])
    assert study.motion.drawing == dock.drawing
    dock.clear()
    dock.undo()
    at_rest.until(lambda: read_study(autosaved_files()[0]).study.motion.drawing == dock.drawing)
    dock.undo()
    assert not dock.drawing.marks
    at_rest.until(lambda: not autosaved_files())


def test_edits_of_a_study_that_cannot_be_solved_are_autosaved(dock, photo, frame, at_rest):
    viewer = frame.viewer
    dock.make_layers()
    at_rest()
    tissue, boundary = viewer.layers["Tissue"], viewer.layers["Boundary"]
    viewer.layers.selection.active = tissue
    tissue.fill((5, 5), 2)
    at_rest()
    tissue.translate = (3, 3)
    at_rest()
    assert "not on the grid" in dock.status
    dock.drawing = DRAWING
    viewer.layers.selection.active = boundary
    boundary.fill((5, 5), 1)

    def autosaved():
        return read_study(autosaved_files()[0]).study

    at_rest.until(lambda: autosaved_files() and (autosaved().motion.labels == 1).all())
    study = autosaved()
    assert study.motion.drawing == DRAWING
    assert (study.tissue.labels == 2).all(), "the last valid tissue is missing"


LEFT = "Unsaved work"


def write_recovery_file(study, process, monkeypatch):
    """Write a recovery file as another process does."""
    with monkeypatch.context() as its:
        its.setattr(os, "getpid", lambda: process.pid)
        file = recovery.new_file(settings() / "unsaved")
    write_study(file, study)
    return file


@pytest.fixture
def left_behind(monkeypatch):
    """Return a function that creates a recovery file of a terminated process."""
    over = subprocess.Popen([sys.executable, "-I", "-S", "-c", ""])
    over.wait(LONG)
    return lambda study: write_recovery_file(study, over, monkeypatch)


def test_work_of_a_killed_process_is_offered_and_stored_until_it_is_saved(
    new_dock, wait_for, tmp_path, monkeypatch
):
    folder = settings() / "unsaved"
    pictures = Pictures(image=np.full((64, 64), 100, np.uint8), name="photo")
    study = Study(Grid((64, 64), (1, 1)), motion=Motion(drawing=DRAWING), pictures=pictures)
    waiting = [sys.executable, "-I", "-S", "-c", "input()"]
    with subprocess.Popen(waiting, stdin=subprocess.PIPE) as process:
        file = write_recovery_file(study, process, monkeypatch)
        assert not recovery.abandoned_files(folder), "work of a running process is offered"
        process.kill()
    dock = new_dock(ViewerModel())
    assert f"{LEFT} on 'photo'" in Screen(dock).words
    Screen(dock).press("Open it")
    wait_for(lambda: not dock.busy)
    assert LEFT not in Screen(dock).words
    assert dock.drawing == DRAWING
    assert dock.image.name == "photo"
    assert dock.active, "the marks cannot be seen or edited"
    assert dock.unsaved
    (own,) = autosaved_files()
    assert own != file
    assert not recovery.abandoned_files(folder), "recovered work is offered again"
    dock.save_study(tmp_path / "case")
    assert not autosaved_files()


def test_a_hundred_held_patches_are_autosaved(dock, photo, at_rest):
    lattice = {"start": (0, 0), "step": 2, "shape": (33, 33)}
    values = np.random.default_rng(4).normal(0, 0.01, (100, 2 * 33**2))
    marks = (Arrow((32, 32), (0, 0), 32.0, motion=PatchMotion(**lattice, values=v)) for v in values)
    dock.drawing = held = Drawing(tuple(marks))
    at_rest.until(lambda: len(autosaved_files()) == 1)
    assert read_study(*autosaved_files()).study.motion.drawing == held


NOT_AUTOSAVED = "The work on 'photo' is not autosaved, so a crash would lose it"


def test_work_that_cannot_be_autosaved_is_reported_with_the_reason(
    dock, photo, at_rest, monkeypatch
):
    with monkeypatch.context() as full:
        full.setattr(atomic_write.os, "fsync", disk_full)
        dock.drawing = DRAWING
        at_rest.until(lambda: NOT_AUTOSAVED in Screen(dock).words)
        assert "the disk is full" in Screen(dock).words
    dock.drawing = OTHER
    at_rest.until(lambda: len(autosaved_files()) == 1)
    at_rest.until(lambda: NOT_AUTOSAVED not in Screen(dock).words)


def disk_full(_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_work_without_a_folder_for_recovery_files_is_reported_until_it_is_saved(
    dock, photo, at_rest, tmp_path
):
    blocking = settings() / "unsaved"
    blocking.parent.mkdir(parents=True, exist_ok=True)
    blocking.write_text("a file in place of the folder")
    dock.drawing = DRAWING
    at_rest.until(lambda: NOT_AUTOSAVED in Screen(dock).words)
    assert "unsaved: " in Screen(dock).words, "the path of the folder is missing"
    dock.save_study(tmp_path / "case")
    assert NOT_AUTOSAVED not in Screen(dock).words


def test_recovered_work_uses_an_open_image_without_a_drawing(new_dock, wait_for, left_behind):
    pixels = np.arange(64 * 64, dtype=np.uint16).reshape(64, 64)
    pictures = Pictures(image=pixels, name="photo")
    for _ in range(2):
        study = Study(Grid((64, 64), (1, 1)), motion=Motion(drawing=DRAWING), pictures=pictures)
        left_behind(study)
    viewer = ViewerModel()
    viewer.add_image(pixels + np.uint16(1), name="other")
    image = viewer.add_image(pixels, name="photo")
    dock = new_dock(viewer)
    for is_unused in (True, False):
        Screen(dock).press("Open it")
        wait_for(lambda: not dock.busy)
        assert dock.drawing == DRAWING
        assert (dock.image is image) == is_unused
        dock.image = image
        wait_for(lambda: not dock.busy)
        assert dock.drawing == (DRAWING if is_unused else OTHER)
        dock.drawing = OTHER


def test_the_offer_of_unsaved_work_is_whole_and_low(new_dock, left_behind, qtbot, at_rest):
    name = "a_scan_of_a_knee" * 6
    left_behind(Study(Grid((20, 24), (1.0, 1.0)), pictures=Pictures(name=name)))
    dock = new_dock(ViewerModel())
    dock.native.resize(345, 745)  # as in a window of 1366 x 768 pixels
    with qtbot.waitExposed(dock.native):
        dock.native.show()
    at_rest(thread=False)
    (label,) = (each for each in dock.native.findChildren(QLabel) if LEFT in each.text())
    assert label.heightForWidth(label.width()) <= label.height()
    assert label.height() <= 8 * label.fontMetrics().lineSpacing()
    assert name in label.text().replace("\u200b", "")
    longest = max(re.split(r"[ \u200b]", label.text()), key=len)
    assert label.fontMetrics().horizontalAdvance(longest) < label.width(), "a word is cut"


def test_unreadable_work_of_a_killed_process_can_be_discarded(new_dock, left_behind, monkeypatch):
    study = Study(Grid((20, 24), (1.0, 1.0)), motion=Motion(drawing=DRAWING))
    older = [left_behind(study) for _ in range(2)]
    for age, each in enumerate(older, 1):
        os.utime(each, (0, -age))
    file = left_behind(study)
    file.write_bytes(file.read_bytes()[:200])
    dock = new_dock(ViewerModel())
    thrown = []
    monkeypatch.setattr(QFile, "moveToTrash", lambda each: bool(thrown.append(each.fileName())))
    Screen(dock).press("Open it")
    assert "damaged" in dock.status
    assert autosaved_files() == sorted([file, *older])
    Screen(dock).press("Discard")
    assert thrown == [str(file)], "the file was not moved to the trash"
    assert autosaved_files() == sorted(older)
    Screen(dock).press("Discard all")
    assert thrown == [str(each) for each in (file, *older)]
    assert not autosaved_files()
    assert LEFT not in Screen(dock).words


def test_work_on_a_deleted_image_is_offered_at_once_until_the_window_closes(
    window, press_close, at_rest, tmp_path
):
    viewer, dock = window(name="knee", slices=0)
    dock.drawing = DRAWING
    viewer.layers.remove("knee")  # before the work is autosaved
    at_rest.until(lambda: LEFT in Screen(dock).words)
    assert "Its drawing is kept: 'Open it'" in dock.status
    Screen(dock).press("Open it")
    at_rest.until(lambda: not dock.busy)
    assert (dock.image.name, dock.drawing, dock.unsaved) == ("knee", DRAWING, True)
    assert LEFT not in Screen(dock).words
    dock.save_study(tmp_path / "knee")
    viewer.layers.remove(dock.image)
    at_rest.until(lambda: "is saved in 'knee.study'" in dock.status)
    assert LEFT not in Screen(dock).words, "saved work is offered"
    viewer.add_image(np.full((64, 64), 90, np.uint8), name="hip")
    at_rest.until(lambda: dock.image is not None and not dock.busy)
    assert "knee" not in dock.status
    dock.drawing = OTHER
    viewer.layers.remove("hip")
    at_rest.until(lambda: LEFT in Screen(dock).words)
    asked = Answers(dock)
    assert press_close(dock)
    assert asked.questions == []
    assert not autosaved_files(), "work on an image deleted on purpose stays"


def test_marks_on_tissue_without_an_image_are_saved_before_closing(frame, at_rest, tmp_path):
    tissue = frame.viewer.add_labels(np.pad(np.ones((30, 40), int), 8), name="only tissue")
    dock = quick(frame.open())
    dock.tissue = tissue
    dock.drawing = DRAWING
    path = dock.save_study(tmp_path / "alone.study")
    dock.drawing = OTHER
    frame.viewer.add_image(np.zeros((46, 56)), name="another")
    dock.image = frame.viewer.layers["another"]
    at_rest()
    Answers(dock, "save")
    assert dock._unsaved.may_close()
    assert read_study(path)[0].motion.drawing == OTHER
    at_rest()
