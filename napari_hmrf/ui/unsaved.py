"""Work that is in no file yet: asked for before its window closes, and kept against a crash."""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

from napari.qt import QtViewer
from napari.utils.notifications import show_warning
from qtpy.QtCore import QEvent, QObject, Qt, QThread, QTimer, Signal
from qtpy.QtWidgets import (
    QApplication,
    QFileDialog,
    QFrame,
    QHBoxLayout,
    QLabel,
    QMainWindow,
    QMessageBox,
    QPushButton,
    QVBoxLayout,
)

from napari_hmrf.errors import HmrfError
from napari_hmrf.io import recovery
from napari_hmrf.io.study_file import SUFFIX, save_study
from napari_hmrf.layers.compat import is_quitting, stop_quitting
from napari_hmrf.layers.edit_history import CHOICE, DRAWING, MODEL, Slot, steps_of
from napari_hmrf.layers.unsaved_work import UnsavedWork
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.study.study import Study
from napari_hmrf.ui import study_files
from napari_hmrf.ui.events import Listening, single_shot
from napari_hmrf.ui.messages import in_short
from napari_hmrf.ui.remembered_settings import settings

Answer = Literal["save", "discard", "cancel"]
_log = logging.getLogger("napari_hmrf")
#: How long nothing must be edited until it is kept against a crash, in milliseconds.
_REST = 1000
#: Those of all docks there are.
_all: weakref.WeakSet[Unsaved] = weakref.WeakSet()


class Unsaved(QObject):
    """Saves and opens the studies of a dock, and lets none of what was done be lost by accident.

    A script that closes its viewer is not asked.

    Parameters
    ----------
    dock : SoftTissue
    viewer : napari.Viewer or ViewerModel
    pointer : Pointer
    live : LiveStudy

    Attributes
    ----------
    ask : callable
        Given a question, answers "save", "discard" or "cancel"; by default a person does.
    """

    def __init__(self, dock: Any, viewer: Any, pointer: Any, live: Any) -> None:
        super().__init__(dock.native)
        self.ask: Callable[[str], Answer] = self._ask_person
        self._dock, self._viewer, self._pointer, self._live = dock, viewer, pointer, live
        self._steps, self._work = steps_of(viewer), shared(viewer, UnsavedWork)
        self._over = False
        self._writer = threading.Thread()
        self._resting = single_shot(dock.native, _REST, self._keep)
        self._heard = Listening((self._steps.edits.changed, self._on_edited))
        self._left = LeftBehind(self._take_up)
        self._left.refused.connect(self._refuse)
        dock.native.layout().insertWidget(0, self._left)
        self._left.show_next(recovery.left_behind(folder()))
        _all.add(self)

    @property
    def there(self) -> bool:
        """Whether something was done that no file holds."""
        return bool(self._work.slices)

    # What is done with files

    def save(self, path: str | Path) -> Path:
        """Save the study as it is, and its field if that is up to date."""
        written = study_files.save(self._dock, path, self._live.fresh)
        self._settle(self._pointer.history.slot, written)
        return written

    def save_as(self) -> bool:
        """Ask where to save the study, and save it; whether it was."""
        image, here = self._dock.image, self._pointer.history.slot
        name = "study" if image is None else str(image.name)
        if isinstance(here, Slot):
            name = f"{name} {_slice(here)}".strip()
        chosen, _ = QFileDialog.getSaveFileName(
            self._dock.native, "Save the study", name + SUFFIX, f"Studies (*{SUFFIX})"
        )
        if chosen:
            self.save(chosen)
        return bool(chosen)

    def open(self, path: str | Path) -> None:
        """Add the layers of a saved study; what was drawn on others stays on them."""
        study_files.open_into(self._dock, self._viewer, path)
        self._settle(self._pointer.history.slot, Path(path))

    def painted(self) -> None:
        """A layer that is read was painted on."""
        if isinstance(here := self._pointer.history.slot, Slot):
            self._work.note(here)
            self._resting.start()

    def _on_edited(self, slot: Slot, _: Any, before: Any) -> None:
        if slot.what in (CHOICE, MODEL):
            return  # made again in a moment
        edits = self._steps.edits
        here = slot if slot.what == DRAWING else self._pointer.history.slot
        by_hand = edits.next_undo or edits.next_redo or edits.in_progress
        if isinstance(here, Slot) and by_hand:
            self._work.note(here, slot, before)
            self._resting.start()

    def _settle(self, here: Any, path: Path | None = None) -> None:
        """A slice needs to be kept no more."""
        self._work.save(here)
        if path is not None:
            self._work.paths[here] = path
        if self._writer.is_alive():
            self._writer.join()
        if (kept := self._work.kept.pop(here, None)) is not None:
            kept.unlink(missing_ok=True)

    # Before the window closes

    def watch(self, window: QMainWindow) -> None:
        """Hear of a window of napari's."""
        window.installEventFilter(self)

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Hear of the window's closing before napari does."""
        if event.type() != QEvent.Type.Close or self._over:
            return False
        if watched.findChild(QtViewer).isHidden():
            # A script closes it, or napari does after another window: too late to stay.
            if QThread.currentThread().loopLevel() == 0:
                self._discard()
            return False
        asked = [each for each in _all if each is self or is_quitting(watched)]
        asked = [each for each in asked if each.there]
        if not all(each.may_close() for each in asked):
            stop_quitting(watched)
            event.ignore()
            return True
        if asked and event.spontaneous():
            event.ignore()  # napari would ask once more
            QTimer.singleShot(0, watched.close)
            return True
        return False

    def may_close(self) -> bool:
        """Ask what to do with what no file holds; whether nothing of it is wanted any more."""
        names = [
            f"'{slot.layer.name}'" + (f" ({_slice(slot)})" if _slice(slot) else "")
            for slot in self._work.slices
        ]
        answer = self.ask(
            f"What was done on {' and '.join(names)} is in no file yet. Save it before closing?"
        )
        if answer == "discard":
            self._discard()
        elif answer == "save":
            for slot in self._work.slices:
                self._save_slice(slot)
        return answer != "cancel" and not self.there

    def _save_slice(self, slot: Slot) -> None:
        """Go to a slice, and save it where it is known to be, or where somebody says."""
        self._dock.image = slot.layer
        self._steps.go_to(slot)
        self._live.look()
        try:
            if (known := self._work.paths.get(slot)) is not None:
                self.save(known)
            else:
                self.save_as()
        except (HmrfError, OSError) as error:
            self._refuse(in_short(error))

    def _refuse(self, why: str) -> None:
        self._dock.say(why)
        show_warning(why)

    def _ask_person(self, question: str) -> Answer:
        button = QMessageBox.StandardButton
        answers: dict[Any, Answer] = {button.Save: "save", button.Discard: "discard"}
        offered = button.Save | button.Discard | button.Cancel
        answer = QMessageBox.question(
            self._dock.native, "Soft tissue", question, offered, button.Save
        )
        return answers.get(answer, "cancel")

    def _discard(self) -> None:
        for slot in {*self._work.slices, *self._work.kept}:
            self._settle(slot)

    # Against a crash

    def _keep(self) -> None:
        """Write the slice that is worked on, once nothing moves."""
        here = self._pointer.history.slot
        held = QApplication.mouseButtons() != Qt.MouseButton.NoButton
        if held or self._steps.edits.in_progress is not None or self._writer.is_alive():
            self._resting.start()
        elif here not in self._work.slices:
            self._settle(here)  # all of it was taken back
        else:
            try:
                study = self._dock.study
                file = self._work.kept.get(here) or recovery.new_file(folder())
            except (HmrfError, ValueError, OSError):
                return  # it cannot be saved as it is: what was kept before stays
            self._work.kept[here] = file
            self._writer = threading.Thread(target=_write, args=(file, study), daemon=True)
            self._writer.start()

    def _take_up(self, file: Path) -> None:
        """Open what was left behind; it is kept until somebody saves it."""
        study_files.open_into(self._dock, self._viewer, file)
        here = self._pointer.history.slot
        self._work.note(here)
        self._work.kept[here] = recovery.take_over(file)

    def release(self) -> None:
        """The dock is closed, or its window is gone."""
        _all.discard(self)
        self._heard.release()
        self._resting.stop()
        self._over = True


