"""Form fields, menus and labels that magicgui does not provide."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from magicgui.widgets import ComboBox, Container, FloatSlider, FloatSpinBox, Label
from magicgui.widgets.bases import RangedWidget, Widget
from qtpy.QtCore import QEvent, QObject, QPropertyAnimation, Qt
from qtpy.QtCore import Signal as QtSignal
from qtpy.QtGui import QKeySequence, QPainter, QTextLayout
from qtpy.QtWidgets import (
    QAbstractSpinBox,
    QComboBox,
    QLabel,
    QMenu,
    QPushButton,
    QSizePolicy,
    QStyle,
    QStyleOptionButton,
    QStylePainter,
    QWhatsThis,
    QWidget,
)
from superqt import QCollapsible

from napari_hmrf.errors import HmrfError
from napari_hmrf.ui.font_size import LabelAligner
from napari_hmrf.ui.messages import in_short

#: Word at the end of a text that does not fit.
_MORE = "more"


def narrow(menu: Any) -> None:
    """Elide long names in a menu, so that they do not widen the dock."""
    box = menu.native
    box.setSizeAdjustPolicy(box.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
    box.setMinimumContentsLength(8)
    box.view().setTextElideMode(Qt.TextElideMode.ElideMiddle)


def share(label: str, tooltip: str, **options: Any) -> FloatSlider:
    """Create a slider for a fraction; it emits its value when the mouse button is released."""
    settings = {"value": 0.5, "min": 0.0, "max": 1.0, "step": 0.05, **options}
    made = FloatSlider(label=label, tooltip=tooltip, tracking=False, **settings)
    made.native.setToolTip(tooltip)  # for the number beside the slider
    return made


def number(
    label: str, tooltip: str, *, decimals: int = 2, value: float = 0.0, **options: Any
) -> FloatSpinBox:
    """Create a field for a number; it emits its value when the number is complete."""
    made = FloatSpinBox(label=label, tooltip=tooltip, **options)
    made.native.setDecimals(decimals)
    made.native.setKeyboardTracking(False)  # "0." is not a complete number
    made.value = value
    return made


def length(label: str, tooltip: str, least: float = -1e9, **options: Any) -> FloatSpinBox:
    """Create a field for a length, or for a displacement if negative values are allowed.

    The range of the field is wide, so that a number out of the range of the image can be typed; the
    form refuses the number with a message. Otherwise Qt would drop some of its digits.
    """
    return number(label, tooltip, min=least, max=1e9, **{"step": 0.5, **options})


def show_value(field: Any, value: Any) -> None:
    """Show a value in a field, even if the user cannot choose or type it."""
    if isinstance(field, ComboBox) and value not in field.choices:
        field.set_choice(f"{value:g}" if isinstance(value, float) else str(value), value)
    elif isinstance(field, RangedWidget):
        field.range = min(field.min, value), max(field.max, value)
    field.value = value


def show_quietly(field: Any, value: Any) -> None:
    """Show a value in a field, without an event."""
    with field.changed.blocked():
        field.value = value


def show_choices(menu: ComboBox, choices: Iterable[tuple[str, Any]], value: Any) -> None:
    """Show other choices in a menu, and choose one of them, without an event."""
    with menu.changed.blocked():
        menu.choices = []  # otherwise magicgui would move the remaining choices to the front
        menu.choices = [*choices]
        menu.value = value


def menu(label: str, words: Mapping[Any, str], tooltip: str, **options: Any) -> ComboBox:
    """Create a menu of values; `words` maps each value to its text."""
    choices = [(word, value) for value, word in words.items()]
    return ComboBox(label=label, choices=choices, tooltip=tooltip, **options)


def add_entry(menu: QMenu, title: str, about: str, answer: Callable[[], Any]) -> Any:
    """Add an entry with a tooltip and a callback to a menu; "&" is displayed literally."""
    action = menu.addAction(title.replace("&", "&&"))
    action.setToolTip(about)
    action.triggered.connect(lambda: answer())
    return action


def give_menu(button: QPushButton, fill: Callable[[], None]) -> None:
    """Give a button a menu that is filled by a callback each time the menu opens."""
    made = QMenu(button)
    made.setToolTipsVisible(True)
    made.aboutToShow.connect(fill)
    button.setMenu(made)


def number_of(text: str) -> float:
    """Parse a number with a decimal point or comma; NaN for any other text."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan


