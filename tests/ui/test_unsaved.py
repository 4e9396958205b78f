"""What was done and is in no file is asked for before a window closes, and outlives a crash."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.settings import get_settings
from qtpy.QtCore import QEvent, QFile, QObject, QSettings, Qt
from qtpy.QtWidgets import QFileDialog, QMessageBox

from napari_hmrf import Arrow, Drawing, Grid, Motion, Study, read_study, write_study
from napari_hmrf.io import recovery
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.docks import dock_in
from tests.support.person import CTRL, Person
from tests.support.screen import Screen
from tests.support.timeouts import LONG

DRAWING = Drawing((Arrow(at=(30, 30), by=(2.0, 5.0), radius=4.0),))
OTHER = Drawing((Arrow(at=(20, 40), by=(-3.0, 1.0), radius=4.0),))


class Asked:
    """Somebody who is asked, and what they answer."""

    def __init__(self, dock, *answers):
        self.questions, self._answers = [], list(answers)
        dock.prompt = self

    def __call__(self, question):
        self.questions.append(question)
        return self._answers.pop(0)


@pytest.fixture(autouse=True)
def nobody_is_asked_by_napari():
    before = get_settings().application.confirm_close_window
    get_settings().application.confirm_close_window = False
    yield
    get_settings().application.confirm_close_window = before


class Door(QObject):
    """Stands between a window and its end, as napari's fixture wants to be who closes it."""

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
    """A window with the dock beside an image of several slices, and the door it has to go by.

    One that is not `shown` is closed as any other, but nothing of it is drawn.
    """
    doors = []

    def opened(name="MR", slices=3, shown=False):
        viewer = make_napari_viewer(show=shown)
        doors.append(Door(viewer.window._qt_window))
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
def close(at_rest):
    """Press the X of a window; whether it goes then."""

    def pressed(dock):
        before = dock.door.passed
        window = dock.native.window()
        (window.windowHandle() if window.isVisible() else window).close()
        at_rest()
        return dock.door.passed > before

    return pressed


@pytest.fixture
def beside(qtbot, wait_for):
    """A dock beside a viewer without a window, at rest."""

    def made(viewer):
        dock = SoftTissue(viewer)
        qtbot.addWidget(dock.native)
        dock.live = False
        wait_for(lambda: not dock.busy)
        return dock

    return made


def settings():
    """Where is what is remembered for good."""
    kind = QSettings.Format.IniFormat, QSettings.Scope.UserScope
    return Path(QSettings(*kind, "napari-hmrf", "napari-hmrf").fileName()).parent


def kept(place=None):
    """The files that work is kept in against a crash, beside what is remembered for good."""
    return sorted(((place or settings()) / "unsaved").glob("*.study"))


def test_nobody_is_asked_where_nothing_was_done(window, close):
    _, dock = window()
    asked = Asked(dock)
    assert not dock.unsaved
    assert close(dock)
    assert asked.questions == []


def test_cancel_keeps_the_window_with_all_that_was_done(window, close, at_rest):
    _, dock = window(shown=True)
    dock.drawing = DRAWING
    at_rest()
    asked = Asked(dock, "cancel", "cancel", "discard")
    assert not close(dock)
    assert dock.drawing == DRAWING
    assert dock.unsaved
    dock.native.window().close()  # as File > Close Window does
    at_rest()
    assert dock.door.passed == 0
    assert close(dock)
    assert len(asked.questions) == 3, "once each time"
    assert "'MR slice 1'" in asked.questions[0]
    assert not kept()


def test_a_window_that_is_closed_by_a_script_asks_nobody(window, at_rest):
    viewer, dock = window()
    dock.drawing = DRAWING
    at_rest()
    asked = Asked(dock)
    dock.door.remove()
    viewer.close()
    assert asked.questions == []
    assert not kept()


def test_save_saves_where_somebody_says_and_then_where_it_was_saved(
    window, close, at_rest, tmp_path, monkeypatch
):
    path, chosen = tmp_path / "case.study", ["", tmp_path / "case.study"]
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(chosen.pop(0)), ""))
    _, dock = window()
    dock.drawing = DRAWING
    Asked(dock, "save", "save", "save")
    assert not close(dock), "no file was chosen"
    dock.save_study(path)
    assert not dock.unsaved
    dock.undo()
    dock.redo()
    assert not dock.unsaved, "it is as it was saved"
    dock.drawing = OTHER
    assert close(dock)
    assert read_study(path).study.motion.drawing == OTHER
    assert not kept()


