"""Plot of a stiffness curve over the histogram of an image, with points to drag."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from psygnal import Signal
from qtpy.QtWidgets import QSizePolicy, QVBoxLayout, QWidget

from napari_hmrf.errors import ArgumentError
from napari_hmrf.tissue.stiffness_curve import Point, StiffnessCurve, with_point
from napari_hmrf.ui.events import single_shot

_HEIGHT, _BINS = 170, 128
#: Largest number of pixels in the histogram.
_LARGEST = 1_000_000
#: Largest distance at which the mouse grabs a point, in pixels.
_NEAR = 9
_LINE = "#4ea6dc"
#: Left, bottom, width and height of the axes, as fractions of the figure size.
_AXES = (0.13, 0.13, 0.84, 0.82)
_INKS = ("axes.edgecolor", "text.color", "xtick.color", "ytick.color")
_HELP = (
    "Drag a point to move it. Double-click to add a point. Right-click a point to remove it.\n"
    "The grey area behind the curve is the histogram of the intensities."
)


class CurvePlot(QWidget):
    """Plot of a curve; the user drags, adds and removes its points with the mouse.

    Attributes
    ----------
    canvas : FigureCanvasQTAgg or None
        Canvas of the plot; None until the plot is shown, because importing matplotlib is slow.
    edited : Signal(StiffnessCurve)
        Emitted with the curve after every change by the user, including during a drag.
    settled : Signal(StiffnessCurve)
        Emitted with the curve at the end of an edit.
    """

    edited = Signal(StiffnessCurve)
    settled = Signal(StiffnessCurve)

    def __init__(self, curve: StiffnessCurve) -> None:
        super().__init__(toolTip=_HELP)
        self.setFixedHeight(_HEIGHT)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        QVBoxLayout(self).setContentsMargins(0, 0, 0, 0)
        self._curve = curve
        # Index of the dragged point, or None.
        self._dragged: int | None = None
        self._counts, self._edges = np.zeros(0), np.array([curve.points[0][0], curve.points[-1][0]])
        self.canvas: Any = None

    @property
    def curve(self) -> StiffnessCurve:
        """Displayed curve; setting it does not emit signals."""
        return self._curve

    @curve.setter
    def curve(self, curve: StiffnessCurve) -> None:
        self._curve = curve
        self._draw_soon()

    def apply_edit(self, curve: StiffnessCurve) -> None:
        """Show a curve that the user has edited, and emit the signals of the edit."""
        if curve != self._curve:
            self.curve = curve
            self.edited.emit(curve)
            if self._dragged is None:
                self.settled.emit(curve)

    def show_intensities(self, values: npt.NDArray[Any]) -> None:
        """Draw the histogram of an image, shape (H, W), behind the curve."""
        finite = values[np.isfinite(values)]
        some = finite[:: max(1, finite.size // _LARGEST)].astype(float)
        self._counts, self._edges = np.histogram(some, _BINS)
        self._draw_soon()

    def showEvent(self, event: Any) -> None:
        """Create the canvas when the plot is first shown."""
        super().showEvent(event)
        if self.canvas is not None:
            return
        from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg  # heavy: matplotlib
        from matplotlib.figure import Figure  # heavy: matplotlib

        self.canvas = canvas = FigureCanvasQTAgg(Figure(facecolor="none"))
        canvas.setStyleSheet("background: transparent")
        canvas.setMinimumWidth(50)
        # Matplotlib's own timer would fire even after the canvas was deleted.
        canvas.draw_idle = single_shot(canvas, 0, self._draw).start
        canvas.mpl_connect("button_press_event", self._on_press)
        canvas.mpl_connect("motion_notify_event", self._on_motion)
        canvas.mpl_connect("button_release_event", self._on_release)
        self.layout().addWidget(canvas)
        self._draw()

    def _on_press(self, event: Any) -> None:
        places = self.canvas.figure.axes[0].transData.transform(self._curve.points)
        away = np.hypot(*(places - (event.x, event.y)).T)
        number = int(away.argmin())
        near = away[number] <= _NEAR * self.canvas.device_pixel_ratio
        if event.dblclick and not near:
            self._change(None, self._point_at(event))
        elif near and event.button == 1:
            self._dragged = number
        elif near and event.button == 3:
            self._change(number, None)

    def _on_motion(self, event: Any) -> None:
        if self._dragged is not None:
            point = self._point_at(event)
            self._change(self._dragged, point)
            with suppress(ValueError):  # the curve cannot have a point here
                self._dragged = self._curve.points.index(point)

    def _on_release(self, _: Any) -> None:
        if self._dragged is not None:
            self._dragged = None
            self._draw_soon()
            self.settled.emit(self._curve)

    def _point_at(self, event: Any) -> Point:
        """Return the point at the mouse position, clipped to the axes."""
        (axes,) = self.canvas.figure.axes
        within = np.clip((event.x, event.y), axes.bbox.min, axes.bbox.max)
        intensity, stiffness = axes.transData.inverted().transform(within).tolist()
        stiffness = max(stiffness, self._curve.range[0] / 100)  # a linear axis extends below 0
        return float(f"{intensity:.5g}"), float(f"{stiffness:.3g}")

    def _change(self, number: int | None, point: Point | None) -> None:
        with suppress(ArgumentError):  # another point has this intensity, or only two points remain
            self.apply_edit(with_point(self._curve, number, point))

    def _draw_soon(self) -> None:
        if self.canvas is not None:
            self.canvas.draw_idle()

    def _draw(self) -> None:
        from matplotlib import rc_context  # heavy: matplotlib

        curve, figure = self._curve, self.canvas.figure
        ink = self.palette().windowText().color().name()
        limits = [each.axis() for each in figure.axes if self._dragged is not None]
        figure.clear()
        with rc_context({"font.size": 6, **dict.fromkeys(_INKS, ink)}):
            axes = figure.add_axes(_AXES, facecolor="none")
            axes.set_yscale("log" if curve.logarithmic else "linear")
            axes.set_yticks(curve.range, [f"{end:g}" for end in curve.range])
            axes.minorticks_off()
            title = f"stiffness ({curve.unit})" if curve.unit else "relative stiffness"
            axes.text(0.015, 0.97, title, va="top", transform=axes.transAxes)
            axes.text(0.985, 0.03, "intensity", ha="right", transform=axes.transAxes)
        # Leave room to drag a point up and down.
        axes.margins(0, 0.4)
        if self._counts.any():
            # Most pixels of an image are background: square roots keep the other bars visible.
            heights = 0.9 * np.sqrt(self._counts / self._counts.max())
            bars = axes.get_xaxis_transform()
            axes.stairs(heights, self._edges, fill=True, color=ink, alpha=0.25, transform=bars)
        points = np.array(curve.points)
        marks = np.union1d(self._edges, points[:, 0])
        along = np.union1d(np.linspace(marks[0], marks[-1], 400), points[:, 0])
        axes.plot(along, replace(curve, void_below=None)(along), color=_LINE, linewidth=2)
        axes.scatter(*points.T, 40, _LINE, edgecolors="white", zorder=3)
        if curve.void_below is not None:
            axes.axvspan(marks[0], curve.void_below, color="#808080", alpha=0.4)
        for each in limits:  # keep the axes during a drag, so that the point stays under the mouse
            axes.axis(each)
        with suppress(RuntimeError):  # the window may be deleted meanwhile
            self.canvas.draw()
