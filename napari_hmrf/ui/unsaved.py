"""Unsaved work: prompt before the window closes, and crash recovery."""

from __future__ import annotations

import logging
import os
import re
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

from magicgui.widgets import Container, PushButton
from napari.qt import QtViewer
from napari.utils.notifications import show_warning
from qtpy.QtCore import QEvent, QFile, QObject, Qt, QThread, QTimer
from qtpy.QtWidgets import (
    QApplication,
    QDialog,
    QFileDialog,
    QMainWindow,
    QMessageBox,
    QSizePolicy,
    QWidget,
)

from napari_hmrf.errors import CANNOT_SAVE, HmrfError
from napari_hmrf.field.frame import SlicePlace
from napari_hmrf.io import recovery
from napari_hmrf.io.study_file import (
    SUFFIX,
    image_named_in,
    overlay_named_in,
    read_study,
    second_image_named_in,
    write_study,
)
from napari_hmrf.layers.compat import is_quitting, stop_quitting
from napari_hmrf.layers.image_choice import is_same_image
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.read import study_layers
from napari_hmrf.layers.viewer_layers import layers_of
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.session import Part, UnsavedWork
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing.drawing import Drawing, ends_of
from napari_hmrf.ui import messages
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections, single_shot
from napari_hmrf.ui.forms import Prose, row
from napari_hmrf.ui.jobs import GuiThread
from napari_hmrf.ui.remembered_settings import settings

Answer = Literal["save", "discard", "cancel"]
Prompt = Callable[[str], Answer]
Attempt = Callable[[Callable[[], object]], None]
_log = logging.getLogger("napari_hmrf")
#: Characters that some systems do not allow in file names.
_NO_FILE_NAME = re.compile(r'[\\/:*?"<>|]')
#: Time without an edit after which a recovery file is written, in milliseconds.
_REST = 1000
#: Texts of notifications that a study was not saved; they are closed when a study is saved.
_NOT_SAVED = ("study cannot be saved", f"{SUFFIX}: {CANNOT_SAVE}", "is not autosaved")
#: Number of characters above which the name of an image may be wrapped between any two characters.
_WRAPPED = 20
#: `Unsaved` instances of all open docks.
_all: weakref.WeakSet[Unsaved] = weakref.WeakSet()
#: Unsaved work of each viewer that has or had a dock.
_works: weakref.WeakKeyDictionary[Any, UnsavedWork] = weakref.WeakKeyDictionary()


class Dock(Protocol):
    """Members of the dock that are used to save and open studies."""

    @property
    def native(self) -> QWidget:
        """Qt widget of the dock."""

    @property
    def image(self) -> Any:
        """Layer of the selected image, or None; can be set."""

    @image.setter
    def image(self, value: Any) -> None: ...

    @property
    def study(self) -> Study:
        """Study of the visible slice."""

    @property
    def solution(self) -> Solution | None:
        """Latest solution of the visible slice."""

    @property
    def status(self) -> str:
        """Status text of the dock."""

    @property
    def drawing(self) -> Drawing:
        """Drawing of the visible slice; can be set."""

    @drawing.setter
    def drawing(self, drawing: Drawing) -> None: ...

    def insert(self, key: int, widget: Container) -> None:
        """Insert a container into the dock."""

    def show_message(self, message: str) -> None:
        """Show a message."""

    def fit_view(self) -> None:
        """Fit all layers into the canvas."""

    def show_marks(self) -> None:
        """Start drawing if the study has marks."""


