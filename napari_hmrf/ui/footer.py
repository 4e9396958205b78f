"""What always stays in sight: the buttons, how far the work is, and what there is to say."""

from __future__ import annotations

from magicgui.widgets import CheckBox, PushButton
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QPushButton, QSizePolicy, QVBoxLayout, QWhatsThis, QWidget

from napari_hmrf.layers.viewer_undo import ViewerUndo
from napari_hmrf.ui.forms import Prose, row

#: Lines of the status that are seen at most; its tooltip has all of it.
_LINES = 9
#: Dark words on amber: read on napari's dark theme and on its light one.
_CHIP = "background: #ffb454; color: #1d1d1d; border-radius: 8px; padding: 3px 8px;"
_HELP = (
    "Drag tissue: pull it. Click: hold it there. Drag an arrow's head or base: change it.\n"
    "Shift+click: select what was drawn. Delete: remove it. Esc: cancel.\n"
    "[ and ]: size. Hold Space: move the view. Hold Shift+B: the image as it was.\n"
    "While napari paints: 2 paints, 1 erases, 3 draws an outline, 4 fills.\n"
    "Ctrl+Z: undo. Ctrl+Shift+Z or Ctrl+Y: redo. Ctrl+Shift+P: all commands, by their words.\n"
)
#: So many pixels are followed without being asked. On two cores and no GPU the picture follows an
#: edit of 1200 x 1200 pixels in 0.4 s (elastic) to 1.4 s, and one of 2048 x 2048 in 1.6 to 5 s.
LARGEST = 1200 * 1200
_LIVE = (
    "The tissue follows any edit of tissue, boundary or tables; what is pulled, always.\n"
    "Off at first beyond 1200 x 1200 pixels, which without a graphics card take seconds an edit."
)


class Footer(QWidget):
    """Words and buttons; words are above and take no more room than they need.

    What can be pressed lies at the bottom and stays there, so nothing moves under the mouse.

    Parameters
    ----------
    tools : str
        Which keys the tools have.

    Attributes
    ----------
    deform, cancel : PushButton
    live : LiveChoice
    undo, redo : PushButton
        Their tooltips say what they would do.
    chip : QPushButton
        There only when there is something to know of the tissue that is seen.
    other : QPushButton
        There only when another model would mend it.
    """

    def __init__(self, tools: str = "") -> None:
        super().__init__()
        self.deform = PushButton(text="Deform", tooltip="Compute from nothing how the tissue moves")
        self.cancel = PushButton(text="Cancel", tooltip="Stop; nothing is changed")
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
        # magicgui's containers end with the last reference.
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
        """Show what there is to take back, and to do again."""
        self.undo.tooltip, self.redo.tooltip = undo.tooltips
        self.undo.enabled = undo.model.next_undo is not None
        self.redo.enabled = undo.model.next_redo is not None

    def say(self, status: str) -> None:
        """Show a sentence; what has no room is read where the mouse rests on it."""
        self._status.say(status)
        self._status.tooltip = status

    def _show_help(self, *_: object) -> None:
        button = self.help.native
        middle = button.mapToGlobal(button.rect().center())
        QWhatsThis.showText(middle, self.help.tooltip, button)  # there until a click or a key

    def explain(self, technical: str) -> None:
        """Show, where the mouse rests on the sentence, what few want to know of it."""
        self._status.tooltip = technical

    def warn(self, sentences: str, short: str = "") -> None:
        """Show what is to be known of the tissue that is seen; "" if nothing."""
        self.warning = sentences
        self.chip.setVisible(bool(sentences))
        self.chip.setText(f"⚠  {short or 'Good to know'}")
        self.chip.setToolTip(sentences)

    def offer(self, words: str) -> None:
        """Have a button for something that helps; "" if there is nothing."""
        self.other.setVisible(bool(words))
        self.other.setText(words)

    def show_work(self, going_on: bool) -> None:
        """Show whether there is anything to be cancelled before the next can begin."""
        self.deform.enabled, self.cancel.enabled = not going_on, going_on


class LiveChoice(CheckBox):
    """Whether every edit is followed: by default unless the image is large."""

    def __init__(self) -> None:
        super().__init__(value=True, text="Live", tooltip=_LIVE)
        # Once somebody has decided, the size of the image decides nothing.
        self._decided = False
        self.changed.connect(self._on_changed)

    def judge(self, pixels: int) -> None:
        """Decide by the size, unless somebody else has decided."""
        if not self._decided:
            with self.changed.blocked():
                self.value = pixels <= LARGEST

    def _on_changed(self, _: bool) -> None:
        self._decided = True
