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

#: Added to the Jacobian at a fold, where it is 0 or below; elsewhere it is the mean of the corners.
_FOLDS = " (folds: that of the worst corner)"
_FULL = 100


class Probe(NamedTuple):
    """The tissue at a point.

    Attributes
    ----------
    site : tuple of int
        Pixel of the tissue before the motion, (row, col), or voxel, (depth, row, col).
    displacement : tuple of float
        In the order of the axes and the unit of the solution's spacing.
    length : float
        Length of the displacement.
    jacobian : float
        Factor of area, or volume, change; 0 or below where the tissue folds.
    strain : float
        Equivalent strain, in per cent, of the kind given by `strain_kind`.
    """

    site: tuple[int, ...]
    displacement: tuple[float, ...]
    length: float
    jacobian: float
    strain: float


def holds(image: npt.NDArray[Any], pixel: tuple[int, ...]) -> bool:
    """Return whether a pixel lies inside an image that is above 0 there."""
    inside = all(0 <= at < size for at, size in zip(pixel, image.shape, strict=True))
    return inside and bool(image[pixel] > 0)


class Points:
    """Fast lookup of points of a solution.

    Parameters
    ----------
    solution : Solution
    """

    def __init__(self, solution: Solution) -> None:
        self._solution = solution
        self._farthest = farthest_of(solution.displacement)

    def before(self, place: tuple[float, ...], fraction: float = 1.0) -> tuple[float, ...] | None:
        """Return the original place of the tissue now seen at a place; None if there is none.

        Parameters
        ----------
        place : tuple of float
            ([depth,] row, col) in pixels.
        fraction : float
            Fraction of the displacement that is applied: 0 to 1.
        """
        solution = self._solution
        field = (solution.displacement, solution.spacing, solution.tissue)
        return inverse_point(place, *field, self._farthest, fraction)

    def after(self, places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the places after the motion of tissue originally at `places`, (N, n) in pixels."""
        return moved_points(places, self._solution.displacement, spacing=self._solution.spacing)

    def at(self, place: tuple[float, ...], fraction: float = 0.0) -> Probe | None:
        """Return displacement, Jacobian and strain of the tissue seen at a place.

        Parameters
        ----------
        place : tuple of float
            ([depth,] row, col) in pixels, where the tissue is seen.
        fraction : float
            Fraction of the displacement that is applied: 0 to 1.

        Returns
        -------
        Probe or None
            None where there is no tissue.
        """
        solution, origin = self._solution, self.before(place, fraction)
        site = () if origin is None else tuple(int(np.floor(along + 0.5)) for along in origin)
        if not (site and holds(solution.tissue, site)):
            return None
        step = solution.displacement[site]
        # The neighbours of a site determine its values: computing a whole volume would be slow.
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
    unit: str, found: Probe, ways: Directions, more: Sequence[str] = (), percent: int = _FULL
) -> str:
    """Describe the deformation at a point in a line short enough for a status bar.

    The values are always those of the whole deformation.

    Parameters
    ----------
    unit : str
        Unit of lengths.
    found : Probe
    ways : Directions
        Directions of rows and columns.
    more : sequence of str
        Further parts of the line.
    percent : int
        Percentage of the deformation that is shown; below 100 the line says that it is for 100 %.
    """
    step = tuple(rounded(part) for part in ways.seen(found.displacement))
    length = rounded(found.length)
    parts = [
        f"moves {length:g} {unit}" + (f" ({ways.step(step)})" if length else ""),
        f"Jacobian {found.jacobian:.3f}" + (_FOLDS if found.jacobian <= 0 else ""),
    ]
    line = ", ".join([*parts, *filter(None, more)])
    return line if percent == _FULL else f"at {_FULL} %: {line}"


def rounded(length: float) -> float:
    """Round to three significant digits, and at most two decimals."""
    return round(float(f"{length:.3g}"), 2) + 0.0  # avoids -0
