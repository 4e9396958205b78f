"""Plot of the mean energy after each sweep or multigrid cycle."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.solver.model_names import is_multigrid
from napari_hmrf.solver.solution import Solution

_LINE = "#4ea6dc"


def draw_energy(axes: Any, solution: Solution) -> None:
    """Plot the mean energy of a solution after each iteration.

    For the paper's schedule, the energy is plotted against the number of sweeps, with a vertical
    line at the beginning of each level. For multigrid, it is plotted against the number of cycles,
    with the estimated error as the title.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Empty axes.
    solution : Solution
    """
    axes.set_ylabel("mean energy (px²)")
    if is_multigrid(solution.provenance.parameters):
        axes.set_xlabel("cycle over all levels")
        _draw_cycles(axes, solution)
    else:
        axes.set_xlabel("sweep (levels on top, coarse to fine)")
        _draw_levels(axes, solution)


def _draw_cycles(axes: Any, solution: Solution) -> None:
    """Plot the energy after each multigrid cycle, and show the estimated error as the title."""
    # The centred update records only its final energy, so only one point is drawn.
    energy = solution.energy
    cycles = np.arange(1, len(energy) + 1)
    known = slice(-1, None) if (energy == energy[-1]).all() else slice(None)
    axes.plot(cycles[known], energy[known], color=_LINE, linewidth=1.2, marker="o", markersize=3)
    axes.set_xlim(0.5, len(cycles) + 0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if solution.convergence is not None:
        near = f"within {solution.convergence.error:.1g} px of the converged field"
        axes.set_title(near, fontsize=10)


def _draw_levels(axes: Any, solution: Solution) -> None:
    count = len(solution.energy)
    sweeps, positive = np.arange(1, count + 1), solution.energy > 0
    if positive.any():
        axes.set_yscale("log")
        axes.plot(sweeps[positive], solution.energy[positive], color=_LINE, linewidth=1.2)
    begin, above = 0, axes.get_xaxis_transform()
    for level in solution.levels:
        axes.axvline(begin + 0.5, color="black", alpha=0.25, linewidth=0.6)
        # The number of a narrow level would overlap the numbers of adjacent levels.
        if level.iterations >= 0.07 * count:
            middle = begin + level.iterations / 2
            place = {"transform": above, "ha": "center", "va": "bottom"}
            axes.text(middle, 1.0, str(level.number), fontsize=9, **place)
        begin += level.iterations
    axes.set_xlim(0.5, max(1.5, count + 0.5))
