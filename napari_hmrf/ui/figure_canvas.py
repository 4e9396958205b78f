"""Figures in a dock, in its colours."""

from __future__ import annotations

from typing import Any

from qtpy.compat import isalive

from napari_hmrf.ui.events import single_shot


def figure_canvas(layout: Any = "constrained") -> Any:
    """Make a matplotlib canvas that is a Qt widget, with axes; matplotlib is imported only now.

    Parameters
    ----------
    layout : str
        Matplotlib's; "none" takes half the time to draw, and leaves room as it is told.
    """
    from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2, 1.7), layout=layout)
    figure.patch.set_alpha(0)
    figure.add_subplot()
    canvas = FigureCanvasQTAgg(figure)
    canvas.setStyleSheet("background: transparent")
    canvas.setMinimumWidth(50)
    # Matplotlib's own timer would ring though the canvas is gone.
    canvas.draw_idle = single_shot(canvas, 0, lambda: isalive(canvas) and canvas.draw()).start
    return canvas


def emptied(canvas: Any, ink: str) -> Any:
    """Take away what is on the axes of a `figure_canvas`, and return them.

    Parameters
    ----------
    canvas : FigureCanvasQTAgg
    ink : str
        The colour of words and lines.
    """
    (axes,) = canvas.figure.axes
    axes.clear()
    axes.patch.set_alpha(0)
    axes.tick_params(labelsize=6, colors=ink, which="both")
    for spine in axes.spines.values():
        spine.set(color=ink, alpha=0.4)
    canvas.draw_idle()
    return axes
