"""Coupling of the fields of sliding parts along the normals of their interfaces.

The fields of all parts are stored in one *unfolded* grid: the boxes of the parts are placed one
below the other along the first axis, separated by void. In its box, a part has its own sites and
*copies* of the sites of other parts that share an element with it. The energy is the elastic energy
of the unfolded grid plus the coupling

    U_coupling = 1/2 sum over pairs of  k (n . (d_first - d_second))^2

where a pair consists of a site and a copy of it in the field of another part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]
Index = tuple[slice, ...]


#: Attributes of a coupling that are arrays.
_ARRAYS = "first", "second", "normals", "distances", "strength", "stiffness", "own"


class Box(NamedTuple):
    """Box of a part: its index in the image, and its index in the unfolded grid."""

    image: Index
    unfolded: Index


@dataclass(frozen=True, eq=False)
class Coupling:
    """Pairs of sites in an unfolded grid that are coupled along a normal.

    Attributes
    ----------
    first, second : ndarray of int, shape (n,)
        Index of each site and of its copy, in the flattened unfolded grid.
    normals : ndarray, shape (n, axes)
        Unit normals.
    distances : ndarray, shape (n,)
        Distance of each site from the interface along its normal, in the solver's unit of length.
    strength : ndarray, shape (n,)
        Strength k, in the unit of `Problem.precision`.
    stiffness : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness of the image.
    boxes : tuple of Box
        Boxes of the parts.
    own : ndarray of bool, shape of the unfolded grid
        Mask of the sites that are no copies.
    nearly_free : bool
        True if the normals hardly resist some rigid motion of a part, which cycles may then miss.
    """

    first: npt.NDArray[np.intp]
    second: npt.NDArray[np.intp]
    normals: Float64Array
    distances: Float64Array
    strength: Float64Array
    stiffness: npt.NDArray[np.float32]
    boxes: tuple[Box, ...]
    own: npt.NDArray[np.bool_]
    nearly_free: bool = False

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, Coupling)
            and self.nearly_free == other.nearly_free
            and self.boxes == other.boxes
            and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in _ARRAYS)
        )

    __hash__ = None  # type: ignore[assignment]

    def energy(self, displacement: npt.NDArray[Any]) -> float:
        """Return the energy of the coupling.

        Parameters
        ----------
        displacement : ndarray, shape of the unfolded grid, with the component as the last axis
        """
        return self.product(displacement, displacement) / 2

    def product(self, one: npt.NDArray[Any], other: npt.NDArray[Any]) -> float:
        """Return the bilinear form of the energy for two displacements."""
        return float((self.strength * self._gaps(one) * self._gaps(other)).sum())

    def forces(self, displacement: npt.NDArray[Any]) -> Float64Array:
        """Return the gradient of the energy with respect to the displacement."""
        pulls = (self.strength * self._gaps(displacement))[:, None] * self.normals
        forces = np.zeros((self.own.size, self.normals.shape[1]))
        np.add.at(forces, self.first, pulls)
        np.add.at(forces, self.second, -pulls)
        return forces.reshape(displacement.shape)

    def _gaps(self, displacement: npt.NDArray[Any]) -> Float64Array:
        """Return the distance n . (d_first - d_second) of each pair."""
        flat = displacement.reshape(-1, displacement.shape[-1]).astype(np.float64)
        return np.asarray(((flat[self.first] - flat[self.second]) * self.normals).sum(axis=1))

    def tensors(self) -> Float64Array:
        """Return the sum of ``k n n^T`` at each site of the unfolded grid."""
        axes = self.normals.shape[1]
        sums = np.zeros((self.own.size, axes, axes))
        each = self.strength[:, None, None] * self.normals[:, :, None] * self.normals[:, None, :]
        np.add.at(sums, self.first, each)
        np.add.at(sums, self.second, each)
        return sums.reshape(*self.own.shape, axes, axes)

    def matrix(self) -> scipy.sparse.csr_array:
        """Return the second derivatives of the energy, with a row for each component.

        The components are in the order of a displacement of the unfolded grid, flattened.
        """
        axes = self.normals.shape[1]
        pairs = np.arange(len(self.first))
        size = self.own.size * axes
        gaps = scipy.sparse.csr_array((len(pairs), size))
        for sites, sign in ((self.first, 1.0), (self.second, -1.0)):
            columns = sites[:, None] * axes + np.arange(axes)
            entries = (sign * self.normals).ravel(), (np.repeat(pairs, axes), columns.ravel())
            gaps += scipy.sparse.csr_array(entries, shape=gaps.shape)
        return scipy.sparse.csr_array(gaps.T @ (self.strength[:, None] * gaps))

    def places(self) -> npt.NDArray[np.intp]:
        """Return the index in the flattened image of each site of the unfolded grid, or of void."""
        image = np.arange(self.stiffness.size).reshape(self.stiffness.shape)
        places = np.zeros(self.own.shape, np.intp)
        for box in self.boxes:
            places[box.unfolded] = image[box.image]
        return places.ravel()

    def folded(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the values of an unfolded grid on the image, taken from the sites that own them.

        Parameters
        ----------
        values : ndarray
            The first axes are those of the unfolded grid.
        """
        axes = self.own.ndim
        image = np.zeros((*self.stiffness.shape, *values.shape[axes:]), values.dtype)
        for box in self.boxes:
            own = self.own[box.unfolded]
            image[box.image][own] = values[box.unfolded][own]
        return image