class LeftBehind(QFrame):
    """Says that work was found which was not saved when napari ended, and what can be done.

    Parameters
    ----------
    take_up : callable
        Opens a file.
    """

    #: Why a file cannot be opened.
    refused = Signal(str)

    def __init__(self, take_up: Callable[[Path], None]) -> None:
        super().__init__()
        self._take_up = take_up
        self._files: list[Path] = []
        self._label = QLabel(wordWrap=True)
        take, drop = QPushButton("Open it"), QPushButton("Discard")
        take.clicked.connect(self._on_open)
        drop.clicked.connect(self._on_drop)
        layout, buttons = QVBoxLayout(self), QHBoxLayout()
        layout.setContentsMargins(4, 4, 4, 4)
        layout.addWidget(self._label)
        layout.addLayout(buttons)
        buttons.addWidget(take)
        buttons.addWidget(drop)

    def show_next(self, files: Iterable[Path]) -> None:
        """Speak of the first of some files, if there is one."""
        self._files = [file for file in files if file.exists()]
        self.setVisible(bool(self._files))
        said = ""
        if self._files:
            when = time.strftime("%d %b, %H:%M", time.localtime(self._files[0].stat().st_mtime))
            more = f" (and {len(self._files) - 1} more)" if len(self._files) > 1 else ""
            said = f"Work of {when} was not saved when napari ended{more}."
        self._label.setText(said)

    def _on_open(self) -> None:
        file = self._files[0]
        try:
            self._take_up(file)
        except (HmrfError, OSError) as error:
            self.refused.emit(in_short(error))
        else:
            self.show_next(self._files[1:])

    def _on_drop(self) -> None:
        self._files[0].unlink(missing_ok=True)
        self.show_next(self._files[1:])


def folder() -> Path:
    """Where work is kept against a crash: beside what is remembered for good."""
    return Path(settings().fileName()).parent / "unsaved"


def _slice(slot: Slot) -> str:
    return "" if slot.place is None else slot.place.name


def _write(file: Path, study: Study) -> None:
    try:
        save_study(file, study)
    except (OSError, TypeError, ValueError):
        _log.exception("what is not saved yet could not be kept against a crash")
