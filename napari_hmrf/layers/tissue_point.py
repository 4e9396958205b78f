"""What happens to the tissue at one point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf.field.deformation import jacobian_determinant, smallest_determinant
from napari_hmrf.solver.solution import Solution

#: Steps of the search for where tissue came from; where tissue does not fold far fewer do.
_STEPS = 40
#: In pixels.
_CLOSE = 0.02


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
        d, spacing, tissue = solution.displacement, solution.spacing, solution.tissue
        smallest = smallest_determinant(d, spacing, tissue)
        at_sites = jacobian_determinant(d, spacing=spacing, tissue=tissue)
        # At folds the smallest around the site, so that it is 0 or below at all of them.
        self._jacobian = np.where(smallest <= 0, smallest, at_sites)
        #: Sites at which the tissue folds over itself.
        self.folds = int((smallest <= 0).sum())
        # Tissue may be seen where there was none: there it is looked for as the nearest moves.
        self._steps = solution.displacement / np.asarray(solution.spacing, dtype=np.float32)
        if solution.tissue.any() and not solution.tissue.all():
            nearest = ndimage.distance_transform_edt(
                ~solution.tissue, return_distances=False, return_indices=True
            )
            self._steps = self._steps[tuple(nearest)]

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
        origin = self._origin(np.asarray(place, dtype=float), fraction)
        if origin is None:
            return None
        row, col = (int(at) for at in np.floor(origin + 0.5))
        solution = self._solution
        rows, cols = solution.tissue.shape
        if not (0 <= row < rows and 0 <= col < cols and solution.tissue[row, col]):
            return None
        down, along = (float(part) for part in solution.displacement[row, col])
        length = float(np.hypot(down, along))
        return Probe(row, col, (down, along), length, float(self._jacobian[row, col]))

    def _origin(
        self, seen: npt.NDArray[np.float64], fraction: float
    ) -> npt.NDArray[np.float64] | None:
        """Where X + fraction d(X) is what is seen, going by what is missing; None if nowhere."""
        place = seen
        for _ in range(_STEPS):
            missing = seen - place - fraction * self._step_at(place)
            if np.abs(missing).max() < _CLOSE:
                return place
            place = place + 0.7 * missing
        return None

    def _step_at(self, place: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The displacement between the sites, bilinear, in pixels."""
        steps = self._steps
        last = np.array(steps.shape[:2]) - 1
        inside = np.clip(place, 0, last)
        low = np.minimum(inside.astype(int), np.maximum(last - 1, 0))
        high = np.minimum(low + 1, last)
        down, along = inside - low
        top = (1 - along) * steps[low[0], low[1]] + along * steps[low[0], high[1]]
        bottom = (1 - along) * steps[high[0], low[1]] + along * steps[high[0], high[1]]
        between: npt.NDArray[np.float64] = (1 - down) * top + down * bottom
        return between
