"""Elements of volumes for large motion: finite strain and rotation, in NumPy and float64.

Displacement is trilinear between the eight sites of an element. F_p is the deformation gradient at
each of the eight Gauss points, and J_p is its determinant. The mean of the J_p is the change of
volume V, exactly. The energy of an element is that of a neo-Hookean solid, whose resistance to a
change of volume acts on the element as a whole (counting it at each point would lock nearly
incompressible tissue), plus a barrier that rises as the element comes close to folding:

    U = mean over points of [mu/2 (|F_p|^2 - 3) - mu ln J_p]
        + lambda/4 (V^2 - 1) - lambda/2 ln V
        + mu kappa times the mean of b(B) over the Bernstein coefficients B
    below J_0:  b = -(B - J_0)^2 ln(B / J_0)

The 27 Bernstein coefficients of the Jacobian bound it everywhere in the element: if all are
positive, the element is folded nowhere (see `backends.cpu.bernstein`; positive corners are not
enough).

For small motion this is the element of `hexahedra`. Let e_g be the growth strain, which tissue
would have if it were free, and G = (1 + e_g)^-1. The energy is then that of the deformation from
the grown shape, for the grown amount of tissue:

    F_p -> F_p G,    J_p, V, B -> det(G) times the same,    U -> U / det(G)
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from napari_hmrf.solver.priors.elements import Float64Array, lame_parameters
from napari_hmrf.solver.priors.finite_strain import BARRIER, BARRIER_BEGIN, FiniteMaterial
from napari_hmrf.solver.priors.hexahedra import BrickShape

_CORNERS = tuple(product((0, 1), repeat=3))
_POINTS = tuple(product((-1 / np.sqrt(3), 1 / np.sqrt(3)), repeat=3))


class BrickModuli(NamedTuple):
    """Moduli of the elements of a volume, relative to the stiffest tissue.

    Attributes
    ----------
    shear, first : ndarray, shape (D - 1, H - 1, W - 1)
        Parameters mu and lambda, times the growth of the volume; 0 in void.
    undo : ndarray, shape (D - 1, H - 1, W - 1, 3, 3), or None
        Matrix G, which removes growth; None without growth.
    """

    shear: Float64Array
    first: Float64Array
    undo: Float64Array | None


def brick_moduli(
    material: FiniteMaterial, stand_in: float = 0.0, planes: slice = slice(None)
) -> BrickModuli:
    """Return the moduli of the elements of a volume.

    Parameters
    ----------
    material : FiniteMaterial
    stand_in : float
        Stiffness used for rigid tissue, in units of the stiffest other tissue; 0 leaves its
        elements out.
    planes : slice
        Planes of sites whose elements are returned; by default all.
    """
    nu = material.poisson
    nu = nu[planes] if isinstance(nu, np.ndarray) else nu
    lame = lame_parameters(material.relative(stand_in, planes), nu, strain=True)
    if material.growth is None:
        return BrickModuli(lame.shear, lame.first, None)
    strains, _ = material.element_growth(lame, planes)
    grown = np.eye(3) + np.moveaxis(strains, (0, 1), (-2, -1))
    amount = np.linalg.det(grown)
    undo: Float64Array = np.asarray(np.linalg.inv(grown), dtype=np.float64)
    return BrickModuli(amount * lame.shear, amount * lame.first, undo)


class FiniteBricks:
    """Energy of all elements of a volume, and its derivatives.

    Parameters
    ----------
    moduli : BrickModuli
    shape : BrickShape
    """

    def __init__(self, moduli: BrickModuli, shape: BrickShape) -> None:
        self._moduli, self._shape = moduli, shape
        self._is_tissue = moduli.shear > 0
        undo = np.eye(3) if moduli.undo is None else moduli.undo
        self._undo = np.broadcast_to(undo, (*moduli.shear.shape, 3, 3))
        self._gain = np.linalg.det(self._undo)

    def energy(self, d: Float64Array) -> float:
        """Return the energy of a displacement (D, H, W, 3) in voxels.

        It is infinite if a Bernstein coefficient of any element of tissue is not positive.
        """
        bernstein = self.corner_jacobians(d)
        if (bernstein[:, self._is_tissue] <= 0).any():
            return np.inf
        shear, first = self._moduli.shear, self._moduli.first
        each, volume = np.zeros(shear.shape), np.zeros(shear.shape)
        with np.errstate(all="ignore"):  # in void
            for gradient in self._gradients(d):
                elastic = gradient @ self._undo
                jacobian = np.linalg.det(elastic)
                each += shear / 8 * ((elastic**2).sum(axis=(-1, -2)) - 3) / 2
                each -= shear / 8 * np.log(jacobian)
                volume += jacobian / 8
            each += first / 4 * (volume**2 - 1) - first / 2 * np.log(volume)
            below = np.minimum(bernstein, BARRIER_BEGIN)
            wall = -((below - BARRIER_BEGIN) ** 2) * np.log(below / BARRIER_BEGIN)
        each += shear * BARRIER * wall.mean(axis=0)
        return float(each[self._is_tissue].sum())

    def forces(self, d: Float64Array) -> Float64Array:
        """Return the gradient of the energy with respect to the displacement, (D, H, W, 3)."""
        shear, first, gain = self._moduli.shear, self._moduli.first, self._gain
        gradients = list(self._gradients(d))
        jacobians = [np.linalg.det(gradient) for gradient in gradients]
        volume = gain * sum(jacobians) / 8
        total: Float64Array = np.zeros(d.shape)
        square = self._undo @ self._undo
        with np.errstate(all="ignore"):  # in void
            pressure = gain * first / 2 * (volume - 1 / volume)
            for point, gradient, jacobian in zip(_POINTS, gradients, jacobians, strict=True):
                stress = shear[..., None, None] * (gradient @ square)
                slope = pressure - shear / jacobian
                stress = (stress + slope[..., None, None] * _cofactors(gradient)) / 8
                stress = np.where(self._is_tissue[..., None, None], stress, 0.0)
                for corner, factors in zip(_CORNERS, self._slopes(point), strict=True):
                    total[_sites(corner)] += stress @ factors
        return total + self._barrier_forces(d)

    def corner_jacobians(self, d: Float64Array) -> Float64Array:
        """Return the Bernstein coefficients of the Jacobian of each element, with growth.

        Parameters
        ----------
        d : ndarray, shape (D, H, W, 3)
            Displacement, in voxels.

        Returns
        -------
        ndarray, shape (27, D - 1, H - 1, W - 1)
            Coefficients; 1 in void.
        """
        return np.where(self._is_tissue, self._gain * bernstein_coefficients(d, self._shape), 1.0)

    def _barrier_forces(self, d: Float64Array) -> Float64Array:
        total: Float64Array = np.zeros(d.shape)
        coefficients = self.corner_jacobians(d)
        below = np.minimum(coefficients, BARRIER_BEGIN)
        gap, log = below - BARRIER_BEGIN, np.log(below / BARRIER_BEGIN)
        slopes = -gap * (2 * log + gap / below) * self._moduli.shear * BARRIER * self._gain / 27
        if not slopes.any():
            return total
        sides, (a, b, c) = np.array(self._shape) * 4, _edges(d, self._shape)
        for (index, weight), one, two, three in _triples():
            share = weight * slopes[index][..., None]
            for axis, near, pull in (
                (0, one, np.cross(b[two], c[three])),
                (1, two, np.cross(c[three], a[one])),
                (2, three, np.cross(a[one], b[two])),
            ):
                begin, end = _ends(axis, near)
                total[end] += sides[axis] * share * pull
                total[begin] -= sides[axis] * share * pull
        return total

    def _gradients(self, d: Float64Array) -> Iterator[Float64Array]:
        """Yield the deformation gradient at each Gauss point, (D - 1, H - 1, W - 1, 3, 3)."""
        for point in _POINTS:
            gradient = np.broadcast_to(np.eye(3), (*self._moduli.shear.shape, 3, 3)).copy()
            for corner, factors in zip(_CORNERS, self._slopes(point), strict=True):
                gradient += d[_sites(corner)][..., None] * factors
            yield gradient

    def _slopes(self, point: tuple[float, ...]) -> Float64Array:
        """Return the derivatives of the shape function of each corner at a point, (8, 3)."""
        signs = 2 * np.array(_CORNERS) - 1
        values = 1 + signs * np.array(point)
        factors = np.array(self._shape) * signs
        return np.stack(
            [
                factors[:, 0] * values[:, 1] * values[:, 2],
                factors[:, 1] * values[:, 0] * values[:, 2],
                factors[:, 2] * values[:, 0] * values[:, 1],
            ],
            axis=1,
        )


def bernstein_coefficients(d: Float64Array, shape: BrickShape) -> Float64Array:
    """Return the 27 Bernstein coefficients of the Jacobian of each element.

    Parameters
    ----------
    d : ndarray, shape (D, H, W, 3)
        Displacement, in voxels.
    shape : BrickShape

    Returns
    -------
    ndarray, shape (27, D - 1, H - 1, W - 1)
        Coefficients, all 1 without displacement. If all are positive, the element is folded
        nowhere.
    """
    made = np.zeros((27, *(size - 1 for size in d.shape[:-1])))
    a, b, c = _edges(d, shape)
    for (index, weight), one, two, three in _triples():
        made[index] += weight * (a[one] * np.cross(b[two], c[three])).sum(axis=-1)
    return made


_Side = tuple[int, ...]


@lru_cache(maxsize=1)
def _triples() -> tuple[tuple[tuple[int, float], _Side, _Side, _Side], ...]:
    """Return the coefficient and weight of each triple of sides, with the indices of its sides."""
    made = []
    for j, k, i, other_k, other_i, other_j in product((0, 1), repeat=6):
        index = i + other_i, j + other_j, k + other_k
        weight = 0.5 ** index.count(1)
        number = 9 * index[0] + 3 * index[1] + index[2]
        made.append(((number, weight), (j, k), (i, other_k), (other_i, other_j)))
    return tuple(made)


def _edges(d: Float64Array, shape: BrickShape) -> list[dict[_Side, Float64Array]]:
    """Return the sides of the elements along each axis, divided by their length at rest."""
    made = []
    for axis in range(3):
        sides = {}
        for near in product((0, 1), repeat=2):
            begin, end = _ends(axis, near)
            sides[near] = np.eye(3)[axis] + 4 * shape[axis] * (d[end] - d[begin])
        made.append(sides)
    return made


def _ends(axis: int, near: _Side) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the indices of the sites at the begin and at the end of a side of the elements."""
    begin, end = ((*near[:axis], far, *near[axis:]) for far in (0, 1))
    return _sites(begin), _sites(end)


def _sites(corner: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the index of the sites at a corner of the elements."""
    return tuple(slice(1, None) if far else slice(None, -1) for far in corner)


def _cofactors(matrices: Float64Array) -> Float64Array:
    """Return the cofactors of 3 x 3 matrices."""
    rows = np.moveaxis(matrices, -2, 0)
    return np.stack(
        [np.cross(rows[1], rows[2]), np.cross(rows[2], rows[0]), np.cross(rows[0], rows[1])],
        axis=-2,
    )
