"""What lies over the image of a result, one thing at a time, such as the strain as colours."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from napari_hmrf.field.animation import Motion, moved_grid
from napari_hmrf.field.colormaps import reach_of
from napari_hmrf.field.comparison import Comparison
from napari_hmrf.field.deformation import pixels_between
from napari_hmrf.field.quantities import QUANTITIES, Coloured, Quantity, coloured
from napari_hmrf.field.strain import folds
from napari_hmrf.layers.arrow_layer import spread
from napari_hmrf.layers.label_colours import (
    OBSERVED,
    OVER,
    confidence_look,
    fold_colours,
    quantity_colours,
    stiffness_colours,
)
from napari_hmrf.layers.result_layers import Answer, Array, LayerData
from napari_hmrf.solver.problem import Problem

#: What there is to lie over the image.
Name = (
    Quantity
    | Literal["grid", "labels", "difference", "folds", "stiffness", "observed", "confidence"]
)
#: Arrows of what is given that fit beside each other across the image.
_ACROSS = 40
#: Of what does not move with the tissue.
_BEFORE = "{} where tissue was"


class Overlay(NamedTuple):
    """What lies over the image of a result.

    Attributes
    ----------
    name : Name
    layer : LayerData
        When all of the deformation is seen.
    picture : ndarray, shape (H, W), optional
        Its pixels before they move with the tissue; None if they do not, or if it is of lines.
    """

    name: Name
    layer: LayerData
    picture: Array | None = None


def overlay_of(answer: Answer, name: Name, compared: Comparison | None = None) -> Overlay | None:
    """Make what is to lie over the image of a result; on the compute thread only.

    All moves with the tissue, the difference to what it was `compared` with, too. Folds, and arrows
    of the motion that was given, begin where tissue was, as their names say.

    Returns
    -------
    Overlay or None
        None if the result has nothing of that name: no folds, no labels, no reference, or no
        problem.
    """
    solution, pictures, problem = answer.solution, answer.pictures, answer.problem
    made: LayerData | None = None
    look: dict[str, Any]
    picture: Array | None = None
    if name in QUANTITIES:
        shown = coloured(solution, name)
        made, picture = quantity_layer(answer, name, shown), shown.values
    elif name == "labels" and pictures.labels is not None:
        look, source, picture = pictures.labels_look, pictures.labels_name, pictures.labels
        made = answer.pixels(name, picture, "deformed", look, "labels", source)
    elif name == "difference":
        if compared is not None:
            picture, what = compared.difference, f"difference from {compared.reference}"
            shown = Coloured(picture, (0.0, reach_of(picture)), signed=False)
            made = _coloured_layer(answer, name, shown, f"{what} ({answer.unit})")
    elif name == "grid":
        look = {"vector_style": "line", "edge_color": "cyan", "edge_width": max(answer.shape) / 500}
        made = answer.vectors(name, moved_grid(solution), name, look)
    elif name == "folds":
        made = _fold_layer(answer)
    elif problem is not None and name == "observed":
        made = _motion_layer(answer, problem)
    elif problem is not None and name != "labels":
        made, picture = _given_layer(answer, problem, name)
    if made is not None and picture is not None:
        moved = np.asarray(Motion(solution, overlay=picture).at(1).overlay)
        made = made._replace(data=answer.frame.put_image(moved))
    return None if made is None else Overlay(name, made, picture)


def quantity_layer(answer: Answer, quantity: Quantity, shown: Coloured | None = None) -> LayerData:
    """Colour every pixel of tissue by a quantity of a result, before it moves.

    What has two directions is drawn from purple (less) to orange (more), the rest from dark to
    light, and where hardly anything happens the image is seen. Folds are yellow, which is the
    colour of whatever is at the lower limit.

    Parameters
    ----------
    answer : Answer
    quantity : {"magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", \
"shear"}
    shown : Coloured, optional
        What `coloured` says of it, if that is known already.
    """
    shown = shown or coloured(answer.solution, quantity)
    title, unit = QUANTITIES[quantity]
    return _coloured_layer(answer, quantity, shown, f"{title} ({unit or answer.unit})")


def _coloured_layer(answer: Answer, name: Name, shown: Coloured, what: str) -> LayerData:
    """Colour every pixel of tissue, before it moves."""
    colours = quantity_colours(shown.signed, shown.folded)
    look = {"colormap": colours, "contrast_limits": shown.limits, **OVER}
    return answer.pixels(name, shown.values, what, look)


def _fold_layer(answer: Answer) -> LayerData | None:
    """Where the tissue folds over itself, before it moved; None if it does not."""
    solution = answer.solution
    folded = folds(solution.displacement, spacing=solution.spacing, tissue=solution.tissue)
    if not folded.any():
        return None
    look = {"colormap": fold_colours(), "opacity": 1.0}
    return answer.pixels("folds", folded.astype(np.uint8), _BEFORE.format("folds"), look, "labels")


def _given_layer(answer: Answer, problem: Problem, name: Name) -> tuple[LayerData, Array]:
    """How stiff tissue was taken to be (m), or how sure it is how it was to move (c)."""
    if name == "confidence":
        c = problem.confidence.max(axis=-1)
        return answer.pixels(name, c, "confidence (0 to 1)", confidence_look()), c
    m = problem.stiffness
    most = float(m[np.isfinite(m)].max(initial=0.0)) or 1.0
    look = {"colormap": stiffness_colours(), "contrast_limits": (1e-9, most), **OVER}
    tissue = answer.solution.provenance.parameters.get("tissue", {})
    unit = tissue.get("unit") or tissue.get("curve", {}).get("unit") or "relative"
    return answer.pixels(name, m, f"stiffness ({unit})", look), m


def _motion_layer(answer: Answer, problem: Problem) -> LayerData:
    """How tissue was to move (y), as arrows."""
    y, known = problem.observed, problem.known  # what was held has a dot
    apart = pixels_between(_ACROSS, answer.shape, problem.spacing)
    starts = spread(np.asarray(known.any(axis=-1)), apart)
    steps = np.where(known, y, 0)[tuple(starts.T)] / problem.spacing
    arrows = np.stack([starts, steps], axis=1).astype(np.float32)
    width = max(answer.shape) / 300
    look = {"vector_style": "arrow", "edge_color": OBSERVED, "edge_width": width}
    return answer.vectors("observed", arrows, _BEFORE.format("motion given"), look)
