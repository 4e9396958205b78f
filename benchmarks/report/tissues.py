"""Tissue that is difficult for solvers: stiff parts of many shapes and sizes, at any contrast."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf.data import phantom

Array = npt.NDArray[Any]
#: Displacement of the last row, in pixels: 4 px, towards the first row and to the right.
PUSH = (-3.2, 2.4)
#: Contrast of the unchanged phantoms.
PHANTOM_CONTRAST = 4.0


@dataclass(frozen=True, eq=False)
class Images:
    """Data of a `Problem` without validation, also for tissue that a `Problem` refuses.

    Attributes
    ----------
    observed, confidence : ndarray, shape (H, W, 2), float32
        Observed displacement, and its confidence.
    stiffness : ndarray, shape (H, W), float32
        Stiffness; 0 is void.
    """

    observed: Array
    confidence: Array
    stiffness: Array
    spacing: tuple[float, ...] = (1.0, 1.0)
    unit: float = 1.0
    loads: None = None
    sliding: None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid, (H, W)."""
        return self.stiffness.shape

    @cached_property
    def rigid(self) -> Array:
        """Mask of sites with infinite stiffness."""
        return np.isinf(self.stiffness)

    @cached_property
    def tissue(self) -> Array:
        """Mask of sites with positive stiffness."""
        return self.stiffness > 0

    @property
    def known(self) -> Array:
        """Mask of the prescribed components, (H, W, 2)."""
        return (self.confidence > 0) & self.tissue[..., None]


class Layout(NamedTuple):
    """Case at one size, for any contrast.

    Attributes
    ----------
    pattern : ndarray, shape (H, W)
        Logarithm of the stiffness to the base of the contrast: 0 in soft tissue, 1 in stiff tissue.
    void : ndarray of bool, shape (H, W)
        Mask of void.
    observed, confidence : ndarray, shape (H, W, 2)
        Observed displacement, and its confidence.
    """

    pattern: Array
    void: Array
    observed: Array
    confidence: Array

    def images(self, contrast: float, unit: float = 1.0) -> Images:
        """Return the images with stiffness from `unit` to `contrast * unit`."""
        m = np.where(self.void, 0, unit * contrast**self.pattern).astype(np.float32)
        return Images(self.observed.astype(np.float32), self.confidence.astype(np.float32), m)


def _pushed(stiff: Array, void: Array | None = None) -> Layout:
    """Return a layout with first and last row prescribed, and the last row pushed."""
    y, c = np.zeros((*stiff.shape, 2)), np.zeros((*stiff.shape, 2))
    c[0] = c[-1] = 1
    y[-1] = PUSH
    return Layout(
        stiff.astype(np.float64), np.zeros(stiff.shape, bool) if void is None else void, y, c
    )


def _noise(n: int, sigma: float, seed: int) -> Array:
    smooth = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(n, n)), sigma)
    return smooth > np.median(smooth)


def noise(n: int, sigma: float, seed: int = 2008) -> Layout:
    """Return two phases of equal volume, by a threshold on smoothed noise."""
    return _pushed(_noise(n, sigma, seed))


def ribs(n: int) -> Layout:
    """Return vertebrae with soft discs, and slanted ribs on both sides with void gaps."""
    row, col = np.indices((n, n)) / (n - 1)
    side = np.abs(col - 0.5)
    count = min(12, max(2, n // 12))
    turn = (count * (row - 0.3 * side)) % 1
    within = (row > 0.06) & (row < 0.94)
    rib = (np.abs(turn - 0.5) < 0.12) & (side > 0.08) & (side < 0.42)
    vertebra = (side < 0.06) & ((count * row) % 1 > 0.25)
    gap = (np.abs(turn - 0.5) > 0.36) & (side > 0.14) & (side < 0.36)
    return _pushed((rib | vertebra) & within, gap & within)


def checkerboard(n: int) -> Layout:
    """Return squares of 5 x 5 sites; stiff squares are connected at their corners."""
    row, col = np.indices((n, n)) // 5
    return _pushed((row + col) % 2 == 0)


def fibres(n: int) -> Layout:
    """Return slanted fibres one pixel wide, in pieces of 23 rows with gaps of 4 rows."""
    row, col = np.indices((n, n))
    number, place = np.divmod(col - np.rint(0.35 * row).astype(int), 7)
    return _pushed((place == 0) & ((row + 11 * number) % 27 >= 4))


def holes(n: int, seed: int = 2008) -> Layout:
    """Return a grid of round holes, nine pixels wide and four apart, in two phases."""
    row, col = np.indices((n, n)) - (n % 13) // 2
    void = (row % 13 - 6) ** 2 + (col % 13 - 6) ** 2 <= 20
    void[:2] = void[-2:] = False
    return _pushed(_noise(n, 5.0, seed), void)


def inclusion(n: int) -> Layout:
    """Return a stiff disc, slightly off the middle."""
    row, col = np.indices((n, n)) / (n - 1)
    return _pushed((row - 0.55) ** 2 + (col - 0.42) ** 2 < 0.2**2)


def brain(n: int, name: str) -> Layout:
    """Return a phantom with the logarithms of its stiffnesses scaled to the contrast."""
    problem = phantom(name, n).problem
    void = ~problem.tissue
    m = np.where(
        void, 1, problem.stiffness.astype(np.float64) / problem.stiffness[problem.tissue].min()
    )
    return Layout(
        np.log(m) / math.log(PHANTOM_CONTRAST), void, problem.observed, problem.confidence
    )


#: Functions from a size to a layout, by name. For the seeds of the smoothest noise, an iteration
#: that estimates its error from previous iterates misses the motion of a stiff part (n = 97, 257).
TISSUES: dict[str, Callable[..., Layout]] = {
    "noise-2": partial(noise, sigma=2),
    "noise-5": partial(noise, sigma=5),
    "noise-10": partial(noise, sigma=10, seed=1),
    "noise-20": partial(noise, sigma=20, seed=7),
    "ribs": ribs,
    "checkerboard": checkerboard,
    "fibres": fibres,
    "holes": holes,
    "inclusion": inclusion,
    "expansion": partial(brain, name="expansion"),
    "mass-effect": partial(brain, name="mass-effect"),
}
#: Names of the cases with a seed.
SEEDED = ("noise-2", "noise-5", "noise-10", "noise-20", "holes")


def disc(n: int) -> Array:
    """Return a round bone, (n, n) of bool."""
    row, col = np.indices((n, n)) / (n - 1)
    return (row - 0.55) ** 2 + (col - 0.42) ** 2 < 0.15**2


def bar(n: int) -> Array:
    """Return a thin slanted bone, (n, n) of bool."""
    row, col = np.indices((n, n)) / (n - 1) - 0.5
    along, across = 0.8 * row + 0.6 * col, 0.8 * col - 0.6 * row
    return (np.abs(along) < 0.35) & (np.abs(across) < max(0.008, 1.5 / n))


def bones(n: int) -> Array:
    """Return the two bones side by side."""
    return np.roll(disc(n), n // 5, axis=1) | np.roll(bar(n), -n // 5, axis=1)


#: Rigid bones, by name.
BONES: dict[str, Callable[[int], Array]] = {"disc": disc, "bar": bar, "disc and bar": bones}


def bone_images(bone: Array) -> Images:
    """Return soft tissue around a rigid bone, with the last row pushed."""
    soft = _pushed(bone).images(1.0)
    return Images(
        soft.observed, soft.confidence, np.where(bone, np.inf, soft.stiffness).astype(np.float32)
    )