def attempt(action: Callable[[], object], refuse: Callable[[str], object]) -> None:
    """Run an action, and report a short error message if it fails."""
    try:
        action()
    except (HmrfError, OSError, ValueError) as error:  # ValueError: data that cannot be saved
        refuse(in_short(error))


def row(*widgets: Any) -> Container:
    """Arrange widgets in a row, without labels."""
    made = Container(widgets=widgets, layout="horizontal", labels=False)
    made.native.layout().setSpacing(2)
    return made


class Form(Container):
    """Form of labelled fields, without margins; all labels have the same width.

    Parameters
    ----------
    widgets : sequence of Widget
    """

    def __init__(self, widgets: Sequence[Widget]) -> None:
        super().__init__(widgets=widgets)
        self.margins = (0, 0, 0, 0)
        LabelAligner(self.native)


class Prose(Label):
    """Label that wraps its text at the width of the parent and is as high as the text."""

    def __init__(self) -> None:
        super().__init__()
        words = self.native
        words.setWordWrap(True)
        words.setAlignment(Qt.AlignmentFlag.AlignTop)
        words.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._fit = _FitHeight(words)
        words.installEventFilter(self._fit)

    def show_text(self, sentence: str) -> None:
        """Show a message."""
        self.value = sentence
        self._fit.fit()


class _FitHeight(QObject):
    """Event filter that fits the height of a label to its text, even inside a scroll area."""

    def __init__(self, words: Any) -> None:
        super().__init__(words)
        self._words = words

    def fit(self) -> None:
        words = self._words
        words.setMinimumHeight(0)  # otherwise `heightForWidth` is at least the current height
        words.setFixedHeight(max(0, words.heightForWidth(words.width())))  # -1: no text

    def eventFilter(self, watched: Any, event: Any) -> bool:
        if event.type() in (QEvent.Type.Resize, QEvent.Type.FontChange, QEvent.Type.StyleChange):
            self.fit()
        return False


class FixedText(QLabel):
    """Label of a fixed height; a text that does not fit ends in "more", which shows all of it.

    The first lines are painted. The text of the label remains complete, and its tooltip has all of
    it.

    Parameters
    ----------
    lines : int
        Number of lines.
    """

    def __init__(self, lines: int = 1) -> None:
        super().__init__()
        self._text = ""
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.limit(lines)

    def limit(self, lines: int) -> None:
        """Set the number of lines."""
        self._count = lines
        self._fit()

    @property
    def value(self) -> str:
        """The text."""
        return self._text

    def text(self) -> str:
        """Return the text, which is not that of the label: that would lay out the window anew."""
        return self._text

    @property
    def is_elided(self) -> bool:
        """True if a part of the text is not visible."""
        return self._lines()[1]

    def show_text(self, sentence: str, details: str = "") -> None:
        """Show a text, with the text or its details in the tooltip."""
        if sentence != self._text:
            self._text = sentence
            self.setAccessibleName(sentence)
            self.update()
        self.setToolTip(details or sentence)

    def _fit(self) -> None:
        frame = self.contentsMargins()
        # Two texts of one line are as high as a text of two lines.
        line = self.fontMetrics().lineSpacing() + frame.top() + frame.bottom()
        self.setFixedHeight(self._count * line)

    def _lines(self) -> tuple[list[str], bool]:
        """Return the visible lines, and whether the last line ends in dots before more text."""
        text = self.text().replace("\n", "\u2028")
        width, metrics = self.contentsRect().width(), self.fontMetrics()
        lines: list[str] = []
        is_elided = False
        layout = QTextLayout(text, self.font())
        layout.beginLayout()
        while (line := layout.createLine()).isValid():
            line.setLineWidth(max(width, 1))
            begin = line.textStart()
            if len(lines) + 1 == self._count:
                rest = text[begin:].replace("\u2028", " ").rstrip()
                is_elided = metrics.horizontalAdvance(rest) > width
                if is_elided:
                    width -= metrics.horizontalAdvance(f" {_MORE}")
                lines.append(metrics.elidedText(rest, Qt.TextElideMode.ElideRight, width))
                break
            lines.append(text[begin : begin + line.textLength()].strip("\u2028 "))
        layout.endLayout()
        return lines, is_elided

    def paintEvent(self, event: Any) -> None:
        """Paint the lines; an underlined word at their end shows that there is more text."""
        lines, is_elided = self._lines()
        painter, area, metrics = QPainter(self), self.contentsRect(), self.fontMetrics()

        def draw(text: str, left: int, number: int) -> None:
            place = area.adjusted(left, number * metrics.lineSpacing(), 0, 0)
            self.style().drawItemText(
                painter, place, 0, self.palette(), True, text, self.foregroundRole()
            )

        for number, line in enumerate(lines):
            draw(line, 0, number)
        if is_elided:
            font = self.font()
            font.setUnderline(True)
            painter.setFont(font)
            draw(_MORE, area.width() - metrics.horizontalAdvance(_MORE), len(lines) - 1)
        painter.end()
        hand, arrow = Qt.CursorShape.PointingHandCursor, Qt.CursorShape.ArrowCursor
        if self.cursor().shape() != (cursor := hand if is_elided else arrow):
            self.setCursor(cursor)

    def mouseReleaseEvent(self, event: Any) -> None:
        """Show all of the text."""
        if self.toolTip():
            QWhatsThis.showText(event.globalPosition().toPoint(), self.toolTip(), self)

    def event(self, event: Any) -> bool:
        """Fit the height to the font, which a style sheet can change with no event but `Show`."""
        if event.type() in (QEvent.Type.FontChange, QEvent.Type.StyleChange, QEvent.Type.Show):
            self._fit()
        return bool(super().event(event))


