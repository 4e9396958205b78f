"""Places of a slice that were found again elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

#: How far, in pixels, two ways may differ and be the same.
_SAME = 1e-3


class LandmarkPairs(NamedTuple):
    """Landmarks of a slice.

    Attributes
    ----------
    numbers : ndarray of int
        Which of their layer they are.
    at, to : ndarray, shape (N, n)
        Where things are and should be, in pixels of the slice.
    """

    numbers: npt.NDArray[np.intp]
    at: npt.NDArray[np.float64]
    to: npt.NDArray[np.float64]

    @property
    def contradiction(self) -> tuple[int, int] | None:
        """The numbers of two of one pixel that should go to different places, if there are any."""
        first: dict[tuple[float, ...], int] = {}
        ways = self.to - self.at
        for each, pixel in enumerate(np.rint(self.at).tolist()):
            earlier = first.setdefault(tuple(pixel), each)
            if not np.allclose(ways[each], ways[earlier], atol=_SAME):
                return int(self.numbers[earlier]), int(self.numbers[each])
        return None

    def radii(self, radius: float, spacing: Sequence[float]) -> list[float]:
        """A radius for the patch of each, such that none lies on another.

        Where places are close it is half of the way to the next one: else the later patch would
        win, and the earlier place not go where it should. Those of one pixel are one patch.

        Parameters
        ----------
        radius : float
            Of those that have room, in the unit of the spacing.
        spacing : sequence of float, shape (n,)
            Size of a pixel along each axis.
        """
        _, first, which = np.unique(
            np.rint(self.at), axis=0, return_index=True, return_inverse=True
        )
        places = self.at[first] * spacing
        away = scipy.spatial.KDTree(places).query(places, k=2)[0][:, 1]  # infinite of a single one
        return [min(radius, half) for half in (away / 2)[which.reshape(-1)].tolist()]
