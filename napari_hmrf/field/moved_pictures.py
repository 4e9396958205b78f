"""An image, and what lies over it, where one solution after another takes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness
from napari_hmrf.solver.solution import Solution

Array = npt.NDArray[Any]


class MovedPictures:
    """Moves pictures, and keeps what the next solution needs, too; on the compute thread only."""

    def __init__(self) -> None:
        self._warper: tuple[Array | None, tuple[Picture, ...], Warper] | None = None
        # Of a volume: across which axis, of which image.
        self._slicer: tuple[int, Array, Warper] | None = None

    def whole(
        self, image: Array | None, over: tuple[Picture, ...], solution: Solution | None
    ) -> tuple[Array | None, tuple[Array, ...]]:
        """The image and what lies over it; as they are without a solution.

        Parameters
        ----------
        image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
        over : tuple of Picture
        solution : Solution, optional
        """
        if solution is None:
            return image, tuple(np.array(picture.image) for picture in over)
        if image is None and not over:
            return None, ()
        d, tissue, known = solution.displacement, solution.tissue, self._warper
        if known is None or known[0] is not image or known[1] != over:
            shown = [] if image is None else [Picture(image, fill=emptiness(image, tissue.ndim))]
            shown += over
            known = self._warper = (image, over, Warper(shown, spacing=solution.spacing))
        moved = known[2](d, tissue)
        return moved.pop(0) if image is not None else None, tuple(moved)

    def plane(
        self,
        image: Array,
        axis: int,
        number: int,
        displacement: Array,
        tissue: npt.NDArray[np.bool_],
        spacing: Sequence[float],
        every: int,
    ) -> Array:
        """A slice of a volume, where a displacement on a coarse grid takes it.

        Parameters
        ----------
        image : ndarray, shape (D, H, W) or (D, H, W, 3 or 4)
        axis, number : int
            Across which axis of the volume the slice lies, and which of them it is.
        displacement : ndarray, shape (d, h, w, 3)
            At every so many-th voxel, in the unit of the spacing.
        tissue : ndarray of bool, shape (D, H, W)
        spacing : sequence of float, shape (3,)
        every : int
        """
        order = (axis, *(each for each in range(3) if each != axis))
        known = self._slicer
        if known is None or known[0] != axis or known[1] is not image:
            picture = Picture(np.moveaxis(image, axis, 0), fill=emptiness(image, 3))
            warper = Warper(picture, spacing=[spacing[each] for each in order])
            known = self._slicer = (axis, image, warper)
        d = np.moveaxis(displacement[..., order], axis, 0)
        return known[2].slice(number, d, np.moveaxis(tissue, axis, 0), every=every)[0]
