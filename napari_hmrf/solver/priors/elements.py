"""Elements of elastic tissue and their forces, in NumPy and float64.

An element's displacement is described by three differences per component, as in the kernels (which
compute forces from differences of displacement, never from an assembled stencil):

    along rows     D_r = (d10 - d00) + (d11 - d01)
    along columns  D_c = (d01 - d00) + (d11 - d10)
    the twist      D_x = (d11 - d01) - (d10 - d00)

The mean strains follow from D_r and D_c. Their energy and that of the twist add up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.neighbours import in_elements, of_corners

Float64Array = npt.NDArray[np.float64]

#: Stiffness used for rigid tissue in cycles that hold all bodies, in units of the stiffest other
#: tissue.
HELD_STAND_IN = 1.0
#: The same in cycles that move bodies, whose coarse levels must stay accurate.
CYCLE_STAND_IN = 40.0
#: The same in factors.
FACTOR_STAND_IN = 1e6
#: Largest ratio of stiffnesses for which a cycle of multigrid is known to reduce every motion.
MILD_CONTRAST = 5.0
#: The same for the ratio of the sides of a pixel.
MILD_ASPECT = 1.5
#: The same for the ratio of the sides of a voxel; estimates for volumes have a larger margin.
MILD_VOXEL_ASPECT = 2.0
#: The same for Poisson's ratio in plane strain.
MILD_POISSON = 0.4
#: Least number of elements per site for which a cycle reduces every motion: thin strips bend in
#: ways that coarse levels cannot represent.
MILD_COMPACTNESS = 0.85
#: Ratio of stiffnesses from which cycles miss some motions of thin strips.
LACED_CONTRAST = 300.0


@dataclass(frozen=True, eq=False)
class ElasticMaterial:
    """Material of a problem's tissue, as the kernels use it.

    Attributes
    ----------
    m : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness; 0 is void. Only its ratios matter.
    poisson : float or ndarray of the same shape, float32
        Poisson's ratio of all tissue, or of each site.
    strain : bool
        True for plane strain and for volumes, False for plane stress.
    shape : ElementShape or BrickShape
    """

    m: npt.NDArray[np.float32]
    poisson: float | npt.NDArray[np.float32]
    strain: bool
    shape: Any

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ElasticMaterial)
            and (self.strain, self.shape) == (other.strain, other.shape)
            and np.array_equal(self.poisson, other.poisson)
            and np.array_equal(self.m, other.m)
        )

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def rigid(self) -> bool:
        """True if there is rigid tissue."""
        return math.isinf(float(self.m.max()))

    def relative(self, stand_in: float, sites: Any = ...) -> Float64Array:
        """Return the stiffness of some sites in units of the stiffest tissue that is not rigid."""
        m = self.m[sites].astype(np.float64) / stiffest(self.m)
        return np.where(np.isinf(m), stand_in, m)

    @cached_property
    def mild(self) -> bool:
        """True if a cycle is known to reduce every motion of such tissue."""
        aspect = MILD_ASPECT if self.m.ndim == 2 else MILD_VOXEL_ASPECT
        return (
            contrast(self.m) <= MILD_CONTRAST
            and self._compactness >= MILD_COMPACTNESS
            and self.shape.aspect <= aspect
        )

    @property
    def compressible(self) -> bool:
        """True if cycles reduce changes of volume as well as other motions."""
        return not (self.strain and self.largest_poisson > MILD_POISSON)

    @cached_property
    def laced(self) -> bool:
        """True if the contrast of thin strips is too high for a rehearsal to succeed."""
        return self._compactness < MILD_COMPACTNESS and contrast(self.m) >= LACED_CONTRAST

    @cached_property
    def _compactness(self) -> float:
        """Number of elements per site of tissue: 1/2 for strips of two sites, near 1 if wide."""
        # Borders take up the same part of each axis; the power makes volumes comparable to images.
        share = np.count_nonzero(in_elements(self.m)) / np.count_nonzero(self.m > 0)
        return float(share ** (2 / self.m.ndim))

    #: Number of sites along a side of an element.
    patch = 2
    #: Number of sites by which elements extend beyond the image.
    margin = 0
    symmetric = True

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """All components together, with the function that returns the matrices.

        The matrices of elements have shape (h, w, 8, 8), or (d, h, w, 24, 24).
        """
        return ((tuple(range(self.m.ndim)), self._matrices),)

    def _matrices(self, *elements: slice) -> Float64Array:
        """Return the matrices of the elements in these ranges along the axes."""
        first, shear = element_stiffness(self.shape)
        sites = tuple(slice(each.start, each.stop + 1) for each in elements)
        nu = self.poisson if isinstance(self.poisson, float) else self.poisson[sites]
        lame = lame_parameters(self.relative(FACTOR_STAND_IN, sites), nu, self.strain)
        of_first, of_shear = (each[..., None, None] for each in lame)
        return np.asarray(of_first * first + of_shear * shear)

    @property
    def largest_poisson(self) -> float:
        """Largest Poisson's ratio of any tissue."""
        if isinstance(self.poisson, float):
            return self.poisson
        return float(self.poisson.max(where=self.m > 0, initial=0.0))


class Lame(NamedTuple):
    """Lame's parameters of the elements, relative to the stiffest; 0 in void.

    The arrays are one shorter along each axis than those of the sites.
    """

    first: Float64Array
    shear: Float64Array


