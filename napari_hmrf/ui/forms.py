"""What forms need that magicgui's containers do not bring: sentences, and labels in one column."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import Container, FloatSlider, Label
from qtpy.QtCore import QEvent, QObject, Qt
from qtpy.QtWidgets import QFrame, QScrollArea, QSizePolicy

#: The lowest confidence that is asked for; below, it says nothing.
LEAST_CONFIDENCE = 0.05


def confidence_slider(tooltip: str) -> FloatSlider:
    """A field for how sure something is; it speaks when the mouse lets go."""
    return FloatSlider(
        value=1.0,
        min=LEAST_CONFIDENCE,
        max=1.0,
        step=0.05,
        tracking=False,
        label="confidence",
        tooltip=tooltip,
    )


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


def put_scrolled(outer: Container, body: Container, width: int) -> None:
    """Put a form into a dock widget that may be lower than the form is, but no narrower.

    Parameters
    ----------
    outer : Container
        The dock widget.
    body : Container
        The form; the dock widget has to keep it.
    width : int
        The least width, in pixels.
    """
    scroll = QScrollArea()
    scroll.setWidgetResizable(True)
    scroll.setFrameShape(QFrame.Shape.NoFrame)
    scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    scroll.setWidget(body.native)
    scroll.setMinimumWidth(width)
    scroll.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
    outer.native.layout().addWidget(scroll)