class ElidedButton(QPushButton):
    """Button as wide as its place; a longer text is painted with dots at its end."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)

    @property
    def painted_text(self) -> str:
        """Visible part of the text."""
        look = QStyleOptionButton()
        self.initStyleOption(look)
        area = self.style().subElementRect(QStyle.SubElement.SE_PushButtonContents, look, self)
        elided = Qt.TextElideMode.ElideRight
        text: str = self.fontMetrics().elidedText(self.text(), elided, area.width())
        return text

    def paintEvent(self, event: Any) -> None:
        """Paint the button with as much of its text as fits."""
        look = QStyleOptionButton()
        self.initStyleOption(look)
        look.text = self.painted_text
        QStylePainter(self).drawControl(QStyle.ControlElement.CE_PushButton, look)


class Section(QCollapsible):
    """Section of a form; while it is closed, the Tab key does not visit its controls.

    Parameters
    ----------
    title : str
    """

    #: Emitted when the section has its final height after it was opened.
    opened = QtSignal()

    def __init__(self, title: str) -> None:
        super().__init__(title, expandedIcon="▾", collapsedIcon="▸")
        content = self.content()
        policy = content.sizePolicy()
        policy.setRetainSizeWhenHidden(True)  # the form is wide enough for closed sections, too
        content.setSizePolicy(policy)
        content.hide()
        self.findChild(QPropertyAnimation).finished.connect(self._on_finished)

    def expand(self, animate: bool = True) -> None:
        """Open the section."""
        self.content().show()
        super().expand(animate)

    def collapse(self, animate: bool = True) -> None:
        """Close the section."""
        super().collapse(animate)
        if not animate:
            self._hide_closed()

    def _on_finished(self) -> None:
        self._hide_closed()
        if self.isExpanded():
            self.opened.emit()

    def _hide_closed(self) -> None:
        self.content().setVisible(self.isExpanded())


class CalmField(QObject):
    """Event filter for fields; passes some events on to the surrounding widget.

    The mouse wheel scrolls the surrounding widget unless the field has the focus. The undo and redo
    keys undo and redo steps, as they do outside the fields, unless the user is typing a number. A
    menu gets the focus only through the Tab key. Otherwise, after a choice by mouse, the menu would
    receive all key presses, including those that select tools.
    """

    def watch(self, field: Any) -> None:
        """Filter the events of a field."""
        by_tab, by_both = Qt.FocusPolicy.TabFocus, Qt.FocusPolicy.StrongFocus
        field.setFocusPolicy(by_tab if isinstance(field, QComboBox) else by_both)
        field.installEventFilter(self)
        if isinstance(field, QAbstractSpinBox):
            field.editingFinished.connect(partial(field.lineEdit().setModified, False))

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Pass on wheel events and undo or redo keys that the field does not use."""
        theirs = event.type() == QEvent.Type.Wheel and not watched.hasFocus()
        if event.type() == QEvent.Type.KeyPress and isinstance(watched, QAbstractSpinBox):
            keys = QKeySequence.StandardKey
            step = event.matches(keys.Undo) or event.matches(keys.Redo)
            theirs = step and not watched.lineEdit().isModified()
        if theirs:
            event.ignore()
        return theirs
