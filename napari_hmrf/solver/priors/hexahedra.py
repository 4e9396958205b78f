"""The elements of a volume, and what they pull with, in NumPy and float64.

Between eight sites displacement is trilinear. In coordinates from -1 to 1 along each axis it is a
sum of *modes*: 1, the coordinates, their products in pairs, and the product of all three. A mode's
share is a sum of the eight corners, each with the sign that the mode has there (Walsh's functions),
over eight. Modes are orthogonal, so that each adds to the energy by itself: of strains that vary
within an element no two differ in the same way, but for those of shear.

Tissue resists a change of volume of the element as a whole only, as in plane strain (selective
reduced integration): where that counted at each point, nearly incompressible tissue would lock.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from napari_hmrf.solver.priors.elements import Float64Array, Lame

#: Modes as arrays: on the first three axes, whether each of the coordinates is a factor.
_MODES = (2, 2, 2)
_AXES = range(3)


class BrickShape(NamedTuple):
    """What the size of a voxel makes of an element's modes.

    Attributes
    ----------
    planes, rows, cols : float
        What a sum of all corners, with their signs along an axis, says of the derivative along it.
    """

    planes: float
    rows: float
    cols: float

    @property
    def axes(self) -> int:
        """Of the grid."""
        return 3

    @property
    def aspect(self) -> float:
        """The ratio of the longest side to the shortest."""
        return max(self) / min(self)

    @property
    def sides(self) -> tuple[float, ...]:
        """The lengths of a voxel's sides, whose product is 1."""
        return tuple(1 / (4 * each) for each in self)

    def forces(self, lame: Lame, d: Float64Array) -> Float64Array:
        """What all elements together pull at each site: the stiffness matrix times d."""
        stresses = self._stresses(lame, self._gradients(modes(d)))
        return corners(self._pulls(stresses))

    def energy(self, lame: Lame, d: Float64Array) -> float:
        """U of a displacement (D, H, W, 3) in voxels."""
        gradients = self._gradients(modes(d))
        return float((self._stresses(lame, gradients) * gradients).sum() / 2)

    def _gradients(self, shares: Float64Array) -> Float64Array:
        """The derivatives along each axis of each component, in modes: (axis, mode, component)."""
        made = np.zeros((len(_AXES), *shares.shape))
        # A mode is a coordinate times another mode, which is the derivative along its axis.
        for axis in _AXES:
            _without(made[axis], axis)[...] = self[axis] * _with(shares, axis)
        return made

    def _pulls(self, stresses: Float64Array) -> Float64Array:
        """The transpose of `_gradients`."""
        made = np.zeros(stresses.shape[1:])
        for axis in _AXES:
            _with(made, axis)[...] += self[axis] * _without(stresses[axis], axis)
        return made

    def _stresses(self, lame: Lame, gradients: Float64Array) -> Float64Array:
        """The stresses, each mode in proportion to the mean of its square."""
        by_component = np.moveaxis(gradients, 4, 1)
        sheared: Float64Array = lame.shear * (by_component + by_component.swapaxes(0, 1))
        thirds = 3.0 ** -np.indices(_MODES).sum(axis=0)
        sheared *= thirds[..., None, None, None]
        mean = (..., 0, 0, 0, slice(None), slice(None), slice(None))
        volume = lame.first * sum(by_component[axis, axis][mean] for axis in _AXES)
        for axis in _AXES:
            sheared[axis, axis][mean] += volume
        return np.moveaxis(sheared, 1, 4)


def brick_shape(spacing: tuple[float, ...]) -> BrickShape:
    """The shape of a voxel of this size; only its proportions matter."""
    unit = float(np.prod(spacing)) ** (1 / 3)
    return BrickShape(*(unit / side / 4 for side in spacing))


def modes(d: Float64Array) -> Float64Array:
    """What each mode has of each component, (2, 2, 2, 3, D - 1, H - 1, W - 1), eightfold."""
    values = np.moveaxis(d, -1, 0)
    for axis in (-1, -2, -3):
        ends = np.moveaxis(values, axis, 0)
        behind, ahead = (np.moveaxis(each, 0, axis) for each in (ends[:-1], ends[1:]))
        values = np.stack([behind + ahead, ahead - behind])
    return values


def corners(pulls: Float64Array) -> Float64Array:
    """The transpose of `modes`: what modes pull with, at the sites, (D, H, W, 3)."""
    for axis in (-3, -2, -1):
        behind, ahead = pulls[0] - pulls[1], pulls[0] + pulls[1]
        pad = [(0, 0)] * behind.ndim
        pad[axis] = (0, 1)
        total = np.pad(behind, pad)
        pad[axis] = (1, 0)
        pulls = total + np.pad(ahead, pad)
    return np.moveaxis(pulls, 0, -1)


def _with(shares: Float64Array, axis: int) -> Float64Array:
    """The modes that have an axis's coordinate as a factor."""
    index: Any = (*(slice(None),) * axis, 1)
    part: Float64Array = shares[index]
    return part


def _without(shares: Float64Array, axis: int) -> Float64Array:
    """The modes that have not."""
    index: Any = (*(slice(None),) * axis, 0)
    part: Float64Array = shares[index]
    return part