class Unsaved:
    """Manager that saves and opens the studies of a dock, and protects unsaved work.

    Parameters
    ----------
    dock : Dock
    viewer : napari.Viewer or ViewerModel
    controller : Controller
    attempt : callable
        Runs a given action, and reports the error if it fails.

    Attributes
    ----------
    prompt : callable
        Takes a question, and returns "save", "discard" or "cancel". The default shows a dialog.
    """

    def __init__(self, dock: Dock, viewer: Any, controller: Controller, attempt: Attempt) -> None:
        self.prompt: Prompt = self._show_prompt
        self._try = attempt
        self._dock, self._viewer, self._controller = dock, viewer, controller
        self._binding, self._undo = controller.binding, undo_of(viewer)
        self._session = self._undo.session
        self._work = self._session.unsaved
        self._writer = threading.Thread()
        self._keep_timer = single_shot(dock.native, _REST, self._keep)
        # Image of an opened study, and the name of its second image, until this is in the viewer.
        self._awaited: tuple[Any, str] = None, ""
        # Deferred, because the menus list a new layer later.
        self._second_timer = single_shot(dock.native, 0, self._choose_second)
        self._connections = EventConnections(
            (self._session.changed, self._on_edited),
            (viewer.layers.events.inserted, self._on_images),
            (self._session.selected, self._on_images),
            (controller.form.result.second.changed, self._on_images),
        )
        self._gui = GuiThread()
        self._autosave = AutosaveNotice()
        self._missing = MissingImageNotice()
        dock.insert(0, self._missing)
        dock.insert(0, self._autosave)
        dock.insert(0, RecoveryNotice(lambda file: attempt(partial(self._open_recovered, file))))
        _all.add(self)
        _works[viewer] = self._work

    @property
    def viewer(self) -> Any:
        """Viewer of the dock."""
        return self._viewer

    @property
    def has_work(self) -> bool:
        """True if there is unsaved work."""
        return bool(self._work.slices)

    # Files

    def save(self, path: str | Path) -> Path:
        """Save the current study, with the displayed field if it belongs to the study.

        The field of a solve that is still being continued is saved, too.
        """
        study = self._dock.study
        solution = self._dock.solution if self._session.shows(study) else None
        written = write_study(path, study, solution, overlay=self._overlay, second=self._second)
        apart, here = self._landmarks_apart(study), self._session.slice
        has_slices = self._controller.form.extent.has_slices
        extent = messages.extent_name(study.grid.known_place.slice_seen) if has_slices else ""
        others = [
            messages.extent_name(part.place.name)
            for part in self._work.slices
            if part.layer is here.layer and part != here and part.place is not None
        ]
        solved = solution is not None
        self._dock.show_message(messages.saved_study(written.name, extent, solved, apart, others))
        self._drop_recovery(here, written)
        _close_notifications(self._dock.native.window(), _NOT_SAVED)
        return written

    @property
    def _overlay(self) -> str:
        """Overlay of the window, or "" if it needs a layer that is not in the file."""
        chosen = self._session.display.overlay
        return "" if chosen in ("difference", "uncertainty") else chosen

    @property
    def _second(self) -> str:
        """Name of the second image, or of the one that the opened study still lacks; or ""."""
        chosen = self._controller.form.result.second.value
        if chosen is not None:
            return str(chosen.name)
        image, name = self._awaited
        return name if image is self._dock.image else ""

    def _on_images(self, *_: Any) -> None:
        """Choose the missing second image once the menus list a new layer."""
        self._second_timer.start()

    def _choose_second(self) -> None:
        """Choose the second image that an opened study names, once it is in the viewer."""
        (image, name), second = self._awaited, self._controller.form.result.second
        if name and image is self._session.image and second.value is None:
            named = [layer for layer in second.offered if layer.name == name]
            if named:
                with self._binding.automatically():
                    second.value = named[-1]
                self._awaited = None, ""
        self._missing.show_name(self._second if second.value is None else "")

    def _landmarks_apart(self, study: Study) -> str:
        """Return the name of the landmark layer if any of its pairs was not added, else ""."""
        form, grid = self._controller.form, study.grid
        where, should = form.motion.boundary.landmarks.pair
        taken = [ends_of(mark, grid.spacing) for mark in study.motion.drawing.marks]
        if where is None:
            return ""
        try:
            chosen = read_landmarks(
                where, should, grid.known_place, grid.shape, self._controller.view
            )
        except HmrfError:  # reported when the landmarks are added
            return ""
        return where.name if any((mark.target, mark.source) not in taken for mark in chosen) else ""

    def save_as(self) -> None:
        """Prompt for a file name, and save the study."""
        slice_part = self._session.slice
        name = "study" if slice_part.layer is None else _NO_FILE_NAME.sub("-", _name(slice_part))
        known = self._work.paths.get(slice_part, Path(name + SUFFIX))
        chosen, _ = QFileDialog.getSaveFileName(
            self._dock.native, "Save the study", str(known), f"Studies (*{SUFFIX})"
        )
        if chosen:
            self.save(chosen)

    def open(self, path: str | Path) -> None:
        """Add the layers of a saved study, and keep the drawings on other layers."""
        self._add(path)
        self._binding.begin()  # images that are opened later do not replace that of the study
        self._drop_recovery(self._session.slice, Path(path))

    def _add(self, path: str | Path, reuse: bool = False) -> None:
        """Add the content of a file to the viewer, without undo steps for its layers.

        If `reuse` is True, an open image without a drawing is used instead of an equal image of
        the file.
        """
        (study, solution), dock = read_study(path), self._dock
        if solution is not None:
            self._controller.engine.start_from(solution)
        layers = study_layers(study)
        if reuse and "image" in layers:
            layers["image"] = self._undrawn_image(layers["image"]) or layers["image"]
        written = layers_of(self._viewer)
        with self._binding.automatically():
            for layer in layers.values():
                if layer in self._viewer.layers:
                    written.want(layer)
                else:
                    written.add(layer, select=True)
            if (frame := study.grid.place) is not None:
                first = next(iter(layers.values()))
                place = SlicePlace(frame.plane, (0,) * first.ndim)
                self._undo.go_to(Part("drawing", first, place), turn=True)
            self._session.restore(study, layers)
            drawing, measured = study.motion.drawing, study.motion.measured
            if measured is not None or drawing.marks:
                is_read = self._controller.refresh()  # selects the slice
                if drawing.marks and not is_read:
                    raise HmrfError(f"{Path(path).name} cannot be shown here: {dock.status}")
            if solution is not None:  # known before the motion starts a solve
                shown = dock.study
                motion = replace(shown.motion, drawing=drawing, measured=measured)
                self._controller.engine.deliver_again(replace(shown, motion=motion), solution)
            if measured is not None:
                self._session.set_measured(measured)
            dock.drawing = drawing
        if (brightness := self._controller.curve_layer.layer) is not None and study.moves:
            written.want(brightness, wanted=False)  # would tint the deformed image
        if (name := overlay_named_in(path)) in self._controller.form.result.overlay.choices:
            self._session.choose_display(overlay=name)
        self._awaited = self._session.image, second_image_named_in(path)
        self._choose_second()
        self._missing.show_name(self._awaited[1])
        dock.fit_view()

    def _undrawn_image(self, image: Any) -> Any:
        """Return an open image that equals a layer and has no drawing, or None."""
        parts = [each for each in self._session.parts if each.kind == "drawing"]
        drawn = {each.layer for each in parts if self._session.get(each).marks}
        for layer in self._viewer.layers:
            if layer not in drawn and is_same_image(layer, image):
                return layer
        return None

    def _on_edited(self, part: Part, _: object, before: object) -> None:
        session = self._session
        others = part.kind == "paint" and part.layer not in session.choice.layers
        if part.kind in ("choice", "model") or others:
            return  # easy to choose again, or not part of the study
        slice_part = part if part.kind == "drawing" else session.slice
        # An automatic change, such as the choice of a new layer, is not an undo step.
        steps = (session.next_undo, session.next_redo)
        by_hand = any(step is not None and step.part == part for step in steps)
        if slice_part.layer is not None and by_hand:
            self._work.note(slice_part, part, before)
            self._keep_timer.start()

    def _drop_recovery(self, slice_part: Part, path: Path | None = None) -> None:
        """Delete the recovery file of a slice that was saved or discarded."""
        self._work.save(slice_part)
        self._autosave.report(slice_part)
        if path is not None:
            self._work.paths[slice_part] = path
        if self._writer.is_alive():
            self._writer.join()
        if (kept := self._work.saved_files.pop(slice_part, None)) is not None:
            kept.unlink(missing_ok=True)

    # Before the window closes

    def may_close(self) -> bool:
        """Show the prompt about unsaved work; return whether the window may close."""
        slices, paths = self._work.slices, self._work.paths
        names = [f"'{_name(part)}'" for part in slices]
        replaced = [f"'{paths[part].name}'" for part in slices if part in paths]
        answer = self.prompt(
            f"The work on {' and '.join(names)} is not saved. Save it before closing?"
            + (f" Saving replaces {' and '.join(replaced)}." if replaced else "")
        )
        if answer == "discard":
            self.discard()
        elif answer == "save":
            for part in self._work.slices:
                self._save_slice(part)
        return answer != "cancel" and not self.has_work

    def _save_slice(self, part: Part) -> None:
        """Go to a slice or a volume, and save it to its known path, or to a path that is chosen."""
        self._undo.select_image_of(part)
        extent = self._controller.form.extent
        if part.place is not None and extent.has_slices:
            extent.value = "volume" if len(part.place.plane) == 3 else "slice"
        self._undo.go_to(part, turn=True)
        self._controller.refresh()
        known = self._work.paths.get(part)
        if self._session.slice == part:  # False if another slice is still visible
            self._try(self.save_as if known is None else partial(self.save, known))

    def _show_prompt(self, question: str) -> Answer:
        button = QMessageBox.StandardButton
        answers: dict[Any, Answer] = {button.Save: "save", button.Discard: "discard"}
        offered = button.Save | button.Discard | button.Cancel
        window = self._dock.native.window()  # may be behind the window that quits napari
        window.raise_()
        window.activateWindow()
        answer = QMessageBox.question(
            self._dock.native, "Soft tissue", question, offered, button.Save
        )
        return answers.get(answer, "cancel")

    def discard(self) -> None:
        """Discard all unsaved work, with its recovery files."""
        for part in {*self._work.slices, *self._work.saved_files}:
            self._drop_recovery(part)

    # Crash recovery

    def _keep(self) -> None:
        """Write the current slice to a recovery file, once no edit is in progress."""
        is_pressed = QApplication.mouseButtons() != Qt.MouseButton.NoButton
        if is_pressed or self._session.in_progress is not None or self._writer.is_alive():
            self._keep_timer.start()
        else:
            self._write_recovery()

    def _write_recovery(self) -> None:
        """Write the recovery file of the current slice, or delete it if all edits were undone."""
        slice_part = self._session.slice
        if slice_part not in self._work.slices:
            self._drop_recovery(slice_part)  # all edits were undone
        else:
            study = self._controller.reader.read_partly(self._session.study)
            if study is None:
                return
            try:
                file = self._work.saved_files.get(slice_part) or recovery.new_file(folder())
            except OSError as error:
                self._autosave.report(slice_part, error)
                return
            self._work.saved_files[slice_part] = file
            self._writer = threading.Thread(
                target=self._write,
                args=(slice_part, file, study, self._overlay, self._second),
                daemon=True,
            )
            self._writer.start()

    def _write(self, slice_part: Part, file: Path, study: Study, overlay: str, second: str) -> None:
        """Write a recovery file, and report on the GUI thread if this failed."""
        failure: Exception | None = None
        try:
            write_study(file, study, overlay=overlay, second=second)
        except (OSError, TypeError, ValueError) as error:
            _log.exception("the recovery file of unsaved work could not be written")
            failure = error
        self._gui.submit(partial(self._on_written, slice_part, failure))

    def _on_written(self, slice_part: Part, failure: Exception | None) -> None:
        is_saved = slice_part not in self._work.slices
        self._autosave.report(slice_part, None if is_saved else failure)

    def _open_recovered(self, file: Path) -> None:
        """Open a recovery file of a terminated process, and keep it until the work is saved."""
        self._add(file, reuse=True)
        slice_part = self._session.slice
        self._work.note(slice_part)
        self._work.saved_files[slice_part] = recovery.claim(file)
        self._dock.show_marks()

    def keep_now(self) -> None:
        """Write the recovery file of the latest edits, before the dock closes."""
        if self._keep_timer.isActive():
            self._session.end()
            if self._writer.is_alive():
                self._writer.join()
            self._write_recovery()

    def release(self) -> None:
        """Disconnect from edits after the dock was closed or its window was deleted."""
        _all.discard(self)
        self._connections.release()
        self._keep_timer.stop()
        self._second_timer.stop()
        self._gui.release()


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
        unsaved = [viewer for viewer in closing if viewer in _works and _works[viewer].slices]
        if not all(_unsaved_of(viewer).may_close() for viewer in unsaved):
            stop_quitting(watched)
            event.ignore()
            return True
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


