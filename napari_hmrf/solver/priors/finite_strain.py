"""Elements of tissue that may stretch and turn as far as it likes, in NumPy and float64.

What an element's two sides and its twist have become, per side of a pixel, are six numbers

    z = (a, b, x):  a = e_r + D_r / 2 h_r,  b = e_c + D_c / 2 h_c,  x = D_x

of which a and b are the columns of the mean deformation gradient F. As an element is bilinear, its
Jacobian is linear within it: four positive corners prove that a pixel is nowhere folded. The mean
and each corner's are quadratic in z,

    J = z . Q z / 2.

The energy of an element is that of a neo-Hookean solid, with what resists its twist, and with a
barrier that stands before a corner that is about to fold:

    U = mu/2 (|F|^2 - 2) + g(J) + t/2 |x|^2 + mu kappa/4 sum over corners of b(J_k)
    plane strain:  g = lambda/4 (J^2 - 1) - (mu + lambda/2) ln J
    plane stress:  g = (mu + lambda/2) (ln((mu + lambda J^2/2) / (mu + lambda/2)) / 2 - ln J)
    below J_0:     b = -(J - J_0)^2 ln(J / J_0)

For small motion this is linear elasticity. Where growth comes in, it divides z, and multiplies U by
its area; forces from outside are no business of an element's.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from napari_hmrf.solver.priors.elements import (
    ElementShape,
    Float64Array,
    Lame,
    differences,
)

#: How strong the barrier is, in units of mu, and below which Jacobian it stands.
BARRIER, BARRIER_BEGIN = 10.0, 0.5
_AT_REST = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])


class Moduli(NamedTuple):
    """What the elements resist with, relative to the stiffest; 0 in void.

    Attributes
    ----------
    shear, first : ndarray
        Lame's parameters mu and lambda, the latter as of a volume.
    twist : ndarray
        Against the square of the twist.
    bulges : bool
        Whether tissue is free to become thicker: plane stress.
    """

    shear: Float64Array
    first: Float64Array
    twist: Float64Array
    bulges: bool


def moduli_of(lame: Lame, shape: ElementShape) -> Moduli:
    """The moduli of elements that resist small motion as Lame's parameters in the plane say."""
    bulges = shape.twist_volume > 0
    first, shear = lame
    # What a twist costs must not depend on how far its element has turned: of oblong pixels the
    # mean of both directions counts.
    twist = (shape.twist_rows + shape.twist_cols) * (
        shear + (shape.twist_volume * first + shear) / 2
    )
    if bulges:
        stretches = shear > 0
        free = np.where(stretches, 2 * shear - first, 1.0)
        first = np.where(stretches, 2 * shear * first / free, 0.0)
    return Moduli(shear, first, twist, bulges)


