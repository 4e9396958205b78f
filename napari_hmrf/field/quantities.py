"""Quantities of a result that are shown as colours: displacement, change of area, strain."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.colormaps import SMALLEST, area_limits, reach_of
from napari_hmrf.field.deformation import FloatArray, determinant_or_fold
from napari_hmrf.field.elastic_strain import strain_kind, values_of_strain
from napari_hmrf.field.strain import equivalent_strain, magnitude, principal_strains
from napari_hmrf.solver.solution import Solution

Quantity = Literal[
    "magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", "shear"
]
_PER_CENT = 100.0
#: Titles and units of the quantities; the unit "" stands for that of the lengths, "{kind}" for the
#: `StrainKind`. Strains are in per cent; of a volume those of rows and columns, and the shear
#: between them, are those within its slices.
QUANTITIES: dict[Quantity, tuple[str, str]] = {
    "magnitude": ("displacement", ""),
    "jacobian": ("Jacobian", "area ratio"),
    "equivalent": ("equivalent {kind} strain", "%"),
    "stretch": ("largest {kind} stretch", "%"),
    "squeeze": ("largest {kind} squeeze", "%"),
    "rows": ("{kind} strain from row to row", "%"),
    "columns": ("{kind} strain from column to column", "%"),
    "shear": ("{kind} shear strain", "%"),
}


def title_and_unit(quantity: Quantity, solution: Solution) -> tuple[str, str]:
    """Return the title of a quantity of a solution, which names the kind of a strain; its unit."""
    title, unit = QUANTITIES[quantity]
    if solution.tissue.ndim == 3:
        unit = unit.replace("area", "volume")
    return title.format(kind=strain_kind(solution)), unit


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
        Strains are of the kind that `strain_kind` says; "stretch" and "squeeze" are the principal
        ones, of an image those within it. "jacobian" is as of `area_change`.
    """
    values, signed = values_of(solution, quantity), quantity not in ("magnitude", "equivalent")
    if quantity == "jacobian":
        folded = bool((values <= 0).any())
        return Coloured(values, area_limits(values, folded), signed, folded)
    least = SMALLEST * (_PER_CENT if QUANTITIES[quantity][1] == "%" else 1)
    reach = reach_of(values, signed, least)
    return Coloured(values, (-reach if signed else 0.0, reach), signed)


def values_of(solution: Solution, quantity: Quantity, fraction: float = 1.0) -> FloatArray:
    """Compute the values of `coloured` alone, after a part of the deformation."""
    tissue = solution.tissue
    if quantity == "magnitude":
        return np.where(tissue, fraction * magnitude(solution.displacement), np.float32(np.nan))
    if quantity == "jacobian":
        return area_change(solution, fraction)

    def value(strain: npt.NDArray[np.float64], across: npt.ArrayLike) -> npt.NDArray[np.floating]:
        if quantity == "equivalent":
            return equivalent_strain(strain, across)
        if quantity in ("stretch", "squeeze"):
            return principal_strains(strain)[..., 0 if quantity == "stretch" else -1]
        one, other = {"rows": (-2, -2), "columns": (-1, -1), "shear": (-2, -1)}[quantity]
        return strain[..., one, other]

    return values_of_strain(solution, value, fraction) * np.float32(_PER_CENT)


def area_change(solution: Solution, fraction: float = 1.0) -> FloatArray:
    """Compute the factor by which the area, or volume, of each site changes.

    NaN where there is no tissue. Where tissue folds it is the smallest determinant around the site,
    so that it is 0 or below at all folds.
    """
    displacement = solution.displacement * np.float32(fraction)
    return determinant_or_fold(displacement, solution.spacing, solution.tissue)
