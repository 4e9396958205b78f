"""Font size of the dock: controls that napari does not scale, and the width of the forms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from qtpy.QtCore import QEvent, QObject
from qtpy.QtWidgets import QApplication, QLabel, QScrollArea, QWidget

_FONT_EVENTS = (QEvent.Type.FontChange, QEvent.Type.StyleChange, QEvent.Type.Show)


class FontFollower(QObject):
    """Event filter that gives controls the font size of a field.

    The font size in the settings of napari does not change tables and tool buttons.

    Parameters
    ----------
    field : QWidget
    controls : sequence of QWidget
    """

    def __init__(self, field: QWidget, controls: Sequence[QWidget]) -> None:
        super().__init__(field)
        self._controls = controls
        field.installEventFilter(self)

    def eventFilter(self, field: Any, event: Any) -> bool:
        """Copy the font size after each change."""
        size = field.font().pointSizeF()
        if event.type() in _FONT_EVENTS and size > 0:  # a font can have a size in pixels instead
            for control in self._controls:
                font = control.font()
                if font.pointSizeF() != size:
                    font.setPointSizeF(size)
                    control.setFont(font)
        return False


class LabelAligner(QObject):
    """Event filter that gives all labels of a form the width of the widest label.

    magicgui measures labels in the default font, which is smaller than the font of napari.

    Parameters
    ----------
    area : QWidget
        Widget of the form.
    """

    def __init__(self, area: QWidget) -> None:
        super().__init__(area)
        area.installEventFilter(self)

    def eventFilter(self, area: Any, event: Any) -> bool:
        """Set the width after each change of the layout."""
        if event.type() == QEvent.Type.LayoutRequest:
            labels = area.findChildren(QLabel)
            widest = max((label.sizeHint().width() for label in labels), default=0)
            for label in labels:
                if label.minimumWidth() != widest:
                    label.setMinimumWidth(widest)
        return False


class WidthFitter(QObject):
    """Event filter that makes a scroll area as wide as its contents, because it scrolls vertically.

    Closed sections count as well. Qt measures hidden widgets in the default font until they are
    polished, so that without this the dock would become wider at a later time.

    Parameters
    ----------
    area : QScrollArea
    least : int
        Minimum width of the area, in pixels.
    """

    def __init__(self, area: QScrollArea, least: int) -> None:
        super().__init__(area)
        self._area, self._least = area, least
        area.widget().installEventFilter(self)

    def eventFilter(self, contents: Any, event: Any) -> bool:
        """Fit the width after each change of the layout, and measure what is hidden."""
        if event.type() in _FONT_EVENTS:
            _measure_hidden(contents)
        elif event.type() == QEvent.Type.LayoutRequest:
            area = self._area
            beside = area.verticalScrollBar().sizeHint().width() + 2 * area.frameWidth()
            width = max(self._least, contents.minimumSizeHint().width() + beside)
            if width != area.minimumWidth():
                area.setMinimumWidth(width)
        return False


def _measure_hidden(contents: QWidget) -> None:
    """Polish the hidden widgets inside a widget, and let their forms align the labels."""
    hidden = [each for each in contents.findChildren(QWidget) if not each.isVisible()]
    for each in hidden:
        each.ensurePolished()
    for each in reversed(hidden):  # the innermost layouts first
        if (layout := each.layout()) is not None:
            layout.invalidate()
            QApplication.sendEvent(each, QEvent(QEvent.Type.LayoutRequest))
