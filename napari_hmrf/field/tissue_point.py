"""What happens to the tissue at one point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from napari_hmrf.field.inverse_point import farthest_of, inverse_point
from napari_hmrf.field.quantities import area_change
from napari_hmrf.solver.solution import Solution


class Probe(NamedTuple):
    """The tissue at a point.

    Attributes
    ----------
    row, col : int
        The pixel it lay on before it moved.
    displacement : (float, float)
        (row, col), in the unit of the solution's spacing.
    length : float
        Of the displacement.
    jacobian : float
        By which factor its area changes; 0 or below where it folds.
    """

    row: int
    col: int
    displacement: tuple[float, float]
    length: float
    jacobian: float


class Points:
    """All points of a solution; made once, and then quick to ask.

    Parameters
    ----------
    solution : Solution
    """

    def __init__(self, solution: Solution) -> None:
        self._solution = solution
        self._jacobian = area_change(solution)
        self._farthest = farthest_of(solution.displacement)

    def at(self, place: tuple[float, float], fraction: float = 0.0) -> Probe | None:
        """Say what happens to the tissue that is seen at a place.

        Parameters
        ----------
        place : (float, float)
            (row, col) in pixels, where the tissue is seen.
        fraction : float
            How much of the displacement it has moved by then: 0 to 1.

        Returns
        -------
        Probe or None
            None where there is no tissue.
        """
        solution = self._solution
        field = (solution.displacement, solution.spacing, solution.tissue)
        origin = inverse_point(place, *field, self._farthest, fraction)
        if origin is None:
            return None
        row, col = (int(np.floor(along + 0.5)) for along in origin)
        rows, cols = solution.tissue.shape
        if not (0 <= row < rows and 0 <= col < cols and solution.tissue[row, col]):
            return None
        down, along = (float(part) for part in solution.displacement[row, col])
        length = float(np.hypot(down, along))
        return Probe(row, col, (down, along), length, float(self._jacobian[row, col]))
