"""Pairs of landmark positions on a slice, before and after the motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.solver.solution import Solution

#: Largest difference, in pixels, between displacements that are treated as equal.
_SAME = 1e-3


class LandmarkPairs(NamedTuple):
    """Landmarks on a slice, with their positions before and after the motion.

    Attributes
    ----------
    numbers : ndarray of int, shape (N,)
        Index of each landmark in its layer.
    at, to : ndarray, shape (N, n)
        Positions before and after the motion, in pixels of the slice.
    sd : ndarray, shape (N,), or None
        Standard deviation of each landmark, in the unit of the image; 0 for exact landmarks. None
        if all landmarks are exact.
    """

    numbers: npt.NDArray[np.intp]
    at: npt.NDArray[np.float64]
    to: npt.NDArray[np.float64]
    sd: npt.NDArray[np.float64] | None = None

    @property
    def spreads(self) -> npt.NDArray[np.float64]:
        """Standard deviation of each landmark, 0 if it is exact."""
        return np.zeros(len(self.at)) if self.sd is None else self.sd

    @property
    def contradiction(self) -> tuple[int, int] | None:
        """Indices of two exact landmarks in a pixel with different displacements, or None."""
        first: dict[tuple[float, ...], int] = {}
        steps = self.to - self.at
        pixels, exact = np.rint(self.at).tolist(), self.spreads == 0
        for number in np.flatnonzero(exact).tolist():
            pixel = pixels[number]
            earlier = first.setdefault(tuple(pixel), number)
            if not np.allclose(steps[number], steps[earlier], atol=_SAME):
                return int(self.numbers[earlier]), int(self.numbers[number])
        return None

    def distances(self, solution: Solution) -> npt.NDArray[np.float64]:
        """Return the distance of each landmark from its target, before and after the motion.

        Parameters
        ----------
        solution : Solution
            Motion of the tissue of the slice.

        Returns
        -------
        ndarray, shape (2, N)
            Distances in the unit of the spacing.
        """
        now = moved_points(self.at, solution.displacement, spacing=solution.spacing)
        left = (self.to - np.stack([self.at, now])) * solution.spacing
        lengths: npt.NDArray[np.float64] = np.linalg.norm(left, axis=-1)
        return lengths

    def radii(self, radius: float, spacing: Sequence[float]) -> list[float]:
        """Return the radius of the patch around each landmark; patches do not overlap.

        The radius is at most half the distance to the nearest other landmark. In overlapping
        patches, the later patch would overwrite the earlier patch. Landmarks in the same pixel
        share a patch.

        Parameters
        ----------
        radius : float
            Largest radius, in the unit of the spacing.
        spacing : sequence of float, shape (n,)
            Size of a pixel along each axis.

        Returns
        -------
        list of float
            Radii in the unit of the spacing.
        """
        _, first, patches = np.unique(
            np.rint(self.at), axis=0, return_index=True, return_inverse=True
        )
        places = self.at[first] * spacing
        # For a single landmark, the distance to the nearest other landmark is infinite.
        away = scipy.spatial.KDTree(places).query(places, k=2)[0][:, 1]
        return [min(radius, half) for half in (away / 2)[patches.reshape(-1)].tolist()]
