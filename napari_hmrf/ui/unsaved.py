"""Prompt about unsaved work before a window closes."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal

from napari.qt import QtViewer
from qtpy.QtCore import QEvent, QObject, QThread, QTimer
from qtpy.QtWidgets import QApplication, QMainWindow, QMessageBox, QWidget

from napari_hmrf.layers.compat import is_quitting, stop_quitting
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.study.session import Part
from napari_hmrf.ui.autosave import Autosave, discard
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.study_files import StudyFiles

Answer = Literal["save", "discard", "cancel"]
Prompt = Callable[[str], Answer]
#: `Unsaved` instances of all open docks.
_all: weakref.WeakSet[Unsaved] = weakref.WeakSet()


class Unsaved:
    """Prompt about the unsaved work of a viewer.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    controller : Controller
    files : StudyFiles
    autosave : Autosave
    attempt : callable
        Runs a given action, and reports the error if it fails.

    Attributes
    ----------
    viewer : napari.Viewer or ViewerModel
    prompt : callable
        Takes a question, and returns "save", "discard" or "cancel". The default shows a dialog.
    """

    def __init__(
        self,
        native: QWidget,
        viewer: Any,
        controller: Controller,
        files: StudyFiles,
        autosave: Autosave,
        attempt: Callable[[Callable[[], object]], None],
    ) -> None:
        self.viewer, self.prompt = viewer, self._show_prompt
        self._native, self._controller, self._try = native, controller, attempt
        self._files, self._autosave, self._undo = files, autosave, undo_of(viewer)
        self._work = self._undo.session.unsaved
        _all.add(self)

    @property
    def has_work(self) -> bool:
        """True if there is unsaved work."""
        return bool(self._work.slices)

    def may_close(self) -> bool:
        """Show the prompt about unsaved work; return whether the window may close."""
        slices, paths = self._work.slices, self._work.paths
        names = [f"'{part.title}'" for part in slices]
        replaced = [f"'{paths[part].name}'" for part in slices if part in paths]
        answer = self.prompt(
            f"The work on {' and '.join(names)} is not saved. Save it before closing?"
            + (f" Saving replaces {' and '.join(replaced)}." if replaced else "")
        )
        if answer == "discard":
            self.discard()
        elif answer == "save":
            for part in slices:
                self._save_slice(part)
        return answer != "cancel" and not self.has_work

    def discard(self) -> None:
        """Discard all unsaved work, with its recovery files."""
        for part in {*self._work.slices, *self._work.saved_files}:
            self._autosave.drop(part)

    def release(self) -> None:
        """Leave the prompt to another dock of the viewer, after this one was closed."""
        _all.discard(self)

    def _save_slice(self, part: Part) -> None:
        """Go to a slice or a volume, and save it to its known path, or to a path that is chosen."""
        self._undo.select_image_of(part)
        extent = self._controller.form.extent
        if part.plane and extent.has_slices:
            extent.value = "volume" if len(part.plane) == 3 else "slice"
        self._undo.go_to(part, turn=True)
        self._controller.refresh()
        known = self._work.paths.get(part)
        if self._undo.session.slice == part:  # False if another slice is still visible
            self._try(self._files.save_as if known is None else partial(self._files.save, known))

    def _show_prompt(self, question: str) -> Answer:
        button = QMessageBox.StandardButton
        answers: dict[Any, Answer] = {button.Save: "save", button.Discard: "discard"}
        offered = button.Save | button.Discard | button.Cancel
        window = self._native.window()  # may be behind the window that quits napari
        window.raise_()
        window.activateWindow()
        answer = QMessageBox.question(self._native, "Soft tissue", question, offered, button.Save)
        return answers.get(answer, "cancel")


class CloseGuard(QObject):
    """Event filter of all napari windows: prompts about unsaved work before a window closes.

    A window can quit napari even if it has no dock, and work remains unsaved after its dock was
    closed. The prompt is therefore shown for windows without a dock, too. If a script closes a
    viewer, no prompt is shown.
    """

    def __init__(self) -> None:
        app = QApplication.instance()
        super().__init__(app)
        app.focusWindowChanged.connect(self.watch)  # windows that are opened later

    def watch(self, *_: Any) -> None:
        """Filter the events of all windows before napari handles them."""
        for window, _viewer in _windows():
            window.installEventFilter(self)

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Handle the closing of a napari window before napari does."""
        if event.type() != QEvent.Type.Close:
            return False
        canvas = watched.findChild(QtViewer)
        if canvas.isHidden():
            # `Viewer.close` was called, by a script or because napari is quitting. The layers were
            # removed, so it is too late for a prompt; the recovery files remain.
            if _is_script():
                for each in [each for each in _all if each.viewer is canvas.viewer]:
                    each.discard()
            return False
        quitting = is_quitting(watched)
        closing = [viewer for window, viewer in _windows() if quitting or window is watched]
        work = [undo_of(viewer).session.unsaved for viewer in closing]
        unsaved = [viewer for viewer in closing if undo_of(viewer).session.unsaved.slices]
        if not all(_unsaved_of(viewer).may_close() for viewer in unsaved):
            stop_quitting(watched)
            event.ignore()
            return True
        for of_viewer in work:  # the dock has offered the work on images that were removed
            for file in [*of_viewer.removed.values()]:
                discard(file, of_viewer)
        if unsaved and event.spontaneous():
            event.ignore()  # napari would show its own prompt, too
            QTimer.singleShot(0, watched.close)
            return True
        return False


_guard: CloseGuard | None = None


def guard_windows() -> None:
    """Prompt about unsaved work before any napari window closes."""
    global _guard
    _guard = _guard or CloseGuard()
    _guard.watch()


def _windows() -> Iterator[tuple[QMainWindow, Any]]:
    """Iterate over the windows of napari, with their viewers."""
    for window in QApplication.topLevelWidgets():
        if isinstance(window, QMainWindow) and (canvas := window.findChild(QtViewer)) is not None:
            yield window, canvas.viewer


def _unsaved_of(viewer: Any) -> Unsaved:
    """Return the instance of an open dock; if all docks of the viewer were closed, open one."""
    if all(each.viewer is not viewer for each in _all):
        viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")
    return next(each for each in _all if each.viewer is viewer)


def _is_script() -> bool:
    """Return whether a script is running, with neither an event loop nor an interactive prompt."""
    return QThread.currentThread().loopLevel() == 0 and not hasattr(sys, "ps1")
