"""Elements of elastic tissue and their forces, in NumPy and float64.

The displacement of an element is described by three differences per component. The kernels use the
same differences, never an assembled stencil:

    row axis       D_r = (d10 - d00) + (d11 - d01)
    column axis    D_c = (d01 - d00) + (d11 - d10)
    twist          D_x = (d11 - d01) - (d10 - d00)

D_r and D_c determine the mean strains. The energy of an element is the energy of the mean strains
plus the energy of the twist.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.neighbours import around_sites, in_elements, of_corners
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.coupling import Coupling
from napari_hmrf.solver.data_term import DataTerm, are_same

Float64Array = npt.NDArray[np.float64]

#: Stiffness that represents rigid tissue in cycles in which all rigid bodies are prescribed,
#: relative to the stiffest non-rigid tissue.
HELD_STAND_IN = 1.0
#: Same for cycles that move bodies; small enough for the coarse levels to remain accurate.
CYCLE_STAND_IN = 40.0
#: Same for factorizations.
FACTOR_STAND_IN = 1e6
#: Largest ratio of stiffnesses for which a multigrid cycle is known to reduce the error in every
#: motion.
MILD_CONTRAST = 5.0
#: Same for the ratio between the sides of a pixel.
MILD_ASPECT = 1.5
#: Same for the ratio between the sides of a voxel; error estimates in volumes have a larger margin.
MILD_VOXEL_ASPECT = 2.0
#: Same for Poisson's ratio in plane strain.
MILD_POISSON = 0.4
#: Smallest number of elements per site for which a cycle reduces the error in every motion. Thin
#: strips have fewer, and coarse levels cannot represent all their bending modes.
MILD_COMPACTNESS = 0.85
#: Ratio of stiffnesses above which cycles do not reduce the error in some motions of thin strips.
LACED_CONTRAST = 300.0


@dataclass(frozen=True, eq=False)
class ElasticMaterial:
    """Tissue of a problem, as required by the kernels.

    Attributes
    ----------
    m : ndarray, shape (H, W) or (D, H, W), float32
        Stiffness; 0 is void. Only ratios of stiffness matter.
    poisson : float or ndarray of the same shape, float32
        Poisson's ratio of all tissue, or of each site.
    strain : bool
        True for plane strain and for volumes, False for plane stress.
    shape : ElementShape or BrickShape
        Constants of an element for the size of a pixel or voxel.
    data : DataTerm, optional
        Quadratic data term, which adds to the matrix of the tissue.
    coupling : Coupling, optional
        Coupling of the fields of sliding parts, which adds to the matrix, too.
    unit : float
        Precision of 1 in the units of the model, for the coupling.
    """

    m: npt.NDArray[np.float32]
    poisson: float | npt.NDArray[np.float32]
    strain: bool
    shape: Any
    data: DataTerm | None = None
    coupling: Coupling | None = None
    unit: float = 1.0

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ElasticMaterial)
            and (self.strain, self.shape) == (other.strain, other.shape)
            and np.array_equal(self.poisson, other.poisson)
            and are_equal(self.m, other.m)
            and are_same(self.data, other.data)
            and self.coupling == other.coupling
        )

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def rigid(self) -> bool:
        """True if there is rigid tissue."""
        return math.isinf(float(self.m.max()))

    def relative(self, stand_in: float, sites: Any = ...) -> Float64Array:
        """Return the stiffness relative to the stiffest non-rigid tissue; `stand_in` if rigid."""
        m = self.m[sites].astype(np.float64) / stiffest(self.m)
        return np.where(np.isinf(m), stand_in, m)

    @cached_property
    def mild(self) -> bool:
        """True if a cycle is known to reduce the error in every motion of this tissue."""
        aspect = MILD_ASPECT if self.m.ndim == 2 else MILD_VOXEL_ASPECT
        return (
            contrast(self.m) <= MILD_CONTRAST
            and self._compactness >= MILD_COMPACTNESS
            and self.shape.aspect <= aspect
        )

    @property
    def compressible(self) -> bool:
        """True if cycles reduce errors in volume as well as in other motions."""
        return not (self.strain and self.largest_poisson > MILD_POISSON)

    @cached_property
    def is_gapped(self) -> bool:
        """True if some void lies between two sites of tissue in a row along an axis.

        Coarse levels bridge a gap that is narrower than their elements. Parts on its two sides,
        such as a flap on a neck, then move against each other much more easily than cycles assume.
        """
        tissue = self.m > 0
        if tissue.all():
            return False
        for axis in range(tissue.ndim):
            along = np.moveaxis(tissue, axis, 0)
            starts = np.count_nonzero(along[1:] > along[:-1], axis=0)
            if (starts + along[0] > 1).any():
                return True
        return False

    @cached_property
    def laced(self) -> bool:
        """True if thin strips have too high a contrast for a trial run of the cycles to succeed."""
        return self._compactness < MILD_COMPACTNESS and contrast(self.m) >= LACED_CONTRAST

    @cached_property
    def _compactness(self) -> float:
        """Number of elements per site of tissue: 1/2 in strips two sites wide, at most 1."""
        # Borders reduce the number by the same factor for each axis. The exponent makes volumes
        # comparable with images.
        share = np.count_nonzero(in_elements(self.m)) / np.count_nonzero(self.m > 0)
        return float(share ** (2 / self.m.ndim))

    #: Number of sites along a side of an element.
    patch = 2
    #: Number of sites by which elements extend beyond the image.
    margin = 0
    symmetric = True

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """All components together, with the function that returns the element matrices.

        The matrices have shape (h, w, 8, 8), or (d, h, w, 24, 24) in a volume.
        """
        return ((tuple(range(self.m.ndim)), self._matrices),)

    def _matrices(self, *elements: slice) -> Float64Array:
        """Return the matrices of the elements in the given ranges along the axes."""
        first, shear = element_stiffness(self.shape)
        sites = tuple(slice(each.start, each.stop + 1) for each in elements)
        nu = self.poisson if isinstance(self.poisson, float) else self.poisson[sites]
        lame = lame_parameters(self.relative(FACTOR_STAND_IN, sites), nu, self.strain)
        of_first, of_shear = (each[..., None, None] for each in lame)
        matrices = np.asarray(of_first * first + of_shear * shear)
        self.add_data(matrices, elements)
        return matrices

    def add_data(self, matrices: Float64Array, elements: tuple[slice, ...]) -> None:
        """Add any data term to the matrices of elements in the given ranges, in place."""
        if self.data is not None:
            self.data.add_to_elements(matrices, elements, self._elements_around)

    @cached_property
    def _elements_around(self) -> npt.NDArray[np.intp]:
        """Number of tissue elements of which each site is a corner."""
        return around_sites(in_elements(self.m).astype(np.intp), np.add)

    @property
    def largest_poisson(self) -> float:
        """Largest Poisson's ratio of any tissue."""
        if isinstance(self.poisson, float):
            return self.poisson
        return float(self.poisson.max(where=self.m > 0, initial=0.0))


