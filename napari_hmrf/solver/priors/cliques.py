"""The cliques of the paper's prior (eqs. 9-11), and what its linear models know of tissue."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors.elements import MILD_CONTRAST, contrast

Float64Array = npt.NDArray[np.float64]
Slices = tuple[slice, ...]


@cache
def line_steps(axes: int) -> tuple[tuple[int, ...], ...]:
    """The directions of the lines: first the axes, then the diagonals of faces, then of space.

    Parameters
    ----------
    axes : int
        2 for images, which have four (figure 2), or 3 for volumes, which have thirteen.

    Returns
    -------
    tuple of tuple of int
        The step from the middle of a clique to its end u; its end s lies on the other side.
    """
    steps = [step for step in product((1, 0, -1), repeat=axes) if 1 in step]
    upwards = [step for step in steps if -1 not in step[: step.index(1)]]
    return tuple(sorted(upwards, key=np.count_nonzero))


def line_weights(spacing: tuple[float, ...]) -> Float64Array:
    """How much each line of cliques counts for each component of displacement.

    The paper's pixels are square: there the vertical line carries the row component, the horizontal
    line the col component, and the diagonals both, all with weight 1. So it is with cubes: a
    diagonal carries the components along which it leads. For other pixels and voxels the weights
    are those, none negative, that keep the continuum the lines stand for: in uniform tissue
    component i obeys ``3 d_ii + 2 d_jj (+ 2 d_kk) = 0`` in physical lengths, for any spacing. In a
    volume they are also those that make of slices which are all alike the images that they are.

    Parameters
    ----------
    spacing : tuple of float
        Size of a pixel in (row, col) direction, or of a voxel in (plane, row, col) direction.

    Returns
    -------
    ndarray, shape (4, 2) or (13, 3)
        Weight of each of `line_steps` for each component.
    """
    axes = len(spacing)
    sizes = np.array(spacing) / spacing[0]
    along = sizes**2 / np.prod(sizes**2) ** (1 / axes)  # in units of one pixel
    # Each pair of slices is joined by two diagonals of faces for one within them, and so by three
    # times as much in all.
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
    """What the kernels of multigrid need to know of a problem's tissue.

    Attributes
    ----------
    m : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness; 0 is void. Only its ratios matter.
    lines : ndarray, shape (4, 2) or (13, 3)
        What each line of cliques counts for each component: `line_weights`.
    square : bool
        Whether the pixels are, or the voxels cubes.
    blanket : bool
        Whether every clique that contains a site pulls at it, or those whose middle it is.
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
            and np.array_equal(self.m, other.m)
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds of the spectrum of D^-1 A, for usual and for any materials.

        Centred, a row is 1 less a weighted mean; blanket, each term of the energy is the square
        of a sum of three, which is at most three times the sum of their squares.
        """
        most = 3.0 if self.blanket else 2.0
        return most, most

    @cached_property
    def mild(self) -> bool:
        """Whether a cycle sees every motion of it: not blanket, where parts three wide can bend."""
        return contrast(self.m) <= MILD_CONTRAST and self.square and not self.blanket

    #: A rehearsal may always show that cycles see every motion.
    laced = False
    #: No volume is kept.
    compressible = True
    #: Sites along a side of an element (the cliques around a site), and how far it reaches beyond.
    patch, margin = 3, 1

    @property
    def symmetric(self) -> bool:
        """Whether the model is: it has an energy."""
        return self.blanket

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """Of an image each component apart, and what gives the matrices around sites, 9 x 9."""
        padded = np.pad(self.m, 1)
        return tuple(((k,), partial(self._matrices, k, padded)) for k in range(2))

    def _matrices(
        self, component: int, padded: npt.NDArray[np.float32], rows: slice, cols: slice
    ) -> Float64Array:
        """The matrices of the cliques whose middles lie between these rows and columns."""
        # Blanket, the second derivatives of their energies; centred, the middle's d - q(d).
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
            # How the two terms of V depend on d_s, d_t and d_u.
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
        """- A d of the blanket reading, for a displacement in two parts: planes.

        Next to nothing moves the softest tissue, and stiff tissue multiplies what differences
        between neighbours are rounded by; so those are found with twice the digits.
        """
        m = np.pad(self.m, 2)
        made = np.zeros(d.shape)
        for weights, (s, t, u) in _lines(2 * self.lines, m):
            r_s, r_u, there = ratios(m, s, t, u)
            r_s, r_u, exists = r_s[..., 0], r_u[..., 0], there[..., 0]
            from_s, to_u = _apart(d, low, t, s), _apart(d, low, u, t)
            first = exists * weights * _stretched(r_u, from_s, to_u)
            second = exists * weights * _stretched(-r_s, to_u, _turned(from_s))
            for site, force in (
                (s, r_u * first + second),
                (t, -((1 + r_u) * first + (1 + r_s) * second)),
                (u, first + r_s * second),
            ):
                made[:, *site] += force
        return made


class Cliques(NamedTuple):
    """What the cliques around sites ask for, planes, and what those in whose middle they are cost.

    Attributes
    ----------
    curvature : ndarray, shape (2, H + 4, W + 4) or (3, D + 4, H + 4, W + 4)
    slope : ndarray
        -1/2 of the derivative of the energy by the site's displacement.
    energy : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
    """

    curvature: Float64Array
    slope: Float64Array
    energy: Float64Array


def cliques(
    d: npt.NDArray[np.floating], m: npt.NDArray[np.floating], lines: Float64Array, blanket: bool
) -> Cliques:
    """Look at the cliques that pull at each site: as its middle or, blanket, all (eqs. 9-11).

    Parameters
    ----------
    d : ndarray, shape (2, H + 4, W + 4) or (3, D + 4, H + 4, W + 4)
        Displacement in pixels, in a ring of zeros two sites wide.
    m : ndarray, shape (H + 4, W + 4) or (D + 4, H + 4, W + 4)
        Stiffness in the same ring; 0 is void.
    lines : ndarray, shape (4, 2) or (13, 3)
        What each line of cliques counts for each component.
    blanket : bool
    """
    curvature, slope = np.zeros((2, *d.shape))
    energy = np.zeros(m.shape)
    for weights, (s, t, u) in _lines(lines, m):
        r_s, r_u, there = (each[..., 0] for each in ratios(m, s, t, u))
        counts = there * weights
        to_s, to_u = d[:, *s] - d[:, *t], d[:, *u] - d[:, *t]
        first, second = r_u * to_s + to_u, r_s * to_u + to_s
        curvature[:, *t] += counts * ((1 + r_u) ** 2 + (1 + r_s) ** 2)
        slope[:, *t] += counts * ((1 + r_u) * first + (1 + r_s) * second)
        energy[t] += (counts * (first**2 + second**2)).sum(axis=0)
        if blanket:
            curvature[:, *s] += counts * (r_u**2 + 1)
            curvature[:, *u] += counts * (1 + r_s**2)
            slope[:, *s] -= counts * (r_u * first + second)
            slope[:, *u] -= counts * (first + r_s * second)
    return Cliques(curvature, slope, energy)


def _lines(
    lines: Float64Array, m: npt.NDArray[np.floating]
) -> Iterator[tuple[Float64Array, tuple[Slices, Slices, Slices]]]:
    """Each line of cliques in planes: what it counts, (2, 1, 1), and its sites s, t and u."""
    for step, weights in zip(line_steps(m.ndim), lines, strict=True):
        s, t, u = (
            tuple(slice(2 + k * a, size - 2 + k * a) for a, size in zip(step, m.shape, strict=True))
            for k in (-1, 0, 1)
        )
        yield weights.reshape(-1, *(1,) * m.ndim), (s, t, u)


_Pair = tuple[Float64Array, Float64Array]


def _apart(d: Float64Array, low: Float64Array, here: Slices, there: Slices) -> _Pair:
    """How far displacements differ, d[here] - d[there], in two parts."""
    a, b = d[:, *here], d[:, *there]
    high, rest = _sum(a, -b)
    return high, rest + (low[:, *here] - low[:, *there])


def _turned(pair: _Pair) -> _Pair:
    return -pair[0], -pair[1]


def _stretched(ratio: Float64Array, one: _Pair, other: _Pair) -> Float64Array:
    """Ratio * one - other, rounded at the end."""
    product, rest = _product(ratio, one[0])
    high, lost = _sum(product, -other[0])
    return high + (lost + rest + ratio * one[1] - other[1])


def _sum(a: Float64Array, b: Float64Array) -> _Pair:
    """A sum, and what it is rounded by (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def _product(a: Float64Array, b: Float64Array) -> _Pair:
    """A product, and what it is rounded by (Dekker)."""
    product = a * b
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    rest = (a_high * b_high - product) + a_high * b_low + a_low * b_high + a_low * b_low
    return product, rest


def _halves(a: Float64Array) -> _Pair:
    """The first and the last 26 digits of numbers."""
    wide = 134217729.0 * a  # 2^27 + 1
    high = wide - (wide - a)
    return high, a - high


def ratios(
    m: npt.NDArray[np.floating], s: Slices, t: Slices, u: Slices
) -> tuple[Float64Array, Float64Array, npt.NDArray[np.bool_]]:
    """Return m_t/m_s, m_t/m_u (1 where undefined) and whether the clique exists, each (..., 1)."""
    ms, mt, mu = (m[at].astype(np.float64)[..., None] for at in (s, t, u))
    exists = (ms > 0) & (mt > 0) & (mu > 0)
    one = np.ones_like(mt)
    return (
        np.divide(mt, ms, out=one.copy(), where=exists),
        np.divide(mt, mu, out=one.copy(), where=exists),
        exists,
    )
