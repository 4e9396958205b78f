"""Forward or backward displacement field, as stored in a file or a layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.inverse_field import Inverse, inverse_displacement, origins_at
from napari_hmrf.field.moved_points import interpolate_linearly


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """Displacement field, either forward or backward.

    Attributes
    ----------
    vectors : ndarray, shape ([D,] H, W, n)
        Vectors in the unit of `spacing`, with components in axis order.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    back : bool
        True for a backward field, which maps each moved position to its origin and is used to
        warp images. False for a forward (material) field, which maps each point of tissue to its
        moved position.
    """

    vectors: npt.NDArray[Any]
    spacing: Sequence[float]
    back: bool = False

    @classmethod
    def in_pixels(cls, vectors: npt.NDArray[Any], back: bool = False) -> DisplacementField:
        """Create a field from vectors in pixels."""
        return cls(vectors, (1.0,) * vectors.shape[-1], back)

    def to_pixels(self) -> DisplacementField:
        """Return the same field with vectors in pixels."""
        if all(size == 1 for size in self.spacing):
            return self
        steps = self.vectors / np.asarray(self.spacing, self.vectors.dtype)
        return DisplacementField.in_pixels(steps, self.back)

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
        """Forward displacement of each site; a backward field is inverted on its whole grid."""
        return self._inverse.displacement if self.back else self.vectors

    @property
    def backward(self) -> npt.NDArray[Any]:
        """Backward displacement, from each site after the motion to its origin."""
        return self.vectors if self.back else self._inverse.displacement

    @property
    def residual(self) -> float:
        """Largest error of the inversion of a backward field, in pixels; 0 for a forward field."""
        return self._inverse.residual if self.back else 0.0

    @cached_property
    def _inverse(self) -> Inverse:
        return inverse_displacement(self.vectors, spacing=self.spacing)
