"""Cliques of the paper's prior (eqs. 9-11), and the material of its linear models."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.priors.elements import MILD_CONTRAST, contrast

Float64Array = npt.NDArray[np.float64]
Slices = tuple[slice, ...]


@cache
def line_steps(axes: int) -> tuple[tuple[int, ...], ...]:
    """Return the directions of the lines: along the axes, face diagonals, then space diagonals.

    Parameters
    ----------
    axes : int
        Number of axes: 2 for images, which have four directions (figure 2), or 3 for volumes, which
        have thirteen.

    Returns
    -------
    tuple of tuple of int
        Step from the middle site t of a clique to its end u; its end s is on the opposite side.
    """
    steps = [step for step in product((1, 0, -1), repeat=axes) if 1 in step]
    upwards = [step for step in steps if -1 not in step[: step.index(1)]]
    return tuple(sorted(upwards, key=np.count_nonzero))


def line_weights(spacing: tuple[float, ...]) -> Float64Array:
    """Return the weight of each line of cliques for each component of the displacement.

    In the paper, pixels are square: the vertical line contributes to the row component, the
    horizontal line to the column component, and the diagonals to both components, all with weight
    1. The same holds for cubic voxels, where a diagonal contributes to the components of its
    direction. For other pixels and voxels, the weights are nonnegative and preserve the continuum
    limit: in uniform tissue, component i satisfies ``3 d_ii + 2 d_jj (+ 2 d_kk) = 0`` in physical
    lengths, for any spacing. With these weights, a volume of identical slices has the same solution
    as the image of a single slice.

    Parameters
    ----------
    spacing : tuple of float
        Size of a pixel along (row, column), or of a voxel along (plane, row, column).

    Returns
    -------
    ndarray, shape (4, 2) or (13, 3)
        Weight of each line in `line_steps` for each component.
    """
    axes = len(spacing)
    sizes = np.array(spacing) / spacing[0]
    along = sizes**2 / np.prod(sizes**2) ** (1 / axes)  # squared sides; their product is 1
    # Each line within a slice of a volume is also the projection of two lines to the neighbouring
    # slices, so the total weight is three times that of an image.
    total = 3.0 ** (axes - 2)
    longer = np.maximum.outer(along, along)
    of_space, of_faces = 1 / along.max(), total / longer - (total - 1) / along.max()
    weights = np.zeros((len(line_steps(axes)), axes))
    for line, step in enumerate(line_steps(axes)):
        at = np.flatnonzero(step)
        if len(at) > 1:
            weights[line, at] = of_space if len(at) == axes else of_faces[at[0], at[1]]
    own = 3 * total / along - weights.sum(axis=0)
    weights[:axes] = 2 * total / along[:, None] - 2 * total / longer
    np.fill_diagonal(weights[:axes], own)
    return weights


@dataclass(frozen=True, eq=False)
class SeilerMaterial:
    """Tissue of a problem in the paper's model, as required by the multigrid kernels.

    Attributes
    ----------
    m : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness; 0 is void. Only ratios of stiffness matter.
    lines : ndarray, shape (4, 2) or (13, 3)
        Weight of each line of cliques for each component; see `line_weights`.
    square : bool
        True if the pixels are squares or the voxels are cubes.
    blanket : bool
        True for the blanket reading, in which all cliques that contain a site act on it. False for
        the centred reading, in which only the cliques centred at a site act on it.
    """

    m: npt.NDArray[np.float32]
    lines: Float64Array
    square: bool
    blanket: bool

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, SeilerMaterial)
            and (self.square, self.blanket) == (other.square, other.blanket)
            and np.array_equal(self.lines, other.lines)
            and are_equal(self.m, other.m)
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds of the spectrum of D^-1 A, for typical materials and for all materials.

        In the centred reading, a row of D^-1 A is 1 minus a weighted mean. In the blanket reading,
        each term of the energy is the square of a sum of three numbers, which is at most three
        times the sum of their squares.
        """
        most = 3.0 if self.blanket else 2.0
        return most, most

    @cached_property
    def mild(self) -> bool:
        """True if a cycle is known to reduce the error in every motion of this tissue."""
        # In the blanket reading, cycles do not reduce the bending of parts three sites wide.
        return contrast(self.m) <= MILD_CONTRAST and self.square and not self.blanket

    #: False because a trial run of the cycles can succeed for any tissue.
    laced = False
    #: True because the model does not resist changes in volume.
    compressible = True
    #: Number of sites along a side of an element, which consists of the cliques centred at a site.
    patch = 3
    #: Number of sites by which elements extend beyond the image.
    margin = 1

    @property
    def symmetric(self) -> bool:
        """True if the matrix of the model is symmetric, so that an energy exists."""
        return self.blanket

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """Components of an image, each with the function that returns its matrices.

        The matrices of the cliques centred at the sites have shape (h, w, 9, 9).
        """
        padded = np.pad(self.m, 1)
        return tuple(((k,), partial(self._matrices, k, padded)) for k in range(2))

    def _matrices(
        self, component: int, padded: npt.NDArray[np.float32], rows: slice, cols: slice
    ) -> Float64Array:
        """Return the matrices of the cliques centred at the sites in the given rows and columns."""
        # Blanket: second derivatives of the energy. Centred: d - q(d) of the middle site.
        sites = padded[rows.start : rows.stop + 2, cols.start : cols.stop + 2]
        shape = sites.shape[0] - 2, sites.shape[1] - 2
        total, curvature = np.zeros((*shape, 9, 9)), np.zeros((*shape, 1))
        for (i, j), weight in zip(line_steps(2), self.lines[:, component], strict=True):
            s, t, u = (
                (slice(1 + k * i, 1 + k * i + shape[0]), slice(1 + k * j, 1 + k * j + shape[1]))
                for k in (-1, 0, 1)
            )
            at = np.array([3 * (1 + k * i) + 1 + k * j for k in (-1, 0, 1)])
            r_s, r_u, exists = ratios(sites, s, t, u)
            one = np.ones_like(r_s)
            # Coefficients of d_s, d_t and d_u in the two terms of V.
            for ratio, term in (
                (r_u, np.concatenate([-r_u, 1 + r_u, -one], axis=-1)),
                (r_s, np.concatenate([-one, 1 + r_s, -r_s], axis=-1)),
            ):
                if self.blanket:
                    square = term[..., :, None] * term[..., None, :]
                    total[..., at[:, None], at] += 2 * weight * exists[..., None] * square
                else:
                    total[..., 4, at] += weight * exists * (1 + ratio) * term
                    curvature += weight * exists * (1 + ratio) ** 2
        if not self.blanket:
            steep = np.where(curvature > 0, curvature, 1.0)[..., None]
            total = np.divide(total, steep)
        return total

    def pull(self, d: Float64Array, low: Float64Array) -> Float64Array:
        """Return -A (d + low) in the blanket reading, where d + low is the displacement.

        The forces of the softest tissue are tiny, and stiff tissue amplifies rounding errors in the
        differences between neighbours, so these differences use double-double arithmetic.
        """
        m = np.pad(self.m, 2)
        total = np.zeros(d.shape)
        for weights, (s, t, u) in _lines(2 * self.lines, m):
            r_s, r_u, exists = ratios(m, s, t, u)
            r_s, r_u, exists = r_s[..., 0], r_u[..., 0], exists[..., 0]
            from_s, to_u = _difference(d, low, t, s), _difference(d, low, u, t)
            first = exists * weights * _scaled_difference(r_u, from_s, to_u)
            second = exists * weights * _scaled_difference(-r_s, to_u, _negative(from_s))
            for site, force in (
                (s, r_u * first + second),
                (t, -((1 + r_u) * first + (1 + r_s) * second)),
                (u, first + r_s * second),
            ):
                total[:, *site] += force
        return total


