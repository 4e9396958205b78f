"""What is seen of a result as colours: how far tissue goes, how its area changes, its strain."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from napari_hmrf.field.colormaps import SMALLEST, area_limits, reach_of
from napari_hmrf.field.deformation import FloatArray, determinant_or_fold
from napari_hmrf.field.strain import (
    equivalent_strain,
    magnitude,
    principal_strains,
    strain_values,
)
from napari_hmrf.solver.solution import Solution

Quantity = Literal[
    "magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", "shear"
]
_PER_CENT = 100.0
#: What there is to show, and its unit; "" stands for that of the lengths. Strains are
#: Green-Lagrange's, in per cent of the length; of a volume those of rows and columns, and the shear
#: between them, are those within its slices.
QUANTITIES: dict[Quantity, tuple[str, str]] = {
    "magnitude": ("displacement", ""),
    "jacobian": ("Jacobian", "area ratio"),
    "equivalent": ("equivalent strain", "%"),
    "stretch": ("largest stretch", "%"),
    "squeeze": ("largest squeeze", "%"),
    "rows": ("strain from row to row", "%"),
    "columns": ("strain from column to column", "%"),
    "shear": ("shear strain", "%"),
}


def title_and_unit(quantity: Quantity, axes: int = 2) -> tuple[str, str]:
    """What `QUANTITIES` says of a quantity, of a slice or of a volume, which has three axes."""
    title, unit = QUANTITIES[quantity]
    return title, unit.replace("area", "volume") if axes == 3 else unit


class Coloured(NamedTuple):
    """A quantity of the tissue before it moved, and the scale of its colours.

    Attributes
    ----------
    values : ndarray, shape ([D,] H, W), float32
        In the unit of `QUANTITIES`: strains in per cent. NaN where there is no tissue.
    limits : (float, float)
        Where the scale begins and ends.
    signed : bool
        Whether no change is in the middle of the scale, and not at its lower end.
    folded : bool
        Whether there are folds, which are at the lower limit, or beyond.
    """

    values: FloatArray
    limits: tuple[float, float]
    signed: bool
    folded: bool = False


def coloured(solution: Solution, quantity: Quantity) -> Coloured:
    """Compute a quantity, and how far its scale has to go.

    Parameters
    ----------
    solution : Solution
    quantity : {"magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", \
"shear"}
        The strains are Green-Lagrange's: "stretch" and "squeeze" the principal ones; "jacobian" is
        as of `area_change`.
    """
    values, signed = values_of(solution, quantity), quantity not in ("magnitude", "equivalent")
    if quantity == "jacobian":
        folded = bool((values <= 0).any())
        return Coloured(values, area_limits(values, folded), signed, folded)
    least = SMALLEST * (_PER_CENT if QUANTITIES[quantity][1] == "%" else 1)
    reach = reach_of(values, signed, least)
    return Coloured(values, (-reach if signed else 0.0, reach), signed)


def values_of(solution: Solution, quantity: Quantity) -> FloatArray:
    """Compute the values of `coloured` alone."""
    d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
    if quantity == "magnitude":
        return np.where(tissue, magnitude(d), np.float32(np.nan))
    if quantity == "jacobian":
        return area_change(solution)

    def value(strain: FloatArray) -> FloatArray:
        if quantity == "equivalent":
            return equivalent_strain(strain)
        if quantity in ("stretch", "squeeze"):
            return principal_strains(strain)[..., 0 if quantity == "stretch" else -1]
        one, other = {"rows": (-2, -2), "columns": (-1, -1), "shear": (-2, -1)}[quantity]
        return strain[..., one, other]

    return strain_values(value, d, spacing=spacing, tissue=tissue) * np.float32(_PER_CENT)


def area_change(solution: Solution) -> FloatArray:
    """By which factor the area, or volume, of each site changes; NaN where there is no tissue.

    Where tissue folds it is the smallest determinant around the site, so that it is 0 or below at
    all folds.
    """
    return determinant_or_fold(solution.displacement, solution.spacing, solution.tissue)
