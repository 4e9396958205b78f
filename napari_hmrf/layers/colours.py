"""Colours that set boundaries apart from tissues and from what they do."""

from __future__ import annotations

from typing import Any

#: Of the arrows that show what a boundary will do.
PREVIEW = "magenta"
#: Of the arrows of a result: seen on black, grey and white.
ARROWS = "#ff6000"
#: Of boundary labels 1, 2, ...; napari's own would repeat the colours of the tissues.
#: The first two, which hold and push in new layers, differ from the arrows on them.
_BOUNDARY = ("#7ee081", "#f4f482", "#ff4fd8", "#a78bfa", "#ff5a5f", "#ff9f1c")


def boundary_colours() -> Any:
    """The colormap of a Labels layer of boundaries."""
    from napari.utils.colormaps import CyclicLabelColormap

    return CyclicLabelColormap(colors=["transparent", *_BOUNDARY])


def fold_colours() -> Any:
    """The colormap of a Labels layer of folds."""
    from napari.utils.colormaps import DirectLabelColormap

    return DirectLabelColormap(color_dict={None: "transparent", 0: "transparent", 1: "red"})
