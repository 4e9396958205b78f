"""The mean energy after each sweep, coarse to fine."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.solution import Solution

#: Height of the plot, in pixels.
_HEIGHT = 170


def energy_canvas(text: str = "#dddddd") -> Any:
    """Make a matplotlib canvas that is a Qt widget; matplotlib is imported only now.

    Parameters
    ----------
    text : str
        Colour of the words and lines.
    """
    from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2, 1.7), layout="constrained")
    figure.patch.set_alpha(0)
    figure.add_subplot()
    canvas = FigureCanvasQTAgg(figure)
    canvas.setStyleSheet("background: transparent")
    canvas.setFixedHeight(_HEIGHT)
    canvas.setMinimumWidth(50)
    canvas.text_colour = text
    return canvas


def draw_energy(canvas: Any, solution: Solution) -> None:
    """Draw a solution's energies, with a line where each level begins."""
    axes = canvas.figure.axes[0]
    axes.clear()
    axes.patch.set_alpha(0)
    colour = canvas.text_colour
    sweeps = np.arange(1, len(solution.energy) + 1)
    positive = solution.energy > 0
    if positive.any():
        axes.set_yscale("log")
        axes.plot(sweeps[positive], solution.energy[positive], color="#4ea6dc", linewidth=1.2)
    begin = 0
    for level in solution.levels:
        axes.axvline(begin + 0.5, color=colour, alpha=0.25, linewidth=0.6)
        # Narrow levels get a line but no words.
        if level.iterations >= 0.07 * max(1, solution.iterations):
            axes.text(
                begin + level.iterations / 2,
                1.0,
                str(level.number),
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="bottom",
                fontsize=6,
                color=colour,
            )
        begin += level.iterations
    axes.set_xlim(0.5, max(1.5, solution.iterations + 0.5))
    axes.set_xlabel("sweep (levels on top, coarse to fine)", fontsize=7, color=colour)
    axes.set_ylabel("mean energy (px²)", fontsize=7, color=colour)
    axes.tick_params(labelsize=6, colors=colour, which="both")
    for spine in axes.spines.values():
        spine.set_color(colour)
        spine.set_alpha(0.4)
    canvas.draw_idle()
