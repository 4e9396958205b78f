"""A displacement field as it is stored, whichever way it leads, and the motion that it means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.inverse_field import Inverse, inverse_displacement, origins_at
from napari_hmrf.field.moved_points import looked_up


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """A displacement field as it is stored, whichever way it leads.

    Attributes
    ----------
    vectors : ndarray, shape (..., n)
        In the unit of `spacing`, components in the order of the axes.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    back : bool
        Whether they lead from what is seen to where it came from, as those that move images do. By
        default they are material: they lead to where tissue goes.
    """

    vectors: npt.NDArray[Any]
    spacing: Sequence[float]
    back: bool = False

    @classmethod
    def in_pixels(cls, vectors: npt.NDArray[Any], back: bool = False) -> DisplacementField:
        """A field whose vectors are in pixels."""
        return cls(vectors, (1.0,) * vectors.shape[-1], back)

    def to_pixels(self) -> DisplacementField:
        """The same field in pixels."""
        if all(size == 1 for size in self.spacing):
            return self
        steps = self.vectors / np.asarray(self.spacing, self.vectors.dtype)
        return DisplacementField.in_pixels(steps, self.back)

    @property
    def shape(self) -> tuple[int, ...]:
        """The pixels of its grid along each axis."""
        return self.vectors.shape[:-1]

    def at(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.floating]:
        """By how much tissue moves that is at points, (N, n) in pixels.

        Of a volume that leads back only these points are inverted.
        """
        if not self.back or self.vectors.shape[-1] != 3:
            return looked_up(self.displacement, points)
        origins = origins_at(self.to_pixels().vectors, points)
        return (origins - points) * self.spacing

    def arrows(self, about: int) -> tuple[npt.NDArray[np.float32], int]:
        """Some of its arrows, evenly: about so many of each slice along its last two axes.

        Returns
        -------
        arrows : ndarray, shape (N, 2, n)
            (start, step) of each; the start in pixels.
        apart : int
            Pixels from one to the next.
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
        """Material, at every site: of a field that leads back, all of it is inverted."""
        return self._inverse.displacement if self.back else self.vectors

    @property
    def backward(self) -> npt.NDArray[Any]:
        """From what is seen at every site to where it came from: `displacement` the other way."""
        return self.vectors if self.back else self._inverse.displacement

    @property
    def residual(self) -> float:
        """How far, in pixels, `displacement` is from the inverse of the vectors at the worst site.

        0 if they are material.
        """
        return self._inverse.residual if self.back else 0.0

    @cached_property
    def _inverse(self) -> Inverse:
        return inverse_displacement(self.vectors, spacing=self.spacing)
