"""Pictures of the studies."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.fields import deformation_grid

COLOURS = ("#0b7285", "#e8590c", "#5f3dc4", "#2b8a3e", "#868e96", "#c2255c", "#1864ab")


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure; sizes are in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Any, folder: Path, name: str) -> Path:
    """Write a figure to a folder."""
    from PIL import Image

    path = folder / f"{name}.png"
    drawn = BytesIO()
    figure.savefig(drawn, dpi=100, facecolor="white")
    # A palette reduces the file to a third, without a visible difference.
    Image.open(drawn).convert("RGB").quantize(128).save(path, optimize=True)
    return path


def draw_grid(axes: Any, field: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]) -> None:
    """Draw a square grid that moves with the tissue (figure 4); the field is in pixels."""
    from matplotlib.collections import LineCollection

    every = max(1, max(tissue.shape) // 50)
    segments = deformation_grid(field, spacing=(1.0, 1.0), every=every, tissue=tissue)
    ends = np.stack([segments[:, 0], segments.sum(axis=1)], axis=1)
    axes.add_collection(LineCollection(ends[..., ::-1], colors=COLOURS[0], linewidths=0.5))
    (top, left), (bottom, right) = (at(ends.reshape(-1, 2), axis=0) for at in (np.min, np.max))
    margin = 0.02 * (bottom - top)
    axes.set_xlim(left - margin, right + margin)
    axes.set_ylim(bottom + margin, top - margin)
    axes.set_aspect("equal")
    axes.set_axis_off()


def draw_differences(
    axes_row: Any, found: npt.NDArray[Any], truth: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]
) -> Any:
    """Draw figure 5, differences in magnitude, x (col) and y (row), and return the last panel."""
    error = np.where(tissue[..., None], found - truth, np.nan)
    length = np.linalg.norm(found, axis=-1) - np.linalg.norm(truth, axis=-1)
    panels = (np.where(tissue, length, np.nan), error[..., 1], error[..., 0])
    limit = max(float(np.nanmax(np.abs(panel))) for panel in panels) or 1.0
    shown = None
    for axes, panel in zip(axes_row, panels, strict=True):
        shown = axes.imshow(panel, cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set_axis_off()
    return shown
