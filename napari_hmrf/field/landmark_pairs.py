"""Pairs of landmarks on a slice, before and after the motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

#: Tolerance of equal displacements, in pixels.
_SAME = 1e-3


class LandmarkPairs(NamedTuple):
    """Landmarks on a slice, with their positions before and after the motion.

    Attributes
    ----------
    numbers : ndarray of int, shape (N,)
        Index of each landmark in its layer.
    at, to : ndarray, shape (N, n)
        Positions before and after the motion, in pixels of the slice.
    """

    numbers: npt.NDArray[np.intp]
    at: npt.NDArray[np.float64]
    to: npt.NDArray[np.float64]

    @property
    def contradiction(self) -> tuple[int, int] | None:
        """Indices of two landmarks in one pixel with different displacements, or None."""
        first: dict[tuple[float, ...], int] = {}
        steps = self.to - self.at
        for number, pixel in enumerate(np.rint(self.at).tolist()):
            earlier = first.setdefault(tuple(pixel), number)
            if not np.allclose(steps[number], steps[earlier], atol=_SAME):
                return int(self.numbers[earlier]), int(self.numbers[number])
        return None

    def radii(self, radius: float, spacing: Sequence[float]) -> list[float]:
        """Return the radius of the patch of each landmark, such that no patch covers another.

        The radius is at most half the distance to the next landmark: if patches overlapped, the
        later patch would overwrite the earlier. Landmarks in one pixel share a patch.

        Parameters
        ----------
        radius : float
            Largest radius, in the unit of the spacing.
        spacing : sequence of float, shape (n,)
            Size of a pixel along each axis.

        Returns
        -------
        list of float
            In the unit of the spacing.
        """
        _, first, patches = np.unique(
            np.rint(self.at), axis=0, return_index=True, return_inverse=True
        )
        places = self.at[first] * spacing
        # The distance of a single landmark is infinite.
        away = scipy.spatial.KDTree(places).query(places, k=2)[0][:, 1]
        return [min(radius, half) for half in (away / 2)[patches.reshape(-1)].tolist()]
