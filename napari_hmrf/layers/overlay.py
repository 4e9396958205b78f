"""What lies over the image of a result: one thing at a time."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.animation import Motion
from napari_hmrf.layers.result_layers import LayerData, result_layers
from napari_hmrf.layers.result_lookup import FoundResult
from napari_hmrf.layers.strain_layers import QUANTITIES, Quantity, quantity_layer, quantity_of

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
        values = quantity_of(result, name)
        made = quantity_layer(result, name, values)
        moved = np.asarray(Motion(solution, overlay=values).at(1).overlay)
        return Overlay(name, made._replace(data=frame.put_image(moved)), values)
    given = cast(Given, name)
    layers = result_layers(solution, frame, pictures, {given}, problem=result.problem).layers
    picture = pictures.labels if name == "labels" else None
    return Overlay(name, layers[given], picture) if given in layers else None
