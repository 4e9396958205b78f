"""A motion as it is met by another grid: by a film, a volume, or pixels of another size."""

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
from napari_hmrf.field.moved_points import looked_up
from napari_hmrf.field.resample import emptiness, resample
from napari_hmrf.field.units import unit_factor
from napari_hmrf.field.warp import inverse_map
from napari_hmrf.solver.solution import Solution

Array = npt.NDArray[Any]
#: How far, in pixels, two grids may lie apart and be the same.
_SAME = 1e-3
#: How far from a slice, in slices, is on it.
_ON = 0.5
#: What an axis of space is called that has no unit of length.
_DEPTHS = ("z", "depth", "slice", "plane", "section")


@dataclass(frozen=True, eq=False)
class OtherGrid:
    """A grid that lies on the tissue of a solution, and moves with it.

    What lies beside the solution's pixels, or on another slice than its own, stays.

    Attributes
    ----------
    solution : Solution
    to : ndarray, shape (m + k, n + 1)
        From the grid's pixels, homogeneous, to the solution's along its m axes, and then to how
        many slices it is from the solution's along each of k axes.
    plane : sequence of int, shape (m,)
        The grid's axes that are those of the solution.
    """

    solution: Solution
    to: Array
    plane: Sequence[int]

    @classmethod
    def of(cls, solution: Solution, frame: Frame, own: Frame) -> OtherGrid:
        """A grid that may have other pixels than a solution, and more axes.

        Along an axis of space the slice of the solution is moved; along others, such as time,
        channels, or one of which nobody has said what it is, all that there is.

        Parameters
        ----------
        solution : Solution
        frame, own : Frame
            Where the solution lies, and where the grid does.

        Raises
        ------
        ProblemError
            If the grid's axes have no unit in common with the solution's, or it is at an angle to
            it.
        """
        more = own.ndim - frame.ndim
        plane = [axis + more for axis in frame.plane]
        if min(plane) < 0:
            raise ProblemError("observed", f"has {own.ndim} axes, and not those of the result.")
        across = [axis for axis in frame.others if axis + more >= 0 and _is_space(frame, axis)]
        counted = [*frame.plane, *across]
        found = frame.from_pixels_of(own, counted)
        if found is None:
            raise ProblemError(
                "observed", "is measured in other units than the result. Give it those."
            )
        to = found[counted]
        out = to[len(plane) :]
        out[:, -1] -= np.array(frame.index)[across]
        if np.abs(out[:, plane]).max(initial=0.0) * max(solution.tissue.shape) > 1:
            raise ProblemError("observed", "is at an angle to the result. Resample one of them.")
        return cls(solution, to, plane)

    def moved_points(self, points: Array) -> Array:
        """Move points, (N, n) in the grid's pixels, to where their tissue has gone."""
        at, there = self._at(points)
        steps = looked_up(self.solution.displacement / self.solution.spacing, at[there])
        moved = points.astype(float)
        moved[np.ix_(np.flatnonzero(there), np.array(self.plane))] += steps @ self._back.T
        return moved

    def moved_pixels(self, pixels: Array, *, order: int) -> Array:
        """Move an image on the grid, which may have colours; by `order` as `warp`."""
        moved, n = np.array(pixels), self.to.shape[1] - 1
        others = [axis for axis in range(n) if axis not in self.plane]
        slices = np.moveaxis(moved, self.plane, range(len(others), n))
        before, found = None, None
        for numbers in np.ndindex(*slices.shape[: len(others)]):
            index = np.zeros(n)
            index[others] = numbers
            at = np.round(self.to @ [*index, 1.0], 6)
            if before is None or not np.array_equal(at, before):  # along time it is the same
                before, found = at, self._origins_on(index, slices.shape[len(others) : n])
            if found is not None:
                picture = slices[numbers]
                fill = 0 if order == 0 else emptiness(picture, len(self.plane))
                slices[numbers] = resample(picture, *found, order=order, fill=fill)
        return moved

    def _at(self, points: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Where points are on the solution's pixels, and which of them are there at all."""
        at = points @ self.to[:, :-1].T + self.to[:, -1]
        size = np.array(self.solution.tissue.shape)
        within, across = at[:, : len(size)], at[:, len(size) :]
        inside = (within > -_ON - _SAME) & (within < size - 1 + _ON + _SAME)
        return within, inside.all(axis=1) & (np.abs(across) <= _ON).all(axis=1)

    def _origins_on(self, index: Array, shape: tuple[int, ...]) -> tuple[Array, Array] | None:
        """Where the pixels of a slice came from, and which are seen; None if all stay."""
        sites = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, len(shape))
        points = np.zeros((len(sites), len(index))) + index
        points[:, self.plane] = sites
        at, there = self._at(points)
        if not there.any():
            return None
        origins, covered = self._origins
        if shape == covered.shape and np.abs(at - sites).max() < _SAME:
            return origins, covered
        came, seen = sites.astype(float), np.ones(len(sites), dtype=bool)
        came[there] += looked_up(self._inverse, at[there]) @ self._back.T
        nearest = np.clip(np.rint(at[there]).astype(int), 0, np.array(covered.shape) - 1)
        seen[there] = covered[tuple(nearest.T)]
        seen &= ((came > -_ON) & (came < np.array(shape) - 1 + _ON)).all(axis=1)
        return came.reshape(*shape, len(shape)), seen.reshape(shape)

    @cached_property
    def _back(self) -> Array:
        """Steps of the solution's pixels, in the grid's."""
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
    """Whether an axis is known to be one of space."""
    length = np.isfinite(unit_factor(frame.units[axis], "millimeter"))
    return bool(length) or frame.axis_labels[axis].lower() in _DEPTHS
