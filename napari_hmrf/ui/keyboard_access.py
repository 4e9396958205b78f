"""Access by keyboard and screen reader: names of fields, order of the Tab key, visible focus."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Any

from magicgui.widgets import Container
from qtpy.QtCore import QEvent, QObject, Qt
from qtpy.QtGui import QPainter, QPen
from qtpy.QtWidgets import (
    QAbstractButton,
    QApplication,
    QLayout,
    QPushButton,
    QScrollArea,
    QToolButton,
    QWidget,
)

#: Width of the line around the field with the keyboard focus, in pixels.
_LINE = 2


def name_fields(form: Container) -> None:
    """Make the labels of a form the accessible names of its fields, for screen readers."""
    for field in form:
        if isinstance(field, Container):
            name_fields(field)
        elif field.label and not getattr(field, "text", ""):
            _name_field(field, field.label)
            field.label_changed.connect(partial(_name_field, field), max_args=1)


def _name_field(field: Any, label: str) -> None:
    for part in (field.native, *field.native.findChildren(QWidget)):
        if not (isinstance(part, QAbstractButton) and part.text()):
            part.setAccessibleName(label)


def order_tabs(parent: QWidget) -> None:
    """Make the Tab key visit the fields of a widget in the order of its layout."""
    for before, after in pairwise(_tab_stops(parent)):
        QWidget.setTabOrder(before, after)


def _tab_stops(part: QWidget | QLayout) -> Iterator[QWidget]:
    """Return the widgets that the Tab key visits, in the order of their layout."""
    if isinstance(part, QLayout):
        items = (part.itemAt(number) for number in range(part.count()))
        inner = [item.widget() or item.layout() for item in items]
    else:
        if part.focusPolicy() & Qt.FocusPolicy.TabFocus:
            yield part
        inner = [part.widget() if isinstance(part, QScrollArea) else part.layout()]
    for each in inner:
        if each is not None:
            yield from _tab_stops(each)


class EnterKey(QObject):
    """Event filter that lets the Enter key press the buttons of a dock, as the space bar does.

    Parameters
    ----------
    dock : QWidget
    """

    def __init__(self, dock: QWidget) -> None:
        super().__init__(dock)
        for button in dock.findChildren(QAbstractButton):
            if isinstance(button, QPushButton | QToolButton):
                button.installEventFilter(self)

    def eventFilter(self, button: Any, event: Any) -> bool:
        """Press the button."""
        keys = Qt.Key.Key_Return, Qt.Key.Key_Enter
        is_enter = event.type() == QEvent.Type.KeyPress and event.key() in keys
        if is_enter and not event.isAutoRepeat():
            button.click()
        return is_enter


class FocusRings(QObject):
    """Lines around the field of a dock that gets the keyboard focus without the mouse.

    The styles of napari do not show which button, menu or slider has the focus.

    Parameters
    ----------
    dock : QWidget
    """

    def __init__(self, dock: QWidget) -> None:
        super().__init__(dock)
        self._dock = dock
        QApplication.instance().focusChanged.connect(self._on_focus)

    def _on_focus(self, _: QWidget | None, field: QWidget | None) -> None:
        is_inside = field is not None and self._dock.isAncestorOf(field)
        if is_inside and QApplication.mouseButtons() == Qt.MouseButton.NoButton:
            FocusRing(field).show()


class FocusRing(QWidget):
    """Line around a field, in the colour of its text, until the field loses the focus."""

    def __init__(self, field: QWidget) -> None:
        super().__init__(field)
        self.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.setGeometry(field.rect())
        field.installEventFilter(self)

    def eventFilter(self, field: Any, event: Any) -> bool:
        """Follow the size of the field, and end when the field loses the focus."""
        if event.type() == QEvent.Type.Resize:
            self.setGeometry(field.rect())
        elif event.type() == QEvent.Type.FocusOut:
            self.hide()
            self.deleteLater()
        return False

    def paintEvent(self, event: Any) -> None:
        """Paint the line."""
        painter, line = QPainter(self), QPen(self.palette().color(self.foregroundRole()), _LINE)
        line.setJoinStyle(Qt.PenJoinStyle.MiterJoin)
        painter.setPen(line)
        half = _LINE // 2
        painter.drawRect(self.rect().adjusted(half, half, -half, -half))
        painter.end()
