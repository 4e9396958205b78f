"""A result on its way: its image, and what lies over that, after any part of the deformation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.deformation import deformation_grid, pixels_between
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.quantities import Quantity, values_of
from napari_hmrf.field.resample import emptiness
from napari_hmrf.field.strain import folds
from napari_hmrf.field.warp import inverse_map_and_overlaps
from napari_hmrf.solver.solution import Solution

#: What tissue may do at some sites, which are marked.
Mark = Literal["folds", "overlaps"]
MARKS: tuple[Mark, ...] = get_args(Mark)
#: Lines of the grid across the longer side.
_LINES = 30
#: Moments kept, in bytes; a second pass then costs nothing.
_KEPT = 256 * 2**20


@dataclass(frozen=True, eq=False)
class Moment:
    """What is seen at one moment; what was not asked for is None.

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
        """How much memory it takes."""
        parts = (self.image, self.overlay, self.grid)
        return sum(part.nbytes for part in parts if part is not None)


@dataclass(frozen=True, eq=False)
class Motion:
    """A deformation between rest (0) and what was solved for (1): the tissue at X is at X + f d(X).

    Attributes
    ----------
    solution : Solution
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4), optional
        Before it moves.
    overlay : ndarray, shape ([D,] H, W), optional
        Before it moves: labels, or a quantity of the tissue, NaN where there is none. Where it is
        of bool, its sites are marked where they are: a picture has none left where tissue folds.
    grid : bool
        Whether the deformation grid moves, too; of a slice only.
    quantity : Quantity, optional
        Of which `overlay` holds the values at 1; on the way they are those of the tissue there.
    """

    solution: Solution
    image: npt.NDArray[Any] | None = None
    overlay: npt.NDArray[Any] | None = None
    grid: bool = False
    quantity: Quantity | None = None

    def at(self, fraction: float) -> Moment:
        """Move everything by a part of the displacement; on the compute thread only.

        Parameters
        ----------
        fraction : float
            From 0, nothing has moved, to 1, all has.

        Returns
        -------
        Moment
            At 1 exactly what the layers of the result show.
        """
        solution = self.solution
        parts: dict[str, npt.NDArray[Any]] = {}
        if self._pictures:
            if self.quantity is not None and self.overlay is not None:
                values = self._values_at(fraction, self.overlay)
                self._warper.replace(len(self._pictures) - 1, _overlaid(values))
            moved = self._warper(solution.displacement, solution.tissue, fraction)
            parts = dict(zip(self._pictures, moved, strict=True))
        if self.overlay is not None and self.overlay.dtype == bool:
            parts["overlay"] = moved_marks(solution, self.overlay, fraction)
        moment = Moment(**parts, grid=moved_grid(solution, fraction) if self.grid else None)
        while self._kept and (len(self._kept) + 1) * moment.nbytes > _KEPT:
            del self._kept[next(iter(self._kept))]
        self._kept[fraction] = moment
        return moment

    def known(self, fraction: float) -> Moment | None:
        """What `at` has computed before, if there was room to keep it; from any thread."""
        return self._kept.get(fraction)

    @property
    def finest(self) -> float:
        """The smallest fraction in whose steps all moments can be kept; 0 before the first."""
        sizes = [moment.nbytes for moment in [*self._kept.values()]]
        return max(sizes, default=0) / _KEPT

    @cached_property
    def _kept(self) -> dict[float, Moment]:
        return {}

    @cached_property
    def _pictures(self) -> dict[str, Picture]:
        pictures = {}
        if self.image is not None:
            fill = emptiness(self.image, self.solution.tissue.ndim)
            pictures["image"] = Picture(self.image, order=1, fill=fill)
        if self.overlay is not None and self.overlay.dtype != bool:
            pictures["overlay"] = _overlaid(self.overlay)
        return pictures

    def _values_at(self, fraction: float, whole: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """The quantity, of the tissue before it moved, after a part of the displacement."""
        if fraction == 1 or self.quantity is None:
            return whole
        return values_of(self.solution, self.quantity, fraction)

    @cached_property
    def _warper(self) -> Warper:
        return Warper(list(self._pictures.values()), spacing=self.solution.spacing)


def _overlaid(values: npt.NDArray[Any]) -> Picture:
    return Picture(values, order=0, fill=np.nan if values.dtype.kind == "f" else 0)


def moved_marks(
    solution: Solution, marks: npt.NDArray[np.bool_], fraction: float = 1.0
) -> npt.NDArray[np.uint8]:
    """Mark the pixels nearest to where some sites are after a part of the deformation."""
    _, places = _moved_sites(solution, marks, fraction)
    moved = np.zeros(marks.shape, np.uint8)
    moved[tuple(places.T)] = 1
    return moved


def marked_sites(solution: Solution, mark: Mark) -> npt.NDArray[np.bool_]:
    """Find where tissue folds, or the sites of all its parts that have moved onto each other."""
    tissue = solution.tissue
    if mark == "folds":
        return folds(solution.displacement, spacing=solution.spacing, tissue=tissue)
    *_, overlaps = inverse_map_and_overlaps(solution.displacement, solution.spacing, tissue)
    sites, places = _moved_sites(solution, tissue)
    found = np.zeros(tissue.shape, bool)
    found[tuple(sites[overlaps[tuple(places.T)]].T)] = True
    return found


def fullest_planes(marks: npt.NDArray[Any]) -> tuple[int, ...]:
    """Across each axis, the number of the plane in which most pixels are marked."""
    axes = range(marks.ndim)
    planes = (marks.sum(axis=tuple(set(axes) - {axis})) for axis in axes)
    return tuple(int(each.argmax()) for each in planes)


def _moved_sites(
    solution: Solution, marks: npt.NDArray[np.bool_], fraction: float = 1.0
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Marked sites, (N, n), and the pixels nearest to where they are then, if these are inside."""
    sites = np.argwhere(marks)
    step = fraction * solution.displacement[marks] / solution.spacing
    places = np.rint(sites + step).astype(np.intp)
    inside = ((places >= 0) & (places < marks.shape)).all(axis=1)
    return sites[inside], places[inside]


def moved_grid(solution: Solution, fraction: float = 1.0) -> npt.NDArray[np.float32]:
    """Draw a grid that was square, after a part of the deformation; as of `deformation_grid`."""
    tissue, spacing = solution.tissue, solution.spacing
    every = pixels_between(_LINES, tissue.shape, spacing)
    # On its way a grid need not be as fine as where it stays, and is drawn twice as fast.
    pieces = 5 if fraction == 1 else 2
    displacement = solution.displacement * np.float32(fraction)
    return deformation_grid(
        displacement, spacing=spacing, every=every, tissue=tissue, pieces=pieces
    )
