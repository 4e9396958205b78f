"""What lies over the image of a result, one thing at a time, such as the strain as colours."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.colormaps import SMALLEST, area_limits, reach_of
from napari_hmrf.field.strain import (
    equivalent_strain,
    green_lagrange_strain,
    magnitude,
    principal_strains,
)
from napari_hmrf.layers.animation import Motion
from napari_hmrf.layers.label_colours import quantity_colours
from napari_hmrf.layers.result_layers import (
    OVER,
    LayerData,
    pixel_layer,
    result_layers,
    result_name,
)
from napari_hmrf.layers.result_lookup import FoundResult
from napari_hmrf.layers.tissue_point import area_change

Quantity = Literal[
    "magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", "shear"
]
FloatArray = npt.NDArray[np.float32]
_PER_CENT = 100.0
#: What there is to show, and its unit; "" stands for that of the lengths. Strains are
#: Green-Lagrange's, in per cent of the length.
QUANTITIES: dict[Quantity, tuple[str, str]] = {
    "magnitude": ("displacement", ""),
    "jacobian": ("Jacobian", "area ratio"),
    "equivalent": ("equivalent strain", "%"),
    "stretch": ("largest stretch", "%"),
    "squeeze": ("largest squeeze", "%"),
    "rows": ("strain along rows", "%"),
    "columns": ("strain along columns", "%"),
    "shear": ("shear strain", "%"),
}


def quantity_of(result: FoundResult, quantity: Quantity) -> FloatArray:
    """Compute a quantity of a result.

    Parameters
    ----------
    result : FoundResult
    quantity : {"magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", \
"shear"}
        The strains are Green-Lagrange's: "stretch" and "squeeze" the principal ones.

    Returns
    -------
    ndarray, shape (H, W), float32
        Of the tissue before it moved, in the unit of `QUANTITIES`: strains in per cent. NaN where
        there is none. "jacobian" is as of `area_change`.
    """
    solution = result.solution
    d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
    if quantity == "magnitude":
        return np.where(tissue, magnitude(d), np.float32(np.nan))
    if quantity == "jacobian":
        return area_change(solution)
    strain = green_lagrange_strain(d, spacing=spacing, tissue=tissue)
    shown: FloatArray
    if quantity == "equivalent":
        shown = equivalent_strain(strain)
    elif quantity in ("stretch", "squeeze"):
        shown = principal_strains(strain)[..., 0 if quantity == "stretch" else 1]
    else:
        row, col = {"rows": (0, 0), "columns": (1, 1), "shear": (0, 1)}[quantity]
        shown = strain[..., row, col]
    return shown * np.float32(_PER_CENT)


def quantity_layer(
    result: FoundResult, quantity: Quantity, values: FloatArray | None = None
) -> LayerData:
    """Colour every pixel of tissue by a quantity of a result, before it moves.

    What has two directions is drawn from purple (less) to orange (more), the rest from dark to
    light, and where hardly anything happens the image is seen. Folds are yellow, which is the
    colour of whatever is at the lower limit.

    Parameters
    ----------
    result, quantity
        As of `quantity_of`.
    values : ndarray, shape (H, W), optional
        What that gave, if it is known already.
    """
    values = quantity_of(result, quantity) if values is None else values
    signed, folded = quantity not in ("magnitude", "equivalent"), False
    if quantity == "jacobian":
        folded = bool((values <= 0).any())
        limits = area_limits(values, folded)
    else:
        least = SMALLEST * (_PER_CENT if QUANTITIES[quantity][1] == "%" else 1)
        reach = reach_of(values, signed, least)
        limits = (-reach if signed else 0.0, reach)
    look = {"colormap": quantity_colours(signed, folded), "contrast_limits": limits, **OVER}
    known = {"kind": quantity, **result.facts}
    return pixel_layer(result.frame, values, _name(result, quantity), known, look)


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
        values = quantity_of(result, name)
        made = quantity_layer(result, name, values)
        moved = np.asarray(Motion(solution, overlay=values).at(1).overlay)
        return Overlay(name, made._replace(data=frame.put_image(moved)), values)
    given = cast(Given, name)
    layers = result_layers(solution, frame, pictures, {given}, problem=result.problem).layers
    picture = pictures.labels if name == "labels" else None
    return Overlay(name, layers[given], picture) if given in layers else None
