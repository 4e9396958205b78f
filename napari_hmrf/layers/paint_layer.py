"""How what was painted looks: a Labels layer of what it does, and marks that say it without colour.

Hues are those of Okabe and Ito, which no colour blindness confuses. What is freed is striped, and
so is tissue that was painted where something else was.
Crosses lie where nothing moves, arrows where tissue is moved, double arrows where only one
direction is spoken of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels

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

NAME = "Motion, painted"
#: Red, green and blue, 0 to 1.
COLOURS: dict[str, tuple[float, float, float]] = {
    "pin": (0.90, 0.62, 0.0),
    "free": (1.0, 1.0, 1.0),
    "move": (0.34, 0.71, 0.91),
    "expand": (0.80, 0.47, 0.65),
    "confidence": (0.0, 0.62, 0.45),
}
#: Of tissues without a layer of their own.
_HUES = (
    (0.95, 0.9, 0.26), (0.0, 0.45, 0.70), (0.84, 0.37, 0.0), (0.6, 0.95, 0.6), (0.5, 0.3, 0.9),
    (0.95, 0.7, 0.8), (0.3, 0.85, 0.85),
)  # fmt: skip
#: Where the numbers of tissues begin, and how many there are.
_TISSUE, _TISSUES = 64, 128
#: How opaque what is painted is, and painted tissue.
_OPACITY, _TISSUE_OPACITY = 0.55, 0.6
#: Marks that fit across the shorter side of a picture.
_ACROSS = 32


def number_of(action: Action, label: int = 0) -> int:
    """The value that a pixel has where a stroke was painted."""
    return _TISSUE + label % _TISSUES if action == "tissue" else KINDS[action]


def show_painted(
    canvas: Canvas,
    base: Canvas,
    window: Box,
    picture: npt.NDArray[np.uint8],
    confidence: FloatArray | None = None,
) -> None:
    """Bring the pictures of what was painted up to date in a window, in place.

    Parameters
    ----------
    canvas : Canvas
        With what was painted.
    base : Canvas
        Beneath it.
    window : Box
        Which pixels.
    picture : ndarray of uint8, shape ([D,] H, W)
        0 where nothing was painted, or confidence alone; else as `number_of`.
    confidence : ndarray of float32, shape ([D,] H, W), optional
        How sure is what is held or moved; the larger of its components.
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


def tissue_colours(palette: Palette, layer: Any = None) -> dict[int, Any]:
    """Red, green and blue, 0 to 1, of each tissue: those of its layer, if that has the table."""
    if palette.own and isinstance(layer, Labels):  # another may be chosen by now
        found = {row.label: layer.get_color(row.label) for row in palette.materials}
        return {
            label: tuple((0.5, 0.5, 0.5) if colour is None else map(float, colour[:3]))
            for label, colour in found.items()
        }
    rows = [row for row in palette.materials if row.stiffness > 0]
    hues = {row.label: _HUES[at % len(_HUES)] for at, row in enumerate(rows)}
    return {row.label: hues.get(row.label, (0.0, 0.0, 0.0)) for row in palette.materials}


def painted_colours(tissues: dict[int, Any]) -> Any:
    """The colormap of what was painted; the same one for the same tissues.

    Parameters
    ----------
    tissues : dict of int to colour
        Red, green and blue of each tissue's label, 0 to 1.
    """
    return _colours(tuple((label, *colour[:3]) for label, colour in tissues.items()))


@lru_cache(maxsize=4)
def _colours(tissues: tuple[tuple[float, ...], ...]) -> Any:
    from napari.utils.colormaps import CyclicLabelColormap

    # As many colours as there are values, so that none comes twice; of a colormap for some values
    # napari would compile the mapping first, for seconds.
    colours = np.zeros((256, 4))
    for action, kind in KINDS.items():
        colours[kind] = (*COLOURS[action], _OPACITY)
    for label, *colour in tissues:
        colours[_TISSUE + int(label) % _TISSUES] = (*colour, _TISSUE_OPACITY)
    return CyclicLabelColormap(colors=colours)


def painted_layer(
    frame: Frame, picture: npt.NDArray[np.uint8], tissues: dict[int, Any]
) -> LayerData:
    """A Labels layer of what was painted."""
    known = {"kind": PAINTED, "slice": frame.slice_name}
    look = {"opacity": 1.0, "colormap": painted_colours(tissues)}
    return layer_on(frame, picture, NAME, known, look, "labels")


def confidence_layer(frame: Frame, confidence: FloatArray) -> LayerData:
    """An Image layer of how sure is what is held or moved."""
    known = {"kind": CONFIDENCE, "slice": frame.slice_name}
    return layer_on(frame, confidence, "Confidence", known, confidence_look())


def painted_marks(canvas: Canvas) -> Lines:
    """Crosses where tissue is pinned, arrows where it is moved; thin strokes have some, too.

    Where one direction alone is spoken of there is a double arrow along that instead of a cross.
    In a volume each slice along the first axis has marks, which lie in it.

    Parameters
    ----------
    canvas : Canvas
        With what was painted.

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


#: What has marks beside its colour.
_MARKED: tuple[Action, ...] = ("pin", "move", "expand")


def way_of(stroke: Stroke, spacing: Sequence[float], goes_to: Callable[[Any], Any]) -> Lines:
    """The way of the brush in a stroke that is selected, from a circle to a circle.

    Parameters
    ----------
    stroke : Stroke
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    goes_to : callable
        Where places, (N, n) in pixels, are seen.
    """
    ways = [np.array(line) for line in stroke.lines]
    circle = stroke.radius * CIRCLE @ np.eye(len(spacing))[-2:] / spacing
    ends = [way[at] + circle for way in ways for at in (0, -1)]
    seen = [goes_to(places) for places in (*ways, *ends)]
    return coloured(((along(places), SELECTED) for places in seen), len(spacing))
