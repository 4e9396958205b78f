"""Colours and display settings of layers: boundaries, quantities, confidence and stiffness."""

from __future__ import annotations

from typing import Any

import numpy as np
from napari.utils import colormaps
from napari.utils.colormaps.standardize_color import transform_color

from napari_hmrf.field.colormaps import DIVERGING, FOLDED, OPACITY, RISING, opacity

#: Display settings of a quantity shown over an image. In a 3-D view, an interpolation with the NaN
#: outside tissue would draw wrong colours at the surface, and with the depth test, the brightest
#: voxels of the image would hide the quantity.
OVER = {
    "blending": "translucent_no_depth",
    "opacity": OPACITY,
    "interpolation3d": "nearest",
    "rendering": "mip",
}
#: Colour of the arrows of observed motion.
OBSERVED = "magenta"
#: Colour of the arrows of a result; visible on black, grey and white.
ARROWS = "#ff6000"
#: Colormap of stiffness; perceptually uniform, and different from the colormaps of results.
_STIFF = "viridis"
#: Red, green, blue and opacity of drawn arrows.
DRAWN = (0.0, 0.62, 1.0, 1.0)
#: Red, green, blue and opacity of a selected arrow; much brighter than `DRAWN`, so that
#: colour-blind users can see the difference.
SELECTED = (1.0, 0.9, 0.1, 1.0)
#: Colours of boundary labels 1, 2, ...; napari's default colours are used for the tissues. The
#: first two colours, for fixed and moved boundaries in new layers, differ from those of arrows.
_BOUNDARY = ("#7ee081", "#f4f482", "#ff4fd8", "#a78bfa", "#ff5a5f", "#ff9f1c")


def boundary_colours() -> Any:
    """Return the colormap of a boundary layer (a Labels layer)."""
    return colormaps.CyclicLabelColormap(colors=["transparent", *_BOUNDARY])


def mark_look() -> dict[str, Any]:
    """Return the display settings of a Labels layer that marks sites, such as folds."""
    colours = {None: "transparent", 0: "transparent", 1: FOLDED}
    colormap = colormaps.DirectLabelColormap(color_dict=colours)
    return {"colormap": colormap, "opacity": 1.0, "blending": OVER["blending"]}


def quantity_colours(signed: bool, folds: bool = False, descending: bool = True) -> Any:
    """Return the colormap of a quantity in an Image layer, transparent at the neutral value.

    Parameters
    ----------
    signed : bool
        True if the neutral value is at the middle of the colormap, False if it is at the lower end.
    folds : bool
        True to draw values at or beyond a limit in the colour of folds.
    descending : bool
        True if folds are below the lower limit, False if they are above the upper limit.
    """
    name = DIVERGING if signed else RISING
    part = np.linspace(0, 1, 256)
    colours = np.array(colormaps.ensure_colormap(name).map(part))
    colours[:, 3] = opacity(part, signed)
    end = {"low_color" if descending else "high_color": transform_color(FOLDED)[0]} if folds else {}
    return colormaps.Colormap(colours, name=f"{name}, clear", **end)


def opaque_gaps(colormap: Any) -> Any:
    """Return a copy of a colormap that draws NaN in black, so that no layer below shows through.

    The copy has a name of its own, because napari replaces its colormap of the same name.
    """
    if colormap.nan_color[3] == 1:
        return colormap
    return colormaps.Colormap(
        colormap.colors,
        controls=colormap.controls,
        interpolation=colormap.interpolation,
        low_color=colormap.low_color,
        high_color=colormap.high_color,
        nan_color=(0.0, 0.0, 0.0, 1.0),
        name=f"{colormap.name}, NaN black",
    )


def confidence_look() -> dict[str, Any]:
    """Return the display settings of an Image layer that shows confidence."""
    return {"colormap": quantity_colours(signed=False), "contrast_limits": (0.0, 1.0), **OVER}


def stiffness_colours() -> Any:
    """Return the colormap of stiffness in an Image layer, transparent outside tissue."""
    colours = np.array(colormaps.ensure_colormap(_STIFF).map(np.linspace(0, 1, 256)))
    return colormaps.Colormap(colours, name=f"{_STIFF}, clear", low_color=(0.0, 0.0, 0.0, 0.0))