class FiniteElements:
    """All elements of a grid.

    Parameters
    ----------
    moduli : Moduli
    shape : ElementShape
    """

    def __init__(self, moduli: Moduli, shape: ElementShape) -> None:
        self._moduli, self._shape = moduli, shape
        self._there = moduli.shear > 0

    def energy(self, d: Float64Array) -> float:
        """The energy of a displacement (H, W, 2) in pixels; infinite if anything is folded."""
        z = self._deformed(d)
        mean, corners = self._jacobians(z)
        if (corners[:, self._there] <= 0).any():
            return np.inf
        shear, first, twist, bulges = self._moduli
        stretch = (z[..., :4] ** 2).sum(axis=-1) - 2
        whole = shear + first / 2
        with np.errstate(all="ignore"):  # in void
            if bulges:
                volume = whole * (np.log((shear + first * mean**2 / 2) / whole) / 2 - np.log(mean))
            else:
                volume = first / 4 * (mean**2 - 1) - whole * np.log(mean)
            below = np.minimum(corners, BARRIER_BEGIN)
            wall = -((below - BARRIER_BEGIN) ** 2) * np.log(below / BARRIER_BEGIN)
        each = shear / 2 * stretch + volume + twist / 2 * (z[..., 4:] ** 2).sum(axis=-1)
        each += shear * BARRIER / 4 * wall.sum(axis=0)
        return float(each[self._there].sum())

    def forces(self, d: Float64Array) -> Float64Array:
        """The derivative of the energy by each site's displacement, (H, W, 2)."""
        z = self._deformed(d)
        _, slopes, _ = self._slopes(z)
        pull = self._own() * z + np.einsum("kij,kab,ijb->ija", slopes, _quadratic(self._shape), z)
        pull = np.where(self._there[..., None], pull * self._scale(), 0.0)
        total: Float64Array = np.zeros(d.shape)
        for sign_row, sign_col, sites in _CORNERS:
            signs = np.repeat([sign_row, sign_col, sign_row * sign_col], 2)
            total[sites] += (pull * signs).reshape(*pull.shape[:2], 3, 2).sum(axis=2)
        return total

    def tangents(self, d: Float64Array) -> Float64Array:
        """The second derivatives by (D_r, D_c, D_x) of each element, (H - 1, W - 1, 6, 6)."""
        z = self._deformed(d)
        _, slopes, bends = self._slopes(z)
        quadratic = _quadratic(self._shape)
        way = np.einsum("kab,ijb->kija", quadratic, z)
        made = np.einsum("kij,kab->ijab", slopes, quadratic)
        made += np.einsum("kij,kija,kijb->ijab", bends, way, way)
        made += self._own()[..., None] * np.eye(6)
        scale = self._scale()
        made = made * scale * scale[:, None]
        return np.where(self._there[..., None, None], made, 0.0)

    def corner_jacobians(self, d: Float64Array) -> Float64Array:
        """The Jacobian at the corners of each element, (4, H - 1, W - 1); 1 where there is none."""
        _, corners = self._jacobians(self._deformed(d))
        return np.where(self._there, corners, 1.0)

    def _deformed(self, d: Float64Array) -> Float64Array:
        changes = np.concatenate(list(differences(d))) * self._scale()[:, None, None]
        return np.asarray(_AT_REST + np.moveaxis(changes, 0, -1))

    def _scale(self) -> Float64Array:
        """What the differences are in z."""
        rows, cols = np.sqrt(self._shape.rows), np.sqrt(self._shape.cols)
        return np.array([rows, rows, cols, cols, 1.0, 1.0])

    def _own(self) -> Float64Array:
        """What resists stretch and twist."""
        shear, twist = self._moduli.shear, self._moduli.twist
        return np.stack([*[shear] * 4, *[twist] * 2], axis=-1)

    def _jacobians(self, z: Float64Array) -> tuple[Float64Array, Float64Array]:
        all_of_them = np.einsum("ija,kab,ijb->kij", z, _quadratic(self._shape), z) / 2
        return all_of_them[0], all_of_them[1:]

    def _slopes(self, z: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """The Jacobians (5, H - 1, W - 1), and the energy's derivatives by them."""
        mean, corners = self._jacobians(z)
        shear, first, _, bulges = self._moduli
        whole = shear + first / 2
        below = np.minimum(corners, BARRIER_BEGIN)
        with np.errstate(all="ignore"):  # in void
            if bulges:
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
        slopes = np.concatenate([slope[None], weight * walls])
        bends = np.concatenate([bend[None], weight * steep])
        return np.concatenate([mean[None], corners]), slopes, bends


# The sign of a corner along rows and columns, and the sites that are such corners of elements.
_CORNERS = (
    (-1, -1, np.s_[:-1, :-1]),
    (-1, 1, np.s_[:-1, 1:]),
    (1, -1, np.s_[1:, :-1]),
    (1, 1, np.s_[1:, 1:]),
)


@lru_cache(maxsize=16)
def _quadratic(shape: ElementShape) -> Float64Array:
    """Q of the mean Jacobian and of each corner's, (5, 6, 6)."""
    a, b, x = slice(0, 2), slice(2, 4), slice(4, 6)
    cross = np.array([[0.0, 1.0], [-1.0, 0.0]])
    mean, down, right = np.zeros((3, 6, 6))
    mean[a, b] = cross
    down[a, x] = np.sqrt(shape.cols) * cross
    right[x, b] = np.sqrt(shape.rows) * cross
    made = [mean] + [mean + row * down + col * right for row, col, _ in _CORNERS]
    return np.array([each + each.T for each in made])
