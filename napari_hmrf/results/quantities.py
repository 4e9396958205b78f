"""Quantities of a result that are displayed in colour: displacement, area change, strain."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.colormaps import SMALLEST, area_limits, reach_of
from napari_hmrf.field.deformation import FloatArray, determinant_or_fold
from napari_hmrf.field.strain import equivalent_strain, fold_mask, magnitude, principal_strains
from napari_hmrf.solver.elastic_strain import strain_kind, values_of_strain
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.stress import hydrostatic_pressure, stress_values, von_mises_stress

Quantity = Literal[
    "magnitude",
    "jacobian",
    "equivalent",
    "stretch",
    "squeeze",
    "rows",
    "columns",
    "shear",
    "von_mises",
    "pressure",
]
_PER_CENT = 100.0
#: Largest end of a scale of strain, in per cent. Larger strain occurs only at sites that nearly
#: fold, and would make the strain of the other tissue invisible.
_LARGEST_STRAIN = 100.0
#: Distance of clipped values from the ends of a scale, as a fraction of the scale. napari draws
#: values at one end in the colour of folds, and stops its search for folds in a 3-D view at values
#: at this end.
_INSIDE = 1e-3
#: Function of the stress that each quantity of the stress shows.
_OF_STRESS: dict[Quantity, Callable[[npt.NDArray[np.float64]], FloatArray]] = {
    "von_mises": von_mises_stress,
    "pressure": hydrostatic_pressure,
}
#: Title and unit of each quantity. The unit "" means the unit of length, "{stress}" is replaced by
#: the unit of stress, and "{kind}" by the `StrainKind`. "rows", "columns" and "shear" are the
#: components of the strain within slices, also for a volume.
QUANTITIES: dict[Quantity, tuple[str, str]] = {
    "magnitude": ("displacement", ""),
    "jacobian": ("area change", "ratio"),
    "equivalent": ("equivalent {kind} strain", "%"),
    "stretch": ("maximum {kind} stretch", "%"),
    "squeeze": ("maximum {kind} compression", "%"),
    "rows": ("{kind} strain from row to row", "%"),
    "columns": ("{kind} strain from column to column", "%"),
    "shear": ("{kind} shear strain", "%"),
    "von_mises": ("von Mises stress", "{stress}"),
    "pressure": ("pressure", "{stress}"),
}


def title_and_unit(quantity: Quantity, solution: Solution) -> tuple[str, str]:
    """Return the title and the unit of a quantity; the title of a strain includes its kind."""
    title, unit = QUANTITIES[quantity]
    if solution.tissue.ndim == 3:
        title = title.replace("area", "volume")
    words = {"kind": strain_kind(solution), "stress": solution.stress_unit or "relative"}
    return title.format(**words), unit.format(**words)


class Coloured(NamedTuple):
    """Quantity of the tissue on the pixels before the motion, and its colour scale.

    Attributes
    ----------
    values : ndarray, shape ([D,] H, W), float32
        Values in the unit of `QUANTITIES`; NaN outside tissue. Strain and stress at folds are
        infinity, or -infinity if `descending`.
    limits : (float, float)
        Ends of the scale.
    signed : bool
        True if the middle of the scale means no change; False if its lower end does.
    folded : bool
        True if any tissue is folded.
    descending : bool
        True if folds are below the scale, and a 3-D view shows the lowest value on each line of
        sight. Otherwise, folds are above the scale, and a 3-D view shows the highest value.
    """

    values: FloatArray
    limits: tuple[float, float]
    signed: bool
    folded: bool = False
    descending: bool = False

    @property
    def unit_note(self) -> str:
        """Explanation of the colour of folds, for the legend; "" without folds."""
        return "; blue: folded" if self.folded else ""

    def is_fold(self, values: FloatArray) -> npt.NDArray[np.bool_]:
        """Return a mask of the folds in `values`, or in a slice of `values`."""
        if not self.folded:
            return np.zeros(values.shape, dtype=bool)
        is_infinite = bool(np.isinf(self.values).any())
        mask: npt.NDArray[np.bool_] = np.isinf(values) if is_infinite else values <= 0
        return mask


def coloured(solution: Solution, quantity: Quantity) -> Coloured:
    """Compute a quantity and the ends of its colour scale.

    Parameters
    ----------
    solution : Solution
    quantity : {"magnitude", "jacobian", "equivalent", "stretch", "squeeze", "rows", "columns", \
"shear", "von_mises", "pressure"}
        Strains are of the kind given by `strain_kind`. "stretch" is the largest and "squeeze" the
        smallest principal strain, in the plane of an image. "jacobian" is computed by
        `area_change`.

    Returns
    -------
    Coloured
    """
    values = values_of(solution, quantity)
    signed = quantity not in ("magnitude", "equivalent", "von_mises")
    if quantity == "jacobian":
        folded = bool(_folds(solution).any())
        return Coloured(values, area_limits(values, folded), signed, folded, folded)
    is_strain = QUANTITIES[quantity][1] == "%"
    if is_strain or quantity in _OF_STRESS:
        values = without_folds(values, solution, quantity)
    reach = reach_of(values, signed, SMALLEST * _size_of_one(solution, quantity))
    if is_strain:
        reach = min(reach, _LARGEST_STRAIN)
    folded, descending = bool(np.isinf(values).any()), quantity == "squeeze"
    return Coloured(values, (-reach if signed else 0.0, reach), signed, folded, descending)


def _size_of_one(solution: Solution, quantity: Quantity) -> float:
    """Return the size of a quantity at a strain, or a displacement, of about 1."""
    if quantity in _OF_STRESS and solution.elasticity is not None:
        stiffness = solution.elasticity.stiffness
        return float(stiffness[np.isfinite(stiffness)].max(initial=0.0)) or 1.0
    return _PER_CENT if QUANTITIES[quantity][1] == "%" else 1.0


def neutral_value(quantity: Quantity) -> float:
    """Return the value of a quantity without deformation, which is drawn transparently."""
    return 1.0 if quantity == "jacobian" else 0.0


def without_folds(
    values: FloatArray, solution: Solution, quantity: Quantity, fraction: float = 1.0
) -> FloatArray:
    """Replace strain or stress at folds, where it is not defined, by infinity or -infinity.

    The sign is that of the values that matter most, so that other values on a line of sight do not
    hide folds in a 3-D view.
    """
    fold = np.float32(-np.inf if quantity == "squeeze" else np.inf)
    return np.where(_folds(solution, fraction), fold, values)


def _folds(solution: Solution, fraction: float = 1.0) -> npt.NDArray[np.bool_]:
    """Return a mask of the folds at a fraction of the deformation, as they are counted."""
    return fold_mask(solution.displacement * np.float32(fraction), **solution.on_grid)


def within(values: FloatArray, limits: tuple[float, float]) -> FloatArray:
    """Clip strain to the inside of a scale, so that only folds are at or beyond an end."""
    low, high = limits
    margin = _INSIDE * (high - low)
    return np.where(np.isinf(values), values, np.clip(values, low + margin, high - margin))


def values_of(solution: Solution, quantity: Quantity, fraction: float = 1.0) -> FloatArray:
    """Compute the values of a quantity at a fraction of the deformation.

    Parameters
    ----------
    solution, quantity
        As for `coloured`.
    fraction : float
        Fraction of the displacement, from 0 to 1.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        Values in the unit of `QUANTITIES`; NaN outside tissue.
    """
    tissue = solution.tissue
    if quantity == "magnitude":
        return np.where(tissue, fraction * magnitude(solution.displacement), np.float32(np.nan))
    if quantity == "jacobian":
        return area_change(solution, fraction)
    if quantity in _OF_STRESS:
        return stress_values(solution, _OF_STRESS[quantity], fraction=fraction)

    def value(strain: npt.NDArray[np.float64], across: npt.ArrayLike) -> npt.NDArray[np.floating]:
        if quantity == "equivalent":
            return equivalent_strain(strain, across)
        if quantity in ("stretch", "squeeze"):
            return principal_strains(strain)[..., 0 if quantity == "stretch" else -1]
        one, other = {"rows": (-2, -2), "columns": (-1, -1), "shear": (-2, -1)}[quantity]
        return strain[..., one, other]

    return values_of_strain(solution, value, fraction) * np.float32(_PER_CENT)


def area_change(solution: Solution, fraction: float = 1.0) -> FloatArray:
    """Compute the ratio of the areas, or volumes, after and before the motion at each site.

    The ratio is the Jacobian determinant. At folds it is the smallest determinant around the site,
    which is 0 or below. Outside tissue it is NaN.
    """
    displacement = solution.displacement * np.float32(fraction)
    return determinant_or_fold(displacement, **solution.on_grid)
