"""How a curve is drawn, and what of it is where."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from qtpy.QtCore import QPointF, QRectF, Qt
from qtpy.QtGui import QColor, QPainter, QPen, QPolygonF, QTextOption

from napari_hmrf.tissue.stiffness_curve import Point, StiffnessCurve
from napari_hmrf.ui.curve.axes import CurveAxes

#: Around the plot: room for numbers.
_LEFT, _TOP, _RIGHT, _BOTTOM = 46, 8, 10, 20
#: How near the mouse takes hold of a point or the threshold, in pixels.
_NEAR = 9
_BINS = 128
#: Of a large image so many pixels are counted.
_COUNTED = 1_000_000
_LINE, _SELECTED, _VOID = QColor("#4ea6dc"), QColor("#f0a030"), QColor(128, 128, 128, 70)
#: What the mouse is over, if it is no point: the edge of what is no tissue.
VOID = "void"


class CurvePicture:
    """A curve on its axes, over the histogram of an image, in a rectangle of some size.

    Parameters
    ----------
    curve : StiffnessCurve
    """

    def __init__(self, curve: StiffnessCurve) -> None:
        self.curve = curve
        self.size = (200.0, 100.0)
        self._counts: npt.NDArray[Any] = np.zeros(0)
        self._lowest, self._highest = curve.points[0][0], curve.points[-1][0]
        self.fit()

    def fit(self) -> None:
        """Choose the axes anew, so that all is seen and there is room to drag."""
        self.axes = CurveAxes.around(self.curve, self._lowest, self._highest)

    def count(self, values: npt.NDArray[Any]) -> None:
        """Count how many pixels of an image have which intensity."""
        finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values.ravel()
        self._counts = np.zeros(0)
        if not finite.size:
            return
        low, high = float(finite.min()), float(finite.max())
        if low < high and math.isfinite(high - low):
            self._lowest, self._highest = low, high
            some = finite[:: max(1, finite.size // _COUNTED)].astype(float)
            self._counts, _ = np.histogram(some, _BINS, (low, high))

    @property
    def area(self) -> QRectF:
        """Where the curve is, without the numbers beside it."""
        width, height = self.size
        return QRectF(_LEFT, _TOP, max(1, width - _LEFT - _RIGHT), max(1, height - _TOP - _BOTTOM))

    def place_of(self, point: Point) -> QPointF:
        """Where a point of intensity and stiffness is seen."""
        across, up = self.axes.place(point)
        area = self.area
        return QPointF(area.left() + across * area.width(), area.bottom() - up * area.height())

    def point_at(self, place: Any) -> Point:
        """The intensity and the stiffness at a place, or at the nearest on the axes."""
        area = self.area
        return self.axes.point(
            (place.x() - area.left()) / area.width(), (area.bottom() - place.y()) / area.height()
        )

    def under(self, place: Any) -> int | str | None:
        """What the mouse would take hold of: the number of a point, or else `VOID`, or None."""
        places = [self.place_of(point) for point in self.curve.points]
        away = [math.hypot(at.x() - place.x(), at.y() - place.y()) for at in places]
        nearest = min(range(len(away)), key=away.__getitem__)
        if away[nearest] <= _NEAR:
            return nearest
        edge = self.curve.void_below
        if edge is None or abs(self._across(edge) - place.x()) > _NEAR:
            return None
        return VOID

    def draw(self, painter: QPainter, ink: QColor, selected: int | None) -> None:
        """Draw all of it.

        Parameters
        ----------
        painter : QPainter
        ink : QColor
            Of numbers and lines.
        selected : int, optional
            The number of a point.
        """
        faint = QColor(ink)
        faint.setAlpha(60)
        painter.setPen(faint)
        painter.drawRect(self.area)
        self._draw_histogram(painter, faint)
        self._draw_numbers(painter, ink, faint)
        painter.setClipRect(self.area.adjusted(-7, -7, 7, 7))
        self._draw_void(painter)
        self._draw_line(painter)
        for number, point in enumerate(self.curve.points):
            painter.setPen(QPen(QColor("white"), 1.5))
            painter.setBrush(_SELECTED if number == selected else _LINE)
            radius = 6.0 if number == selected else 4.5
            painter.drawEllipse(self.place_of(point), radius, radius)
        painter.setClipping(False)

    def _across(self, intensity: float) -> float:
        return float(self.place_of((intensity, self.axes.top)).x())

    def _draw_histogram(self, painter: QPainter, colour: QColor) -> None:
        if not self._counts.size:
            return
        area = self.area
        # Of most images the background has more pixels than all the rest: roots show both.
        heights = np.sqrt(self._counts / self._counts.max()) * area.height() * 0.9
        edges = [self._across(edge) for edge in np.linspace(self._lowest, self._highest, _BINS + 1)]
        for (begin, end), height in zip(pairwise(edges), heights, strict=True):
            painter.fillRect(QRectF(begin, area.bottom() - height, end - begin, height), colour)

    def _draw_numbers(self, painter: QPainter, ink: QColor, faint: QColor) -> None:
        area, font = self.area, painter.font()
        font.setPointSizeF(max(6.0, font.pointSizeF() * 0.8))
        painter.setFont(font)
        beside = QTextOption(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        for stiffness in self.axes.stiffness_ticks():
            y = self.place_of((self.axes.left, stiffness)).y()
            painter.setPen(faint)
            painter.drawLine(QPointF(area.left(), y), QPointF(area.right(), y))
            painter.setPen(ink)
            painter.drawText(QRectF(0, y - 8, _LEFT - 5, 16), f"{stiffness:g}", beside)
        painter.setPen(ink)
        unit = f" ({self.curve.unit})" if self.curve.unit else ""
        inside = area.adjusted(5, 2, -5, -2)
        painter.drawText(inside, f"stiffness{unit}")
        corner = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignBottom
        painter.drawText(inside, "intensity", QTextOption(corner))
        below = QTextOption(Qt.AlignmentFlag.AlignHCenter)
        for intensity in self.axes.intensity_ticks():
            box = QRectF(self._across(intensity) - 30, area.bottom() + 2, 60, _BOTTOM - 2)
            painter.drawText(box, f"{intensity:g}", below)

    def _draw_void(self, painter: QPainter) -> None:
        if self.curve.void_below is None:
            return
        area, edge = self.area, self._across(self.curve.void_below)
        painter.fillRect(QRectF(area.left(), area.top(), edge - area.left(), area.height()), _VOID)
        painter.setPen(QPen(_LINE, 1, Qt.PenStyle.DashLine))
        painter.drawLine(QPointF(edge, area.top()), QPointF(edge, area.bottom()))

    def _draw_line(self, painter: QPainter) -> None:
        axes, area, void_below = self.axes, self.area, self.curve.void_below
        begin = axes.left if void_below is None else min(max(void_below, axes.left), axes.right)
        intensities = np.linspace(begin, axes.right, max(2, round(area.width())))
        stiffnesses = replace(self.curve, void_below=None)(intensities)
        line = [
            self.place_of((float(intensity), float(stiffness)))
            for intensity, stiffness in zip(intensities, stiffnesses, strict=True)
        ]
        painter.setPen(QPen(_LINE, 2))
        painter.drawPolyline(QPolygonF(line))
