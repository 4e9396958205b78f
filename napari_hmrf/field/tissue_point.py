"""Displacement, Jacobian and strain of the tissue at one point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.inverse_point import farthest_of, inverse_point
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.field.quantities import area_change, values_of
from napari_hmrf.solver.solution import Solution

#: Remark after the area change at a fold, where the displayed value is the smallest determinant of
#: the elements around the site; elsewhere, the displayed value is the mean of these determinants.
_FOLDS = " (folds: value at the worst corner)"
_FULL = 100


class Probe(NamedTuple):
    """Displacement and strain of the tissue at a point.

    Attributes
    ----------
    site : tuple of int
        Pixel of the tissue before the motion, (row, col), or voxel, (depth, row, col).
    displacement : tuple of float
        Components in the order of the axes, in the unit of the solution's spacing.
    length : float
        Length of the displacement.
    jacobian : float
        Ratio of the areas, or volumes, after and before the motion; 0 or below at folds.
    strain : float
        Equivalent strain, in per cent, of the kind given by `strain_kind`.
    """

    site: tuple[int, ...]
    displacement: tuple[float, ...]
    length: float
    jacobian: float
    strain: float


def holds(image: npt.NDArray[Any], pixel: tuple[int, ...]) -> bool:
    """Return whether a pixel is inside an image and its value is above 0."""
    inside = all(0 <= at < size for at, size in zip(pixel, image.shape, strict=True))
    return inside and bool(image[pixel] > 0)


class Points:
    """Fast evaluation of a solution at single points.

    Parameters
    ----------
    solution : Solution

    Attributes
    ----------
    farthest : ndarray, shape (n,)
        Largest displacement along each axis, in the unit of the spacing.
    """

    def __init__(self, solution: Solution) -> None:
        self._solution = solution
        self.farthest = farthest_of(solution.displacement)

    def before(self, place: tuple[float, ...], fraction: float = 1.0) -> tuple[float, ...] | None:
        """Return the origin of the tissue at a moved position; None if no tissue is there.

        Parameters
        ----------
        place : tuple of float
            Position after the motion, ([depth,] row, col) in pixels.
        fraction : float
            Fraction of the displacement that is applied, from 0 to 1.

        Returns
        -------
        tuple of float or None
            Position before the motion, in pixels.
        """
        solution = self._solution
        field = (solution.displacement, solution.spacing, solution.tissue)
        return inverse_point(place, *field, self.farthest, fraction)

    def after(self, places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the moved positions, shape (N, n), of tissue points (N, n), in pixels."""
        return moved_points(places, self._solution.displacement, spacing=self._solution.spacing)

    def at(self, place: tuple[float, ...], fraction: float = 0.0) -> Probe | None:
        """Return displacement, Jacobian and strain of the tissue at a displayed position.

        Parameters
        ----------
        place : tuple of float
            Position in the displayed image, ([depth,] row, col) in pixels.
        fraction : float
            Fraction of the displacement that is applied in the displayed image, from 0 to 1.

        Returns
        -------
        Probe or None
            Values for the full displacement; None if no tissue is there.
        """
        solution, origin = self._solution, self.before(place, fraction)
        site = () if origin is None else tuple(int(np.floor(along + 0.5)) for along in origin)
        if not (site and holds(solution.tissue, site)):
            return None
        step = solution.displacement[site]
        # The values at a site depend only on neighbouring sites; computing all sites would be slow.
        around = tuple(slice(max(at - 1, 0), at + 2) for at in site)
        near = replace(
            solution,
            displacement=solution.displacement[around],
            tissue=solution.tissue[around],
            elasticity=solution.elasticity
            and solution.elasticity.mapped(lambda values: values[around]),
        )
        middle = tuple(min(at, 1) for at in site)
        return Probe(
            site,
            tuple(step.tolist()),
            float(np.linalg.norm(step)),
            float(area_change(near)[middle]),
            float(values_of(near, "equivalent")[middle]),
        )


def at_point(
    unit: str, probe: Probe, ways: Directions, more: Sequence[str] = (), percent: int = _FULL
) -> str:
    """Describe the deformation at a point in one line for the status bar.

    The values are always those of the full deformation.

    Parameters
    ----------
    unit : str
        Symbol of the unit of lengths.
    probe : Probe
    ways : Directions
        Directions of rows and columns.
    more : sequence of str
        Further parts of the line, appended with commas.
    percent : int
        Percentage of the deformation in the displayed image. If it is below 100, the line starts
        with a remark that the values are those at 100 %.

    Returns
    -------
    str
    """
    step = tuple(rounded(part) for part in ways.to_display(probe.displacement))
    length = rounded(probe.length)
    size = "volume" if len(probe.displacement) == 3 else "area"
    parts = [
        f"moves {length:g} {unit}" + (f" ({ways.step(step)})" if length else ""),
        f"{size} change x {probe.jacobian:.3f}" + (_FOLDS if probe.jacobian <= 0 else ""),
    ]
    line = ", ".join([*parts, *filter(None, more)])
    return line if percent == _FULL else f"at {_FULL} %: {line}"


def rounded(length: float) -> float:
    """Round a length to at most three significant digits and two decimals."""
    return round(float(f"{length:.3g}"), 2) + 0.0  # avoids -0
