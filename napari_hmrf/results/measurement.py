"""Measurements of the deformation of each tissue."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import is_whole, refuse_unless, require_kind
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.deformation import FloatArray, determinant, jacobian_determinant
from napari_hmrf.field.parts import Sites, in_one_part
from napari_hmrf.field.strain import equivalent_strain, fold_mask, magnitude
from napari_hmrf.field.warp import Float64Array, numbered_sites
from napari_hmrf.real_arrays import as_numbers, grid_in_words, whole_numbers
from napari_hmrf.solver.elastic_strain import StrainKind, strain_kind, values_of_strain
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.stress import hydrostatic_pressure, stress_values, von_mises_stress

# Number of planes of cells processed together.
_SLAB = 8
# Largest difference between two means of the same tissue, relative to the size of a pixel plus the
# standard deviation.
_SAME_MEAN = 0.05


class MeanBars(Protocol):
    """Mean displacement of a label with its standard deviations, as in `MeanDisplacement`."""

    @property
    def mean(self) -> Float64Array:
        """Mean displacement along each axis, shape (n,)."""

    @property
    def sd(self) -> Float64Array:
        """Standard deviation along each axis, shape (n,)."""

    @property
    def along(self) -> float:
        """Standard deviation along the motion."""


@runtime_checkable
class LabelBars(Protocol):
    """Record with the mean displacements of labels, as in `Uncertainty`."""

    @property
    def labels(self) -> Mapping[int, MeanBars]:
        """Mean displacement of each label."""

    @property
    def along(self) -> npt.NDArray[np.float32]:
        """Standard deviations of patches."""


class Measurement(NamedTuple):
    """Measurements of the tissue with one label.

    Attributes
    ----------
    label : int
    name : str
    pixels : int
        Number of pixels of the tissue before the motion.
    size : float
        Area, or volume, before the motion, in the squared, or cubed, unit of the spacing.
    size_change : float
        Change in the area or volume, in per cent, computed from the cells between sites. Each cell
        counts towards the tissues at its corners; inverted cells have negative size. A site in no
        cell counts with its own Jacobian, as much as a site with all its cells.
    mean_displacement, largest_displacement : float
        Mean and largest length of the displacement, in the unit of the spacing.
    mean_strain, largest_strain : float
        Von Mises equivalent strain, in per cent, of the kind given by `strain`.
    folds : int
        Number of pixels at which the tissue folds.
    strain : {"elastic", "in-plane", "total"}
        "elastic": the model's elastic strain in all three directions, without growth, as in
        `Solution.strain`. "in-plane": total strain within an image, for models without a third
        direction such as the paper's. "total": total strain of a volume.
    mean_von_mises, largest_von_mises, mean_pressure : float, optional
        Mean and largest von Mises stress, and mean pressure, of the sites with a stress; None if
        there are none, as for the paper's model and rigid tissue.
    stress_unit : str
        Unit of the stress; "" if the stiffness is relative.
    mean_displacement_sd : float, optional
        Standard deviation of the mean displacement along the motion: the error bar of
        `mean_displacement`. None if the uncertainty is unknown.
    mean_vector, mean_vector_sd : tuple of float
        Mean displacement along each axis, and its standard deviation, in the unit of the spacing;
        empty if the uncertainty is unknown.
    """

    label: int
    name: str
    pixels: int
    size: float
    size_change: float
    mean_displacement: float
    largest_displacement: float
    mean_strain: float
    largest_strain: float
    folds: int
    strain: StrainKind = "elastic"
    mean_von_mises: float | None = None
    largest_von_mises: float | None = None
    mean_pressure: float | None = None
    stress_unit: str = ""
    mean_displacement_sd: float | None = None
    mean_vector: tuple[float, ...] = ()
    mean_vector_sd: tuple[float, ...] = ()

    def __repr__(self) -> str:
        stress = ""
        if self.mean_von_mises is not None:
            stress = f", von Mises stress {self.mean_von_mises:.3g} {self.stress_unit}".rstrip()
        return (
            f"Measurement({self.label} {self.name!r}, {self.pixels} sites, size change "
            f"{self.size_change:.3g} %, moved {self.mean_displacement:.3g}, {self.strain} strain "
            f"{self.mean_strain:.3g} %{stress}, {self.folds} folds)"
        )


def measure(
    solution: Solution,
    labels: npt.ArrayLike,
    *,
    names: Mapping[int, str] | None = None,
    uncertainty: LabelBars | None = None,
) -> tuple[Measurement, ...]:
    """Measure the deformation of each tissue.

    Parameters
    ----------
    solution : Solution
    labels : array_like of int, shape ([D,] H, W)
        Labels before the motion. Pixels outside the solution's tissue are ignored.
    names : mapping of int to str, optional
        Name of the tissue with each label.
    uncertainty : Uncertainty, optional
        Uncertainty of this solution with these labels, for the error bars of the mean
        displacements. Labels that it lacks, such as the label 0, have no error bar.

    Returns
    -------
    tuple of Measurement
        Measurements in the order of the labels; labels without tissue are omitted.

    Raises
    ------
    ArgumentError
        If `solution` is not a Solution, or `names` is not a mapping with integer keys.
    ProblemError
        If the labels are not integers on the pixels of the solution, or if `uncertainty` belongs to
        other labels or another solution.
    """
    require_kind(Solution, "solution", solution, "the result of solve()")
    if uncertainty is not None:
        requirement = "the result of uncertainty(problem, labels=labels)"
        is_known = isinstance(uncertainty, LabelBars)
        refuse_unless(is_known, "uncertainty", uncertainty, requirement)
    if names is not None:
        requirement = 'a mapping of labels to names, such as {1: "bone"}'
        is_by_label = isinstance(names, Mapping) and all(map(is_whole, names))
        refuse_unless(is_by_label, "names", names, requirement)
    image = as_numbers("labels", labels)
    d, tissue = solution.displacement, solution.tissue
    if not image.ndim:
        refuse_unless(False, "labels", labels, "an array of the labels of all pixels")
    if image.dtype.kind == "f":
        image = whole_numbers("labels", image)
    if image.shape != tissue.shape or image.dtype.kind not in "biu":
        raise ProblemError(
            "labels",
            f"are {grid_in_words(image.shape)} of type {image.dtype}. Pass whole numbers on the "
            f"{grid_in_words(tissue.shape)} pixels of the solution.",
        )
    spacing = solution.spacing
    length, folded = magnitude(d), fold_mask(d, **solution.on_grid)
    change, weight = _changes(solution)
    strain, kind = values_of_strain(solution, equivalent_strain), strain_kind(solution)
    stress = None
    if solution.elasticity is not None:
        stress = stress_values(solution, _von_mises_and_pressure)
    pixel = float(np.prod(spacing))
    measurements = []
    for label in np.unique(image[tissue]).tolist():
        mask = tissue & (image == label)
        bars = None if uncertainty is None else uncertainty.labels.get(int(label))
        measurements.append(
            Measurement(
                label=int(label),
                name=(names or {}).get(int(label), ""),
                pixels=int(mask.sum()),
                size=float(mask.sum() * pixel),
                size_change=float(100 * (np.average(change[mask], weights=weight[mask]) - 1)),
                mean_displacement=float(length[mask].mean()),
                largest_displacement=float(length[mask].max()),
                mean_strain=float(100 * np.nanmean(strain[mask])),
                largest_strain=float(100 * np.nanmax(strain[mask])),
                folds=int(folded[mask].sum()),
                strain=kind,
                **{} if stress is None else _of_stress(stress[mask], solution.stress_unit),
                **({} if bars is None else _error_bars(bars, d[mask], int(label), spacing)),
            )
        )
    has_bars = any(row.mean_displacement_sd is not None for row in measurements)
    if measurements and uncertainty is not None and not has_bars:
        raise ProblemError(
            "uncertainty",
            "has none of these labels. Pass uncertainty(problem, labels=labels) with the same "
            "labels.",
        )
    return tuple(measurements)


def _von_mises_and_pressure(stress: Float64Array) -> FloatArray:
    """Return the von Mises stress and the pressure of stresses, (N, 2)."""
    return np.stack([von_mises_stress(stress), hydrostatic_pressure(stress)], axis=-1)


def _of_stress(values: FloatArray, unit: str) -> dict[str, Any]:
    """Return the measurements of the von Mises stress and the pressure at N sites, (N, 2)."""
    known = values[np.isfinite(values).all(axis=-1)].astype(np.float64)
    if not len(known):
        return {"stress_unit": unit}
    return {
        "mean_von_mises": float(known[:, 0].mean()),
        "largest_von_mises": float(known[:, 0].max()),
        "mean_pressure": float(known[:, 1].mean()),
        "stress_unit": unit,
    }


def _error_bars(
    bars: MeanBars, moved: npt.NDArray[np.floating], label: int, spacing: tuple[float, ...]
) -> dict[str, Any]:
    """Return the error bars of a label, after checking that they belong to its tissue.

    Parameters
    ----------
    bars : MeanBars
    moved : ndarray, shape (N, n)
        Displacement of each site of the label.
    label : int
    spacing : tuple of float
    """
    mean = moved.mean(axis=0, dtype=np.float64)
    allowed = _SAME_MEAN * (np.array(spacing) + bars.sd)
    if len(bars.mean) != len(mean) or (np.abs(mean - bars.mean) > allowed).any():
        raise ProblemError(
            "uncertainty",
            f"has another mean displacement of the label {label}, so it belongs to other labels or "
            "to another solution. Pass uncertainty(problem, labels=labels) with the same problem "
            "and labels.",
        )
    return {
        "mean_displacement_sd": float(bars.along),
        "mean_vector": tuple(mean.tolist()),
        "mean_vector_sd": tuple(bars.sd.tolist()),
    }


def _changes(solution: Solution) -> tuple[Float64Array, Float64Array]:
    """Return the mean size ratio of the cells around each site, and the number of cells."""
    d = solution.displacement
    moved, sites = numbered_sites(d, **solution.on_grid)
    total, count = np.zeros(sites.shape), np.zeros(sites.shape)
    for begin in range(0, len(sites) - 1, _SLAB):
        slab = slice(begin, begin + _SLAB + 1)
        cells = _cells(moved[slab], sites[slab])
        for corner in _corners(sites.ndim):
            total[slab][corner] += np.nan_to_num(cells)
            count[slab][corner] += np.isfinite(cells)
    # Sites without cells, in thin tissue, use the determinant at the site, with full weight.
    alone = jacobian_determinant(d, **solution.on_grid)
    change = np.divide(total, count, out=alone.astype(np.float64), where=count > 0)
    return change, np.where(count, count, 2**sites.ndim)


def _cells(moved: Float64Array, sites: Sites) -> Float64Array:
    """Return the area, or volume, of the cells between sites, 1 at rest; NaN outside tissue.

    Cells between two parts count as outside tissue.
    """
    # The size is exact if tissue moves linearly along the edges of cells, and is negative for
    # inverted cells. Unlike a sum of determinants at the sites, the sum of the sizes then equals
    # the area within the outer border of the tissue.
    corners = [moved[each] for each in _corners(sites.ndim)]
    if sites.ndim == 2:
        a, b, c, d = corners
        size = determinant([d - a, c - b]) / -2
    else:
        a, b, c, d, e, f, g, h = corners
        # See Grandy, "Efficient computation of volume of hexahedral cells", 1997.
        size = determinant([(h - e) + (d - a), h - c, g - a])
        size += determinant([d - a, (h - c) + (f - a), h - b])
        size += determinant([h - e, f - a, (h - b) + (g - a)])
        size /= 12
    return np.where(in_one_part(sites), size, np.nan)


def _corners(ndim: int) -> list[tuple[slice, ...]]:
    """Return, for each corner of a cell, the slices that select this corner of all cells."""
    return [*product((slice(None, -1), slice(1, None)), repeat=ndim)]