class Cliques(NamedTuple):
    """Energy of the cliques at each site as a function of the site's displacement, as planes.

    Attributes
    ----------
    curvature : ndarray, shape (2, H + 4, W + 4) or (3, D + 4, H + 4, W + 4)
        Half the second derivative of the energy with respect to the site's displacement.
    slope : ndarray, of the same shape
        -1/2 times the first derivative.
    energy : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
        Energy of the cliques centred at the site.
    """

    curvature: Float64Array
    slope: Float64Array
    energy: Float64Array


def cliques(
    d: npt.NDArray[np.floating], m: npt.NDArray[np.floating], lines: Float64Array, blanket: bool
) -> Cliques:
    """Evaluate the cliques that act on each site (eqs. 9-11).

    Parameters
    ----------
    d : ndarray, shape (2, H + 4, W + 4) or (3, D + 4, H + 4, W + 4)
        Displacement in pixels, with a border of zeros two sites wide.
    m : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
        Stiffness with the same border; 0 is void.
    lines : ndarray, shape (4, 2) or (13, 3)
        Weight of each line of cliques for each component; see `line_weights`.
    blanket : bool
        True if all cliques that contain a site act on it; False if only the cliques centred at the
        site act on it.
    """
    curvature, slope = np.zeros((2, *d.shape))
    energy = np.zeros(m.shape)
    for weights, (s, t, u) in _lines(lines, m):
        r_s, r_u, exists = (each[..., 0] for each in ratios(m, s, t, u))
        factors = exists * weights
        to_s, to_u = d[:, *s] - d[:, *t], d[:, *u] - d[:, *t]
        first, second = r_u * to_s + to_u, r_s * to_u + to_s
        curvature[:, *t] += factors * ((1 + r_u) ** 2 + (1 + r_s) ** 2)
        slope[:, *t] += factors * ((1 + r_u) * first + (1 + r_s) * second)
        energy[t] += (factors * (first**2 + second**2)).sum(axis=0)
        if blanket:
            curvature[:, *s] += factors * (r_u**2 + 1)
            curvature[:, *u] += factors * (1 + r_s**2)
            slope[:, *s] -= factors * (r_u * first + second)
            slope[:, *u] -= factors * (first + r_s * second)
    return Cliques(curvature, slope, energy)