def test_what_was_taken_back_is_not_asked_for_and_what_was_painted_is(window, close, at_rest):
    viewer, dock = window()
    dock.drawing = DRAWING
    dock.undo()
    assert not dock.unsaved
    dock.make_layers()
    at_rest()
    assert not dock.unsaved
    viewer.layers.selection.active = viewer.layers["Tissue"]
    viewer.layers["Tissue"].fill((0, 5, 5), 1)
    assert dock.unsaved
    dock.undo()
    assert not dock.unsaved
    dock.redo()
    assert dock.unsaved
    asked = Asked(dock, "discard")
    assert close(dock)
    assert len(asked.questions) == 1


def test_all_slices_are_saved_by_one_answer(window, close, at_rest, tmp_path, monkeypatch):
    names = []

    def choose(*given):
        names.append(given[2])
        return str(tmp_path / given[2]), ""

    monkeypatch.setattr(QFileDialog, "getSaveFileName", choose)
    viewer, dock = window()
    for number, drawing in ((0, DRAWING), (2, OTHER)):
        viewer.dims.set_current_step(0, number)
        dock.drawing = drawing
    viewer.dims.set_current_step(0, 1)
    asked = Asked(dock, "save")
    assert close(dock)
    assert len(asked.questions) == 1
    assert names == ["MR slice 0.study", "MR slice 2.study"]
    for name, drawing in zip(names, (DRAWING, OTHER), strict=True):
        assert read_study(tmp_path / name).study.motion.drawing == drawing


def test_slices_of_two_orientations_are_saved_by_one_answer(
    window, close, at_rest, tmp_path, monkeypatch
):
    names = iter(["axial.study", "coronal.study"])
    monkeypatch.setattr(
        QFileDialog, "getSaveFileName", lambda *_: (str(tmp_path / next(names)), "")
    )
    viewer, dock = window(slices=40)
    dock.drawing = DRAWING
    viewer.dims.order = (1, 0, 2)
    at_rest()
    dock.drawing = OTHER
    asked = Asked(dock, "save")
    assert close(dock)
    assert len(asked.questions) == 1
    axial, coronal = (read_study(tmp_path / f"{each}.study").study for each in ("axial", "coronal"))
    assert (axial.grid.shape, axial.motion.drawing) == ((64, 64), DRAWING)
    assert (coronal.grid.shape, coronal.motion.drawing) == ((40, 64), OTHER)


def test_of_two_windows_the_one_with_work_asks_and_quitting_asks_before_either_goes(
    window, close, at_rest
):
    (_, first), (_, second) = window("one", shown=True), window("two", shown=True)
    first.drawing = DRAWING
    mine, other = Asked(first, "cancel", "discard"), Asked(second)
    second.native.window().close(quit_app=True)
    at_rest()
    assert first.door.passed == second.door.passed == 0
    assert close(second)
    assert close(first)
    assert len(mine.questions) == 2
    assert other.questions == []


def test_a_person_is_asked_by_a_box_with_three_answers(window, close, monkeypatch):
    _, dock = window()
    dock.drawing = DRAWING
    shown = []

    def answer(parent, title, question, offered, usual):
        shown.append((question, offered))
        return QMessageBox.StandardButton.Cancel

    monkeypatch.setattr(QMessageBox, "question", answer)
    assert not close(dock)
    ((question, offered),) = shown
    assert question == "The work on 'MR slice 1' is not saved. Save it before closing?"
    buttons = QMessageBox.StandardButton
    assert offered == buttons.Save | buttons.Discard | buttons.Cancel
    Asked(dock, "discard")
    assert close(dock)


def test_the_question_names_the_file_that_saving_replaces(window, close, tmp_path, monkeypatch):
    _, dock = window()
    dock.drawing = DRAWING
    path = dock.save_study(tmp_path / "case")
    dock.drawing = OTHER
    offered = []
    monkeypatch.setattr(
        QFileDialog, "getSaveFileName", lambda *said: (offered.append(said[2]), ("", ""))[1]
    )
    Screen(dock).press("Save study ...")
    assert offered == [str(path)]
    asked = Asked(dock, "discard")
    assert close(dock)
    assert asked.questions[0].endswith("Save it before closing? Saving replaces 'case.study'.")


