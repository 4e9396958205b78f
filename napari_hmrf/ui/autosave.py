"""Recovery files: autosaved work, and the work that an ended process left behind."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from magicgui.widgets import PushButton
from napari.utils.notifications import show_warning
from qtpy.QtCore import QFile, Qt
from qtpy.QtWidgets import QApplication

from napari_hmrf.errors import in_words
from napari_hmrf.io import recovery
from napari_hmrf.io.study_file import image_named_in
from napari_hmrf.study.session import Part, Session, UnsavedWork
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections, single_shot
from napari_hmrf.ui.notice import Notice
from napari_hmrf.ui.remembered_settings import settings
from napari_hmrf.ui.study_files import StudyFiles
from napari_hmrf.ui.viewer_dock import Dock

_log = logging.getLogger("napari_hmrf")
#: Time without an edit after which a recovery file is written, in milliseconds.
_REST = 1000
#: Number of characters above which the name of an image may be wrapped between any two characters.
_WRAPPED = 20


class Autosave:
    """Writer of recovery files, which exist until the work of their slices is saved.

    Parameters
    ----------
    dock : Dock
    viewer : napari.Viewer or ViewerModel
    session : Session
    controller : Controller
    files : StudyFiles
    attempt : callable
        Runs a given action, and reports the error if it fails.
    """

    def __init__(
        self,
        dock: Dock,
        viewer: Any,
        session: Session,
        controller: Controller,
        files: StudyFiles,
        attempt: Callable[[Callable[[], object]], None],
    ) -> None:
        self._session, self._controller, self._files = session, controller, files
        self._work = session.unsaved
        self._writer = threading.Thread()
        self._timer = single_shot(dock.native, _REST, self._keep)
        layers = viewer.layers
        self._connections = EventConnections(
            (self._work.noted, self._on_noted),
            (files.stored, self.drop),
            (layers.events.removing, self._on_removing),
            (layers.events.removed, lambda _: self._offer_timer.start()),
        )
        # Deferred until the session has dropped the parts of the removed layer.
        self._offer_timer = single_shot(dock.native, 0, lambda: self._offer.refresh())
        self._viewer, self._notice = viewer, Notice()
        # Reason for each slice that cannot be autosaved.
        self._failures: dict[Part, str] = {}
        dock.insert(0, self._notice)
        self._offer = RecoveryNotice(
            self._work, lambda file: attempt(partial(self._open_recovered, file))
        )
        dock.insert(0, self._offer)

    def drop(self, here: Part) -> None:
        """Delete the recovery file of a slice whose work was saved, discarded or undone."""
        self._work.save(here)
        self._report(here)
        if self._writer.is_alive():
            self._writer.join()
        if (kept := self._work.saved_files.pop(here, None)) is not None:
            kept.unlink(missing_ok=True)

    def keep_now(self) -> None:
        """Write the recovery file of the latest edits, before the dock closes."""
        if self._timer.isActive():
            self._session.end()
            if self._writer.is_alive():
                self._writer.join()
            self._start_writing()

    def release(self) -> None:
        """Disconnect from edits after the dock was closed or its window was deleted."""
        self._connections.release()
        self._timer.stop()
        self._offer_timer.stop()

    def _on_removing(self, event: Any) -> None:
        """Write the latest edits of an image before the image is removed."""
        if self._viewer.layers[event.index] is self._session.slice.layer:
            self.keep_now()

    def _on_noted(self) -> None:
        self._timer.start()

    def _keep(self) -> None:
        """Write the current slice to a recovery file, once no edit is in progress."""
        is_pressed = QApplication.mouseButtons() != Qt.MouseButton.NoButton
        if is_pressed or self._session.in_progress is not None or self._writer.is_alive():
            self._timer.start()
        else:
            self._start_writing()

    def _start_writing(self) -> None:
        here, files = self._session.slice, self._work.saved_files
        if here not in self._work.slices:
            self.drop(here)  # all edits were undone
            return
        study = self._controller.reader.read_partly(self._session.study)
        if study is None:
            return
        try:
            files[here] = files.get(here) or recovery.new_file(folder())
        except OSError as error:
            self._report(here, error)
            return
        writer, _ = self._files.writer(study)
        write = partial(writer, files[here], study)
        self._writer = threading.Thread(target=self._write, args=(here, write), daemon=True)
        self._writer.start()

    def _write(self, here: Part, write: Callable[[], object]) -> None:
        """Write a recovery file, and report on the GUI thread if this failed."""
        failure: Exception | None = None
        try:
            write()
        except (OSError, TypeError, ValueError) as error:
            _log.exception("the recovery file of unsaved work could not be written")
            failure = error
        self._controller.jobs.gui.submit(partial(self._on_written, here, failure))

    def _on_written(self, here: Part, failure: Exception | None) -> None:
        is_saved = here not in self._work.slices
        self._report(here, None if is_saved else failure)
        self._offer.refresh()

    def _report(self, here: Part, failure: Exception | None = None) -> None:
        """Show why a slice cannot be autosaved, until it is autosaved or saved."""
        is_known = self._failures.pop(here, "")
        if failure is not None:
            self._failures[here] = sentence = (
                f"The work on '{here.title}' is not autosaved, so a crash would lose it: save it "
                "with 'Save study ...'. The recovery file could not be written: "
                f"{in_words(failure)}"
            )
            if not is_known:
                show_warning(sentence)
        shown = next(reversed(self._failures.values()), "")
        # A long path is wrapped between its folders.
        self._notice.show_text(shown.replace(os.sep, f"{os.sep}\u200b"), shown)

    def _open_recovered(self, file: Path) -> None:
        """Open a recovery file of a terminated process, and keep it until the work is saved."""
        self._files.add(file, reuse=True)
        here = self._session.slice
        self._work.forget(file)
        self._work.add(here)
        self._work.saved_files[here] = recovery.claim(file)
        self._files.opened.emit()


class RecoveryNotice(Notice):
    """Notice about work that was not saved, with buttons below it.

    It offers the work on images that were removed from this viewer, and the work that was not saved
    when napari ended.

    Parameters
    ----------
    work : UnsavedWork
    open_recovered : callable
        Opens a recovery file, and removes it from the files that the notice offers.
    """

    def __init__(self, work: UnsavedWork, open_recovered: Callable[[Path], None]) -> None:
        self._work, self._files = work, [Path()]
        opened = PushButton(text="Open it", tooltip="Open the work that was not saved")
        discarded = PushButton(text="Discard", tooltip="Move the file of this work to the trash")
        self._all = PushButton(text="Discard all")
        super().__init__(opened, discarded, self._all)
        opened.changed.connect(lambda _: open_recovered(self._files[0]))
        discarded.changed.connect(lambda _: self._discard(1))
        self._all.changed.connect(lambda _: self._discard(len(self._files)))
        for button in (opened, discarded, self._all):
            button.changed.connect(self.refresh)
        self.refresh()

    def refresh(self, *_: object) -> None:
        """Show the newest file, of a removed image if there is one, or hide the notice."""
        removed = [file for file in self._work.removed.values() if file.exists()]
        self._files = files = [*reversed(removed), *recovery.abandoned_files(folder())]
        text, about, number = "", "", len(files)
        if files:
            when = time.strftime("%d %b, %H:%M", time.localtime(files[0].stat().st_mtime))
            more = f" (and {number - 1} more)" if number > 1 else ""
            of = f" on '{name}'" if (name := image_named_in(files[0])) else ""
            shown = of if len(name) <= _WRAPPED else "\u200b".join(of)
            why = "before the image was deleted" if removed else "when napari ended"
            about = f"Work from {when}{of} was not saved {why}{more}."
            text = f"Unsaved work{shown}, {when}{more}"
        self.show_text(text, about)
        self._all.visible = number > 1
        self._all.tooltip = f"Move the files of all {number} studies to the trash"

    def _discard(self, number: int) -> None:
        for file in self._files[:number]:
            discard(file, self._work)


def discard(file: Path, work: UnsavedWork) -> None:
    """Move a recovery file to the system's trash, or delete the file if there is no trash."""
    work.forget(file)
    if not QFile(str(file)).moveToTrash():
        file.unlink(missing_ok=True)


def folder() -> Path:
    """Return the folder of the recovery files, next to the file of remembered settings."""
    return Path(settings().fileName()).parent / "unsaved"
