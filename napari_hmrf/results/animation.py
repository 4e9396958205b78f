"""Animation of a result: its image and overlays at any fraction of the deformation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.deformation import deformation_grid, pixels_between
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness, without_removed
from napari_hmrf.field.strain import fold_mask
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.results.quantities import (
    Quantity,
    neutral_value,
    values_of,
    within,
    without_folds,
)
from napari_hmrf.solver.solution import Solution

#: Name of the overlay that marks the sites at which tissue folds or overlaps other tissue.
FOLD_MARKS: Literal["folds"] = "folds"
#: Number of grid lines that cross the longer side of an image.
_LINES = 30
#: Size limit, in bytes, of the cache of computed moments.
_KEPT = 256 * 2**20


@dataclass(frozen=True, eq=False)
class Moment:
    """Images at one fraction of the motion; images that were not requested are None.

    Attributes
    ----------
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
    overlay : ndarray, shape ([D,] H, W), optional
    grid : ndarray, shape (N, 2, 2), optional
        Segments as (start, direction), each (row, col) in pixels.
    """

    image: npt.NDArray[Any] | None = None
    overlay: npt.NDArray[Any] | None = None
    grid: npt.NDArray[np.float32] | None = None

    @property
    def nbytes(self) -> int:
        """Memory of all arrays, in bytes."""
        parts = (self.image, self.overlay, self.grid)
        return sum(part.nbytes for part in parts if part is not None)


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion from the state at rest to a solution, as a function of a fraction f.

    At fraction f, the tissue with reference position X is at X + f d(X). At fraction 0, removed
    tissue is visible; above 0, it is not.

    Attributes
    ----------
    solution : Solution
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
        Image before the motion.
    overlay : ndarray, shape ([D,] H, W), optional
        Overlay before the motion: labels, or a quantity of the tissue that is NaN outside tissue.
        The sites of a boolean overlay are moved individually, because a warped image would lose
        sites where tissue folds. A quantity of a volume has its neutral value outside tissue.
    grid : bool
        If True, the deformation grid of a slice is drawn as well.
    quantity : Quantity, optional
        Quantity in `overlay`, which contains its values at fraction 1. The values at other
        fractions are recomputed.
    limits : (float, float), optional
        Ends of the scale of the quantity. If `overlay` contains folds (infinite), other values are
        clipped to the scale.
    """

    solution: Solution
    image: npt.NDArray[Any] | None = None
    overlay: npt.NDArray[Any] | None = None
    grid: bool = False
    quantity: Quantity | None = None
    limits: tuple[float, float] | None = None

    def at(self, fraction: float) -> Moment:
        """Warp the images by a fraction of the displacement; call on the compute thread only.

        Parameters
        ----------
        fraction : float
            From 0 (no motion) to 1 (full displacement).

        Returns
        -------
        Moment
            At fraction 1, its images are identical to the layers of the result.
        """
        solution = self.solution
        parts: dict[str, npt.NDArray[Any]] = {}
        if self._pictures:
            if self.quantity is not None and self.overlay is not None:
                values = self._values_at(fraction, self.overlay)
                self._warper.replace(len(self._pictures) - 1, self._overlaid(values))
            d, tissue = solution.displacement, solution.tissue
            moved = self._warper(d, tissue, fraction, parts=solution.parts)
            parts = dict(zip(self._pictures, moved, strict=True))
            if fraction == 0:
                parts |= self._intact
        if self.overlay is not None and self.overlay.dtype == bool:
            parts["overlay"] = moved_marks(solution, self.overlay, fraction)
        moment = Moment(**parts, grid=moved_grid(solution, fraction) if self.grid else None)
        while self._cache and (len(self._cache) + 1) * moment.nbytes > _KEPT:
            del self._cache[next(iter(self._cache))]
        self._cache[fraction] = moment
        return moment

    def cached(self, fraction: float) -> Moment | None:
        """Return a moment that `at` has cached, or None; callable from any thread."""
        return self._cache.get(fraction)

    @property
    def finest(self) -> float:
        """Smallest step between fractions for which all moments fit in the cache.

        The step is 0 if the cache is empty.
        """
        sizes = [moment.nbytes for moment in [*self._cache.values()]]
        return max(sizes, default=0) / _KEPT

    @cached_property
    def _cache(self) -> dict[float, Moment]:
        return {}

    @property
    def _intact(self) -> dict[str, npt.NDArray[Any]]:
        """Pictures with the removed tissue before the motion; empty if no tissue is removed."""
        if self.solution.removed is None:
            return {}
        parts = {"image": self.image}
        if self.overlay is not None and self.overlay.dtype.kind in "iu":
            parts["overlay"] = self.overlay
        return {name: part.copy() for name, part in parts.items() if part is not None}

    @cached_property
    def _pictures(self) -> dict[str, Picture]:
        pictures = {}
        if self.image is not None:
            fill = emptiness(self.image, self.solution.tissue.ndim)
            remaining = without_removed(self.image, self.solution.removed, fill)
            pictures["image"] = Picture(remaining, order=1, fill=fill)
        if self.overlay is not None and self.overlay.dtype != bool:
            whole = self._values_at(1, self.overlay) if self.quantity else self.overlay
            pictures["overlay"] = self._overlaid(whole)
        return pictures

    def _overlaid(self, values: npt.NDArray[Any]) -> Picture:
        if values.dtype.kind != "f":
            return Picture(without_removed(values, self.solution.removed, 0), order=0, fill=0)
        if self.quantity is None or values.ndim == 2:
            return Picture(values, order=0, fill=np.nan)
        # In a 3-D view, vispy may draw NaN next to tissue in the colour of an end of the scale.
        neutral = neutral_value(self.quantity)
        return Picture(np.where(np.isnan(values), neutral, values), order=0, fill=neutral)

    @cached_property
    def _folds(self) -> bool:
        """True if the overlay contains folds."""
        return self.overlay is not None and bool(np.isinf(self.overlay).any())

    def _values_at(self, fraction: float, whole: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the quantity at a fraction of the displacement, on the grid before the motion."""
        if self.quantity is None:
            return whole
        values = whole if fraction == 1 else values_of(self.solution, self.quantity, fraction)
        if not self._folds or self.limits is None:
            return values
        if fraction != 1:
            values = without_folds(values, self.solution, self.quantity, fraction)
        return within(values, self.limits)

    @cached_property
    def _warper(self) -> Warper:
        return Warper(list(self._pictures.values()), spacing=self.solution.spacing)


def moved_marks(
    solution: Solution, marks: npt.NDArray[np.bool_], fraction: float = 1.0
) -> npt.NDArray[np.uint8]:
    """Mark the pixels nearest to the moved positions of marked sites.

    Parameters
    ----------
    solution : Solution
    marks : ndarray of bool, shape ([D,] H, W)
        Marked sites before the motion.
    fraction : float
        Fraction of the displacement, from 0 to 1.

    Returns
    -------
    ndarray of uint8, shape ([D,] H, W)
        1 at the marked pixels.
    """
    _, places = _moved_sites(solution, marks, fraction)
    moved = np.zeros(marks.shape, np.uint8)
    moved[tuple(places.T)] = 1
    return moved


def marked_sites(solution: Solution) -> npt.NDArray[np.bool_]:
    """Return a mask of the sites at which tissue folds or overlaps other tissue.

    Parameters
    ----------
    solution : Solution

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
        Marked sites before the motion.
    """
    found = fold_mask(solution.displacement, **solution.on_grid)
    *_, overlaps = inverse_map_and_overlaps(solution.displacement, **solution.on_grid)
    sites, places = _moved_sites(solution, solution.tissue)
    found[tuple(sites[overlaps[tuple(places.T)]].T)] = True
    return found


def fullest_planes(marks: npt.NDArray[Any]) -> tuple[int, ...]:
    """Return, for each axis, the index of the plane with the most marked pixels."""
    axes = range(marks.ndim)
    planes = (marks.sum(axis=tuple(set(axes) - {axis})) for axis in axes)
    return tuple(int(each.argmax()) for each in planes)


def _moved_sites(
    solution: Solution, marks: npt.NDArray[np.bool_], fraction: float = 1.0
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the marked sites, (N, n), that remain in the image, and their moved pixels, (N, n)."""
    sites = np.argwhere(marks)
    step = fraction * solution.displacement[marks] / solution.spacing
    places = np.rint(sites + step).astype(np.intp)
    inside = ((places >= 0) & (places < marks.shape)).all(axis=1)
    return sites[inside], places[inside]


def moved_grid(solution: Solution, fraction: float = 1.0) -> npt.NDArray[np.float32]:
    """Return the `deformation_grid` at a fraction of the deformation."""
    every = pixels_between(_LINES, solution.tissue.shape, solution.spacing)
    # During playback, two segments between crossings are sufficient and are drawn twice as fast.
    pieces = 5 if fraction == 1 else 2
    displacement = solution.displacement * np.float32(fraction)
    return deformation_grid(displacement, every=every, pieces=pieces, **solution.on_grid)
