"""What lies over the image of a result, one thing at a time, such as the strain as colours."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.animation import Motion
from napari_hmrf.field.quantities import QUANTITIES, Coloured, Quantity, coloured
from napari_hmrf.layers.label_colours import quantity_colours
from napari_hmrf.layers.result_layers import (
    OVER,
    LayerData,
    pixel_layer,
    result_layers,
    result_name,
)
from napari_hmrf.layers.result_lookup import FoundResult


def quantity_layer(
    result: FoundResult, quantity: Quantity, shown: Coloured | None = None
) -> LayerData:
    """Colour every pixel of tissue by a quantity of a result, before it moves.

    What has two directions is drawn from purple (less) to orange (more), the rest from dark to
    light, and where hardly anything happens the image is seen. Folds are yellow, which is the
    colour of whatever is at the lower limit.

    Parameters
    ----------
    result : FoundResult
    quantity : {"magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", \
"shear"}
    shown : Coloured, optional
        What `coloured` says of it, if that is known already.
    """
    shown = shown or coloured(result.solution, quantity)
    colours = quantity_colours(shown.signed, shown.folded)
    look = {"colormap": colours, "contrast_limits": shown.limits, **OVER}
    known = {"kind": quantity, **result.facts}
    return pixel_layer(result.frame, shown.values, _name(result, quantity), known, look)


def _name(result: FoundResult, quantity: Quantity) -> str:
    title, unit = QUANTITIES[quantity]
    where = str(result.facts.get("slice_seen", ""))
    parameters = result.solution.provenance.parameters
    return result_name(result.source, f"{title} ({unit or result.unit})", parameters, where)


Given = Literal["grid", "labels", "folds", "stiffness", "observed", "confidence"]
#: What there is to lie over the image.
Name = Quantity | Given


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
    picture: npt.NDArray[Any] | None = None


def overlay_of(result: FoundResult, name: Name) -> Overlay | None:
    """Make what is to lie over the image of a result; on the compute thread only.

    Quantities, the grid and the labels move with the tissue. Folds, and what was given, lie where
    tissue was before it moved.

    Returns
    -------
    Overlay or None
        None if the result has nothing of that name: no folds, no labels, or no problem.
    """
    solution, frame, pictures = result.solution, result.frame, result.pictures
    if name in QUANTITIES:
        shown = coloured(solution, name)
        made = quantity_layer(result, name, shown)
        moved = np.asarray(Motion(solution, overlay=shown.values).at(1).overlay)
        return Overlay(name, made._replace(data=frame.put_image(moved)), shown.values)
    given = cast(Given, name)
    layers = result_layers(solution, frame, pictures, {given}, problem=result.problem).layers
    picture = pictures.labels if name == "labels" else None
    return Overlay(name, layers[given], picture) if given in layers else None