def _close_notifications(window: QWidget, texts: Iterable[str]) -> None:
    """Close the notifications of napari that contain one of some texts.

    napari closes a notification after some seconds, but only if the window is active.
    """
    for dialog in window.findChildren(QDialog):
        if type(dialog).__name__ == "NapariQtNotification":
            words = dialog.message.text()
            if any(text in words for text in texts):
                dialog.close()


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


class RecoveryNotice(Container):
    """Notice about work that was not saved when napari ended, with two buttons beside it.

    Parameters
    ----------
    open_recovered : callable
        Opens a recovery file, and removes it from the files that the notice offers.
    """

    def __init__(self, open_recovered: Callable[[Path], None]) -> None:
        self._file = Path()
        self._text = Prose()
        opened = PushButton(text="Open it", tooltip="Open the work that was not saved")
        discarded = PushButton(text="Discard", tooltip="Move the file of this work to the trash")
        line = row(self._text, opened, discarded)
        line.margins = (0, 0, 0, 0)
        for button in (opened, discarded):
            button.native.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        super().__init__(widgets=[line], labels=False)
        self.margins = (4, 0, 0, 0)
        opened.changed.connect(partial(self._on_pressed, open_recovered))
        discarded.changed.connect(partial(self._on_pressed, _discard))
        self.refresh()

    def refresh(self) -> None:
        """Show the newest recovery file of a terminated process, or hide the notice."""
        files, text, about = recovery.abandoned_files(folder()), "", ""
        if files:
            self._file = files[0]
            when = time.strftime("%d %b, %H:%M", time.localtime(self._file.stat().st_mtime))
            more = f" (and {len(files) - 1} more)" if len(files) > 1 else ""
            of = f" on '{name}'" if (name := image_named_in(files[0])) else ""
            shown = of if len(name) <= _WRAPPED else "\u200b".join(of)
            about = f"Work from {when}{of} was not saved when napari ended{more}."
            text = f"Unsaved work{shown}, {when}{more}"
        self.visible = bool(files)
        self._text.show_text(text)
        self._text.tooltip = about

    def _on_pressed(self, answer: Callable[[Path], None], _: bool) -> None:
        answer(self._file)
        self.refresh()


