"""Overlay of a film in the colours of its layer."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.io.film_overlay import FilmOverlay
from napari_hmrf.layers.result_layers import Overlay
from napari_hmrf.solver.solution import Solution


def film_overlay(overlay: Overlay, layer: Any, solution: Solution) -> FilmOverlay | None:
    """Return an overlay for a film, in the colours of its layer.

    Parameters
    ----------
    overlay : Overlay
    layer : napari.layers.Layer
        Layer that shows the overlay.
    solution : Solution

    Returns
    -------
    FilmOverlay or None
        None for the arrows of the observed motion, which do not move.
    """
    if overlay.name == "observed":
        return None
    colormap, opacity = getattr(layer, "colormap", None), float(layer.opacity)
    limits: tuple[float, float] | None = None
    line: tuple[float, ...] = ()
    if overlay.layer.kind == "image":
        low, high = layer.contrast_limits
        limits = float(low), float(high)
    elif overlay.layer.kind == "vectors":
        line = tuple(np.atleast_2d(layer.edge_color)[0].tolist())

    def colours(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        assert colormap is not None
        if limits is not None:
            values = (values.astype(float) - limits[0]) / (limits[1] - limits[0])
        known = np.isfinite(values) | np.isinf(values)
        found = np.asarray(colormap.map(np.where(known, values, 0).ravel()), dtype=float)
        found = found.reshape(*values.shape, 4) * (1.0, 1.0, 1.0, opacity)
        found[~known] = 0
        return found

    motion, title = overlay.motion(solution), str(layer.name)
    if line:
        return FilmOverlay(motion, colours, title, line=line)
    return FilmOverlay(motion, colours, title, limits)
