"""The mean energy after each sweep, coarse to fine, or after each cycle over all levels."""

from __future__ import annotations

from typing import Any

import numpy as np
from qtpy.QtWidgets import QVBoxLayout, QWidget
from superqt import QCollapsible

from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.models import is_multigrid

#: Height of the plot, in pixels.
_HEIGHT = 170
_LINE = "#4ea6dc"


class EnergyPlot(QCollapsible):
    """A plot that is drawn only once somebody opens it."""

    def __init__(self) -> None:
        super().__init__("Energy", expandedIcon="▾", collapsedIcon="▸")
        # Its place is kept from the start: how far it opens is asked before the plot is there.
        self._place = QWidget()
        self._place.setFixedHeight(_HEIGHT)
        QVBoxLayout(self._place).setContentsMargins(0, 0, 0, 0)
        self.addWidget(self._place)
        self._canvas: Any = None
        self._solution: Solution | None = None
        self._ink = "#dddddd"
        self.toggled.connect(self._on_toggled)

    def show_solution(self, solution: Solution | None) -> None:
        """Draw a solution's energies, or nothing."""
        self._solution = solution
        if self.isExpanded():
            self._draw()

    def show_theme(self, theme: str) -> None:
        """Take the colour of words from one of napari's themes."""
        from napari.utils.theme import get_theme

        self._ink = get_theme(theme).text.as_hex()
        if self._canvas is not None:
            self._draw()

    def _on_toggled(self, opened: bool) -> None:
        if opened:
            self._draw()

    def _draw(self) -> None:
        if self._canvas is None:
            self._canvas = energy_canvas()
            self._place.layout().addWidget(self._canvas)
        draw_energy(self._canvas, self._solution, self._ink)


def energy_canvas() -> Any:
    """Make a matplotlib canvas that is a Qt widget; matplotlib is imported only now."""
    from matplotlib.backends.backend_qtagg import FigureCanvasQTAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2, 1.7), layout="constrained")
    figure.patch.set_alpha(0)
    figure.add_subplot()
    canvas = FigureCanvasQTAgg(figure)
    canvas.setStyleSheet("background: transparent")
    canvas.setMinimumWidth(50)
    return canvas


def draw_energy(canvas: Any, solution: Solution | None, colour: str) -> None:
    """Draw a solution's energies, with a line where each level begins.

    Parameters
    ----------
    canvas : FigureCanvasQTAgg
        Of `energy_canvas`.
    solution : Solution, optional
        Without one the axes stay empty.
    colour : str
        Of words and lines.
    """
    axes = canvas.figure.axes[0]
    axes.clear()
    axes.patch.set_alpha(0)
    if solution is not None and is_multigrid(solution.provenance.parameters):
        _draw_cycles(axes, solution, colour)
    elif solution is not None:
        _draw_levels(axes, solution, colour)
    if not axes.get_xlabel():
        axes.set_xlabel("sweep (levels on top, coarse to fine)")
    axes.xaxis.label.set(fontsize=7, color=colour)
    axes.set_ylabel("mean energy (px²)", fontsize=7, color=colour)
    axes.tick_params(labelsize=6, colors=colour, which="both")
    for spine in axes.spines.values():
        spine.set_color(colour)
        spine.set_alpha(0.4)
    canvas.draw_idle()


def _draw_cycles(axes: Any, solution: Solution, colour: str) -> None:
    """Cycles go over all levels, and there are few: a point for each, and how near they led."""
    # No energy leads to where the centred update ends: of that, the last is all that is known.
    energy = solution.energy
    cycles = np.arange(1, len(energy) + 1)
    known = slice(-1, None) if (energy == energy[-1]).all() else slice(None)
    axes.plot(cycles[known], energy[known], color=_LINE, linewidth=1.2, marker="o", markersize=3)
    axes.set_xlim(0.5, len(cycles) + 0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel("cycle over all levels")
    if solution.convergence is not None:
        axes.set_title(
            f"within {solution.convergence.error:.1g} px of the converged field",
            fontsize=7,
            color=colour,
        )


def _draw_levels(axes: Any, solution: Solution, colour: str) -> None:
    sweeps = np.arange(1, len(solution.energy) + 1)
    positive = solution.energy > 0
    if positive.any():
        axes.set_yscale("log")
        axes.plot(sweeps[positive], solution.energy[positive], color=_LINE, linewidth=1.2)
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
