"""Tissue that is hard on a solver: stiff parts of many shapes and sizes, at any contrast."""

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
#: How far the last row is pushed, in pixels: 4, towards the first and to the right.
PUSH = (-3.2, 2.4)
#: The contrast of both phantoms as they are.
PHANTOM_CONTRAST = 4.0


@dataclass(frozen=True, eq=False)
class Images:
    """What a `Problem` has, unchecked: also of tissue that a `Problem` refuses.

    Attributes
    ----------
    observed, confidence : ndarray, shape (H, W, 2), float32
    stiffness : ndarray, shape (H, W), float32
    """

    observed: Array
    confidence: Array
    stiffness: Array
    spacing: tuple[float, ...] = (1.0, 1.0)
    unit: float = 1.0
    loads: None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid: (H, W)."""
        return self.stiffness.shape

    @cached_property
    def rigid(self) -> Array:
        """Where stiffness is infinite."""
        return np.isinf(self.stiffness)

    @cached_property
    def tissue(self) -> Array:
        """Where stiffness is above 0."""
        return self.stiffness > 0

    @property
    def known(self) -> Array:
        """Which components are held, (H, W, 2)."""
        return (self.confidence > 0) & self.tissue[..., None]


class Layout(NamedTuple):
    """A case at one size, of any contrast.

    Attributes
    ----------
    pattern : ndarray, shape (H, W)
        0 where tissue is soft, 1 where it is stiff: the logarithm of its stiffness to the base of
        the contrast.
    void : ndarray of bool, shape (H, W)
    observed, confidence : ndarray, shape (H, W, 2)
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
    """First and last row are held, the last is pushed."""
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
    """Two phases of equal volume, by a threshold of smoothed noise."""
    return _pushed(_noise(n, sigma, seed))


def ribs(n: int) -> Layout:
    """Vertebrae with soft discs, slanted ribs on both sides, and void gaps between those."""
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
    """Fields of 5 x 5 sites; stiff ones hang together at their corners."""
    row, col = np.indices((n, n)) // 5
    return _pushed((row + col) % 2 == 0)


def fibres(n: int) -> Layout:
    """Slanted fibres one pixel wide, in pieces of 23 rows with 4 between them."""
    row, col = np.indices((n, n))
    number, place = np.divmod(col - np.rint(0.35 * row).astype(int), 7)
    return _pushed((place == 0) & ((row + 11 * number) % 27 >= 4))


def holes(n: int, seed: int = 2008) -> Layout:
    """A grid of round holes, nine pixels wide with four between them, in two phases."""
    row, col = np.indices((n, n)) - (n % 13) // 2
    void = (row % 13 - 6) ** 2 + (col % 13 - 6) ** 2 <= 20
    void[:2] = void[-2:] = False
    return _pushed(_noise(n, 5.0, seed), void)


def inclusion(n: int) -> Layout:
    """A stiff disc, a little off the middle."""
    row, col = np.indices((n, n)) / (n - 1)
    return _pushed((row - 0.55) ** 2 + (col - 0.42) ** 2 < 0.2**2)


def brain(n: int, name: str) -> Layout:
    """A phantom, the logarithms of its stiffnesses stretched to the contrast."""
    problem = phantom(name, n).problem
    void = ~problem.tissue
    m = np.where(
        void, 1, problem.stiffness.astype(np.float64) / problem.stiffness[problem.tissue].min()
    )
    return Layout(
        np.log(m) / math.log(PHANTOM_CONTRAST), void, problem.observed, problem.confidence
    )


#: The cases, by name: from a size to a layout. With the seeds of the smoothest noise an iteration
#: that estimates its error by what it has seen misses how a stiff part moves (n = 97, 257).
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
#: Those that take a seed.
SEEDED = ("noise-2", "noise-5", "noise-10", "noise-20", "holes")


def disc(n: int) -> Array:
    """A round bone, (n, n) of bool."""
    row, col = np.indices((n, n)) / (n - 1)
    return (row - 0.55) ** 2 + (col - 0.42) ** 2 < 0.15**2


def bar(n: int) -> Array:
    """A thin slanted bone, (n, n) of bool."""
    row, col = np.indices((n, n)) / (n - 1) - 0.5
    along, across = 0.8 * row + 0.6 * col, 0.8 * col - 0.6 * row
    return (np.abs(along) < 0.35) & (np.abs(across) < max(0.008, 1.5 / n))


def bones(n: int) -> Array:
    """Both, side by side."""
    return np.roll(disc(n), n // 5, axis=1) | np.roll(bar(n), -n // 5, axis=1)


#: Bones that are rigid, by name.
BONES: dict[str, Callable[[int], Array]] = {"disc": disc, "bar": bar, "disc and bar": bones}


def bone_images(bone: Array) -> Images:
    """Soft tissue around a bone that has no end of stiffness; the last row is pushed."""
    soft = _pushed(bone).images(1.0)
    return Images(
        soft.observed, soft.confidence, np.where(bone, np.inf, soft.stiffness).astype(np.float32)
    )
