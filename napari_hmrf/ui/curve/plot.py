"""A curve to be dragged by its points, with the histogram of the image behind it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy.typing as npt
from psygnal import Signal
from qtpy.QtCore import QEvent, QPointF, Qt
from qtpy.QtGui import QPainter
from qtpy.QtWidgets import QSizePolicy, QToolTip, QWidget

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.stiffness_curve import Point, StiffnessCurve, with_point
from napari_hmrf.ui.curve.picture import CurvePicture

HEIGHT = 170
#: Two points of one intensity are kept apart by so much of the width.
_APART = 1e-3
#: An arrow key moves a point by so much of the plot.
_NUDGE = 1 / 200
_ARROWS = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, 1),
    Qt.Key.Key_Down: (0, -1),
}
_PAGES = {Qt.Key.Key_PageUp: 1, Qt.Key.Key_PageDown: -1}
HELP = (
    "Drag a point. Double click: add one. Delete: remove the selected one.\n"
    "Arrow keys: nudge it (with Shift, further). Page Up, Page Down: select another.\n"
    "Drag the edge of the grey: what is darker is no tissue."
)


class CurvePlot(QWidget):
    """Shows a curve and lets it be edited with mouse and keys.

    Attributes
    ----------
    edited : Signal(StiffnessCurve)
        Emitted with every curve that the user makes, while dragging, too.
    settled : Signal(StiffnessCurve)
        Emitted when an edit is at its end: the mouse is let go, or a key was pressed.
    picked : Signal(object)
        Emitted with the number of the point that is selected, or None.
    """

    edited = Signal(StiffnessCurve)
    settled = Signal(StiffnessCurve)
    picked = Signal(object)

    def __init__(self, curve: StiffnessCurve) -> None:
        super().__init__()
        self.setFixedHeight(HEIGHT)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setMouseTracking(True)
        self.setAccessibleName("Stiffness by intensity")
        self._picture = CurvePicture(curve)
        self._selected: int | None = None
        #: What the mouse holds: a point's number, or the edge of what is no tissue.
        self._held: int | str | None = None
        self._before = curve

    # What there is

    @property
    def curve(self) -> StiffnessCurve:
        """The curve shown; to set it is no edit of the user's."""
        return self._picture.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve) -> None:
        self._picture.curve = curve
        if self._selected is not None and self._selected >= len(curve.points):
            self.select(None)
        # While something is dragged, the numbers stay under the mouse.
        if self._held is None:
            self._picture.fit()
        self.update()

    @property
    def selected(self) -> int | None:
        """The number of the point that keys and fields change."""
        return self._selected

    def select(self, number: int | None) -> None:
        """Select a point, or none."""
        if number != self._selected:
            self._selected = number
            self.picked.emit(number)
            self.update()

    def show_intensities(self, values: npt.NDArray[Any]) -> None:
        """Draw the histogram of an image, shape (H, W), behind the curve."""
        self._picture.count(values)
        self._picture.fit()
        self.update()

    def place_of(self, point: Point) -> QPointF:
        """Where a point of intensity and stiffness is seen, in pixels of the widget."""
        return self._picture.place_of(point)

    # What can be done

    def add(self, point: Point) -> None:
        """Add a point and select it."""
        self._change(None, point)

    def remove(self) -> None:
        """Remove the selected point; two stay."""
        if self._selected is not None and len(self.curve.points) > 2:
            self._change(self._selected, None)

    def move(self, point: Point) -> None:
        """Move the selected point, as far as its neighbours let it."""
        if self._selected is not None:
            self._change(self._selected, self._between(self._selected, point))

    def _between(self, number: int, point: Point) -> Point:
        """Keep a point between its neighbours."""
        points, axes = self.curve.points, self._picture.axes
        gap = _APART * (axes.right - axes.left)
        intensity, stiffness = point
        if number > 0:
            intensity = max(intensity, points[number - 1][0] + gap)
        if number + 1 < len(points):
            intensity = min(intensity, points[number + 1][0] - gap)
        return intensity, stiffness

    def _change(self, number: int | None, point: Point | None, settled: bool = True) -> None:
        try:
            curve = with_point(self.curve, number, point)
        except ProblemError:
            return  # there is a point of that intensity already, or nothing between two
        self._take(curve, settled)
        self.select(None if point is None else curve.points.index(point))

    def _take(self, curve: StiffnessCurve, settled: bool) -> None:
        if curve != self.curve:
            self.curve = curve
            self.edited.emit(curve)
            if settled:
                self.settled.emit(curve)

    def _nudge(self, right: int, up: int, step: float) -> None:
        assert self._selected is not None
        intensity, stiffness = self.curve.points[self._selected]
        across, high = self._picture.axes.place((intensity, stiffness))
        moved = self._picture.axes.point(across + right * step, high + up * step)
        self.move((moved[0] if right else intensity, moved[1] if up else stiffness))

    # What Qt tells

    def resizeEvent(self, event: Any) -> None:
        """Fill the width there is."""
        self._picture.size = (float(self.width()), float(self.height()))

    def mousePressEvent(self, event: Any) -> None:
        """Take hold of what is under the mouse."""
        if event.button() == Qt.MouseButton.LeftButton:
            self._held, self._before = self._picture.under(event.position()), self.curve
            self.select(self._held if isinstance(self._held, int) else None)

    def mouseMoveEvent(self, event: Any) -> None:
        """Drag what is held, or show what could be."""
        if self._held is None:
            under = self._picture.under(event.position())
            shapes = Qt.CursorShape
            over = shapes.OpenHandCursor if isinstance(under, int) else shapes.SizeHorCursor
            self.setCursor(shapes.ArrowCursor if under is None else over)
            return
        point = self._picture.point_at(event.position())
        if isinstance(self._held, int):
            self._change(self._held, self._between(self._held, point), settled=False)
        else:
            self._take(replace(self.curve, void_below=point[0]), settled=False)

    def mouseReleaseEvent(self, event: Any) -> None:
        """Let go."""
        held, self._held = self._held, None
        if held is not None:
            self._picture.fit()
            self.update()
            if self.curve != self._before:
                self.settled.emit(self.curve)

    def mouseDoubleClickEvent(self, event: Any) -> None:
        """Add a point where there is none."""
        place = event.position()
        taken = isinstance(self._picture.under(place), int)
        if not taken and self._picture.area.contains(place):
            self.add(self._picture.point_at(place))

    def keyPressEvent(self, event: Any) -> None:
        """Do with keys what the mouse does."""
        key, selected = event.key(), self._selected
        if self._held is not None:
            return
        if key in _PAGES:
            first = -1 if _PAGES[key] > 0 else 0
            at = (first if selected is None else selected) + _PAGES[key]
            self.select(at % len(self.curve.points))
        elif selected is not None and key in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            self.remove()
        elif selected is not None and key in _ARROWS:
            far = event.modifiers() & Qt.KeyboardModifier.ShiftModifier
            self._nudge(*_ARROWS[key], _NUDGE * (10 if far else 1))
        else:
            super().keyPressEvent(event)

    def event(self, event: Any) -> bool:
        """Say what lies under the mouse when it rests."""
        if event.type() == QEvent.Type.ToolTip:
            QToolTip.showText(event.globalPos(), self.words_at(event.pos()), self)
            return True
        return bool(super().event(event))

    def words_at(self, place: Any) -> str:
        """What the curve says where the mouse is, and how to change it."""
        intensity, _ = self._picture.point_at(QPointF(place))
        stiffness, unit = float(self.curve(intensity)), self.curve.unit
        what = f"stiffness {stiffness:.3g} {unit}".strip() if stiffness else "no tissue"
        return f"Intensity {intensity:g}: {what}.\n{HELP}"

    def paintEvent(self, event: Any) -> None:
        """Draw the curve, and a frame if keys go to it."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        ink = self.palette().windowText().color()
        self._picture.draw(painter, ink, self._selected)
        if self.hasFocus():
            painter.setPen(ink)
            painter.setBrush(Qt.BrushStyle.NoBrush)
            painter.drawRect(self.rect().adjusted(0, 0, -1, -1))
        painter.end()
