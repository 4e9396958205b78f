"""What a displacement does to the tissue, as colours: how far, area change, strain."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.colormaps import OPACITY, SMALLEST, area_limits, reach_of
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.field.strain import (
    equivalent_strain,
    green_lagrange_strain,
    jacobian_determinant,
    magnitude,
    principal_strains,
)
from napari_hmrf.layers.label_colours import quantity_colours
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.result_layers import LayerData, result_name
from napari_hmrf.layers.result_lookup import FoundResult

Quantity = Literal[
    "magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", "shear"
]
FloatArray = npt.NDArray[np.float32]
_PER_CENT = 100.0


class _Words(NamedTuple):
    """What a quantity is called, and its unit; "" stands for that of the lengths."""

    title: str
    unit: str


#: What there is to show; strains are Green-Lagrange's, in per cent of the length.
QUANTITIES: dict[Quantity, _Words] = {
    "magnitude": _Words("displacement", ""),
    "jacobian": _Words("Jacobian", "area ratio"),
    "equivalent": _Words("equivalent strain", "%"),
    "stretch": _Words("largest stretch", "%"),
    "squeeze": _Words("largest squeeze", "%"),
    "rows": _Words("strain along rows", "%"),
    "columns": _Words("strain along columns", "%"),
    "shear": _Words("shear strain", "%"),
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
        there is none. Where tissue folds "jacobian" is the smallest determinant around the site, so
        that it is 0 or below at all folds.
    """
    solution = result.solution
    d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
    if quantity == "magnitude":
        return np.where(tissue, magnitude(d), np.float32(np.nan))
    if quantity == "jacobian":
        smallest = smallest_determinant(d, spacing, tissue)
        at_sites = jacobian_determinant(d, spacing=spacing, tissue=tissue)
        return np.where(smallest <= 0, smallest, at_sites)
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
        least = SMALLEST * (_PER_CENT if QUANTITIES[quantity].unit == "%" else 1)
        reach = reach_of(values, signed, least)
        limits = (-reach if signed else 0.0, reach)
    attributes = {
        **result.frame.placement(image=True),
        "name": _name(result, quantity),
        "rgb": False,
        "colormap": quantity_colours(signed, folded),
        "contrast_limits": limits,
        "blending": "translucent",
        "opacity": OPACITY,
        "metadata": {METADATA: {"kind": quantity, **result.facts}},
    }
    return LayerData(result.frame.put_image(values), attributes, "image")


def _name(result: FoundResult, quantity: Quantity) -> str:
    words = QUANTITIES[quantity]
    what = f"{words.title} ({words.unit or result.unit})"
    where = str(result.facts.get("slice_seen") or result.facts.get("slice") or "")
    return result_name(result.source, what, result.solution.provenance.parameters, where)
