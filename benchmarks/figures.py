"""Figures 4 and 5 of the paper: deformation grids side by side, and differences of the fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from report.pictures import draw_differences, draw_grid, new_figure

from napari_hmrf import Solution


def save_figures(
    out: Path, name: str, solution: Solution, reference: npt.NDArray[np.float64]
) -> list[Path]:
    """Write ``<name>-figure-4.png`` and ``<name>-figure-5.png``.

    Parameters
    ----------
    out : Path
        Existing output folder.
    name : str
        Name of the phantom.
    solution : Solution
        Solution of the phantom.
    reference : ndarray, shape (H, W, 2)
        Finite-element displacement, in the unit of the solution.
    """
    grids = new_figure(11, 5.5)
    fields = {"HMRF": solution.displacement, "finite elements": reference}
    for axes, (title, field) in zip(grids.subplots(1, 2), fields.items(), strict=True):
        draw_grid(axes, field, solution.tissue)
        axes.set_title(title)
    differences = new_figure(14, 4.5)
    axes_row = differences.subplots(1, 3)
    shown = draw_differences(axes_row, solution.displacement, reference, solution.tissue)
    for axes, title in zip(axes_row, ("a) magnitude", "b) x (col)", "c) y (row)"), strict=True):
        axes.set_title(title)
    differences.colorbar(shown, ax=axes_row, label="HMRF - finite elements (px)")
    paths = [out / f"{name}-figure-4.png", out / f"{name}-figure-5.png"]
    for figure, path in zip((grids, differences), paths, strict=True):
        figure.savefig(path, dpi=120)
    return paths