class ElementShape(NamedTuple):
    """Factors of an element's differences, from the size of a pixel (area times squared lengths).

    Attributes
    ----------
    rows, cols : float
        Factors of the squares of D_r and D_c.
    mixed : float
        Factor of their products.
    twist_rows, twist_cols : float
        Factors of the square of D_x, from its strain along rows and along columns.
    twist_volume : float
        1 if the twist counts as a change of volume, else 0.
    """

    rows: float
    cols: float
    mixed: float
    twist_rows: float
    twist_cols: float
    twist_volume: float

    @property
    def axes(self) -> int:
        """Number of axes of the grid."""
        return 2

    @property
    def aspect(self) -> float:
        """Ratio of a pixel's longer side to the shorter."""
        return max(self.rows, self.cols) / self.mixed

    @property
    def sides(self) -> tuple[float, ...]:
        """Lengths of a pixel's sides, scaled to a product of 1."""
        row = (self.cols / self.rows) ** 0.25
        return row, 1 / row

    def forces(self, lame: Lame, d: Float64Array) -> Float64Array:
        """Return the force of all elements on each site: the stiffness matrix times d."""
        return element_forces(lame, self, d)


class Differences(NamedTuple):
    """D_r, D_c and D_x of every element, each (2, H - 1, W - 1) with the component first."""

    rows: Float64Array
    cols: Float64Array
    twist: Float64Array


def of_elements(values: Float64Array) -> Float64Array:
    """Return the mean over each element's sites: four, or eight in a volume."""
    mean: Float64Array = of_corners(values, np.add) / 2**values.ndim
    return mean


def lame_ratio(poisson: float, strain: bool) -> float:
    """Return lambda / mu, the ratio of Lame's parameters."""
    return 2 * poisson / (1 - (2 * poisson if strain else poisson))


def contrast(m: npt.NDArray[np.float32]) -> float:
    """Return the ratio of the largest stiffness to the least, of tissue that is not rigid."""
    return stiffest(m) / min(float(m.min(where=m > 0, initial=np.inf)), stiffest(m))


def stiffest(m: npt.NDArray[np.float32]) -> float:
    """Return the largest stiffness of tissue that is not rigid; 1 if all tissue is."""
    most = float(m.max())
    if math.isinf(most):
        most = float(m.max(where=np.isfinite(m), initial=0.0)) or 1.0
    return most


def lame_parameters(m: Float64Array, poisson: Any, strain: bool) -> Lame:
    """Return Lame's parameters of each element, from the means of its sites; 0 if one is void.

    Parameters
    ----------
    m : ndarray, shape (H, W) or (D, H, W)
        Stiffness.
    poisson : float or ndarray of the same shape
        Poisson's ratio of all tissue, or of each site.
    strain : bool
        True for plane strain and for volumes, False for plane stress.
    """
    whole = in_elements(m)
    young = np.where(whole, of_elements(m), 0.0)
    nu = poisson
    if isinstance(nu, np.ndarray):
        nu = np.where(whole, of_elements(nu.astype(np.float64)), 0.0)
    shear = young / (2 * (1 + nu))
    return Lame(2 * shear * nu / (1 - (2 * nu if strain else nu)), shear)


def differences(d: Float64Array) -> Differences:
    """Return the differences of every element of a displacement (H, W, 2)."""
    d = np.moveaxis(d, -1, 0)
    d00, d01, d10, d11 = d[:, :-1, :-1], d[:, :-1, 1:], d[:, 1:, :-1], d[:, 1:, 1:]
    left, right = d10 - d00, d11 - d01
    return Differences(left + right, (d01 - d00) + (d11 - d10), right - left)


@lru_cache(maxsize=16)
def element_stiffness(shape: Any) -> tuple[Float64Array, Float64Array]:
    """Return the stiffness matrices of one element for lambda = 1, mu = 0 and the reverse.

    They have shape (8, 8), or (24, 24) in a volume.
    """
    corners = (2,) * shape.axes
    size = shape.axes * 2**shape.axes
    impulses = np.eye(size).reshape(size, *corners, shape.axes)
    one, none = np.ones((1,) * shape.axes), np.zeros((1,) * shape.axes)
    both = []
    for lame in (Lame(one, none), Lame(none, one)):
        both.append(np.array([shape.forces(lame, d).ravel() for d in impulses]))
    return both[0], both[1]


def element_forces(lame: Lame, k: ElementShape, d: Float64Array) -> Float64Array:
    """Return the force of all elements on each site, (H, W, 2): the stiffness matrix times d."""
    first, shear = lame
    (rr, rc), (cr, cc), (xr, xc) = differences(d)
    own = k.twist_volume * first + 2 * shear
    pulls = np.array(
        [
            [
                k.rows * (first + 2 * shear) * rr + k.mixed * first * cc,
                shear * (k.cols * cr + k.mixed * rc),
                (k.twist_rows * own + k.twist_cols * shear) * xr,
            ],
            [
                shear * (k.rows * rc + k.mixed * cr),
                k.cols * (first + 2 * shear) * cc + k.mixed * first * rr,
                (k.twist_cols * own + k.twist_rows * shear) * xc,
            ],
        ]
    )
    total = np.zeros((2, *d.shape[:2]))
    along_rows, along_cols, twist = pulls.swapaxes(0, 1)
    total[:, :-1, :-1] += -along_rows - along_cols + twist
    total[:, :-1, 1:] += -along_rows + along_cols - twist
    total[:, 1:, :-1] += along_rows - along_cols - twist
    total[:, 1:, 1:] += along_rows + along_cols + twist
    return np.moveaxis(total, 0, -1)
