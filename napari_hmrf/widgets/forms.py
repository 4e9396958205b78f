"""What forms need that magicgui's containers do not bring: sentences, and labels in one column."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import Container, Label
from qtpy.QtCore import QEvent, QObject
from qtpy.QtWidgets import QSizePolicy


class Prose(Label):
    """A sentence that wraps: narrower than its words, and then as high as it takes."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        words = self.native
        words.setWordWrap(True)
        words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self._fit = _FitHeight(words)
        words.installEventFilter(self._fit)

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        self.value = sentence
        self._fit.fit()


class _FitHeight(QObject):
    """Keeps a label's height that of its words: layouts in a scrolled area do not ask for it."""

    def fit(self) -> None:
        words: Any = self.parent()
        words.setMinimumHeight(max(0, words.heightForWidth(words.width())))  # -1: no words

    def eventFilter(self, watched: Any, event: Any) -> bool:
        if event.type() in (QEvent.Type.Resize, QEvent.Type.FontChange, QEvent.Type.StyleChange):
            self.fit()
        return False


def align_labels(form: Container) -> None:
    """Give a form's labels one width: magicgui does so only when one of them changes."""
    first = form[0]
    first.label = first.label
