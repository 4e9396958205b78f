"""Strip at the bottom of the dock: result, warning, status text and buttons, always visible."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import Container, PushButton
from qtpy.QtCore import Qt
from qtpy.QtWidgets import (
    QHBoxLayout,
    QMenu,
    QProgressBar,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWhatsThis,
    QWidget,
)

from napari_hmrf.compute.compile_cache.stage import Progress
from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.ui.forms import ElidedButton, FixedText, row
from napari_hmrf.ui.messages import ABOUT_PRECISELY, DEFORM

#: Number of lines of the status.
_LINES = 3
#: Dark text on amber: legible on napari's dark and light themes.
_CHIP = "background: #ffb454; color: #1d1d1d; border-radius: 8px; padding: 4px;"
_HELP = (
    "Drag: pull tissue. Click: hold tissue in place. Drag an end of an arrow: change the arrow.\n"
    "Shift+click: select a mark. Delete: remove the selected mark. Esc: cancel.\n"
    "[ and ]: radius. While Space is pressed: move the view. While Shift+B is pressed: show the\n"
    "undeformed image.\n"
    "In a Labels layer of napari: 2 paints, 1 erases, 3 draws an outline, 4 fills.\n"
    "Ctrl+Z: undo. Ctrl+Shift+Z: redo. Ctrl+Shift+P: search all commands.\n"
)
#: Entries of the menu *Clear*, with their tooltips.
_CLEAR = {
    "Remove the selected mark": "Also: the Delete key. Shift+click selects a mark.",
    "Remove all marks": "Remove all marks of this slice or volume",
    "Reset the study ...": "Remove all marks of this study and restore the default settings, after "
    "a question; layers and tables are kept. Undo restores everything.",
}
_PREPARATION = (
    "The solver is translated for the processor of this computer. You can work meanwhile: only\n"
    "what needs a part that is not ready yet waits for it. The next start needs no preparation."
)


class Footer(QWidget):
    """Result, warning, status text and buttons; the height is fixed, so that nothing moves.

    Only the preparation of a new computer, at the bottom, disappears once it is complete.

    Parameters
    ----------
    result : Container
        Controls of the displayed result, shown on top.
    files : Container
        Row of buttons for files, shown at the bottom.
    tools : str
        Text about the keys of the tools, appended to the help.

    Attributes
    ----------
    deform : PushButton
        Button that solves; visible unless every edit is solved at once.
    cancel : PushButton
        Button that stops the work; visible during work that takes long.
    undo, redo : PushButton
        Buttons; the tooltip names the step to undo or redo.
    clear : QPushButton
        Button of the menu with the next three entries.
    remove, remove_all, reset : QAction
        Entries that remove the selected mark, remove all marks, and reset the study.
    chip : QPushButton
        Warning about the visible tissue; hidden if there is no warning.
    other : QPushButton
        Button that offers another model; hidden if no model is offered.
    preparation : QProgressBar
        Progress of the preparation of the computer; hidden if nothing is prepared.
    """

    def __init__(self, result: Container, files: Container, tools: str = "") -> None:
        super().__init__()
        self.deform = PushButton(text=DEFORM, tooltip=ABOUT_PRECISELY)
        self.cancel = PushButton(text="Cancel", tooltip="Stop computing; nothing is changed")
        policy = self.cancel.native.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        self.cancel.native.setSizePolicy(policy)
        self.undo = PushButton(text="Undo", enabled=False)
        self.redo = PushButton(text="Redo", enabled=False)
        self.clear = QPushButton("Clear")
        self.clear.setToolTip("Remove marks, or reset the study")
        entries = QMenu(self.clear)
        entries.setToolTipsVisible(True)
        self.remove, self.remove_all, self.reset = (entries.addAction(each) for each in _CLEAR)
        for entry, about in zip(entries.actions(), _CLEAR.values(), strict=True):
            entry.setToolTip(about)
            entry.setEnabled(False)
        self.clear.setMenu(entries)
        self.help = PushButton(text="?", tooltip=_HELP + tools)
        self.help.native.setFixedWidth(28)
        self.help.native.setAccessibleName("Help")
        self.chip = ElidedButton()
        self.other = QPushButton()
        self.preparation = QProgressBar()
        self.preparation.setToolTip(_PREPARATION)
        self.preparation.hide()
        self.warning = ""
        self._status = FixedText(_LINES)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(2, 2, 2, 2)
        layout.setSpacing(2)
        # Keep a reference, because magicgui deletes unreferenced containers.
        steps = row(self.undo, self.redo, self.cancel, self.help)
        steps.native.layout().insertWidget(2, self.clear)
        self._rows = (steps, row(self.deform), files, result)
        self.chip.setStyleSheet(_CHIP)
        self.chip.hide()
        self.other.hide()
        self._status.setContentsMargins(4, 0, 4, 0)
        for each in self._rows:
            each.margins = (2, 0, 2, 0)
        below = (self._status, *(each.native for each in self._rows[:-1]))
        for part in (result.native, self._warnings(), *below, self.preparation):
            layout.addWidget(part)
        self.help.changed.connect(self._show_help)
        self.show_update(False)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def _warnings(self) -> QWidget:
        """Return the row of the warning and the offer, which keeps its height without them."""
        place = QWidget()
        beside = QHBoxLayout(place)
        beside.setContentsMargins(4, 0, 4, 0)
        beside.setSpacing(2)
        policy = self.chip.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        self.chip.setSizePolicy(policy)
        beside.addWidget(self.chip, 1)
        beside.addWidget(self.other)
        beside.setAlignment(self.other, Qt.AlignmentFlag.AlignRight)
        return place

    def show_steps(self, undo: ViewerUndo, image: Any = None) -> None:
        """Show the next steps to undo and redo, with their image if it is not `image`."""
        self.undo.tooltip, self.redo.tooltip = undo.tooltips(image)
        self.undo.enabled = undo.session.next_undo is not None
        self.redo.enabled = undo.session.next_redo is not None

    def show_status(self, status: str) -> None:
        """Show a status text; the tooltip has the whole text in case it does not fit."""
        self._status.show_text(status)

    def _show_help(self, *_: object) -> None:
        button = self.help.native
        middle = button.mapToGlobal(button.rect().center())
        QWhatsThis.showText(middle, self.help.tooltip, button)  # stays until a click or a key press

    def show_deform(self, is_shown: bool) -> None:
        """Show the button that solves, if edits are not solved at once."""
        self._rows[1].visible = is_shown

    def explain(self, technical: str) -> None:
        """Show technical details below the status in its tooltip."""
        self._status.setToolTip(f"{self._status.value}\n{technical}")

    def warn(self, sentences: str, short: str = "") -> None:
        """Show a warning about the visible tissue with a short label; "" hides it."""
        self.warning = sentences
        self.chip.setVisible(bool(sentences))
        self.chip.setText(f"⚠  {short}")
        self.chip.setToolTip(sentences)

    def offer(self, words: str, about: str = "") -> None:
        """Show a button that offers another model, with a tooltip; "" hides it."""
        self.other.setVisible(bool(words))
        self.other.setText(words)
        self.other.setToolTip(about)

    def show_preparation(self, progress: Progress | None) -> None:
        """Show the progress of the preparation of the computer; None hides it."""
        self.preparation.setVisible(progress is not None)
        if progress is not None:
            self.preparation.setValue(round(self.preparation.maximum() * progress.fraction))
            self.preparation.setFormat(f"{progress.words[0].upper()}{progress.words[1:]}")

    def show_work(self, is_working: bool) -> None:
        """Show "Cancel" while a solve is in progress; otherwise, enable "Deform"."""
        self.deform.enabled = not is_working
        self.show_update(is_working)

    def show_update(self, is_working: bool) -> None:
        """Show "Cancel" during an update after an edit; offers wait for its result."""
        self.cancel.visible = self.cancel.enabled = is_working
        self.other.setEnabled(not is_working)
