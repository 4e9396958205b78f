"""Motion of a solution on other grids: time series, volumes, or pixels of another size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.moved_points import interpolate_linearly
from napari_hmrf.field.resample import emptiness, resample
from napari_hmrf.field.units import unit_factor
from napari_hmrf.field.warp import inverse_map
from napari_hmrf.solver.solution import Solution

Array = npt.NDArray[Any]
#: Largest distance, in pixels, between corresponding pixels of equal grids.
_SAME = 1e-3
#: Largest distance, in slices, between a point on a slice and the centre plane of the slice.
_ON = 0.5
#: Names of axes that are spatial even without a unit of length.
_DEPTHS = ("z", "depth", "slice", "plane", "section")


@dataclass(frozen=True, eq=False)
class OtherGrid:
    """Grid that overlaps a solution and moves with its tissue.

    Points outside the pixels of the solution, or on another slice, do not move.

    Attributes
    ----------
    solution : Solution
    to : ndarray, shape (m + k, n + 1)
        Transform of homogeneous pixels of the grid. The first m rows yield pixels along the axes
        of the solution. The other k rows yield the distance, in slices, from the slice of the
        solution along each axis perpendicular to it.
    plane : sequence of int, shape (m,)
        Axes of the grid that correspond to the axes of the solution.
    """

    solution: Solution
    to: Array
    plane: Sequence[int]

    @classmethod
    def of(cls, solution: Solution, frame: Frame, own: Frame) -> OtherGrid:
        """Create a grid, which may have other pixels and more axes than the solution.

        Along a spatial axis perpendicular to the solution, only the slice of the solution moves.
        Along other axes, such as time, channels, or an axis of unknown meaning, all slices move.

        Parameters
        ----------
        solution : Solution
        frame, own : Frame
            Frames of the solution and of the grid.

        Returns
        -------
        OtherGrid

        Raises
        ------
        ProblemError
            If the units of the grid cannot be converted to the units of the solution, or the grid
            is at an angle to the slice of the solution.
        """
        more = own.ndim - frame.ndim
        plane = [axis + more for axis in frame.plane]
        if min(plane) < 0:
            raise ProblemError("observed", f"has {own.ndim} axes and lacks an axis of the result.")
        across = [axis for axis in frame.others if axis + more >= 0 and _is_space(frame, axis)]
        counted = [*frame.plane, *across]
        transform = frame.from_pixels_of(own, counted)
        if transform is None:
            raise ProblemError(
                "observed", "has different units from the result. Use the same units for both."
            )
        to = transform[counted]
        out = to[len(plane) :]
        out[:, -1] -= np.array(frame.index)[across]
        if np.abs(out[:, plane]).max(initial=0.0) * max(solution.tissue.shape) > 1:
            raise ProblemError("observed", "is at an angle to the result. Resample one of the two.")
        return cls(solution, to, plane)

    def moved_points(self, points: Array) -> Array:
        """Move points, shape (N, n) in pixels of the grid, with the tissue."""
        at, inside = self._at(points)
        steps = interpolate_linearly(self.solution.displacement / self.solution.spacing, at[inside])
        moved = points.astype(float)
        moved[np.ix_(np.flatnonzero(inside), np.array(self.plane))] += steps @ self._back.T
        return moved

    def moved_pixels(self, pixels: Array, *, order: int) -> Array:
        """Warp an image on the grid.

        Parameters
        ----------
        pixels : ndarray
            Image on the grid; the last axis may contain colours.
        order : int
            Order of interpolation, as for `warp`.

        Returns
        -------
        ndarray
            Warped copy of the image.
        """
        moved, n = np.array(pixels), self.to.shape[1] - 1
        others = [axis for axis in range(n) if axis not in self.plane]
        slices = np.moveaxis(moved, self.plane, range(len(others), n))
        before, origins = None, None
        for numbers in np.ndindex(*slices.shape[: len(others)]):
            index = np.zeros(n)
            index[others] = numbers
            at = np.round(self.to @ [*index, 1.0], 6)
            if before is None or not np.array_equal(at, before):  # equal along a time axis
                before, origins = at, self._origins_on(index, slices.shape[len(others) : n])
            if origins is not None:
                picture = slices[numbers]
                fill = 0 if order == 0 else emptiness(picture, len(self.plane))
                slices[numbers] = resample(picture, *origins, order=order, fill=fill)
        return moved

    def _at(self, points: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return points in pixels of the solution, and a mask of the points inside the solution."""
        at = points @ self.to[:, :-1].T + self.to[:, -1]
        size = np.array(self.solution.tissue.shape)
        within, across = at[:, : len(size)], at[:, len(size) :]
        inside = (within > -_ON - _SAME) & (within < size - 1 + _ON + _SAME)
        return within, inside.all(axis=1) & (np.abs(across) <= _ON).all(axis=1)

    def _origins_on(self, index: Array, shape: tuple[int, ...]) -> tuple[Array, Array] | None:
        """Return the origins and the mask of covered pixels of a slice; None if no pixel moves."""
        sites = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, len(shape))
        points = np.zeros((len(sites), len(index))) + index
        points[:, self.plane] = sites
        at, inside = self._at(points)
        if not inside.any():
            return None
        origins, covered = self._origins
        if shape == covered.shape and np.abs(at - sites).max() < _SAME:
            return origins, covered
        sources, visible = sites.astype(float), np.ones(len(sites), dtype=bool)
        sources[inside] += interpolate_linearly(self._inverse, at[inside]) @ self._back.T
        nearest = np.clip(np.rint(at[inside]).astype(int), 0, np.array(covered.shape) - 1)
        visible[inside] = covered[tuple(nearest.T)]
        visible &= ((sources > -_ON) & (sources < np.array(shape) - 1 + _ON)).all(axis=1)
        return sources.reshape(*shape, len(shape)), visible.reshape(shape)

    @cached_property
    def _back(self) -> Array:
        """Matrix that converts steps in pixels of the solution to steps in pixels of the grid."""
        inverse: Array = np.linalg.inv(self.to[: len(self.plane)][:, list(self.plane)])
        return inverse

    @cached_property
    def _origins(self) -> tuple[Array, Array]:
        d, spacing, tissue = self._field
        return inverse_map(d, spacing=spacing, tissue=tissue)

    @cached_property
    def _inverse(self) -> Array:
        d, spacing, tissue = self._field
        back: Array = inverse_displacement(d, spacing=spacing, tissue=tissue).displacement
        return back / spacing

    @property
    def _field(self) -> tuple[Array, tuple[float, ...], Array]:
        return self.solution.displacement, self.solution.spacing, self.solution.tissue


def _is_space(frame: Frame, axis: int) -> bool:
    """Return whether an axis is spatial, judged by its unit or name."""
    length = np.isfinite(unit_factor(frame.units[axis], "millimeter"))
    return bool(length) or frame.axis_labels[axis].lower() in _DEPTHS
