"""Elements of a volume and their forces, in NumPy and float64.

The displacement is trilinear between the eight sites of an element. In coordinates from -1 to 1
along each axis, it is a sum of *modes*: 1, the coordinates, their pairwise products, and the
product of all three. The coefficient of a mode is the mean of the values at the eight corners,
multiplied by the sign of the mode at each corner (Walsh functions). The modes are orthogonal, so
their energies add up. The only coupling within a mode is between the two terms of a shear strain.

Only the mean change in volume of an element contributes to the energy, as in plane strain
(selective reduced integration). Including the change in volume at each point would lock nearly
incompressible tissue.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from napari_hmrf.solver.priors.elements import Float64Array, Lame

#: Shape of an array of modes. An index is 1 if the coordinate of that axis is a factor of the mode,
#: otherwise 0.
_MODES = (2, 2, 2)
_AXES = range(3)


class BrickShape(NamedTuple):
    """Factors that convert an element's modes to derivatives, for a given voxel size.

    Attributes
    ----------
    planes, rows, cols : float
        Factors that convert the sum over all corners, with signs along an axis, to the derivative
        along that axis.
    """

    planes: float
    rows: float
    cols: float

    @property
    def axes(self) -> int:
        """Number of axes of the grid."""
        return 3

    @property
    def aspect(self) -> float:
        """Ratio of a voxel's longest side to its shortest side."""
        return max(self) / min(self)

    @property
    def sides(self) -> tuple[float, ...]:
        """Lengths of a voxel's sides, scaled to a product of 1."""
        return tuple(1 / (4 * each) for each in self)

    def forces(self, lame: Lame, d: Float64Array) -> Float64Array:
        """Return the total force of the elements on each site: the stiffness matrix times d."""
        stresses = self._stresses(lame, self._gradients(modes(d)))
        return corners(self._pulls(stresses))

    def energy(self, lame: Lame, d: Float64Array) -> float:
        """Return U for a displacement (D, H, W, 3) in voxels."""
        gradients = self._gradients(modes(d))
        return float((self._stresses(lame, gradients) * gradients).sum() / 2)

    def _gradients(self, shares: Float64Array) -> Float64Array:
        """Return the derivatives along each axis as coefficients (axis, mode, component)."""
        gradients = np.zeros((len(_AXES), *shares.shape))
        # The derivative of a mode along an axis is the mode without that coordinate as a factor.
        for axis in _AXES:
            _without(gradients[axis], axis)[...] = self[axis] * _with(shares, axis)
        return gradients

    def _pulls(self, stresses: Float64Array) -> Float64Array:
        """Apply the transpose of `_gradients`."""
        pulls = np.zeros(stresses.shape[1:])
        for axis in _AXES:
            _with(pulls, axis)[...] += self[axis] * _without(stresses[axis], axis)
        return pulls

    def _stresses(self, lame: Lame, gradients: Float64Array) -> Float64Array:
        """Return the stresses, with each mode weighted by its mean square."""
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
    """Return the factors for a voxel size; only the ratios of the sides matter."""
    unit = float(np.prod(spacing)) ** (1 / 3)
    return BrickShape(*(unit / side / 4 for side in spacing))


def modes(d: Float64Array) -> Float64Array:
    """Return eight times the mode coefficients, shape (2, 2, 2, 3, D - 1, H - 1, W - 1)."""
    values = np.moveaxis(d, -1, 0)
    for axis in (-1, -2, -3):
        ends = np.moveaxis(values, axis, 0)
        behind, ahead = (np.moveaxis(each, 0, axis) for each in (ends[:-1], ends[1:]))
        values = np.stack([behind + ahead, ahead - behind])
    return values


def corners(pulls: Float64Array) -> Float64Array:
    """Apply the transpose of `modes`: add the forces of all modes at the sites, (D, H, W, 3)."""
    for axis in (-3, -2, -1):
        behind, ahead = pulls[0] - pulls[1], pulls[0] + pulls[1]
        pad = [(0, 0)] * behind.ndim
        pad[axis] = (0, 1)
        total = np.pad(behind, pad)
        pad[axis] = (1, 0)
        pulls = total + np.pad(ahead, pad)
    return np.moveaxis(pulls, 0, -1)


def _with(shares: Float64Array, axis: int) -> Float64Array:
    """Return the modes that have the coordinate of an axis as a factor."""
    index: Any = (*(slice(None),) * axis, 1)
    part: Float64Array = shares[index]
    return part


def _without(shares: Float64Array, axis: int) -> Float64Array:
    """Return the modes that do not have the coordinate of an axis as a factor."""
    index: Any = (*(slice(None),) * axis, 0)
    part: Float64Array = shares[index]
    return part
