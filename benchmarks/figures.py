"""Figures 4 and 5 of the paper: deformation grids side by side, and where the fields differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from napari_hmrf import Solution, deformation_grid


def save_figures(
    out: Path, name: str, solution: Solution, reference: npt.NDArray[np.float64]
) -> list[Path]:
    """Write ``<name>-figure-4.png`` and ``<name>-figure-5.png``.

    Parameters
    ----------
    out : Path
        An existing folder.
    name : str
        The phantom's.
    solution : Solution
    reference : ndarray, shape (H, W, 2)
        The finite-element displacement, in the unit of the solution.
    """
    from matplotlib.figure import Figure

    grids = Figure(figsize=(11, 5.5), layout="constrained")
    fields = {"HMRF": solution.displacement, "finite elements": reference}
    for axes, (title, field) in zip(grids.subplots(1, 2), fields.items(), strict=True):
        _draw_grid(axes, field, solution)
        axes.set_title(title)
    differences = Figure(figsize=(14, 4.5), layout="constrained")
    error = np.where(solution.tissue[..., None], solution.displacement - reference, np.nan)
    length = [np.linalg.norm(field, axis=-1) for field in (solution.displacement, reference)]
    panels = {
        "a) magnitude": np.where(solution.tissue, length[0] - length[1], np.nan),
        "b) x (col)": error[..., 1],
        "c) y (row)": error[..., 0],
    }
    limit = max(float(np.nanmax(np.abs(panel))) for panel in panels.values())
    axes_row = differences.subplots(1, 3)
    for axes, (title, panel) in zip(axes_row, panels.items(), strict=True):
        shown = axes.imshow(panel, cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set_title(title)
        axes.set_axis_off()
    differences.colorbar(shown, ax=axes_row, label="HMRF - finite elements (px)")
    paths = [out / f"{name}-figure-4.png", out / f"{name}-figure-5.png"]
    for figure, path in zip((grids, differences), paths, strict=True):
        figure.savefig(path, dpi=120)
    return paths


def _draw_grid(axes, field, solution: Solution) -> None:
    from matplotlib.collections import LineCollection

    every = max(1, max(solution.tissue.shape) // 50)
    segments = deformation_grid(field, solution.spacing, every=every, tissue=solution.tissue)
    ends = np.stack([segments[:, 0], segments.sum(axis=1)], axis=1)
    axes.add_collection(LineCollection(ends[..., ::-1], colors="#0b7285", linewidths=0.6))
    height, width = solution.tissue.shape
    axes.set_xlim(-0.05 * width, 1.05 * width)
    axes.set_ylim(1.05 * height, -0.05 * height)
    axes.set_aspect("equal")
    axes.set_axis_off()
