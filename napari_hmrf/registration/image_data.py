"""Two images as observations of the displacement.

Where two images show the same tissue, their brightness differs by

    r(X) = F(X) - M(X + d(X)),

where F and M are the images after a local normalization. To first order in a change of the
displacement, r decreases by ``g . change``, where g is the gradient of the image. The energy

    1/2 sum over sites of  w (r - g . change)^2

is therefore quadratic in the displacement, and a data term of a `Problem` with the precision
``W = w g g^T``. A single pixel observes the displacement along its gradient only. A window around
each site collects the observations of its neighbours, as in the method of Lucas and Kanade (1981).

The images of a pair need not have the same contrast. F may be the negative of the fixed image, or
the brightness of the moving image that is expected from that of the fixed image, as in the
correlation ratio of Roche, Malandain, Pennec and Ayache (1998).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]
Checkpoint = Callable[[], None]

#: Relation of the brightness of two images: the same order, the reverse order, or the brightness of
#: the moving image depends on that of the fixed image in another way, or the reverse.
Relation = Literal["same", "inverse", "from fixed", "from moving"]

# The settings were chosen on two random deformations of a brain and then fixed; the errors of other
# deformations are in docs/validation/registration.md. Lengths are in pixels of the level.

#: Standard deviation of the window of the local normalization.
_NORMALIZATION = 1.7
#: Contrast added to the local contrast, as a fraction of the brightness range of the image. Weaker
#: structures count as noise.
_LEAST_CONTRAST = 0.05
#: Standard deviation of the window that collects observations.
_WINDOW = 2.5
#: Difference of normalized brightness at which the weight of a pixel is halved (Cauchy weights), so
#: that structures without counterpart have little effect.
_OUTLIER = 1.0
#: Smallest residual that counts as noise of the images, and residual above which differences are
#: not noise, but other tissue.
_LEAST_RESIDUAL, _OTHER_TISSUE = 0.05, 0.145
#: Precision along directions in which the images show nothing, relative to the mean precision. It
#: limits the step of an iteration there (Levenberg and Marquardt).
_DAMPING = 1e-3
#: Longest step of a site, as a fraction of the longest side of the image. A nearly singular
#: precision next to pixels that do not count would otherwise lead to larger ones.
_LONGEST_STEP = 0.25
#: Sums below are nothing: single precision keeps no digits of products of windows' tails, so that
#: the tensors of a black background would not be semidefinite.
_NOTHING = 1e-35
#: Largest number of classes of brightness in which the expected brightness is computed, power of
#: the number of pixels that limits it, and standard deviation of a window over classes.
_MOST_CLASSES, _CLASS_POWER, _CLASS_WINDOW = 64, 0.4, 0.7
#: Difference of correlations from which images do not have the same contrast. On few pixels, the
#: difference must be larger, by this number of standard deviations of a correlation. A function of
#: brightness always correlates a little more, because it is fitted.
_RELATED, _BY_CHANCE = 0.15, 2.0
# Fraction of pixels whose brightness is outside of the range of an image.
_BEYOND_RANGE = 0.01
_TINY = 1e-12
# Number of pixels whose equations are solved at once, to limit the use of memory.
_BLOCK_SIZE = 1 << 16


class Images(NamedTuple):
    """Two images on the grid of a problem, with masks of the pixels that count."""

    fixed: FloatArray
    moving: FloatArray
    counted: tuple[BoolArray, BoolArray]


class Reduced(NamedTuple):
    """Image with larger pixels, in units of its brightness range.

    Attributes
    ----------
    sums : ndarray, float32
        Mean brightness of the pixels that count in each larger pixel, times their share of it.
    share : ndarray, float32
        Share of the pixels that count.
    """

    sums: FloatArray
    share: FloatArray

    @property
    def brightness(self) -> FloatArray:
        """Mean brightness of the pixels that count; 0 where none counts."""
        return np.asarray(self.sums / np.maximum(self.share, _TINY), np.float32)


class LinearImages(NamedTuple):
    """Images as a data term, linear around a displacement.

    Attributes
    ----------
    precision : ndarray, shape (H, W, 2, 2) or (D, H, W, 3, 3), float32
        W, relative to the typical stiffness of the tissue.
    observed : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement at the minimum of the data term at each site, in the unit of the spacing.
    residual : float
        Root mean square of the difference of normalized brightness.
    similarity : float
        Correlation of the normalized images, at most 1.
    weight : float
        Weight of the elastic energy relative to that of the images, by which W is divided.
    """

    precision: FloatArray
    observed: FloatArray
    residual: float
    similarity: float
    weight: float

    def weakened(self, sites: BoolArray, factor: float) -> LinearImages:
        """Return the data term with a smaller precision at some sites."""
        share = np.where(sites, np.float32(factor), np.float32(1))
        precision = self.precision * share[..., None, None]
        precision.setflags(write=False)
        return self._replace(precision=precision)


class ImageLevel:
    """Two images on the grid of one level, normalized.

    Parameters
    ----------
    images : tuple of Reduced
        Both images on the level (`reduced_pair`).
    spacing : tuple of float
        Size of a pixel of the level along each axis.
    checkpoint : callable
        Called between the steps; it may raise an error to cancel the computation.
    relation : Relation
    """

    def __init__(
        self,
        images: tuple[Reduced, Reduced],
        spacing: tuple[float, ...],
        checkpoint: Checkpoint,
        relation: Relation = "same",
    ) -> None:
        self.spacing, self._checkpoint, self.relation = spacing, checkpoint, relation
        (self._fixed, self._counted), (self._moving, self._known) = (
            normalized(*image, checkpoint) for image in images
        )
        if relation == "inverse":
            self._fixed = -self._fixed
        # Images whose brightness `expect` needs.
        self._related = images if is_function(relation) else None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid of the level."""
        return self._fixed.shape

    def expect(self, displacement: npt.NDArray[np.floating]) -> None:
        """Replace an image by the brightness that is expected from that of the other image.

        The expected brightness is the mean over all pixels of the same brightness, at a
        displacement.
        """
        if self._related is None:
            return
        one, other = self._related
        fixed, moving = one.brightness, other.brightness
        warped, known = self._warped(moving, displacement)
        both = known > 0.999
        if self.relation == "from fixed":
            expected = expected_brightness(fixed, fixed[both], warped[both])
            self._fixed, _ = normalized(expected * one.share, one.share, self._checkpoint)
        else:
            expected = expected_brightness(moving, warped[both], fixed[both])
            self._moving, _ = normalized(expected * other.share, other.share, self._checkpoint)

    def warped(self, displacement: npt.NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
        """Return M(X + d(X)), and the fraction of each pixel that counts in both images."""
        return self._warped(self._moving, displacement)

    def _warped(
        self, moving: FloatArray, displacement: npt.NDArray[np.floating]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the same for any image on the grid of the moving image."""
        places = moved_places(displacement, self.spacing)
        warped, known = _parallel(
            lambda image: sampled_linearly(image, places, self._checkpoint), (moving, self._known)
        )
        return warped, known * self._counted

    def agreement(self, displacement: npt.NDArray[np.floating]) -> tuple[float, float]:
        """Return the residual and the similarity of the images at a displacement."""
        warped, weight = self.warped(displacement)
        return self._agreement(warped, weight)

    def _agreement(self, warped: FloatArray, weight: FloatArray) -> tuple[float, float]:
        residual = float(np.sqrt(_mean((self._fixed - warped) ** 2, weight)))
        return residual, correlation(self._fixed, warped, weight)

    def linear(self, displacement: npt.NDArray[np.floating], smoothness: float) -> LinearImages:
        """Return the data term of the images, linear around a displacement.

        Parameters
        ----------
        displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        smoothness : float
            Weight of the elastic energy, relative to the variance of the difference of the images.
        """
        self.expect(displacement)
        warped, weight = self.warped(displacement)
        self._checkpoint()
        residual, similarity = self._agreement(warped, weight)
        balance = smoothness * _variance(residual)
        scale = float(np.prod(self.spacing)) / balance
        # All arrays are sums over a window until the last loop, which scales and solves them.
        precision, observed = self._collected(warped, weight)
        least = _NOTHING * max(1.0, 1 / scale)

        def of_diagonal(sites: slice) -> float:
            some = precision[sites]
            seen = np.trace(some, axis1=-2, axis2=-1) > least
            some *= seen[..., None, None]
            observed[sites] *= seen[..., None]
            return float(np.trace(some, axis1=-2, axis2=-1).sum(dtype=np.float64))

        blocks = list(_blocks(self.shape))
        mean = scale * sum(_parallel(of_diagonal, blocks)) / observed.size
        damping = _DAMPING * max(mean, _TINY)
        longest = _LONGEST_STEP * max(
            n * size for n, size in zip(self.shape, self.spacing, strict=True)
        )

        def solve(sites: slice) -> None:
            self._checkpoint()
            tensors = scale * precision[sites].astype(np.float64)
            tensors += damping * (weight[sites] > 0)[..., None, None] * np.eye(observed.shape[-1])
            step = _solved(tensors, scale * observed[sites].astype(np.float64))
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            step *= np.minimum(1, longest / np.maximum(length, _TINY))
            observed[sites] = displacement[sites] + step
            precision[sites] = tensors

        _parallel(solve, blocks)
        precision.setflags(write=False)
        return LinearImages(precision, observed, residual, similarity, balance)

    def _collected(self, warped: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sums over a window of products of slopes, and of slopes and the difference.

        Returns
        -------
        ndarray, shape (H, W, 2, 2) or (D, H, W, 3, 3)
        ndarray, shape (H, W, 2) or (D, H, W, 3)
        """
        difference = (self._fixed - warped) * (weight > 0)
        share = weight / (1 + (difference / _OUTLIER) ** 2)
        # The gradient of the mean of both images halves the error of the linear approximation.
        slopes = self._gradient(np.float32(0.5) * (self._fixed + warped))
        axes = len(slopes)
        products = np.empty((*self.shape, axes, axes), np.float32)
        moments = np.empty((*self.shape, axes), np.float32)

        def collect(pair: tuple[int, int]) -> None:
            i, j = pair
            out = moments[..., i] if j == axes else products[..., i, j]
            values = share * slopes[i]
            values *= difference if j == axes else slopes[j]
            out[...] = smoothed(values, _WINDOW, self._checkpoint)
            if i != j < axes:
                products[..., j, i] = out

        _parallel(collect, [(i, j) for i in range(axes) for j in range(i, axes + 1)])
        return products, moments

    def _gradient(self, image: FloatArray) -> list[FloatArray]:
        self._checkpoint()
        slopes = np.gradient(image, *self.spacing)
        return [np.asarray(slope, np.float32) for slope in slopes]


def moved_places(
    displacement: npt.NDArray[np.floating], spacing: Iterable[float]
) -> list[FloatArray]:
    """Return the places X + d(X) in pixels, as an array for each axis.

    Parameters
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        In the unit of `spacing`.
    spacing : iterable of float
        Size of a pixel along each axis.
    """
    sites = np.ogrid[tuple(slice(n) for n in displacement.shape[:-1])]
    return [
        np.asarray(at.astype(np.float32) + displacement[..., axis] / size, np.float32)
        for axis, (at, size) in enumerate(zip(sites, spacing, strict=True))
    ]


def _variance(residual: float) -> float:
    """Return the variance of the differences for the balance of images and elastic energy.

    Differences of other tissue are similar in neighbouring pixels, so that many pixels count like a
    few. Their variance is counted higher.
    """
    known = max(residual, _LEAST_RESIDUAL)
    return known**2 * max(1.0, known / _OTHER_TISSUE)


def relation_of(
    images: tuple[Reduced, Reduced],
    displacement: npt.NDArray[np.floating],
    spacing: tuple[float, ...],
    choices: Sequence[Relation],
    checkpoint: Checkpoint,
) -> Relation:
    """Return the relation with the largest correlation of the normalized images.

    A relation must correlate much more than one before it in the list, except that a function of
    brightness may follow another function.

    Parameters
    ----------
    images, spacing, checkpoint
        As for `ImageLevel`.
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
    choices : sequence of Relation
    """

    def correlation_of(relation: Relation) -> float:
        level = ImageLevel(images, spacing, checkpoint, relation)
        level.expect(displacement)
        return level.agreement(displacement)[1]

    best, *others = choices
    largest = correlation_of(best)
    much = _RELATED + _BY_CHANCE / math.sqrt(math.prod(displacement.shape[:-1]))
    for relation in others:
        found = correlation_of(relation)
        if found > largest + (0.0 if is_function(best) else much):
            best, largest = relation, found
    return best


def is_function(relation: Relation) -> bool:
    """Return whether the brightness of one image is a function of that of the other."""
    return relation in ("from fixed", "from moving")


def expected_brightness(brightness: FloatArray, given: FloatArray, other: FloatArray) -> FloatArray:
    """Return the mean of `other` over the pixels whose brightness `given` is about that of a pixel.

    Parameters
    ----------
    brightness : ndarray
        Brightness from 0 to 1, of any shape; the result has the same shape.
    given, other : ndarray, shape (N,)
        Brightness of the same tissue in both images.
    """
    count = max(1, min(_MOST_CLASSES, int(len(given) ** _CLASS_POWER)))
    where = np.clip((given * count).astype(np.intp), 0, count - 1)
    counts, sums = (
        scipy.ndimage.gaussian_filter1d(
            np.bincount(where, weights, count), _CLASS_WINDOW, mode="constant"
        )
        for weights in (np.ones(len(where)), other)
    )
    classes = np.flatnonzero(counts > _TINY)
    if not len(classes):
        return brightness
    means, centres = sums[classes] / counts[classes], (classes + 0.5) / count
    return np.asarray(np.interp(brightness, centres, means), np.float32)


def reduced_pair(images: Images, step: int, checkpoint: Checkpoint) -> tuple[Reduced, Reduced]:
    """Return two images with larger pixels; see `reduced`."""
    fixed, moving = images.counted
    return (
        reduced(images.fixed, fixed, step, checkpoint),
        reduced(images.moving, moving, step, checkpoint),
    )


def reduced(image: FloatArray, counted: BoolArray, step: int, checkpoint: Checkpoint) -> Reduced:
    """Return an image with larger pixels, in units of its brightness range.

    Parameters
    ----------
    image : ndarray, shape (H, W) or (D, H, W)
    counted : ndarray of bool
        Mask of the pixels that count.
    step : int
        Size of the larger pixels.
    checkpoint : callable
        Called between the steps; it may raise an error to cancel the computation.
    """
    low, high = np.quantile(image[counted], (_BEYOND_RANGE, 1 - _BEYOND_RANGE))
    span = float(high - low) or float(np.ptp(image[counted])) or 1.0
    scaled = np.where(counted, (image - low) / span, 0)
    share = counted.astype(np.float32)
    every = (slice(None, None, step),) * image.ndim
    if step > 1:
        scaled = smoothed(scaled.astype(np.float32), step / 2, checkpoint)[every]
        share = smoothed(share, step / 2, checkpoint)[every]
    return Reduced(np.ascontiguousarray(scaled, np.float32), np.ascontiguousarray(share))


def normalized(
    sums: FloatArray, share: FloatArray, checkpoint: Checkpoint
) -> tuple[FloatArray, FloatArray]:
    """Return an image with mean 0 and contrast 1 around each pixel, and its weights, 0 or 1.

    Pixels that do not count have no effect on the others.

    Parameters
    ----------
    sums, share : ndarray
        As in `Reduced`.
    checkpoint : callable
        As for `reduced`.
    """

    def mean(values: FloatArray) -> FloatArray:
        return smoothed(values, _NORMALIZATION, checkpoint)

    whole, first, second = _parallel(mean, (share, sums, sums**2 / np.maximum(share, _TINY)))
    whole = np.maximum(whole, _TINY)
    average = first / whole
    contrast = np.sqrt(np.maximum(second / whole - average**2, 0))
    image = (sums / np.maximum(share, _TINY) - average) / (contrast + _LEAST_CONTRAST)
    # The gradient of a pixel beside others that do not count is unknown.
    inside = share > 0.5
    if not inside.all():
        inside = scipy.ndimage.binary_erosion(inside, border_value=1)
    return np.where(inside, image, 0).astype(np.float32), inside.astype(np.float32)


def _blocks(grid: Sequence[int]) -> Iterator[slice]:
    """Yield ranges of rows or planes of a grid, so that arrays of a range are small."""
    count = max(1, _BLOCK_SIZE // math.prod(grid[1:]))
    for begin in range(0, grid[0], count):
        yield slice(begin, begin + count)


def _solved(
    matrix: npt.NDArray[np.float64], right: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Solve a symmetric system of two or three equations at each site; 0 where it is singular."""
    a, b = np.moveaxis(matrix, (-2, -1), (0, 1)), np.moveaxis(right, -1, 0)
    axes = len(b)
    if axes == 2:
        cofactors = [[a[1, 1], -a[0, 1]], [-a[0, 1], a[0, 0]]]
    else:
        cofactors = [[np.zeros(())] * 3 for _ in range(3)]
        for i in range(3):
            for j in range(i, 3):
                (p, q), (r, s) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
                cofactors[i][j] = cofactors[j][i] = a[p, r] * a[q, s] - a[p, s] * a[q, r]
    whole = sum(a[0, j] * cofactors[0][j] for j in range(axes))
    safe = np.where(whole > 0, whole, np.inf)
    parts = [sum(cofactors[i][j] * b[j] for j in range(axes)) / safe for i in range(axes)]
    return np.stack(parts, axis=-1)


def sampled_linearly(
    image: FloatArray, places: Sequence[FloatArray], checkpoint: Checkpoint
) -> FloatArray:
    """Interpolate an image linearly, a few rows or planes at a time; 0 outside of the image."""
    out = np.empty(places[0].shape, np.float32)
    rows = max(1, 2**20 // max(out[0].size, 1))
    for begin in range(0, len(out), rows):
        checkpoint()
        part = slice(begin, begin + rows)
        at = [place[part] for place in places]
        scipy.ndimage.map_coordinates(image, at, output=out[part], order=1, mode="constant")
    return out


def smoothed(image: FloatArray, width: float, checkpoint: Checkpoint) -> FloatArray:
    """Return an image smoothed by a Gaussian window of a standard deviation in pixels."""
    checkpoint()
    found: FloatArray = scipy.ndimage.gaussian_filter(image, width, mode="nearest", truncate=3)
    return found


def _parallel(function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
    """Apply a function to items on several threads; SciPy's filters release the lock of Python."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, items))


def _mean(values: FloatArray, weight: FloatArray) -> float:
    return float((values * weight).sum(dtype=np.float64) / max(float(weight.sum()), _TINY))


def correlation(one: FloatArray, other: FloatArray, weight: FloatArray) -> float:
    """Return the correlation of two normalized images, with a weight for each pixel."""
    sizes = _mean(one**2, weight) * _mean(other**2, weight)
    return _mean(one * other, weight) / max(float(np.sqrt(sizes)), _TINY)
