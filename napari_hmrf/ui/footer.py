"""What always stays in sight: the buttons, how far the work is, and what there is to say."""

from __future__ import annotations

import math
import time
from typing import Any

from magicgui.widgets import CheckBox, PushButton
from napari.utils import progress as napari_progress
from qtpy.QtCore import QEvent, QObject, Qt
from qtpy.QtGui import QFontMetricsF
from qtpy.QtWidgets import (
    QFrame,
    QLabel,
    QProgressBar,
    QScrollArea,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from napari_hmrf.ui.forms import row
from napari_hmrf.ui.step_buttons import StepButtons

#: Lines of text that are seen without scrolling.
_LINES = 6
#: What napari's style may draw around them, in pixels.
_FRAME = 4
#: Work shorter than this is over before anybody has looked at napari's activity panel, in seconds.
_SHORT = 1.0
#: How often that panel is told: it has the whole window drawn each time.
_SELDOM = 0.5


class _WholeLines(QObject):
    """Keeps an area as high as so many lines of a label, of which none is cut."""

    # How high a line is, is known when the window's style has come to the label.

    def __init__(self, label: QLabel, area: QScrollArea, above: int) -> None:
        super().__init__(label)
        self._label, self._area, self._above = label, area, above
        label.installEventFilter(self)
        self._fit()

    def _fit(self) -> None:
        # Text that can be selected is laid out in whole pixels, the metrics' fractions rounded up.
        lines = _LINES * math.ceil(QFontMetricsF(self._label.font()).lineSpacing())
        self._area.setFixedHeight(lines + self._above + _FRAME)

    def eventFilter(self, watched: Any, event: Any) -> bool:
        if event.type() in (QEvent.Type.FontChange, QEvent.Type.StyleChange, QEvent.Type.Show):
            self._fit()
        return False


class Footer:
    """Buttons, bar and words; their height never changes, so nothing moves under the mouse."""

    def __init__(self) -> None:
        self.deform = PushButton(text="Deform", tooltip="Compute how the tissue moves")
        self.cancel = PushButton(text="Cancel", tooltip="Stop; nothing is changed")
        self.cancel.enabled = False
        self._buttons = row(self.deform, self.cancel)
        self._buttons.margins = (2, 2, 2, 2)
        self.live = CheckBox(text="Live", value=True)
        self.steps = StepButtons()
        self._follow = row(self.live, self.steps.undo, self.steps.redo)
        self._follow.margins = (2, 0, 2, 0)
        self._bar = QProgressBar()
        self._bar.setTextVisible(True)
        self._status, self._details = QLabel(), QLabel()
        self._activity: Any = None
        self._started = self._told = 0.0

    def build(self) -> QWidget:
        """Put it together."""
        footer = QWidget()
        layout = QVBoxLayout(footer)
        layout.setContentsMargins(2, 2, 2, 2)
        layout.setSpacing(2)
        layout.addWidget(self._follow.native)
        layout.addWidget(self._buttons.native)
        policy = self._bar.sizePolicy()
        policy.setRetainSizeWhenHidden(True)
        self._bar.setSizePolicy(policy)
        self._bar.hide()
        layout.addWidget(self._bar)
        words = QWidget()
        lines = QVBoxLayout(words)
        lines.setContentsMargins(6, 2, 6, 2)
        lines.setSpacing(3)
        for label in (self._status, self._details):
            label.setWordWrap(True)
            label.setAlignment(Qt.AlignmentFlag.AlignTop)
            label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
            lines.addWidget(label)
        lines.addStretch()
        self._details.setStyleSheet("font-size: 10px")
        area = QScrollArea()
        area.setFrameShape(QFrame.Shape.NoFrame)
        area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        area.setWidgetResizable(True)
        area.setWidget(words)
        self._whole_lines = _WholeLines(self._status, area, above=lines.contentsMargins().top())
        layout.addWidget(area)
        footer.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        return footer

    def say(self, status: str, details: str = "") -> None:
        """Show a sentence, and below it in small what few want to know."""
        self._status.setText(status)
        self._details.setText(details)
        self._details.setToolTip(details)

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
            activity = napari_progress(total=1000, desc="Deform tissue")
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
