"""Elements for large motion: finite strain and rotation, in NumPy and float64.

Six numbers describe a deformed element: its two mean sides, relative to the undeformed sides h_r
and h_c, and its twist,

    z = (a, b, x):  a = e_r + D_r / 2 h_r,  b = e_c + D_c / 2 h_c,  x = D_x

Here a and b are the columns of the mean deformation gradient F. The displacement of an element is
bilinear, so its Jacobian is linear within the element: if the Jacobian is positive at the four
corners, the element is not folded anywhere. The mean Jacobian and the Jacobian at each corner are
quadratic in z,

    J = z . Q z / 2.

The energy of an element is the neo-Hookean energy, plus the energy of the twist, plus a barrier
that increases as a corner approaches folding:

    U = mu/2 (|F|^2 - 2) + g(J) + t/2 |x|^2 + mu kappa/4 sum over corners of b(J_k)
    plane strain:  g = lambda/4 (J^2 - 1) - (mu + lambda/2) ln J
    plane stress:  g = (mu + lambda/2) (ln((mu + lambda J^2/2) / (mu + lambda/2)) / 2 - ln J)
    below J_0:     b = -(J - J_0)^2 ln(J / J_0)

For small motion, this is linear elasticity. Let e_g be the growth strain, which is the strain of
tissue that grows freely. The energy then measures the deformation relative to the grown shape, and
is multiplied by the amount of grown tissue:

    (a, b) -> (a, b) (1 + e_g)^-1,    J, J_k -> J / det(1 + e_g),    U -> det(1 + e_g) U

Out-of-plane growth multiplies the amount of tissue by one plus its strain. In plane strain, where
the slice cannot thicken, J in g is also divided by this factor. External forces are not part of the
energy of an element.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from napari_hmrf.real_arrays import FloatArray, are_equal
from napari_hmrf.solver.priors.elements import (
    ElasticMaterial,
    ElementShape,
    Float64Array,
    Lame,
    differences,
    lame_parameters,
    of_elements,
)
from napari_hmrf.solver.priors.growth import element_strains

#: Strength of the barrier, kappa, in units of mu.
BARRIER = 10.0
#: Value J_0 of the Jacobian below which the barrier acts.
BARRIER_BEGIN = 0.5
# Value of z for an element at rest.
_AT_REST = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def grown_sizes(growth: FloatArray, axes: int) -> Float64Array:
    """Return the factor by which growth changes the area or volume of free tissue at each site.

    Parameters
    ----------
    growth : ndarray
        Growth strain, as in `Loads`: a number or a tensor for each site.
    axes : int
        Number of axes of the grid, 2 or 3.

    Returns
    -------
    ndarray, shape (H, W) or (D, H, W), float64
        Factor on the area or the volume.
    """
    if growth.ndim == axes:
        return np.asarray((1.0 + growth.astype(np.float64)) ** axes)
    within = growth[..., -axes:, -axes:].astype(np.float64)
    return np.asarray(np.linalg.det(np.eye(axes) + within))


class Moduli(NamedTuple):
    """Moduli of the elements, relative to the stiffest tissue.

    Attributes
    ----------
    numbers : tuple of ndarray, shape (H - 1, W - 1), or float
        Seven numbers per element: mu, 0 in void; lambda as for a volume; mu + lambda/2, the modulus
        of volume change at rest; t, the modulus of the twist; and the components rr, rc and cc of
        the inverse growth (1 + e_g)^-1.
    bulges : bool
        True if tissue is free to become thicker, as in plane stress.
    stored : float
        Part of the energy that does not depend on the motion.
    """

    numbers: tuple[Float64Array | float, ...]
    bulges: bool
    stored: float


@dataclass(frozen=True, eq=False)
class FiniteMaterial(ElasticMaterial):
    """Tissue of a problem in large motion, as required by the kernels.

    Attributes
    ----------
    growth : ndarray or None
        Growth strain, as in `Loads`.
    """

    growth: FloatArray | None = None

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, FiniteMaterial)
            and super().__eq__(other)
            and are_equal(self.growth, other.growth)
        )

    __hash__ = None

    def is_tissue_of(self, other: FiniteMaterial) -> bool:
        """Return whether both materials are the same tissue; their growth may differ."""
        return ElasticMaterial.__eq__(self, other)

    def grown(self, part: float) -> FiniteMaterial:
        """Return the material with a fraction of its growth."""
        return self if self.growth is None else replace(self, growth=self.growth * np.float32(part))

    @property
    def most_growth(self) -> float:
        """Largest factor by which growth enlarges or reduces any free tissue."""
        if self.growth is None:
            return 1.0
        sizes = grown_sizes(self.growth, self.m.ndim)[self.m > 0]
        return float(max(sizes.max(), 1 / sizes.min()))

    def moduli(self, stand_in: float = 0.0) -> Moduli:
        """Return the moduli of the elements.

        Parameters
        ----------
        stand_in : float
            Stiffness that represents rigid tissue, relative to the stiffest non-rigid tissue; 0
            excludes rigid elements.
        """
        m = self.relative(stand_in)
        lame = lame_parameters(m, self.poisson, self.strain)
        if self.growth is None:
            return moduli_of(lame, self.shape)
        return moduli_of(lame, self.shape, *self.element_growth(lame))

    def element_growth(
        self, lame: Lame, sites: slice = slice(None)
    ) -> tuple[Float64Array, Float64Array]:
        """Return the growth strain of each element, as `element_strains`; 0 in rigid tissue.

        Parameters
        ----------
        lame : Lame
            Lame parameters of the elements.
        sites : slice
            Sites along the first axis whose elements are returned.
        """
        assert self.growth is not None
        strains, across = element_strains(self.growth[sites], self.m.ndim)
        grows = (lame.shear > 0) & np.isfinite(of_elements(self.m[sites].astype(np.float64)))
        return strains * grows, across * grows


def moduli_of(
    lame: Lame,
    shape: ElementShape,
    growth: Float64Array | None = None,
    across: Float64Array | float = 0.0,
) -> Moduli:
    """Return the moduli of elements from their in-plane Lame parameters for small motion.

    Parameters
    ----------
    lame : Lame
        Lame parameters of linear elasticity in the plane.
    shape : ElementShape
        Factors on the differences of an element.
    growth : ndarray, shape (2, 2, H - 1, W - 1), optional
        Growth strain of each element.
    across : ndarray or float
        Growth strain perpendicular to the image.
    """
    bulges = shape.twist_volume > 0
    first, shear = lame
    # The energy of a twist must not depend on the rotation of its element, so oblong pixels use the
    # mean over both directions.
    of_twist = shear + (shape.twist_volume * first + shear) / 2
    if bulges:
        stretches = shear > 0
        free = np.where(stretches, 2 * shear - first, 1.0)
        first = np.where(stretches, 2 * shear * first / free, 0.0)
    whole = shear + first / 2
    if growth is None:
        twist = (shape.twist_rows + shape.twist_cols) * of_twist
        return Moduli((shear, first, whole, twist, 1.0, 0.0, 1.0), bulges, 0.0)
    row, mixed, col = 1 + growth[0, 0], growth[0, 1], 1 + growth[1, 1]
    area = row * col - mixed**2
    row, mixed, col = col / area, -mixed / area, row / area
    sides = shape.twist_rows * (row**2 + mixed**2) + shape.twist_cols * (mixed**2 + col**2)
    amount, stored = area * (1 + across), 0.0
    if not bulges:
        # Thickness of a slice that cannot thicken, relative to its grown thickness.
        thin = 1 / (1 + across)
        at_rest = shear * (thin**2 - 1) / 2 + first * (thin**2 - 1) / 4 - whole * np.log(thin)
        stored = float((amount * at_rest).sum())
        first = first * thin**2
    moduli = amount * shear, amount * first, amount * whole, amount * sides * of_twist
    return Moduli((*moduli, row, mixed, col), bulges, stored)


class FiniteElements:
    """Energy of all elements of a grid, and its derivatives.

    Parameters
    ----------
    moduli : Moduli
        Moduli of the elements.
    shape : ElementShape
        Factors on the differences of an element.
    """

    def __init__(self, moduli: Moduli, shape: ElementShape) -> None:
        self._moduli, self._shape = moduli, shape
        self._shear, self._first, self._whole, self._twist, *growth = np.broadcast_arrays(
            *moduli.numbers
        )
        self._is_tissue = self._shear > 0
        row, mixed, col = growth
        # Factor that removes growth from a Jacobian, and matrix that removes it from sides in z.
        self._area = row * col - mixed**2
        undone = np.moveaxis(np.array([[row, mixed], [mixed, col]]), (0, 1), (-2, -1))
        self._sides = np.einsum("ijkl,pq->ijkplq", undone, np.eye(2)).reshape(*row.shape, 4, 4)

    def energy(self, d: Float64Array) -> float:
        """Return the energy of a displacement (H, W, 2) in pixels, or infinity if tissue folds."""
        z = self._deformed(d)
        mean, corners = self._jacobians(z)
        if (corners[:, self._is_tissue] <= 0).any():
            return np.inf
        mean, corners = self._area * mean, self._area * corners
        shear, first, whole = self._shear, self._first, self._whole
        sides = np.einsum("ijab,ijb->ija", self._sides, z[..., :4])
        stretch = (sides**2).sum(axis=-1) - 2
        with np.errstate(all="ignore"):  # in void
            if self._moduli.bulges:
                volume = whole * (np.log((shear + first * mean**2 / 2) / whole) / 2 - np.log(mean))
            else:
                volume = first / 4 * (mean**2 - 1) - whole * np.log(mean)
            below = np.minimum(corners, BARRIER_BEGIN)
            wall = -((below - BARRIER_BEGIN) ** 2) * np.log(below / BARRIER_BEGIN)
        each = shear / 2 * stretch + volume + self._twist / 2 * (z[..., 4:] ** 2).sum(axis=-1)
        each += shear * BARRIER / 4 * wall.sum(axis=0)
        return float(each[self._is_tissue].sum()) + self._moduli.stored

    def forces(self, d: Float64Array) -> Float64Array:
        """Return the gradient of the energy with respect to the displacement, (H, W, 2)."""
        z = self._deformed(d)
        slopes, _ = self._slopes(z)
        pull = np.einsum("ijab,ijb->ija", self._own(), z)
        pull += np.einsum("kij,kab,ijb->ija", slopes, _quadratic(self._shape), z)
        pull = np.where(self._is_tissue[..., None], pull * self._scale(), 0.0)
        total: Float64Array = np.zeros(d.shape)
        for sign_row, sign_col, sites in _CORNERS:
            signs = np.repeat([sign_row, sign_col, sign_row * sign_col], 2)
            total[sites] += (pull * signs).reshape(*pull.shape[:2], 3, 2).sum(axis=2)
        return total

    def tangents(self, d: Float64Array) -> Float64Array:
        """Return second derivatives with respect to (D_r, D_c, D_x), (H - 1, W - 1, 6, 6)."""
        z = self._deformed(d)
        slopes, bends = self._slopes(z)
        quadratic = _quadratic(self._shape)
        gradients = np.einsum("kab,ijb->kija", quadratic, z)
        tangents = np.einsum("kij,kab->ijab", slopes, quadratic)
        tangents += np.einsum("kij,kija,kijb->ijab", bends, gradients, gradients)
        tangents += self._own()
        scale = self._scale()
        tangents = tangents * scale * scale[:, None]
        return np.where(self._is_tissue[..., None, None], tangents, 0.0)

    def corner_jacobians(self, d: Float64Array) -> Float64Array:
        """Return the Jacobian at the corners of each element, (4, H - 1, W - 1); 1 in void."""
        _, corners = self._jacobians(self._deformed(d))
        return np.where(self._is_tissue, corners, 1.0)

    def _deformed(self, d: Float64Array) -> Float64Array:
        changes = np.concatenate(list(differences(d))) * self._scale()[:, None, None]
        return np.asarray(_AT_REST + np.moveaxis(changes, 0, -1))

    def _scale(self) -> Float64Array:
        """Return the factors that convert the differences of an element to z."""
        rows, cols = np.sqrt(self._shape.rows), np.sqrt(self._shape.cols)
        return np.array([rows, rows, cols, cols, 1.0, 1.0])

    def _own(self) -> Float64Array:
        """Return second derivatives of the stretch and twist energy with respect to z."""
        matrices = np.zeros((*self._shear.shape, 6, 6))
        square = np.einsum("ijab,ijbc->ijac", self._sides, self._sides)
        matrices[..., :4, :4] = self._shear[..., None, None] * square
        matrices[..., 4:, 4:] = self._twist[..., None, None] * np.eye(2)
        return matrices

    def _jacobians(self, z: Float64Array) -> tuple[Float64Array, Float64Array]:
        jacobians = np.einsum("ija,kab,ijb->kij", z, _quadratic(self._shape), z) / 2
        return jacobians[0], jacobians[1:]

    def _slopes(self, z: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return first and second derivatives with respect to the Jacobians, (5, H - 1, W - 1)."""
        mean, corners = self._jacobians(z)
        mean, corners = self._area * mean, self._area * corners
        shear, first, whole = self._shear, self._first, self._whole
        below = np.minimum(corners, BARRIER_BEGIN)
        with np.errstate(all="ignore"):  # in void
            if self._moduli.bulges:
                thick = shear + first * mean**2 / 2
                slope = -whole * shear / (mean * thick)
                bend = whole * shear * (thick + first * mean**2) / (mean * thick) ** 2
            else:
                slope = first * mean / 2 - whole / mean
                bend = first / 2 + whole / mean**2
            gap, log = below - BARRIER_BEGIN, np.log(below / BARRIER_BEGIN)
            walls = -gap * (2 * log + gap / below)
            steep = -2 * log - 4 * gap / below + (gap / below) ** 2
        weight = shear * BARRIER / 4
        slopes = self._area * np.concatenate([slope[None], weight * walls])
        bends = self._area**2 * np.concatenate([bend[None], weight * steep])
        return slopes, bends


# Signs of each corner along the row and column axes, and the sites at this corner of the elements.
_CORNERS = (
    (-1, -1, np.s_[:-1, :-1]),
    (-1, 1, np.s_[:-1, 1:]),
    (1, -1, np.s_[1:, :-1]),
    (1, 1, np.s_[1:, 1:]),
)


@lru_cache(maxsize=16)
def _quadratic(shape: ElementShape) -> Float64Array:
    """Return Q of the mean Jacobian and of the Jacobian at each corner, shape (5, 6, 6)."""
    a, b, x = slice(0, 2), slice(2, 4), slice(4, 6)
    cross = np.array([[0.0, 1.0], [-1.0, 0.0]])
    mean, down, right = np.zeros((3, 6, 6))
    mean[a, b] = cross
    down[a, x] = np.sqrt(shape.cols) * cross
    right[x, b] = np.sqrt(shape.rows) * cross
    matrices = [mean] + [mean + row * down + col * right for row, col, _ in _CORNERS]
    return np.array([matrix + matrix.T for matrix in matrices])
