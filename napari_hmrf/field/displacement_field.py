"""Forward or backward displacement field, as stored in a file or a layer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.inverse_field import Inverse, inverse_displacement, origins_at
from napari_hmrf.field.moved_points import interpolate_linearly
from napari_hmrf.geometry import Geometry
from napari_hmrf.real_arrays import grid_in_words


@dataclass(frozen=True, eq=False)
class Field:
    """Displacement field on a grid, either forward or backward.

    Attributes
    ----------
    vectors : ndarray, shape ([D,] H, W, n)
        Vectors in the unit of the grid, with components along the axes of the array, in the same
        order.
    geometry : Geometry
        Grid of the field; for a slice of a volume, a volume of one slice.
    back : bool
        True for a backward field, which maps each moved position to its origin and is used to
        warp images. False for a forward (material) field, which maps each point of tissue to its
        moved position.
    """

    vectors: npt.NDArray[Any]
    geometry: Geometry
    back: bool = False

    @classmethod
    def in_pixels(cls, vectors: npt.NDArray[Any], back: bool = False) -> Field:
        """Create a field from vectors in pixels."""
        return cls(vectors, Geometry.at_origin(vectors.shape[:-1]), back)

    def __repr__(self) -> str:
        unit = "mm" if self.geometry.unit == "millimeter" else "px"
        sizes = grid_in_words(self.shape), grid_in_words(self.spacing)
        return f"Field({sizes[0]} sites of {sizes[1]} {unit})"

    def to_pixels(self) -> Field:
        """Return the same field with vectors in pixels."""
        if all(size == 1 for size in self.spacing):
            return self
        steps = self.vectors / np.asarray(self.spacing, self.vectors.dtype)
        return Field.in_pixels(steps, self.back)

    @property
    def spacing(self) -> tuple[float, ...]:
        """Pixel size along each axis of the field, in the order [z,] y, x."""
        return self.geometry.spacing[-self.vectors.shape[-1] :]

    @property
    def origin(self) -> tuple[float, ...]:
        """Centre of the first pixel in ITK's convention: x, y[, z] in LPS."""
        return self.geometry.origin

    @property
    def direction(self) -> npt.NDArray[np.float64]:
        """Direction matrix in ITK's convention: its columns are the directions of x, y[, z]."""
        return self.geometry.direction

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of sites of the grid along each axis."""
        return self.vectors.shape[:-1]

    def at(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.floating]:
        """Return the forward displacement of the tissue at the given points.

        For a backward field of a volume, only the given points are inverted.

        Parameters
        ----------
        points : ndarray, shape (N, n)
            Positions before the motion, in pixels.

        Returns
        -------
        ndarray, shape (N, n)
            Displacement in the unit of `spacing`.
        """
        if not self.back or self.vectors.shape[-1] != 3:
            return interpolate_linearly(self.displacement, points)
        origins = origins_at(self.to_pixels().vectors, points)
        return (origins - points) * self.spacing

    def arrows(self, about: int) -> tuple[npt.NDArray[np.float32], int]:
        """Return evenly spaced arrows of the forward displacement.

        Parameters
        ----------
        about : int
            Approximate number of arrows in each slice along the last two axes.

        Returns
        -------
        arrows : ndarray, shape (N, 2, n)
            Arrows as (start, step), with starts in pixels and steps in the unit of `spacing`.
        apart : int
            Distance between neighbouring arrows, in pixels.
        """
        shape = self.shape
        apart = max(1, round((shape[-2] * shape[-1] / about) ** 0.5))
        lines = [slice(size) for size in shape[:-2]]
        lines += [slice(min(apart // 2, size - 1), size, apart) for size in shape[-2:]]
        starts = np.mgrid[tuple(lines)].reshape(len(shape), -1).T
        arrows = np.stack([starts, self.at(starts.astype(float))], axis=1)
        return arrows.astype(np.float32), apart

    @property
    def displacement(self) -> npt.NDArray[Any]:
        """Material displacement d of each site: tissue at X moves to X + d(X).

        A backward field is inverted on its whole grid on first access.
        """
        return self._inverse.displacement if self.back else self.vectors

    @property
    def backward(self) -> npt.NDArray[Any]:
        """Backward displacement, from each site after the motion to its origin."""
        return self.vectors if self.back else self._inverse.displacement

    @property
    def residual(self) -> float:
        """Largest error of `displacement` as the inverse of a backward field, in pixels, or 0."""
        return self._inverse.residual if self.back else 0.0

    @cached_property
    def _inverse(self) -> Inverse:
        return inverse_displacement(self.vectors, spacing=self.spacing)
