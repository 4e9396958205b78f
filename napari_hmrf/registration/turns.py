"""Search of rigid maps over all turns and shifts, on images with large pixels.

Two images are compared by the directions of their edges, not by their brightness: an edge counts
the same from dark to bright and from bright to dark, so that inverted contrast, gamma and bias do
not matter (normalized gradient fields, Haber and Modersitzki 2006). For each turn, a Fourier
transform compares all shifts at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

FloatArray = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

#: Width of the derivatives, in pixels.
_WIDTH = 1.0
#: Gradient of an edge that counts half, relative to the root mean square of the gradient.
_WEAK = 0.5
#: Smallest overlap, relative to the smaller image.
_LEAST_OVERLAP = 0.25
#: Number of turns of a picture.
_TURNS = 72
#: Number of best turns of a volume around which others are compared, and their distance in degrees;
#: the 60 turns before these are about 40 degrees apart.
_RINGS = ((8, 20.0), (6, 10.0), (4, 5.0))


class Counted(NamedTuple):
    """Image with square pixels, and weights from 0 to 1 of its pixels.

    Attributes
    ----------
    pixels, weights : ndarray, shape (H, W) or (D, H, W), float32
    """

    pixels: FloatArray
    weights: FloatArray


class Start(NamedTuple):
    """Rigid map from pixels of the fixed image to pixels of the moving image, with its score."""

    score: float
    matrix: Float64Array


class Starts(NamedTuple):
    """Best map without a turn, and the best maps with any turn, from the highest score on."""

    straight: Start
    turned: list[Start]


def best_turns(fixed: Counted, moving: Counted, count: int, apart: float) -> Starts:
    """Return the rigid maps with the highest scores, with the best shift of each turn.

    Parameters
    ----------
    fixed, moving : Counted
        Images with pixels of the same size.
    count : int
        Largest number of maps with any turn.
    apart : float
        Smallest angle between the turns of two maps, in degrees.

    Returns
    -------
    Starts
    """
    search = _Search(fixed, moving)
    if fixed.pixels.ndim == 2:
        found = [search.best_shift(_turn(angle)) for angle in 360 / _TURNS * np.arange(_TURNS)]
        return Starts(found[0], _distinct(found, count, apart))
    from scipy.spatial.transform import Rotation  # heavy: scipy

    straight = search.best_shift(np.eye(3))
    found = [search.best_shift(turn) for turn in Rotation.create_group("I").as_matrix()]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    for number, angle in _RINGS:
        around = Rotation.from_rotvec(math.radians(angle) * axes).as_matrix()
        found += [
            search.best_shift(turn @ best.matrix[:3, :3])
            for best in _distinct(found, number, angle)
            for turn in around
        ]
    return Starts(straight, _distinct(found, count, apart))


def angle_between(first: Float64Array, second: Float64Array) -> float:
    """Return the angle in degrees between two turns.

    Parameters
    ----------
    first, second : ndarray, shape (n, n)
        Rotation matrices.
    """
    n = len(first)
    trace = float((first * second).sum())
    return math.degrees(math.acos(np.clip((trace - (n - 2)) / 2, -1.0, 1.0)))


def _turn(angle: float) -> Float64Array:
    cosine, sine = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return np.array([[cosine, -sine], [sine, cosine]])


def _distinct(found: list[Start], count: int, apart: float) -> list[Start]:
    """Return the best maps whose turns differ by more than an angle in degrees."""
    chosen: list[Start] = []
    for each in sorted(found, key=lambda start: -start.score):
        n = len(each.matrix) - 1
        if len(chosen) < count and all(
            angle_between(each.matrix[:n, :n], other.matrix[:n, :n]) > apart for other in chosen
        ):
            chosen.append(each)
    return chosen


class _Search:
    """Comparison of a fixed image with a moving image that is turned.

    Parameters
    ----------
    fixed, moving : Counted
    """

    def __init__(self, fixed: Counted, moving: Counted) -> None:
        axes, shape = fixed.pixels.ndim, fixed.pixels.shape
        self._axes, self._shape, self._moving = axes, shape, moving
        self._weights = (moving.weights > 0.5).astype(np.float32)
        weights = (fixed.weights > 0.5).astype(np.float32)
        # The turned image fits into a cube. A shift by which the fixed image leaves this cube by
        # more than half of its size has little overlap, so that it may wrap around.
        self._side = math.ceil(np.linalg.norm(np.array(moving.pixels.shape) - 1)) + 1
        self._size = [scipy.fft.next_fast_len(n // 2 + self._side, real=True) for n in shape]
        edges = _edges(fixed.pixels) * weights
        self._edges = np.conj(self._transform(edges))
        self._energy = np.conj(self._transform((edges**2).sum(axis=0)))
        self._mask = np.conj(self._transform(weights))
        self._whole = float(weights.sum())
        self._least = max(1.0, _LEAST_OVERLAP * min(self._whole, float(self._weights.sum())))

    def best_shift(self, turn: Float64Array) -> Start:
        """Return the best map with a turn.

        The score is the correlation of the edges of both images, times the root of the overlap:
        the correlation of a small overlap is often high by chance.

        Parameters
        ----------
        turn : ndarray, shape (n, n)
            Rotation matrix from the fixed to the moving image.
        """
        centre = (np.array(self._moving.pixels.shape) - 1) / 2
        middle = np.full(self._axes, (self._side - 1) / 2)
        shape = (self._side,) * self._axes
        pixels, weights = (
            scipy.ndimage.affine_transform(
                image, turn, centre - turn @ middle, output_shape=shape, order=1, mode=mode
            )
            for image, mode in ((self._moving.pixels, "nearest"), (self._weights, "constant"))
        )
        weights = (weights > 0.99).astype(np.float32)
        edges = _edges(pixels) * weights
        mask = self._transform(weights)
        common = self._back((self._edges * self._transform(edges)).sum(axis=0))
        energies = (
            self._back(self._energy * mask),
            self._back(self._mask * self._transform((edges**2).sum(axis=0))),
        )
        overlap = self._back(self._mask * mask)
        product = np.maximum(energies[0], 0) * np.maximum(energies[1], 0)
        counts = (overlap > self._least) & (product > 1e-6 * product.max(initial=0))
        score = np.full(overlap.shape, -1.0, np.float32)
        np.divide(common, np.sqrt(product), out=score, where=counts)
        score[counts] *= np.sqrt(overlap[counts] / self._whole)
        place = np.unravel_index(np.argmax(score), score.shape)
        shift = [
            at - size if at >= size - n // 2 else at
            for at, size, n in zip(place, self._size, self._shape, strict=True)
        ]
        matrix = np.eye(self._axes + 1)
        matrix[:-1, :-1] = turn
        matrix[:-1, -1] = turn @ (np.array(shift) - middle) + centre
        return Start(float(score[place]), matrix)

    def _transform(self, image: FloatArray) -> npt.NDArray[np.complex64]:
        axes = tuple(range(-self._axes, 0))
        return np.asarray(scipy.fft.rfftn(image, self._size, axes=axes))

    def _back(self, product: npt.NDArray[np.complex64]) -> FloatArray:
        return np.asarray(scipy.fft.irfftn(product, self._size))


def _edges(image: FloatArray) -> FloatArray:
    """Return the directions of edges, as the components of a symmetric matrix without a trace.

    The scalar product of two such matrices is high for parallel edges and negative for edges at
    right angles, whatever the signs of the gradients.

    Parameters
    ----------
    image : ndarray, shape (H, W) or (D, H, W)

    Returns
    -------
    ndarray, shape (2, H, W) or (5, D, H, W), float32
    """
    axes = image.ndim
    g = np.stack(
        [
            scipy.ndimage.gaussian_filter(image, _WIDTH, order=order, mode="nearest")
            for order in np.eye(axes, dtype=int)
        ]
    )
    square = (g**2).sum(axis=0)
    g /= np.sqrt(square + _WEAK**2 * square.mean() + np.finfo(np.float32).tiny)
    if axes == 2:
        return np.stack([g[0] ** 2 - g[1] ** 2, 2 * g[0] * g[1]])
    off = [math.sqrt(2) * g[a] * g[b] for a, b in ((0, 1), (0, 2), (1, 2))]
    first = (g[0] ** 2 - g[1] ** 2) / math.sqrt(2)
    last = (2 * g[2] ** 2 - g[0] ** 2 - g[1] ** 2) / math.sqrt(6)
    return np.stack([first, last, *off])
