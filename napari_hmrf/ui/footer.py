"""What always stays in sight: the buttons, how far the work is, and what there is to say."""

from __future__ import annotations

import time
from typing import Any

from magicgui.widgets import CheckBox, PushButton
from napari.utils import progress as napari_progress
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QLabel, QProgressBar, QPushButton, QSizePolicy, QVBoxLayout, QWidget

from napari_hmrf.ui.forms import row
from napari_hmrf.ui.step_buttons import StepButtons

#: Lines of the status that are seen; its tooltip has all of it.
_LINES = 5
#: Work shorter than this is over before anybody has looked at napari's activity panel, in seconds.
_SHORT = 1.0
#: How often that panel is told: it has the whole window drawn each time.
_SELDOM = 0.5
#: Dark words on amber: read on napari's dark theme and on its light one.
_CHIP = "background: #ffb454; color: #1d1d1d; border-radius: 8px; padding: 3px 8px;"
_HELP = (
    "Drag tissue: pull it. Click: hold it there. Drag an arrow's head or base: change it.\n"
    "Shift+click: select what was drawn. Delete: remove it. Esc: cancel.\n"
    "[ and ]: size. Hold Space: move the view. Hold Shift+B: the image as it was.\n"
    "While napari paints: 2 paints, 1 erases, 3 draws an outline, 4 fills.\n"
    "Ctrl+Z: undo. Ctrl+Shift+Z or Ctrl+Y: redo. Ctrl+Shift+P: all commands, by their words.\n"
)


class Footer:
    """Buttons, bar and words; their height never changes, so nothing moves under the mouse.

    Parameters
    ----------
    tools : str
        Which keys the tools have.

    Attributes
    ----------
    deform, cancel : PushButton
    live : CheckBox
    steps : StepButtons
    chip : QPushButton
        There only when there is something to know of the tissue that is seen.
    """

    def __init__(self, tools: str = "") -> None:
        self.deform = PushButton(text="Deform", tooltip="Compute from nothing how the tissue moves")
        self.cancel = PushButton(text="Cancel", tooltip="Stop; nothing is changed")
        self.cancel.enabled = False
        self.live = CheckBox(text="Live", value=True)
        self.steps = StepButtons()
        self.help = PushButton(text="?", tooltip=_HELP + tools)
        self.help.native.setFixedWidth(28)
        self.chip = QPushButton()
        self.warning = ""
        self._bar = QProgressBar()
        self._status, self._details = QLabel(), QLabel()
        self._rows = [
            row(self.live, self.steps.undo, self.steps.redo, self.help),
            row(self.deform, self.cancel),
        ]
        self._activity: Any = None
        self._started = self._told = 0.0

    def build(self) -> QWidget:
        """Put it together."""
        footer = QWidget()
        layout = QVBoxLayout(footer)
        layout.setContentsMargins(2, 2, 2, 2)
        layout.setSpacing(2)
        for each in self._rows:
            each.margins = (2, 0, 2, 0)
            layout.addWidget(each.native)
        self.chip.setStyleSheet(_CHIP)
        self._bar.setFixedHeight(12)
        for kept in (self._bar, self.chip):
            policy = kept.sizePolicy()
            policy.setRetainSizeWhenHidden(True)
            kept.setSizePolicy(policy)
            kept.hide()
            layout.addWidget(kept)
        for label, lines, more in ((self._status, _LINES, 4), (self._details, 1, 10)):
            label.setWordWrap(True)
            label.setAlignment(Qt.AlignmentFlag.AlignTop)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
            label.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
            label.setFixedHeight(lines * label.fontMetrics().lineSpacing() + more)
            label.setContentsMargins(4, 0, 4, 0)
            layout.addWidget(label)
        self.help.changed.connect(lambda _: self.say(self.help.tooltip))
        footer.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        return footer

    def say(self, status: str) -> None:
        """Show a sentence."""
        self._status.setText(status)
        self._status.setToolTip(status)

    def explain(self, technical: str) -> None:
        """Show, where the mouse rests on the sentence, what few want to know of it."""
        self._status.setToolTip(technical)

    def tell(self, brief: str, details: str = "") -> None:
        """Show a line about a result, and where the mouse rests on it what few want to know."""
        self._details.setText(brief)
        self._details.setToolTip(details)

    def warn(self, sentences: str, short: str = "") -> None:
        """Show what is to be known of the tissue that is seen; "" if nothing."""
        self.warning = sentences
        self.chip.setVisible(bool(sentences))
        self.chip.setText(f"⚠  {short or 'Good to know'}")
        self.chip.setToolTip(sentences)

    def start(self, status: str) -> None:
        """Show at once that work begins, though the window may be busy for a moment yet."""
        self._started = time.monotonic()
        self.deform.enabled, self.cancel.enabled = False, True
        self._bar.setRange(0, 0)
        self._bar.show()
        self.say(status)
        for widget in (self.deform.native, self.cancel.native, self._status):
            widget.repaint()

    def progress(self, fraction: float) -> None:
        """Show how far the work is; nobody knows while nothing of it is done.

        Napari's own bar lets Qt answer whatever waits, so the work may be over afterwards.
        """
        done = round(1000 * fraction)
        self._bar.setRange(0, 1000 if done else 0)
        self._bar.setValue(done)
        now = time.monotonic()
        if now - self._started < _SHORT or now - self._told < _SELDOM:
            return
        self._told = now
        if self._activity is None:
            activity = napari_progress(total=1000, desc="Soft tissue")
            if self.cancel.enabled:
                self._activity = activity
            else:
                activity.close()
        elif done > self._activity.n:
            self._activity.update(done - self._activity.n)

    def following(self, slowly: bool) -> None:
        """Show that an edit is being followed, and takes a while; or that it is not."""
        if self.deform.enabled and self.cancel.enabled != slowly:
            self.cancel.enabled = slowly

    def stop(self) -> None:
        """Show that nothing is going on."""
        self.deform.enabled, self.cancel.enabled = True, False
        self._bar.hide()
        activity, self._activity = self._activity, None
        if activity is not None:
            activity.close()
