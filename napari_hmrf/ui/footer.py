"""Footer of the dock: status text, warning and buttons, which are always visible."""

from __future__ import annotations

from magicgui.widgets import CheckBox, PushButton
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QPushButton, QSizePolicy, QVBoxLayout, QWhatsThis, QWidget

from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.ui.forms import Prose, row

#: Largest number of visible lines of the status; its tooltip has the whole text.
_LINES = 9
#: Dark text on amber: legible on napari's dark and light themes.
_CHIP = "background: #ffb454; color: #1d1d1d; border-radius: 8px; padding: 3px 8px;"
_HELP = (
    "Drag: pull tissue. Click: hold tissue in place. Drag an end of an arrow: change the arrow.\n"
    "Shift+click: select a mark. Delete: remove the selected mark. Esc: cancel.\n"
    "[ and ]: radius. While Space is pressed: move the view. While Shift+B is pressed: show the\n"
    "undeformed image.\n"
    "In a Labels layer of napari: 2 paints, 1 erases, 3 draws an outline, 4 fills.\n"
    "Ctrl+Z: undo. Ctrl+Shift+Z: redo. Ctrl+Shift+P: search all commands.\n"
)
#: Largest image, in pixels, for which *Live* is on by default. On two cores without a GPU, an
#: update takes 0.4 s (elastic) to 1.4 s for 1200 x 1200 pixels, and 1.6 s to 5 s for 2048 x 2048
#: pixels.
LARGEST = 1200 * 1200
_LIVE = (
    "Update the result after every edit to tissue, boundary or tables. Tools always update it.\n"
    "Off by default above 1200 x 1200 pixels: without a graphics card, each edit takes seconds."
)


class Footer(QWidget):
    """Status text and warning, with buttons below them.

    The height of the text fits its content. The buttons are at the bottom, so that they do not move
    under the mouse.

    Parameters
    ----------
    tools : str
        Text about the keys of the tools, appended to the help.

    Attributes
    ----------
    deform, cancel : PushButton
    live : LiveChoice
    undo, redo : PushButton
        Buttons; the tooltip names the step to undo or redo.
    chip : QPushButton
        Warning about the visible tissue; hidden if there is no warning.
    other : QPushButton
        Button that offers another model; hidden if no model is offered.
    """

    def __init__(self, tools: str = "") -> None:
        super().__init__()
        self.deform = PushButton(
            text="Deform", tooltip="Compute the motion of the tissue from scratch"
        )
        self.cancel = PushButton(text="Cancel", tooltip="Stop computing; nothing is changed")
        self.cancel.enabled = False
        self.live = LiveChoice()
        self.undo = PushButton(text="Undo", enabled=False)
        self.redo = PushButton(text="Redo", enabled=False)
        self.help = PushButton(text="?", tooltip=_HELP + tools)
        self.help.native.setFixedWidth(28)
        self.chip = QPushButton()
        self.other = QPushButton()
        self.warning = ""
        self._status = Prose(_LINES)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(2, 2, 2, 2)
        layout.setSpacing(2)
        # Keep a reference, because magicgui deletes unreferenced containers.
        self._rows = row(self.live, self.undo, self.redo, self.help), row(self.deform, self.cancel)
        self.chip.setStyleSheet(_CHIP)
        self.chip.hide()
        self.other.hide()
        words = self._status.native
        words.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        words.setContentsMargins(4, 0, 4, 0)
        for each in self._rows:
            each.margins = (2, 0, 2, 0)
        for part in (words, self.chip, self.other, *(each.native for each in self._rows)):
            layout.addWidget(part)
        self.help.changed.connect(self._show_help)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def show_steps(self, undo: ViewerUndo) -> None:
        """Show the next steps to undo and redo."""
        self.undo.tooltip, self.redo.tooltip = undo.tooltips
        self.undo.enabled = undo.model.next_undo is not None
        self.redo.enabled = undo.model.next_redo is not None

    def show_status(self, status: str) -> None:
        """Show a status text; the tooltip has the whole text in case it does not fit."""
        self._status.show_text(status)
        self._status.tooltip = status

    def _show_help(self, *_: object) -> None:
        button = self.help.native
        middle = button.mapToGlobal(button.rect().center())
        QWhatsThis.showText(middle, self.help.tooltip, button)  # stays until a click or a key press

    def explain(self, technical: str) -> None:
        """Show technical details in the tooltip of the status."""
        self._status.tooltip = technical

    def warn(self, sentences: str, short: str = "") -> None:
        """Show a warning about the visible tissue; "" hides it."""
        self.warning = sentences
        self.chip.setVisible(bool(sentences))
        self.chip.setText(f"⚠  {short or 'Note: show details'}")
        self.chip.setToolTip(sentences)

    def offer(self, words: str) -> None:
        """Show a button that offers another model; "" hides it."""
        self.other.setVisible(bool(words))
        self.other.setText(words)

    def show_work(self, is_working: bool) -> None:
        """Enable "Cancel" while a solve is in progress, otherwise "Deform"."""
        self.deform.enabled, self.cancel.enabled = not is_working, is_working


class LiveChoice(CheckBox):
    """Check box that enables a solve after every edit; on by default unless the image is large."""

    def __init__(self) -> None:
        super().__init__(value=True, text="Live", tooltip=_LIVE)
        # True once the user has clicked the box, or a script has set it.
        self._decided = False
        self.changed.connect(self._on_changed)

    def judge(self, pixels: int) -> None:
        """Set the default for this number of pixels, unless the value was set before."""
        if not self._decided:
            with self.changed.blocked():
                self.value = pixels <= LARGEST

    def _on_changed(self, _: bool) -> None:
        self._decided = True
