"""Look of painted strokes: a Labels layer of their effects, and marks that need no colour.

Hues are those of Okabe and Ito, which no colour blindness confuses. Freed pixels are striped, and
so is painted tissue that replaces other tissue.
Crosses mark pinned tissue, arrows moved tissue, double arrows tissue that is observed in one
direction only.
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
#: Red, green and blue, 0 to 1.
Colour = tuple[float, float, float]

NAME = "Motion, painted"
COLOURS: dict[str, Colour] = {
    "pin": (0.90, 0.62, 0.0),
    "free": (1.0, 1.0, 1.0),
    "move": (0.34, 0.71, 0.91),
    "expand": (0.80, 0.47, 0.65),
    "confidence": (0.0, 0.62, 0.45),
}
#: Colours of tissues without a layer of their own.
_HUES = (
    (0.95, 0.9, 0.26), (0.0, 0.45, 0.70), (0.84, 0.37, 0.0), (0.6, 0.95, 0.6), (0.5, 0.3, 0.9),
    (0.95, 0.7, 0.8), (0.3, 0.85, 0.85),
)  # fmt: skip
#: First number of a tissue in the picture, and the count of such numbers.
_TISSUE, _TISSUES = 64, 128
#: Opacity of painted motion, and of painted tissue.
_OPACITY, _TISSUE_OPACITY = 0.55, 0.6
#: Marks that fit across the shorter side of a picture.
_ACROSS = 32


def number_of(action: Action, label: int = 0) -> int:
    """Return the value of a painted pixel in the picture."""
    return _TISSUE + label % _TISSUES if action == "tissue" else KINDS[action]


def show_painted(
    canvas: Canvas,
    base: Canvas,
    window: Box,
    picture: npt.NDArray[np.uint8],
    confidence: FloatArray | None = None,
) -> None:
    """Update the pictures of painted strokes in a window, in place.

    Parameters
    ----------
    canvas : Canvas
        With the strokes.
    base : Canvas
        Without them.
    window : Box
        Pixels to update.
    picture : ndarray of uint8, shape ([D,] H, W)
        0 where nothing, or only confidence, was painted; else as `number_of`.
    confidence : ndarray of float32, shape ([D,] H, W), optional
        Confidence in observed motion; the larger of its components.
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
    """Return the colour of each tissue: that of its layer, if the palette is the layer's."""
    if palette.own and isinstance(layer, Labels):  # another layer may be selected by now
        found = {row.label: layer.get_color(row.label) for row in palette.materials}
        return {
            label: (0.5, 0.5, 0.5) if colour is None else _colour(colour)
            for label, colour in found.items()
        }
    rows = [row for row in palette.materials if row.stiffness > 0]
    hues = {row.label: _HUES[at % len(_HUES)] for at, row in enumerate(rows)}
    return {row.label: hues.get(row.label, (0.0, 0.0, 0.0)) for row in palette.materials}


def _colour(rgba: Sequence[float]) -> Colour:
    red, green, blue = map(float, rgba[:3])
    return red, green, blue


def painted_colours(tissues: dict[int, Colour]) -> CyclicLabelColormap:
    """Return the colormap of painted pixels; the same object for the same tissues.

    Parameters
    ----------
    tissues : dict of int to colour
        Colour of the label of each tissue.
    """
    return _colours(tuple((label, *colour) for label, colour in tissues.items()))


@lru_cache(maxsize=4)
def _colours(tissues: tuple[tuple[float, ...], ...]) -> CyclicLabelColormap:
    # One colour for each value of a pixel: for a colormap of some values, napari would first
    # compile the mapping, for seconds.
    colours = np.zeros((256, 4))
    for action, kind in KINDS.items():
        colours[kind] = (*COLOURS[action], _OPACITY)
    for label, *colour in tissues:
        colours[_TISSUE + int(label) % _TISSUES] = (*colour, _TISSUE_OPACITY)
    return CyclicLabelColormap(colors=colours)


def painted_layer(
    frame: Frame, picture: npt.NDArray[np.uint8], tissues: dict[int, Colour]
) -> LayerData:
    """Return a Labels layer of painted strokes."""
    known = {"kind": PAINTED, "slice": frame.slice_name}
    look = {"opacity": 1.0, "colormap": painted_colours(tissues)}
    return layer_on(frame, picture, NAME, known, look, "labels")


def confidence_layer(frame: Frame, confidence: FloatArray) -> LayerData:
    """Return an Image layer of the confidence in observed motion."""
    known = {"kind": CONFIDENCE, "slice": frame.slice_name}
    return layer_on(frame, confidence, "Confidence", known, confidence_look())


def painted_marks(canvas: Canvas) -> Lines:
    """Return crosses in pinned tissue and arrows in moved tissue; thin strokes have some, too.

    Tissue that is observed in one direction only has a double arrow along it instead of a cross.
    In a volume each slice along the first axis has marks, which lie in it.

    Parameters
    ----------
    canvas : Canvas
        With the strokes.

    Returns
    -------
    lines : ndarray, shape (N, 2, n), float32
        (start, step) in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each, 0 to 1.
    """
    kinds, size = canvas.kinds, np.array(canvas.spacing)
    n = len(size)
    shorter = min(extent * step for extent, step in zip(canvas.shape, size, strict=True))
    apart = max(shorter / _ACROSS, 4 * float(size.max()))
    marked = np.isin(kinds, [KINDS[each] for each in _MARKED])
    counts = marked & (canvas.confidence > 0).any(axis=-1)
    places = spread(counts, np.where(np.arange(n) < n - 2, 1, apart / size))
    parts: list[tuple[npt.NDArray[Any], Sequence[float]]] = []
    for action in _MARKED:
        at = places[kinds[tuple(places.T)] == KINDS[action]]
        by, known = canvas.observed[tuple(at.T)], canvas.confidence[tuple(at.T)] > 0
        colour = (*(0.6 + 0.4 * part for part in COLOURS[action]), 1.0)
        parts.append((motion_marks(at * size, by, known, apart) / size, colour))
    return coloured(parts, n)


#: Actions that have marks beside their colour.
_MARKED: tuple[Action, ...] = ("pin", "move", "expand")


def way_of(stroke: Stroke, spacing: Sequence[float], goes_to: Callable[[Places], Places]) -> Lines:
    """Return the path of the brush in a selected stroke, from a circle to a circle.

    Parameters
    ----------
    stroke : Stroke
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    goes_to : callable
        Maps places, (N, n) in pixels, to the places where they are seen.
    """
    ways = [np.array(line) for line in stroke.lines]
    circle = stroke.radius * CIRCLE @ np.eye(len(spacing))[-2:] / spacing
    ends = [way[at] + circle for way in ways for at in (0, -1)]
    seen = [goes_to(places) for places in (*ways, *ends)]
    return coloured(((along(places), SELECTED) for places in seen), len(spacing))
