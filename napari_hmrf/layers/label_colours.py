"""Colours that set boundaries apart from tissues and from what they do."""

from __future__ import annotations

from typing import Any

import numpy as np
from napari.utils import colormaps
from napari.utils.colormaps.standardize_color import transform_color

from napari_hmrf.field.colormaps import DIVERGING, FOLDED, OPACITY, RISING, opacity

#: How a quantity lies over an image.
OVER = {"blending": "translucent", "opacity": OPACITY}
#: Of the arrows that show what is known of the motion.
OBSERVED = "magenta"
#: Of the arrows of a result: seen on black, grey and white.
ARROWS = "#ff6000"
#: Of stiffness: evenly ever lighter, and of other colours than what is measured of a result.
_STIFF = "viridis"
#: Of arrows that are drawn by hand, and of the one that is selected: red, green, blue and opacity.
#: Told apart by those who are blind to colours, too, as one is much brighter.
DRAWN = (0.0, 0.62, 1.0, 1.0)
SELECTED = (1.0, 0.9, 0.1, 1.0)
#: Of boundary labels 1, 2, ...; napari's own would repeat the colours of the tissues.
#: The first two, which hold and push in new layers, differ from the arrows on them.
_BOUNDARY = ("#7ee081", "#f4f482", "#ff4fd8", "#a78bfa", "#ff5a5f", "#ff9f1c")


def boundary_colours() -> Any:
    """The colormap of a Labels layer of boundaries."""
    return colormaps.CyclicLabelColormap(colors=["transparent", *_BOUNDARY])


def mark_look() -> dict[str, Any]:
    """How a Labels layer of sites that are marked lies over an image, as that of folds."""
    colours = {None: "transparent", 0: "transparent", 1: "red"}
    return {"colormap": colormaps.DirectLabelColormap(color_dict=colours), "opacity": 1.0}


def quantity_colours(signed: bool, folds: bool = False) -> Any:
    """The colormap of an Image layer of a quantity; what says nothing lets the image through.

    Parameters
    ----------
    signed : bool
        Whether no change is in the middle, and not at the lower end.
    folds : bool
        Whether what reaches the lower limit is folded.
    """
    name = DIVERGING if signed else RISING
    part = np.linspace(0, 1, 256)
    colours = np.array(colormaps.ensure_colormap(name).map(part))
    colours[:, 3] = opacity(part, signed)
    low = transform_color(FOLDED)[0] if folds else None
    return colormaps.Colormap(colours, name=f"{name}, clear", low_color=low)


def confidence_look() -> dict[str, Any]:
    """How an Image layer of how sure that is lies over an image."""
    return {"colormap": quantity_colours(signed=False), "contrast_limits": (0.0, 1.0), **OVER}


def stiffness_colours() -> Any:
    """The colormap of an Image layer of stiffness; what is no tissue lets the image through."""
    colours = np.array(colormaps.ensure_colormap(_STIFF).map(np.linspace(0, 1, 256)))
    return colormaps.Colormap(colours, name=f"{_STIFF}, clear", low_color=(0.0, 0.0, 0.0, 0.0))