def test_opening_a_study_loses_nothing_of_the_one_before(beside, wait_for, tmp_path):
    viewer, other = ViewerModel(), ViewerModel()
    other.add_image(np.full((40, 44), 90, np.uint8), name="saved")
    first = beside(other)
    wait_for(lambda: not first.busy)
    first.drawing = OTHER
    path = first.save_study(tmp_path / "other")
    dock = beside(viewer)
    image = viewer.add_image(np.full((64, 64), 100, np.uint8), name="photo")
    wait_for(lambda: not dock.busy)
    dock.drawing = DRAWING
    dock.open_study(path)
    wait_for(lambda: not dock.busy)
    assert dock.drawing == OTHER
    assert dock.unsaved, "what was drawn before is in no file yet"
    dock.image = image
    wait_for(lambda: not dock.busy)
    assert dock.drawing == DRAWING
    dock.save_study(tmp_path / "photo")
    assert not dock.unsaved


def test_work_is_kept_at_rest_and_never_while_a_button_is_down(window, at_rest, wait_for):
    viewer, dock = window(slices=0, shown=True)
    person = Person(viewer, None)
    dock.start()
    at_rest()
    assert not kept()
    person.press(30, 30)
    person.move(36, 38)
    at_rest()
    assert not kept()
    person.release(36, 38)
    at_rest.until(lambda: len(kept()) == 1)
    study, _ = read_study(kept()[0])
    assert study.motion.drawing == dock.drawing
    dock.clear()
    dock.undo()
    at_rest.until(lambda: read_study(kept()[0]).study.motion.drawing == dock.drawing)
    person.key(Qt.Key.Key_Z, CTRL)
    assert not dock.drawing.marks
    at_rest.until(lambda: not kept())


CRASHED = """
import sys
import numpy as np
from qtpy.QtCore import QEventLoop, QSettings
from qtpy.QtWidgets import QApplication
from napari.components import ViewerModel
from napari_hmrf import Arrow, Drawing
from napari_hmrf.ui.soft_tissue import SoftTissue
QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, sys.argv[1])
app = QApplication([])
viewer = ViewerModel()
dock = SoftTissue(viewer)
dock.live = False
viewer.add_image(np.full((64, 64), 100, np.uint8), name="photo")
while dock.busy:
    app.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents)
dock.drawing = Drawing((Arrow(at=(30, 30), by=(2.0, 5.0), radius=4.0),))
app.exec()
"""


@pytest.fixture
def killed(wait_for):
    """A process with work that nobody has saved; it is killed in the end."""

    @contextmanager
    def living():
        place = settings()
        command = [sys.executable, "-c", CRASHED, str(place.parent)]
        process = subprocess.Popen(command, env={**os.environ, "QT_QPA_PLATFORM": "offscreen"})
        try:
            wait_for(lambda: bool(kept(place)) or process.poll() is not None)
            assert process.poll() is None
            yield
        finally:
            process.send_signal(signal.SIGKILL)
            process.wait(LONG)

    if not hasattr(signal, "SIGKILL"):
        pytest.skip("no such way to end a process")
    return living


LEFT = "was not saved when napari ended"


def test_what_a_killed_process_left_is_opened_and_kept_until_it_is_saved(
    killed, beside, wait_for, tmp_path
):
    with killed():
        assert LEFT not in Screen(beside(ViewerModel())).words, "whoever lives has its work itself"
    (file,) = kept()
    dock = beside(ViewerModel())
    assert f" on 'photo' {LEFT}" in Screen(dock).words
    Screen(dock).press("Open it")
    wait_for(lambda: not dock.busy)
    assert LEFT not in Screen(dock).words
    assert dock.drawing == DRAWING
    assert dock.image.name == "photo"
    assert dock.unsaved
    (own,) = kept()
    assert own != file
    assert LEFT not in Screen(beside(ViewerModel())).words, "it has an owner again"
    dock.save_study(tmp_path / "case")
    assert not kept()


def test_what_a_killed_process_left_is_thrown_away_also_if_it_cannot_be_read(beside, monkeypatch):
    over = subprocess.Popen([sys.executable, "-I", "-S", "-c", ""])
    over.wait(LONG)
    with monkeypatch.context() as its:
        its.setattr(os, "getpid", lambda: over.pid)
        file = recovery.new_file(settings() / "unsaved")
    study = Study(Grid((20, 24), (1.0, 1.0)), motion=Motion(drawing=DRAWING))
    file.write_bytes(write_study(file, study).read_bytes()[:200])
    dock = beside(ViewerModel())
    thrown = []
    monkeypatch.setattr(QFile, "moveToTrash", lambda each: bool(thrown.append(each.fileName())))
    Screen(dock).press("Open it")
    assert "damaged" in dock.status
    assert kept() == [file]
    Screen(dock).press("Discard")
    assert thrown == [str(file)], "where it can be had back from, if there is such a place"
    assert not kept()
    assert LEFT not in Screen(dock).words
