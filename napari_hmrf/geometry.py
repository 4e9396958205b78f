"""Where a grid is: its shape, and the map from its pixels to positions in the patient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]

#: Largest distance between corresponding corners of grids in the same place, in pixels: sizes of
#: pixels are rounded in files, which adds up along an axis. A shift by half a pixel, as between
#: conventions for the first pixel, is larger.
SAME = 0.25
#: Largest deviation of the directions of axes at right angles from an orthogonal matrix.
_ROUNDING = 1e-5
#: Largest shift of a pixel to a grid at right angles, in pixels: directions are rounded in files.
_STRAIGHT = 0.1
#: Largest part of a border pixel that a covering grid leaves out because of rounding in files.
_CUT = 0.01
#: Smallest sine of the angle between an axis and the others in a grid that can be resampled.
_STEEP = 0.5


def is_orthogonal(matrix: Float64Array) -> bool:
    """Return whether the columns of a square matrix are unit vectors at right angles."""
    return bool(np.allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=_ROUNDING))


@dataclass(frozen=True, eq=False)
class Geometry:
    """Grid of pixels in patient coordinates.

    A position has the order of the axes of an array, ([z,] y, x); its coordinates increase towards
    superior, posterior and left. ITK's convention is LPS: the same coordinates in the order x, y
    [, z].

    Attributes
    ----------
    shape : tuple of int, shape (n,)
        Number of pixels along each axis of the array. A slice of a volume has three axes, the first
        of length 1.
    affine : ndarray, shape (n + 1, n + 1)
        Homogeneous map from indices to positions.
    unit : str
        Unit of length: "millimeter" in patient coordinates; the symbol of a unit for a picture,
        which starts at the origin, or "pixel" if the size of its pixels is unknown.
    """

    shape: tuple[int, ...]
    affine: Float64Array
    unit: str = "millimeter"

    @classmethod
    def of_itk(
        cls,
        shape: Sequence[int],
        spacing: Sequence[float],
        origin: Sequence[float],
        direction: npt.ArrayLike,
    ) -> Geometry:
        """Create a geometry from ITK's description of a grid.

        Parameters
        ----------
        shape : sequence of int
            Number of pixels along each axis of the array, ([D,] H, W).
        spacing : sequence of float
            Pixel size along each axis of the array, ([z,] y, x), in mm.
        origin : sequence of float
            Centre of the first pixel: x, y[, z] in LPS.
        direction : array_like, shape (n, n)
            Direction matrix: its columns are the directions of the image axes x, y[, z].
        """
        n = len(spacing)
        affine = np.eye(n + 1)
        affine[:n, :n] = np.reshape(direction, (n, n))[::-1, ::-1] * spacing
        affine[:n, n] = origin[::-1]
        return cls(tuple(shape), affine)

    @classmethod
    def at_origin(
        cls, shape: Sequence[int], spacing: Sequence[float] = (), unit: str = "pixel"
    ) -> Geometry:
        """Create a geometry along the axes, whose first pixel is at the origin."""
        n = len(shape)
        return cls(tuple(shape), np.diag([*(spacing or (1.0,) * n), 1.0]), unit)

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.affine) - 1

    @property
    def spacing(self) -> tuple[float, ...]:
        """Pixel size along each axis of the array, ([z,] y, x)."""
        # Unlike `numpy.linalg.norm`, `hypot` is exact for a step along one axis.
        return tuple(math.hypot(*step) for step in self.affine[:-1, :-1].T.tolist())

    @property
    def origin(self) -> tuple[float, ...]:
        """Centre of the first pixel in ITK's convention: x, y[, z] in LPS."""
        return tuple(self.affine[-2::-1, -1].tolist())

    @property
    def directions(self) -> Float64Array:
        """Unit vectors along the axes of the array, as columns, shape (n, n)."""
        return np.asarray(self.affine[:-1, :-1] / self.spacing)

    @property
    def direction(self) -> Float64Array:
        """Direction matrix in ITK's convention; see `of_itk`."""
        return self.directions[::-1, ::-1]

    @property
    def as_itk(self) -> dict[str, Any]:
        """Spacing, origin and direction, as arguments of `write_field`."""
        return {"spacing": self.spacing, "origin": self.origin, "direction": self.direction}

    def right_angled(self) -> Geometry:
        """Return the nearest grid with axes at right angles and the same first pixel.

        Raises
        ------
        ValueError
            If a pixel would be shifted by more than rounding in a file; the message is a clause.
        """
        if is_orthogonal(self.directions):
            return self
        n = self.ndim
        u, _, v = np.linalg.svd(self.directions)
        affine = self.affine.copy()
        affine[:n, :n] = u @ v * self.spacing
        nearest = replace(self, affine=affine)
        shift = nearest.farthest_from(self) / min(self.spacing)
        if shift > _STRAIGHT:
            cosines = self.directions.T @ self.directions - np.eye(n)
            tilt = math.degrees(math.asin(min(np.abs(cosines).max(), 1.0)))
            raise ValueError(
                f"its axes are not at right angles: pixels are shifted by up to {shift:.3g} pixels,"
                f" as by a gantry tilt of {tilt:.3g} degrees"
            )
        return nearest

    def covering(self) -> Geometry:
        """Return the grid at right angles that covers this grid, with the same rows and slices.

        The last axis keeps its direction and the others become perpendicular to it, so that pixels
        are shifted within their slice only, and slices keep their distance.

        Raises
        ------
        ValueError
            If an axis is less than 30 degrees from the others; the message is a clause.
        """
        n = self.ndim
        turn, steps = np.linalg.qr(self.affine[:n, n - 1 :: -1])
        if (np.abs(np.diag(steps)) < _STEEP * np.linalg.norm(steps, axis=0)).any():
            raise ValueError("one of its axes is less than 30 degrees from the others")
        affine = self.affine.copy()
        affine[:n, :n] = (turn * np.diag(steps))[:, ::-1]
        grid = Geometry(self.shape, affine, self.unit)
        corners = grid.to_pixels(self.to_world(self._corners))
        first = np.floor(corners.min(axis=0) + _CUT)
        sizes = np.ceil(corners.max(axis=0) - _CUT) - first + 1
        affine[:n, n] = grid.to_world(first)
        return replace(grid, shape=tuple(sizes.astype(int).tolist()))

    def to_world(self, pixels: npt.ArrayLike) -> Float64Array:
        """Convert points, shape (..., n), from pixels of the grid to positions."""
        n = self.ndim
        return np.asarray(np.asarray(pixels) @ self.affine[:n, :n].T + self.affine[:n, n])

    def to_pixels(self, points: npt.ArrayLike) -> Float64Array:
        """Convert points, shape (..., n), from positions to pixels of the grid."""
        n = self.ndim
        offsets = np.asarray(points) - self.affine[:n, n]
        return np.asarray(offsets @ np.linalg.inv(self.affine[:n, :n]).T)

    def same_as(self, other: Geometry | None) -> bool:
        """Return whether the corners of this grid have the same indices in another grid.

        The numbers of pixels are not compared: a grid with fewer pixels starts at the same pixel.
        """
        if other is None or self.ndim != other.ndim:
            return False
        corners = self._corners
        return bool(np.abs(other.to_pixels(self.to_world(corners)) - corners).max() <= SAME)

    def farthest_from(self, other: Geometry) -> float:
        """Return the largest distance between corners of this grid and their indices in another."""
        apart = other.to_world(self._corners) - self.to_world(self._corners)
        return float(np.linalg.norm(apart, axis=1).max())

    @property
    def _corners(self) -> Float64Array:
        """Indices of the corners, shape (2^n, n)."""
        return np.array([*product(*((0, size - 1) for size in self.shape))], float)

    def scaled(self, factor: float) -> Geometry:
        """Return the geometry with all lengths multiplied by a factor."""
        affine = self.affine.copy()
        affine[:-1] *= factor
        return replace(self, affine=affine)

    def reordered(self, order: Sequence[int]) -> Geometry:
        """Return the geometry of the array that `transpose(order)` returns."""
        shape = tuple(self.shape[axis] for axis in order)
        return replace(self, shape=shape, affine=self.affine[:, [*order, -1]])

    def reversed_along(self, axes: Sequence[int]) -> Geometry:
        """Return the geometry of the array that `numpy.flip` returns."""
        n = self.ndim
        turn = np.eye(n + 1)
        for axis in axes:
            turn[axis, [axis, n]] = -1.0, self.shape[axis] - 1.0
        return replace(self, affine=self.affine @ turn)

    def slice_at(self, number: int) -> Geometry:
        """Return the geometry of the slice with an index along the first axis."""
        affine = self.affine.copy()
        affine[:, -1] += number * affine[:, 0]
        return replace(self, shape=(1, *self.shape[1:]), affine=affine)
