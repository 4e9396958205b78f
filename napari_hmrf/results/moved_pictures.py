"""Image and overlays, warped by successive solutions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness, without_removed
from napari_hmrf.field.volume_preview import CutPlane, VolumePreview
from napari_hmrf.results.finer_grid import mask_on_finer_grid
from napari_hmrf.solver.solution import Solution

Array = npt.NDArray[Any]


class MovedPictures:
    """Reusable warper of an image and its overlays.

    Call its methods on the compute thread only.
    """

    def __init__(self) -> None:
        # Image, distance of its pixels, and the image at these pixels.
        self._sparse: tuple[Array, int, Array] | None = None
        # Image without removed tissue, with the image and the mask from which it was computed.
        self._emptied: tuple[Array, Array, Array] | None = None
        self._warper: tuple[Array | None, tuple[Picture, ...], Warper] | None = None
        # For a volume: axis perpendicular to the displayed slices, the image, and the warper.
        self._slicer: tuple[int, Array, Warper] | None = None
        self._preview: VolumePreview | None = None

    def every(self, image: Array | None, pixel: int) -> Array | None:
        """Return every `pixel`-th pixel of an image along each axis, (H, W) or (H, W, 3 or 4).

        The result is the same array for the same image, so that it is prepared once for `whole`.
        """
        known = self._sparse
        if image is None:
            return None
        if known is None or known[0] is not image or known[1] != pixel:
            known = self._sparse = image, pixel, np.ascontiguousarray(image[::pixel, ::pixel])
        return known[2]

    def whole(
        self, image: Array | None, over: tuple[Picture, ...], solution: Solution | None
    ) -> tuple[Array | None, tuple[Array, ...]]:
        """Warp the image and the overlays by a solution.

        Parameters
        ----------
        image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
        over : tuple of Picture
            Overlays of the image.
        solution : Solution, optional
            Solution that moves the images; None for no motion.

        Returns
        -------
        image : ndarray or None
        over : tuple of ndarray
        """
        if solution is None:
            return image, tuple(np.array(picture.image) for picture in over)
        if image is None and not over:
            return None, ()
        image = self._without(image, solution.removed)
        d, tissue, known = solution.displacement, solution.tissue, self._warper
        if known is None or known[0] is not image or known[1] != over:
            shown = [] if image is None else [Picture(image, fill=emptiness(image, tissue.ndim))]
            shown += over
            known = self._warper = (image, over, Warper(shown, spacing=solution.spacing))
        moved = known[2](d, tissue, parts=solution.parts)
        return moved.pop(0) if image is not None else None, tuple(moved)

    def plane(
        self,
        image: Array,
        axis: int,
        number: int,
        solution: Solution,
        tissue: npt.NDArray[np.bool_],
        spacing: Sequence[float],
        every: int,
    ) -> Array:
        """Warp one slice of a volume by a solution on a coarse grid.

        Parameters
        ----------
        image : ndarray, shape (D, H, W) or (D, H, W, 3 or 4)
        axis, number : int
            Axis perpendicular to the slice, and index of the slice along this axis.
        solution : Solution
            Solution at every `every`-th voxel.
        tissue : ndarray of bool, shape (D, H, W)
            Tissue, of which the slice does not show what is removed.
        spacing : sequence of float, shape (3,)
            Size of a voxel along each axis.
        every : int
            Step between the sites of the coarse grid along each axis, in voxels.

        Returns
        -------
        ndarray, shape of the slice
        """
        if solution.removed is not None:
            removed = mask_on_finer_grid(solution.removed, tissue.shape, every)
            image, tissue = self._without(image, removed), tissue & ~removed
        order = (axis, *(each for each in range(3) if each != axis))
        known = self._slicer
        if known is None or known[0] != axis or known[1] is not image:
            picture = Picture(np.moveaxis(image, axis, 0), fill=emptiness(image, 3))
            warper = Warper(picture, spacing=[spacing[each] for each in order])
            known = self._slicer = (axis, image, warper)
        d = np.moveaxis(solution.displacement[..., order], axis, 0)
        return known[2].slice(number, d, np.moveaxis(tissue, axis, 0), every=every)[0]

    def volume(
        self,
        image: Array,
        solution: Solution | None,
        spacing: Sequence[float],
        every: int,
        cut: CutPlane | None,
    ) -> Array:
        """Warp a volume for a 3-D view by a solution on a coarse grid.

        Parameters
        ----------
        image : ndarray, shape (D, H, W) or (D, H, W, 3 or 4)
        solution : Solution, optional
            Solution at every `every`-th voxel; None for no motion.
        spacing : sequence of float, shape (3,)
            Size of a voxel along each axis.
        every : int
            Step between the sites of the coarse grid along each axis, in voxels.
        cut : CutPlane, optional
            Visible plane; None if the whole volume is visible.

        Returns
        -------
        ndarray
            Values at `CutPlane.voxels` of the plane, or the volume at the sites of the coarse grid.
        """
        if solution is not None and solution.removed is not None:
            removed = mask_on_finer_grid(solution.removed, image.shape[:3], every)
            image = self._without(image, removed)
        known = self._preview
        if known is None or known.image is not image or known.every != every:
            known = self._preview = VolumePreview(image, every, spacing)
        if solution is None:
            where: Any = (slice(None, None, every),) * 3
            if cut is not None:
                where = tuple(cut.voxels(image.shape[:3]).T)
            return np.array(image[where])
        if cut is None:
            return known.coarse(solution.displacement, solution.tissue)
        return known.cut(solution.displacement, solution.tissue, cut)

    def _without(self, image: Any, removed: npt.NDArray[np.bool_] | None) -> Any:
        """Return an image without removed tissue, as the same array while both are unchanged."""
        if image is None or removed is None:
            return image
        known = self._emptied
        if known is None or known[0] is not image or not np.array_equal(known[1], removed):
            fill = emptiness(image, removed.ndim)
            known = self._emptied = (image, removed, without_removed(image, removed, fill))
        return known[2]
