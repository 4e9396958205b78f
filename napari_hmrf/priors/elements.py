"""The elements of elastic tissue, and what they pull with, in NumPy and float64.

An element's displacement is described by three differences per component, which is also how the
kernels see it (from differences of displacement, never from an assembled stencil):

    along rows     D_r = (d10 - d00) + (d11 - d01)
    along columns  D_c = (d01 - d00) + (d11 - d10)
    the twist      D_x = (d11 - d01) - (d10 - d00)

The mean strains follow from D_r and D_c; the integral of what the twist adds separates from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ElasticMaterial:
    """What the kernels need to know of a problem's tissue.

    Attributes
    ----------
    m : ndarray, shape (H, W), float32
        Stiffness; 0 is void. Only its ratios matter.
    poisson : float or ndarray, shape (H, W), float32
    strain : bool
        Plane strain instead of plane stress.
    shape : ElementShape
    """

    m: npt.NDArray[np.float32]
    poisson: float | npt.NDArray[np.float32]
    strain: bool
    shape: ElementShape

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ElasticMaterial)
            and (self.strain, self.shape) == (other.strain, other.shape)
            and np.array_equal(self.poisson, other.poisson)
            and np.array_equal(self.m, other.m)
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def largest_poisson(self) -> float:
        """The largest Poisson's ratio of any tissue."""
        if isinstance(self.poisson, float):
            return self.poisson
        return float(self.poisson.max(where=self.m > 0, initial=0.0))


class Lame(NamedTuple):
    """Lame's parameters of the elements, (H - 1, W - 1), relative to the stiffest; 0 in void."""

    first: Float64Array
    shear: Float64Array


class ElementShape(NamedTuple):
    """What the size of a pixel makes of an element's differences (area times squared lengths).

    Attributes
    ----------
    rows, cols : float
        Of the squares of D_r and D_c.
    mixed : float
        Of their products.
    twist_rows, twist_cols : float
        Of the square of D_x, by its strain along rows and along columns.
    twist_volume : float
        1 where the twist counts as a change of volume, 0 where it does not.
    """

    rows: float
    cols: float
    mixed: float
    twist_rows: float
    twist_cols: float
    twist_volume: float


class Differences(NamedTuple):
    """D_r, D_c and D_x of every element, each (2, H - 1, W - 1) with the component first."""

    rows: Float64Array
    cols: Float64Array
    twist: Float64Array


def of_elements(values: Float64Array) -> Float64Array:
    """The mean of each element's four sites."""
    along = values[:-1] + values[1:]
    mean: Float64Array = (along[:, :-1] + along[:, 1:]) / 4
    return mean


def differences(d: Float64Array) -> Differences:
    """The differences of every element of a displacement (H, W, 2)."""
    d = np.moveaxis(d, -1, 0)
    d00, d01, d10, d11 = d[:, :-1, :-1], d[:, :-1, 1:], d[:, 1:, :-1], d[:, 1:, 1:]
    left, right = d10 - d00, d11 - d01
    return Differences(left + right, (d01 - d00) + (d11 - d10), right - left)


def element_forces(lame: Lame, k: ElementShape, d: Float64Array) -> Float64Array:
    """What all elements together pull at each site: the stiffness matrix times d, (H, W, 2)."""
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
