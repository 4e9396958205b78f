"""Display of paint: a Labels layer with a colour for each action, and marks.

The colours are those of Okabe and Ito, which colour-blind users can distinguish. Freed tissue is
striped, as is painted tissue that also has an action. Marks show the action without colour: crosses
mark fixed sites, arrows mark moved sites, and double arrows mark sites with an observation in only
one direction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels
from napari.utils.colormaps import CyclicLabelColormap

from napari_hmrf.field.deformation import spread
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.motion_lines import CIRCLE, Lines, along, coloured, motion_marks
from napari_hmrf.layers.image_result import CONFIDENCE, PAINTED
from napari_hmrf.layers.label_colours import SELECTED, confidence_look
from napari_hmrf.layers.result_layers import LayerData, layer_on
from napari_hmrf.tissue.drawing import Canvas, Stroke
from napari_hmrf.tissue.drawing.canvas import KINDS, Box
from napari_hmrf.tissue.drawing.marks import Action
from napari_hmrf.tissue.material_presets import Palette

FloatArray = npt.NDArray[np.float32]
Places = npt.NDArray[np.float64]
#: Red, green and blue, from 0 to 1.
Colour = tuple[float, float, float]

#: Name of the paint layer.
NAME = "Motion, painted"
#: Colour of each action.
COLOURS: dict[str, Colour] = {
    "pin": (0.90, 0.62, 0.0),
    "free": (1.0, 1.0, 1.0),
    "move": (0.34, 0.71, 0.91),
    "expand": (0.80, 0.47, 0.65),
    "confidence": (0.0, 0.62, 0.45),
    "slide": (0.84, 0.37, 0.0),
    "remove": (0.35, 0.25, 0.45),
}
#: Colours of painted tissues, if their colours are not defined by a Labels layer.
_HUES = (
    (0.95, 0.9, 0.26), (0.0, 0.45, 0.70), (0.84, 0.37, 0.0), (0.6, 0.95, 0.6), (0.5, 0.3, 0.9),
    (0.95, 0.7, 0.8), (0.3, 0.85, 0.85),
)  # fmt: skip
#: Colour of painted tissue that is not in the palette.
_UNKNOWN: Colour = (0.5, 0.5, 0.5)
#: Pixel value of the first painted tissue, and number of pixel values for tissues.
_TISSUE, _TISSUES = 64, 128
#: Opacity of actions, and of painted tissue.
_OPACITY, _TISSUE_OPACITY = 0.55, 0.6
#: Opacity of paint that removes tissue, through which the blank cavity remains visible.
_REMOVED_OPACITY = 0.3
#: Number of marks along the shorter side of an image.
_ACROSS = 32


def number_of(action: Action, label: int = 0) -> int:
    """Return the pixel value of an action; for the action "tissue", the value of the label."""
    return _TISSUE + label % _TISSUES if action == "tissue" else KINDS[action]


def show_painted(
    canvas: Canvas,
    base: Canvas,
    window: Box,
    picture: npt.NDArray[np.uint8],
    confidence: FloatArray | None = None,
) -> None:
    """Update a region of the paint images in place.

    Parameters
    ----------
    canvas : Canvas
        Canvas with the paint.
    base : Canvas
        Canvas without the paint.
    window : Box
        Region of pixels to update.
    picture : ndarray of uint8, shape ([D,] H, W)
        Image of actions and tissues, with the values of `number_of`; 0 elsewhere.
    confidence : ndarray of float32, shape ([D,] H, W), optional
        Image of the confidence of the motion: at each pixel, the largest confidence of its
        components.
    """
    kinds = canvas.kinds[window]
    shown = kinds.copy()
    if confidence is not None:
        confidence[window] = canvas.confidence[window].max(axis=-1)
    width = max(1, min(canvas.shape) // 90)
    along: npt.NDArray[Any] = sum(np.ogrid[window], np.zeros((), np.intp))
    stripe = along // width % 2 == 0
    shown[(kinds == KINDS["free"]) & stripe] = 0
    labels = canvas.labels[window]
    tissue = (labels != base.labels[window]) & ((shown == 0) | stripe)
    shown[tissue] = _TISSUE + labels[tissue] % _TISSUES
    picture[window] = shown


def tissue_colours(palette: Palette, layer: Any = None) -> dict[int, Colour]:
    """Return the colour of each tissue in a palette, by label.

    If the palette is the table of the layer, the colours are those of the layer.
    """
    if palette.is_table and isinstance(
        layer, Labels
    ):  # the user may have switched to an Image layer
        colours = {row.label: layer.get_color(row.label) for row in palette.materials}
        return {
            label: _UNKNOWN if colour is None else _colour(colour)
            for label, colour in colours.items()
        }
    rows = [row for row in palette.materials if row.stiffness > 0]
    hues = {row.label: _HUES[at % len(_HUES)] for at, row in enumerate(rows)}
    return {row.label: hues.get(row.label, (0.0, 0.0, 0.0)) for row in palette.materials}


def _colour(rgba: Sequence[float]) -> Colour:
    red, green, blue = map(float, rgba[:3])
    return red, green, blue


def painted_colours(tissues: dict[int, Colour]) -> CyclicLabelColormap:
    """Return the colormap of paint, cached for each set of tissue colours.

    Parameters
    ----------
    tissues : dict of int to colour
        Colour of each tissue, by label.
    """
    return _colours(tuple((label, *colour) for label, colour in tissues.items()))


@lru_cache(maxsize=4)
def _colours(tissues: tuple[tuple[float, ...], ...]) -> CyclicLabelColormap:
    # Use a cyclic colormap with a colour for each of the 256 values: napari would need seconds to
    # compile the mapping of a direct colormap that lists only some of the values.
    colours = np.zeros((256, 4))
    for action, kind in KINDS.items():
        opacity = _REMOVED_OPACITY if action == "remove" else _OPACITY
        colours[kind] = (*COLOURS[action], opacity)
    colours[_TISSUE : _TISSUE + _TISSUES] = (*_UNKNOWN, _TISSUE_OPACITY)
    for label, *colour in tissues:
        colours[_TISSUE + int(label) % _TISSUES] = (*colour, _TISSUE_OPACITY)
    return CyclicLabelColormap(colors=colours)


def painted_layer(
    frame: Frame, picture: npt.NDArray[np.uint8], tissues: dict[int, Colour]
) -> LayerData:
    """Return the data of the paint layer (a Labels layer)."""
    known = {"kind": PAINTED, "slice": frame.slice_name}
    look = {"opacity": 1.0, "colormap": painted_colours(tissues)}
    return layer_on(frame, picture, NAME, known, look, "labels")


def confidence_layer(frame: Frame, confidence: FloatArray) -> LayerData:
    """Return the data of the Image layer that shows painted confidence."""
    known = {"kind": CONFIDENCE, "slice": frame.slice_name}
    return layer_on(frame, confidence, "Confidence", known, confidence_look())


def painted_marks(canvas: Canvas) -> Lines:
    """Return the lines of marks: crosses for fixed tissue, and arrows for moved tissue.

    Thin strokes are marked as well. If only one direction is observed, a double arrow along that
    direction replaces the cross. In a volume, there are marks in each slice along the first axis.

    Parameters
    ----------
    canvas : Canvas
        Canvas with the paint.

    Returns
    -------
    lines : ndarray, shape (N, 2, n), float32
        Start and vector of each line, in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each line, from 0 to 1.
    """
    kinds, size = canvas.kinds, np.array(canvas.spacing)
    n = len(size)
    shorter = min(extent * step for extent, step in zip(canvas.shape, size, strict=True))
    distance = max(shorter / _ACROSS, 4 * float(size.max()))
    marked = np.isin(kinds, [KINDS[each] for each in _MARKED])
    is_marked = marked & (canvas.confidence > 0).any(axis=-1)
    places = spread(is_marked, np.where(np.arange(n) < n - 2, 1, distance / size))
    parts: list[tuple[npt.NDArray[Any], Sequence[float]]] = []
    for action in _MARKED:
        at = places[kinds[tuple(places.T)] == KINDS[action]]
        by, known = canvas.observed[tuple(at.T)], canvas.confidence[tuple(at.T)] > 0
        colour = (*(0.6 + 0.4 * part for part in COLOURS[action]), 1.0)
        parts.append((motion_marks(at * size, by, known, distance) / size, colour))
    return coloured(parts, n)


#: Actions that are shown with marks in addition to colours.
_MARKED: tuple[Action, ...] = ("pin", "move", "expand")


def way_of(stroke: Stroke, spacing: Sequence[float], goes_to: Callable[[Places], Places]) -> Lines:
    """Return lines along the brush path of a selected stroke, with a circle at each end.

    Parameters
    ----------
    stroke : Stroke
    spacing : sequence of float, shape (n,)
        Pixel size along each axis.
    goes_to : callable
        Maps original positions, shape (N, n) in pixels, to displayed positions.
    """
    paths = [np.array(line) for line in stroke.lines]
    circle = stroke.radius * CIRCLE @ np.eye(len(spacing))[-2:] / spacing
    ends = [path[at] + circle for path in paths for at in (0, -1)]
    seen = [goes_to(places) for places in (*paths, *ends)]
    return coloured(((along(places), SELECTED) for places in seen), len(spacing))
