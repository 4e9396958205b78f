"""The energy of a solve, for those who open it."""

from __future__ import annotations

from typing import Any

from qtpy.QtWidgets import QVBoxLayout, QWidget
from superqt import QCollapsible

from napari_hmrf.io.energy_figure import draw_energy
from napari_hmrf.solver.solution import Solution
from napari_hmrf.ui.figure_canvas import emptied, figure_canvas

#: Height of the plot, in pixels.
_HEIGHT = 170


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
        self.toggled.connect(lambda _: self._draw())

    def show_solution(self, solution: Solution | None) -> None:
        """Draw a solution's energies, or nothing."""
        self._solution = solution
        self._draw()

    def show_theme(self, theme: str) -> None:
        """Take the colour of words from one of napari's themes."""
        from napari.utils.theme import get_theme

        self._ink = get_theme(theme).text.as_hex()
        self._draw()

    def _draw(self) -> None:
        if not self.isExpanded():
            return
        if self._canvas is None:
            self._canvas = figure_canvas()
            self._place.layout().addWidget(self._canvas)
        axes = emptied(self._canvas, self._ink)
        if self._solution is not None:
            draw_energy(axes, self._solution, self._ink, 7)
