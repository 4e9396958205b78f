"""What a deformation did to each tissue, in numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.deformation import jacobian_determinant
from napari_hmrf.field.strain import equivalent_strain, folds, magnitude, strain_values
from napari_hmrf.solver.problem import as_numbers, grid_in_words
from napari_hmrf.solver.solution import Solution


class Measurement(NamedTuple):
    """What happened to the tissue under one label.

    Attributes
    ----------
    label : int
    name : str
    pixels : int
        Of tissue, before it moved.
    area : float
        Before it moved, in the squared unit of the spacing; of a volume its volume, in the cubed.
    area_change : float
        In per cent; of a volume, of its volume.
    mean_displacement, largest_displacement : float
        In the unit of the spacing.
    mean_strain, largest_strain : float
        Equivalent strain of von Mises, in a slice of plane strain, in per cent.
    folds : int
        Pixels at which it is pushed through itself.
    """

    label: int
    name: str
    pixels: int
    area: float
    area_change: float
    mean_displacement: float
    largest_displacement: float
    mean_strain: float
    largest_strain: float
    folds: int


def measure(
    solution: Solution, labels: npt.ArrayLike, *, names: Mapping[int, str] | None = None
) -> tuple[Measurement, ...]:
    """Measure what a deformation did to each tissue.

    Parameters
    ----------
    solution : Solution
    labels : array_like of int, shape ([D,] H, W)
        Before it moved. What is no tissue of the solution is left out, whatever its label.
    names : mapping of int to str, optional
        Of the labels.

    Returns
    -------
    tuple of Measurement
        By label; those without tissue are left out.

    Raises
    ------
    ProblemError
        If the labels are not on the pixels of the solution.
    """
    image = as_numbers("labels", labels)
    d, tissue = solution.displacement, solution.tissue
    if image.shape != tissue.shape or image.dtype.kind not in "biu":
        raise ProblemError(
            "labels",
            f"are {grid_in_words(image.shape)} of type {image.dtype}. Give whole numbers on the "
            f"{grid_in_words(tissue.shape)} pixels of the solution.",
        )
    spacing = solution.spacing
    length, folded = magnitude(d), folds(d, spacing=spacing, tissue=tissue)
    area = jacobian_determinant(d, spacing=spacing, tissue=tissue)
    strain = strain_values(equivalent_strain, d, spacing=spacing, tissue=tissue)
    pixel = float(np.prod(spacing))
    found = []
    for label in np.unique(image[tissue]).tolist():
        there = tissue & (image == label)
        found.append(
            Measurement(
                label=int(label),
                name=(names or {}).get(int(label), ""),
                pixels=int(there.sum()),
                area=float(there.sum() * pixel),
                area_change=float(100 * (np.nanmean(area[there]) - 1)),
                mean_displacement=float(length[there].mean()),
                largest_displacement=float(length[there].max()),
                mean_strain=float(100 * np.nanmean(strain[there])),
                largest_strain=float(100 * np.nanmax(strain[there])),
                folds=int(folded[there].sum()),
            )
        )
    return tuple(found)