class AutosaveNotice(Container):
    """Notice about unsaved work that cannot be autosaved, with the reason.

    It remains until the work is autosaved or saved.
    """

    def __init__(self) -> None:
        self._text = Prose()
        super().__init__(widgets=[self._text], labels=False)
        self.margins = (4, 0, 0, 0)
        self._sentences: dict[Part, str] = {}
        self.visible = False

    def report(self, part: Part, failure: Exception | None = None) -> None:
        """Show why a slice cannot be autosaved; without a failure, remove the slice."""
        sentence = self._sentences.pop(part, "")
        if failure is not None:
            is_known, sentence = bool(sentence), messages.not_autosaved(_name(part), failure)
            self._sentences[part] = sentence
            if not is_known:
                show_warning(sentence)
        shown = next(reversed(self._sentences.values()), "")
        # A long path is wrapped between its folders.
        self._text.show_text(shown.replace(os.sep, f"{os.sep}\u200b"))
        self._text.tooltip = shown
        self.visible = bool(shown)


class MissingImageNotice(Container):
    """Notice that asks for the second image of an opened study.

    It remains until a second image or another image is chosen.
    """

    def __init__(self) -> None:
        self._text = Prose()
        super().__init__(widgets=[self._text], labels=False)
        self.margins = (4, 0, 0, 0)
        self.show_name("")

    def show_name(self, name: str) -> None:
        """Ask for an image; "" hides the notice."""
        self._text.show_text(messages.SECOND_IMAGE.format(name) if name else "")
        self.visible = bool(name)


def _discard(file: Path) -> None:
    """Move a file to the system's trash, or delete the file if there is no trash."""
    if not QFile(str(file)).moveToTrash():
        file.unlink(missing_ok=True)


def folder() -> Path:
    """Return the folder of the recovery files, next to the file of remembered settings."""
    return Path(settings().fileName()).parent / "unsaved"


def _name(part: Part) -> str:
    """Return the name of an image, with the slice if the image has several slices."""
    return f"{part.layer.name} {'' if part.place is None else part.place.name}".strip()