def _lines(
    lines: Float64Array, m: npt.NDArray[np.floating]
) -> Iterator[tuple[Float64Array, tuple[Slices, Slices, Slices]]]:
    """Yield the weights, (2, 1, 1), and the slices of sites s, t and u for each line of cliques."""
    for step, weights in zip(line_steps(m.ndim), lines, strict=True):
        s, t, u = (
            tuple(slice(2 + k * a, size - 2 + k * a) for a, size in zip(step, m.shape, strict=True))
            for k in (-1, 0, 1)
        )
        yield weights.reshape(-1, *(1,) * m.ndim), (s, t, u)


_Pair = tuple[Float64Array, Float64Array]


def _difference(d: Float64Array, low: Float64Array, one: Slices, other: Slices) -> _Pair:
    """Return the difference of displacements, d[one] - d[other], as an unevaluated sum."""
    high, rest = _sum(d[:, *one], -d[:, *other])
    return high, rest + (low[:, *one] - low[:, *other])


def _negative(pair: _Pair) -> _Pair:
    return -pair[0], -pair[1]


def _scaled_difference(ratio: Float64Array, one: _Pair, other: _Pair) -> Float64Array:
    """Return ratio * one - other with a single rounding error."""
    product, rest = _product(ratio, one[0])
    high, lost = _sum(product, -other[0])
    return high + (lost + rest + ratio * one[1] - other[1])


def _sum(a: Float64Array, b: Float64Array) -> _Pair:
    """Return a sum and its rounding error (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _product(a: Float64Array, b: Float64Array) -> _Pair:
    """Return a product and its rounding error (Dekker)."""
    product = a * b
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    rest = (a_high * b_high - product) + a_high * b_low + a_low * b_high + a_low * b_low
    return product, rest


def _halves(a: Float64Array) -> _Pair:
    """Split numbers into a leading and a trailing part of 26 bits each (Veltkamp)."""
    wide = 134217729.0 * a  # 2^27 + 1
    high = wide - (wide - a)
    return high, a - high


def ratios(
    m: npt.NDArray[np.floating], s: Slices, t: Slices, u: Slices
) -> tuple[Float64Array, Float64Array, npt.NDArray[np.bool_]]:
    """Return m_t/m_s, m_t/m_u (1 if undefined) and a mask of existing cliques, all (..., 1)."""
    ms, mt, mu = (m[at].astype(np.float64)[..., None] for at in (s, t, u))
    exists = (ms > 0) & (mt > 0) & (mu > 0)
    one = np.ones_like(mt)
    return (
        np.divide(mt, ms, out=one.copy(), where=exists),
        np.divide(mt, mu, out=one.copy(), where=exists),
        exists,
    )
