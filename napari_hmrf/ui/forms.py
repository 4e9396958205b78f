"""What forms need that magicgui's containers do not bring: sentences, and labels in one column."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from magicgui.widgets import ComboBox, Container, FloatSlider, FloatSpinBox, Label
from qtpy.QtCore import QEvent, QObject, Qt
from qtpy.QtGui import QKeySequence
from qtpy.QtWidgets import QAbstractSpinBox, QComboBox, QMenu, QPushButton, QSizePolicy

from napari_hmrf.errors import HmrfError
from napari_hmrf.ui.messages import in_short


def narrow(menu: Any) -> None:
    """Have a long name not widen the dock."""
    box = menu.native
    box.setSizeAdjustPolicy(box.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
    box.setMinimumContentsLength(8)
    box.view().setTextElideMode(Qt.TextElideMode.ElideMiddle)


def share(label: str, tooltip: str, **options: Any) -> FloatSlider:
    """A field for a part of a whole; it speaks when the mouse lets go."""
    how = {"value": 0.5, "min": 0.0, "max": 1.0, "step": 0.05, **options}
    return FloatSlider(label=label, tooltip=tooltip, tracking=False, **how)


def length(label: str, tooltip: str, least: float = -1e6, **options: Any) -> FloatSpinBox:
    """A field for a length, or for a step if it may be negative."""
    how = {"value": 0.0, "min": least, "max": 1e6, "step": 0.5, **options}
    return FloatSpinBox(label=label, tooltip=tooltip, **how)


def menu(label: str, words: Mapping[Any, str], tooltip: str, **options: Any) -> ComboBox:
    """A field for one of some values, each called by its words."""
    choices = [(said, value) for value, said in words.items()]
    return ComboBox(label=label, choices=choices, tooltip=tooltip, **options)


def add_entry(menu: QMenu, title: str, about: str, answer: Callable[[], Any]) -> Any:
    """An entry of a menu, with what it does; a layer's name may be its title."""
    action = menu.addAction(title.replace("&", "&&"))
    action.setToolTip(about)
    action.triggered.connect(lambda: answer())
    return action


def give_menu(button: QPushButton, fill: Callable[[], None]) -> None:
    """Give a button a menu that is filled with what there is whenever it opens."""
    made = QMenu(button)
    made.setToolTipsVisible(True)
    made.aboutToShow.connect(fill)
    button.setMenu(made)


def number_of(text: str) -> float:
    """A number as people type it, with a point or a comma; NaN for anything else."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan


def attempt(action: Callable[[], object], refuse: Callable[[str], object]) -> None:
    """Do what somebody has asked for, or say why it cannot be done."""
    try:
        action()
    except (HmrfError, OSError, ValueError) as error:  # the last of what cannot be saved
        refuse(in_short(error))


def row(*widgets: Any) -> Container:
    """Widgets beside each other."""
    made = Container(widgets=widgets, layout="horizontal", labels=False)
    made.native.layout().setSpacing(2)
    return made


class Prose(Label):
    """A sentence that wraps: narrower than its words, and then as high as it takes.

    Parameters
    ----------
    lines : int, optional
        How many are seen at most.
    """

    def __init__(self, lines: int = 1000) -> None:
        super().__init__()
        words = self.native
        words.setWordWrap(True)
        words.setAlignment(Qt.AlignmentFlag.AlignTop)
        words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._fit = _FitHeight(words, lines)
        words.installEventFilter(self._fit)

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        self.value = sentence
        self._fit.fit()


class _FitHeight(QObject):
    """Keeps a label's height that of its words: layouts in a scrolled area do not ask for it."""

    def __init__(self, words: Any, lines: int) -> None:
        super().__init__(words)
        self._words, self._lines = words, lines

    def fit(self) -> None:
        words, most = self._words, self._lines * self._words.fontMetrics().lineSpacing()
        words.setMinimumHeight(0)  # else Qt takes what it is for what it needs
        words.setFixedHeight(min(max(0, words.heightForWidth(words.width())), most))  # -1: no words

    def eventFilter(self, watched: Any, event: Any) -> bool:
        if event.type() in (QEvent.Type.Resize, QEvent.Type.FontChange, QEvent.Type.StyleChange):
            self.fit()
        return False


class CalmField(QObject):
    """Filters events of fields, and leaves some to what they lie in.

    The wheel scrolls that, unless a field was clicked; and the usual keys take back what was done
    last, as they do beside the fields, unless a number is being typed. A menu would take all keys
    after a choice from it, those of the tools, too: by the mouse it is given none.
    """

    def watch(self, field: Any) -> None:
        """Filter the events of a field."""
        by_tab, by_both = Qt.FocusPolicy.TabFocus, Qt.FocusPolicy.StrongFocus
        field.setFocusPolicy(by_tab if isinstance(field, QComboBox) else by_both)
        field.installEventFilter(self)
        if isinstance(field, QAbstractSpinBox):
            field.editingFinished.connect(partial(field.lineEdit().setModified, False))

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Leave an event to those around a field if it is theirs."""
        theirs = event.type() == QEvent.Type.Wheel and not watched.hasFocus()
        if event.type() == QEvent.Type.KeyPress and isinstance(watched, QAbstractSpinBox):
            keys = QKeySequence.StandardKey
            step = event.matches(keys.Undo) or event.matches(keys.Redo)
            theirs = step and not watched.lineEdit().isModified()
        if theirs:
            event.ignore()
        return theirs


def align_labels(form: Container) -> None:
    """Give a form's labels one width: magicgui does so only when one of them changes."""
    first = form[0]
    first.label = first.label
