"""A curve to be dragged by its points, with the histogram of the image behind it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from psygnal import Signal
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QSizePolicy, QVBoxLayout, QWidget

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.stiffness_curve import Point, StiffnessCurve, with_point
from napari_hmrf.ui.events import single_shot

_HEIGHT, _BINS = 170, 128
#: Of a large image so many pixels are counted.
_COUNTED = 1_000_000
#: Room to drag a point up: how far the axes reach beyond the stiffnesses.
_ROOM = 2.5
#: How near the mouse takes hold of a point or of the edge of what is no tissue, in pixels.
_NEAR = 9
#: Two points are kept apart by so much of the width; an arrow key moves one by so much of the plot.
_APART, _NUDGE = 1e-3, 1 / 200
_LINE, _SELECTED = "#4ea6dc", "#f0a030"
_VOID = "void"
_ARROWS = {
    Qt.Key.Key_Left: (-1, 0), Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, 1), Qt.Key.Key_Down: (0, -1),
}  # fmt: skip
_PAGES = {Qt.Key.Key_PageUp: 1, Qt.Key.Key_PageDown: -1}
_HELP = (
    "Drag a point. Double click: add one. Delete or a right click: remove it.\n"
    "Arrow keys: nudge it (with Shift, further). Page Up, Page Down: select another.\n"
    "Drag the edge of the grey: what is darker is no tissue."
)


class CurvePlot(QWidget):
    """Shows a curve and lets it be edited with mouse and keys.

    Attributes
    ----------
    selected : int or None
        The number of the point that keys and fields change; set by `select`.
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
        self.setFixedHeight(_HEIGHT)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setAccessibleName("Stiffness by intensity")
        QVBoxLayout(self).setContentsMargins(0, 0, 0, 0)
        self._curve = self._before = curve
        self.selected: int | None = None
        #: What the mouse holds: a point's number, or the edge of what is no tissue.
        self._held: int | str | None = None
        self._counts, self._edges = np.zeros(0), np.array([curve.points[0][0], curve.points[-1][0]])
        self._canvas: Any = None

    # What there is

    @property
    def curve(self) -> StiffnessCurve:
        """The curve shown; to set it is no edit of the user's."""
        return self._curve

    @curve.setter
    def curve(self, curve: StiffnessCurve) -> None:
        self._curve = curve
        if self.selected is not None and self.selected >= len(curve.points):
            self.select(None)
        self._draw()

    def select(self, number: int | None) -> None:
        """Select a point, or none."""
        if number != self.selected:
            self.selected = number
            self.picked.emit(number)
            self._draw()

    def show_intensities(self, values: npt.NDArray[Any]) -> None:
        """Draw the histogram of an image, shape (H, W), behind the curve."""
        finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values.ravel()
        self._counts = np.zeros(0)
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
        if low < high and math.isfinite(high - low):
            some = finite[:: max(1, finite.size // _COUNTED)].astype(float)
            self._counts, self._edges = np.histogram(some, _BINS, (low, high))
        self._draw()

    @property
    def canvas(self) -> Any:
        """What the curve is drawn on, and feels the mouse; made when it is first asked for."""
        if self._canvas is None:
            self._canvas = canvas = _figure_canvas()
            canvas.figure.subplots_adjust(0.13, 0.13, 0.97, 0.95)
            self.layout().addWidget(canvas)
            canvas.mpl_connect("button_press_event", self._on_press)
            canvas.mpl_connect("motion_notify_event", self._on_motion)
            canvas.mpl_connect("button_release_event", self._on_release)
            self._draw()
        return self._canvas

    # What can be done

    def add(self, point: Point) -> None:
        """Add a point and select it."""
        self._change(None, point)

    def remove(self) -> None:
        """Remove the selected point; two stay."""
        if self.selected is not None and len(self._curve.points) > 2:
            self._change(self.selected, None)

    def move(self, point: Point) -> None:
        """Move the selected point, as far as its neighbours let it."""
        at, points = self.selected, self._curve.points
        if at is not None:
            gap = _APART * float(np.ptp(self._axes.get_xlim()))
            least = points[at - 1][0] + gap if at else -math.inf
            most = points[at + 1][0] - gap if at + 1 < len(points) else math.inf
            self._change(at, (min(max(point[0], least), most), point[1]))

    def _change(self, number: int | None, point: Point | None) -> None:
        try:
            curve = with_point(self._curve, number, point)
        except ProblemError:
            return  # there is a point of that intensity already, or nothing between two
        self.take(curve)
        self.select(None if point is None else curve.points.index(point))

    def take(self, curve: StiffnessCurve) -> None:
        """Show a curve that the user has made, and tell of it."""
        if curve != self._curve:
            self.curve = curve
            self.edited.emit(curve)
            if self._held is None:
                self.settled.emit(curve)

    # Where it is

    @property
    def _axes(self) -> Any:
        return self.canvas.figure.axes[0]

    def _point_at(self, pixel: npt.ArrayLike) -> Point:
        """What lies at a pixel of the canvas, or at the nearest on the axes; to four digits."""
        axes = self._axes
        within = np.clip(pixel, axes.bbox.min, axes.bbox.max)
        intensity, stiffness = axes.transData.inverted().transform(within).tolist()
        step = 10 ** math.floor(math.log10(np.ptp(axes.get_xlim())) - 3)
        if not self._curve.logarithmic:
            stiffness = max(stiffness, axes.get_ylim()[1] / 1000)
        return round(intensity / step) * step, float(f"{stiffness:.3g}")

    def _under(self, event: Any) -> int | str | None:
        """What the mouse would take hold of: the number of a point, or else `_VOID`, or None."""
        near, edge = _NEAR * self.canvas.device_pixel_ratio, self._curve.void_below
        places = self._axes.transData.transform(self._curve.points)
        away = np.hypot(*(places - (event.x, event.y)).T)
        if away.min() <= near:
            return int(away.argmin())
        if edge is None:
            return None
        across, _ = self._axes.transData.transform((edge, self._curve.range[0]))
        return _VOID if abs(across - event.x) <= near else None

    # What is heard

    def _on_press(self, event: Any) -> None:
        under = self._under(event)
        point = under if isinstance(under, int) else None
        if event.dblclick:
            if point is None and event.inaxes:
                self.add(self._point_at((event.x, event.y)))
            return
        self.select(point)
        if event.button == 1:
            self._held, self._before = under, self._curve
        elif event.button == 3:
            self.remove()

    def _on_motion(self, event: Any) -> None:
        """Drag what is held, or show what could be."""
        point = self._point_at((event.x, event.y))
        if isinstance(self._held, int):
            self.move(point)
        elif self._held is not None:
            self.take(replace(self._curve, void_below=point[0]))
        else:
            shapes, under = Qt.CursorShape, self._under(event)
            over = shapes.SizeHorCursor if under == _VOID else shapes.OpenHandCursor
            self.setCursor(shapes.ArrowCursor if under is None else over)
            stiffness = float(self._curve(point[0]))
            what = f"stiffness {stiffness:.3g} {self._curve.unit}" if stiffness else "no tissue"
            self._canvas.setToolTip(f"Intensity {point[0]:g}: {what.rstrip()}.\n{_HELP}")

    def _on_release(self, _: Any) -> None:
        held, self._held = self._held, None
        if held is not None:
            self._draw()
            if self._curve != self._before:
                self.settled.emit(self._curve)

    def keyPressEvent(self, event: Any) -> None:
        """Do with keys what the mouse does."""
        key, selected, points = event.key(), self.selected, self._curve.points
        if key in _PAGES and self._held is None:
            first = -1 if _PAGES[key] > 0 else 0
            self.select(((first if selected is None else selected) + _PAGES[key]) % len(points))
        elif selected is None or self._held is not None:
            super().keyPressEvent(event)
        elif key in (Qt.Key.Key_Delete, Qt.Key.Key_Backspace):
            self.remove()
        elif key in _ARROWS:
            far = event.modifiers() & Qt.KeyboardModifier.ShiftModifier
            way, old, axes = np.array(_ARROWS[key]), points[selected], self._axes
            step = way * _NUDGE * (10 if far else 1) * axes.bbox.size
            moved = self._point_at(axes.transData.transform(old) + step)
            self.move((moved[0] if way[0] else old[0], moved[1] if way[1] else old[1]))
        else:
            super().keyPressEvent(event)

    def showEvent(self, event: Any) -> None:
        """Draw it from now on: somebody looks."""
        super().showEvent(event)
        assert self.canvas

    def changeEvent(self, event: Any) -> None:
        """Take over other colours."""
        super().changeEvent(event)
        self._draw()

    # How it is drawn

    def _draw(self) -> None:
        if self._canvas is None:
            return
        curve, ink = self._curve, self.palette().windowText().color().name()
        axes, points = _emptied(self._canvas, ink), np.array(curve.points)
        # While something is dragged, the numbers stay under the mouse.
        if self._held is None:
            self._ends = self._around(curve)
        (left, right), (bottom, top) = self._ends
        if curve.logarithmic:
            axes.set_yscale("log", subs=(2, 5))
        if top >= 100 * bottom:  # there are decades to see
            axes.minorticks_off()
        axes.set(xlim=(left, right), ylim=(bottom, top))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set(major_formatter="{x:g}", minor_formatter="{x:g}")
        title = f"stiffness ({curve.unit})" if curve.unit else "relative stiffness"
        inside = {"fontsize": 7, "color": ink, "transform": axes.transAxes}
        axes.text(0.015, 0.97, title, va="top", **inside)
        axes.text(0.985, 0.03, "intensity", ha="right", **inside)
        if self._counts.size:
            # Of most images the background has more pixels than all the rest: roots show both.
            heights = 0.9 * np.sqrt(self._counts / self._counts.max())
            bars = axes.get_xaxis_transform()
            axes.stairs(heights, self._edges, fill=True, color=ink, alpha=0.25, transform=bars)
        begin = left
        if curve.void_below is not None:
            begin = min(max(curve.void_below, left), right)
            axes.axvspan(left, begin, color="#808080", alpha=0.3, linewidth=0)
            axes.axvline(begin, color=_LINE, linewidth=1, linestyle="--")
        along = np.union1d(np.linspace(begin, right, 200), points[points[:, 0] >= begin, 0])
        axes.plot(along, replace(curve, void_below=None)(along), color=_LINE, linewidth=2)
        chosen = np.arange(len(points)) == self.selected
        sizes, colours = np.where(chosen, 70, 40), np.where(chosen, _SELECTED, _LINE)
        axes.scatter(*points.T, sizes, colours, edgecolors="white", zorder=3, clip_on=False)

    def _around(self, curve: StiffnessCurve) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ends of the axes that have room for all intensities, all points, and some more."""
        marks = [*self._edges[[0, -1]].tolist(), *(intensity for intensity, _ in curve.points)]
        marks += [] if curve.void_below is None else [curve.void_below]
        (softest, stiffest), room = curve.range, _ROOM if curve.logarithmic else _ROOM / 2
        return (min(marks), max(marks)), (softest / room * curve.logarithmic, stiffest * room)


def _figure_canvas() -> Any:
    """Make a matplotlib canvas that is a Qt widget, with axes; matplotlib is imported only now."""
    from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2, 1.7))
    figure.patch.set_alpha(0)
    figure.add_subplot()
    canvas = FigureCanvasQTAgg(figure)
    canvas.setStyleSheet("background: transparent")
    canvas.setMinimumWidth(50)

    def draw() -> None:
        # Python may take the window apart in the middle of it.
        with suppress(RuntimeError):
            canvas.draw()

    # Matplotlib's own timer would ring though the canvas is gone.
    canvas.draw_idle = single_shot(canvas, 0, draw).start
    return canvas


def _emptied(canvas: Any, ink: str) -> Any:
    """Take away what is on the axes of a canvas, and return them."""
    (axes,) = canvas.figure.axes
    axes.clear()
    axes.patch.set_alpha(0)
    axes.tick_params(labelsize=6, colors=ink, which="both")
    for spine in axes.spines.values():
        spine.set(color=ink, alpha=0.4)
    canvas.draw_idle()
    return axes