class Lame(NamedTuple):
    """Lame parameters of the elements, relative to the stiffest tissue; 0 in void.

    Along each axis, the arrays are one element shorter than the arrays of the sites.
    """

    first: Float64Array
    shear: Float64Array


class ElementShape(NamedTuple):
    """Factors on an element's differences, derived from the size of a pixel.

    Attributes
    ----------
    rows, cols : float
        Factors on the squares of D_r and D_c.
    mixed : float
        Factor on the products of D_r and D_c.
    twist_rows, twist_cols : float
        Factors on the square of D_x, for its strain along the row axis and the column axis.
    twist_volume : float
        1 if the twist counts as a change in volume, otherwise 0.
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
        """Ratio of a pixel's longer side to its shorter side."""
        return max(self.rows, self.cols) / self.mixed

    @property
    def sides(self) -> tuple[float, ...]:
        """Lengths of a pixel's sides, scaled to a product of 1."""
        row = (self.cols / self.rows) ** 0.25
        return row, 1 / row

    def forces(self, lame: Lame, d: Float64Array) -> Float64Array:
        """Return the total force of the elements on each site: the stiffness matrix times d."""
        return element_forces(lame, self, d)


class Differences(NamedTuple):
    """D_r, D_c and D_x of every element, each with shape (2, H - 1, W - 1), component first."""

    rows: Float64Array
    cols: Float64Array
    twist: Float64Array


def of_elements(values: Float64Array) -> Float64Array:
    """Return the mean over the sites of each element: four sites, or eight in a volume."""
    mean: Float64Array = of_corners(values, np.add) / 2**values.ndim
    return mean


def lame_ratio(poisson: float, strain: bool) -> float:
    """Return lambda / mu, the ratio of Lame parameters."""
    return 2 * poisson / (1 - (2 * poisson if strain else poisson))


def contrast(m: npt.NDArray[np.float32]) -> float:
    """Return the ratio of the largest to the smallest stiffness of non-rigid tissue."""
    return stiffest(m) / min(float(m.min(where=m > 0, initial=np.inf)), stiffest(m))


def stiffest(m: npt.NDArray[np.float32]) -> float:
    """Return the largest stiffness of non-rigid tissue, or 1 if all tissue is rigid."""
    most = float(m.max())
    if math.isinf(most):
        most = float(m.max(where=np.isfinite(m), initial=0.0)) or 1.0
    return most


def lame_parameters(m: Float64Array, poisson: Any, strain: bool) -> Lame:
    """Return Lame parameters of each element from the means of its sites; 0 if a site is void.

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
    """Return the differences of every element for a displacement (H, W, 2)."""
    d = np.moveaxis(d, -1, 0)
    d00, d01, d10, d11 = d[:, :-1, :-1], d[:, :-1, 1:], d[:, 1:, :-1], d[:, 1:, 1:]
    left, right = d10 - d00, d11 - d01
    return Differences(left + right, (d01 - d00) + (d11 - d10), right - left)


@lru_cache(maxsize=16)
def element_stiffness(shape: Any) -> tuple[Float64Array, Float64Array]:
    """Return the stiffness matrices of one element for (lambda, mu) = (1, 0) and (0, 1).

    The matrices have shape (8, 8), or (24, 24) in a volume.
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
    """Return the total force of the elements on each site, (H, W, 2): stiffness matrix times d."""
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
