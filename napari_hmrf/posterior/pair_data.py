"""Two images of the same tissue, to which properties of tissue are fitted.

At a displacement d, the difference of the images is

    r(X) = F(X) - M(X + d(X)),

where F is the fixed and M the moving image. On the finest level, both are smoothed and normalized
on the grid of the fixed image, after the moving image is warped, so that r vanishes at the true
displacement even where tissue is stretched. Large differences count less: the residual is
``sign(r) sqrt(log(1 + r^2))``, whose square is the Cauchy loss.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.registration.image_data import (
    Checkpoint,
    FloatArray,
    ImageLevel,
    Images,
    moved_places,
    normalized,
    reduced_pair,
    smoothed,
)
from napari_hmrf.solver.problem import Problem

Float64Array = npt.NDArray[np.float64]

#: Tolerance of a solve, in pixels of the level.
_TOLERANCE = 1e-3
#: Standard deviation of the window that smooths the images on the finest level, in pixels. Without
#: it, the noise of single pixels looks like structure, and the derivatives are wrong.
_WIDTH = 1.0
#: Largest displacement of the finite differences of the images, in pixels of the level.
_STEP = 0.1
#: Side of the blocks of pixels whose differences are independent, in pixels.
_BLOCK = 16
_TINY = 1e-12


class ImagePairData:
    """Differences of two images on a grid with larger pixels.

    Parameters
    ----------
    images : Images
    problem : Problem
        Tissue on the grid of the images.
    size : int
        Size of a pixel of the level, in pixels of the images.
    checkpoint : callable
        Called between the steps; it may raise an error to cancel the computation.
    """

    def __init__(self, images: Images, problem: Problem, size: int, checkpoint: Checkpoint) -> None:
        self._images, self._pixel = images, tuple(problem.spacing)
        self._every = (slice(None, None, size),) * images.fixed.ndim
        self._spacing = np.multiply(size, problem.spacing)
        self._tolerance, self._checkpoint = _TOLERANCE * size, checkpoint
        # On the finest level, linear interpolation would blur the moving image, but not the fixed.
        self._order = 3 if size == 1 else 1
        fixed, moving = reduced_pair(images, size, checkpoint)
        self._fixed, self._counted = self._normalized(*fixed)
        self._counted *= problem.tissue[self._every]
        sums, self._share = moving
        if self._order > 1:
            sums = np.asarray(scipy.ndimage.spline_filter(sums, self._order, np.float32))
        self._sums = sums

    def misfit(self, displacement: npt.NDArray[np.floating]) -> Float64Array:
        """Return the residuals of all pixels of the level.

        Parameters
        ----------
        displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
            On the grid of the images.
        """
        return self._residuals(displacement[self._every])

    def derivative(
        self, displacement: npt.NDArray[np.floating], response: Float64Array
    ) -> Float64Array:
        """Return the derivatives of the residuals, by central differences.

        Parameters
        ----------
        displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        response : ndarray
            Derivative of the displacement with respect to a property, of the same shape.
        """
        here, change = displacement[self._every], response[self._every]
        largest = float(np.abs(change / self._spacing).max())
        if largest == 0:
            return np.zeros(self._fixed.size)
        step = _STEP / largest
        ends = (self._residuals(here + sign * step * change) for sign in (1, -1))
        after, before = ends
        return (after - before) / (2 * step)

    def tolerance(self, problem: Problem) -> float:
        """Return the tolerance of a solve, in pixels."""
        return self._tolerance

    def variance(self, differences: Float64Array) -> float:
        """Return the variance of the noise, from the residuals at the solution."""
        count = max(float(self._counted.sum()), 1.0)
        return max(float(differences @ differences) / count, _TINY)

    def covariance(self, slopes: Float64Array, differences: Float64Array) -> Float64Array:
        """Return the covariance of the properties.

        Residuals of neighbouring pixels are not independent. The covariance is therefore computed
        from the sums over blocks of pixels (a sandwich estimator with clusters), and is at least
        that of independent pixels.

        Parameters
        ----------
        slopes : ndarray, shape (p, k)
            Derivatives of the residuals of p pixels with respect to k properties.
        differences : ndarray, shape (p,)
            Residuals at the solution.
        """
        inverse = np.linalg.inv(slopes.T @ slopes)
        scores = (slopes * differences[:, np.newaxis]).reshape(*self._fixed.shape, -1)
        for axis, size in enumerate(self._fixed.shape):
            scores = np.add.reduceat(scores, np.arange(0, size, _BLOCK), axis=axis)
        blocks = scores.reshape(-1, scores.shape[-1])
        count, unknowns = int(blocks.any(axis=1).sum()), blocks.shape[1]
        found = inverse @ (blocks.T @ blocks) @ inverse * count / max(count - unknowns, 1)
        independent = np.diag(inverse) * self.variance(differences)
        factor = np.sqrt(np.maximum(1, independent / np.maximum(np.diag(found), _TINY)))
        return np.asarray(found * np.outer(factor, factor))

    def similarities(self, displacement: npt.NDArray[np.floating]) -> tuple[float, float]:
        """Return the similarity of the images without and with a displacement.

        The similarity is that which a registration reports.
        """
        whole = reduced_pair(self._images, 1, self._checkpoint)
        level = ImageLevel(whole, self._pixel, self._checkpoint)
        before, after = (level.agreement(each)[1] for each in (0 * displacement, displacement))
        return before, after

    def _residuals(self, displacement: npt.NDArray[np.floating]) -> Float64Array:
        moved, weight = self._warped(displacement)
        difference = ((self._fixed - moved) * weight).astype(np.float64).ravel()
        return np.sign(difference) * np.sqrt(np.log1p(difference**2))

    def _warped(self, displacement: npt.NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
        """Return the normalized moving image at X + d(X), and the weights of both images."""
        places = moved_places(displacement, self._spacing)
        self._checkpoint()
        share = scipy.ndimage.map_coordinates(self._share, places, order=1, mode="constant")
        self._checkpoint()
        sums = scipy.ndimage.map_coordinates(
            self._sums, places, order=self._order, mode="nearest", prefilter=False
        )
        self._checkpoint()
        moved, known = self._normalized(sums * (share > 0), np.asarray(share))
        return moved, known * self._counted

    def _normalized(self, sums: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self._order > 1:
            sums, share = (smoothed(each, _WIDTH, self._checkpoint) for each in (sums, share))
        return normalized(sums, share, self._checkpoint)
