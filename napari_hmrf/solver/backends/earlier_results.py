"""Start of a solve, and the known quality of that start.

The system is linear: a weighted sum of its solutions is the solution for the same sum of
observations and loads. The error of the sum is at most the sum of the errors of its parts.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from napari_hmrf.solver.backends.direct.factors import Factors
    from napari_hmrf.solver.backends.rigid.deflation import Deflation

FloatArray = npt.NDArray[np.float32]


class StartQuality(NamedTuple):
    """Properties of a warm start that are known from earlier solves.

    Attributes
    ----------
    least : float
        Least eigenvalue of the preconditioned system that the iterations have found; at most 1.
    error : float
        Estimated error of the start, in pixels: its largest distance from the converged field.
    """

    least: float
    error: float


# Displacements, each with its properties; used on the compute thread only.
_start_qualities: list[tuple[weakref.ref[Any], StartQuality]] = []


def remember(displacement: npt.NDArray[Any], quality: StartQuality) -> None:
    """Remember the least eigenvalue and the error of the solve of a displacement.

    Parameters
    ----------
    displacement : ndarray
        Displacement; only a weak reference to this array is kept.
    quality : StartQuality
        Properties found by its solve.
    """
    _start_qualities[:] = [each for each in _start_qualities if each[0]() is not None]
    _start_qualities.append((weakref.ref(displacement), quality))


def start_quality_of(start: WarmStart) -> StartQuality:
    """Combine the known properties of the parts of a warm start.

    A warm start is nearly converged, except for motions that cycles hardly reduce. The iteration
    detects these motions late, so its own estimate of the error would be too small.

    Parameters
    ----------
    start : WarmStart

    Returns
    -------
    StartQuality
        Least eigenvalue of all parts, and sum of their weighted errors.
    """
    least, error = 1.0, 0.0
    for share, part in zip(start.shares, start.displacements, strict=True):
        for known, met in _start_qualities:
            if known() is part:
                least, error = min(least, met.least), error + abs(share) * met.error
    return StartQuality(least, error)


# A residual may exceed its known value by this factor, because stored fields are rounded.
_ROUNDED = 4.0
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Sum of displacements, computed only when needed.

    Attributes
    ----------
    displacements : tuple of ndarray, each of shape (H, W, 2)
        One or more displacements.
    shares : tuple of float
        Factor of each displacement.
    unit : float
        Length of a pixel in the unit of the displacements.
    missing : float
        Largest distance of the sum from the observations, in pixels; or of its loads from the
        given loads, relative to the largest motion.
    """

    displacements: tuple[FloatArray, ...]
    shares: tuple[float, ...]
    unit: float
    missing: float

    @property
    def weighted(self) -> list[tuple[FloatArray, float]]:
        """Displacements, each with its factor in the sum in pixels."""
        weights = (share / self.unit for share in self.shares)
        return list(zip(self.displacements, weights, strict=True))


class Quality(NamedTuple):
    """Error and residual of a displacement.

    Attributes
    ----------
    error : float
        Estimated largest error of any site, in pixels.
    residual : float
        Norm of the residual, load - A d, in the model's units.
    """

    error: float
    residual: float

    def suffices(self, tolerance: float, residual: float) -> bool:
        """Return whether the error is at most a tolerance, in pixels.

        Also return False if the present residual exceeds the known one by more than rounding.
        """
        if residual > _ROUNDED * self.residual:
            return False
        # The error is assumed to grow in proportion to the residual.
        return self.error * max(1.0, residual / max(self.residual, _TINY)) <= tolerance


class EarlierResults:
    """Results of earlier solves of one system.

    Displacements are kept by weak reference.

    Attributes
    ----------
    underestimate : float or None
        Factor by which cycles underestimate the error; None until it is known.
    least : float
        Least eigenvalue of the preconditioned system that the iterations have found.
    slow : bool
        True if the iterations have found a motion that cycles hardly reduce.
    care : int
        Number of times that the number of smoothing steps was raised for that reason.
    factors : Factors or None
        Factors of the system, where cycles cannot be trusted.
    deflation : Deflation or None
        Motions that rigid bodies induce in the tissue around them, if there are any bodies.
    idle : ndarray of int or None
        Indices in planes of tissue that is not observed and bears no load; None until the search
        for such tissue has run.
    """

    def __init__(self) -> None:
        self.underestimate: float | None = None
        self.least = 1.0
        self.slow = False
        self.care = 0
        self.factors: Factors | None = None
        self.deflation: Deflation | None = None
        self.idle: npt.NDArray[np.intp] | None = None
        self._qualities: list[tuple[weakref.ref[Any], Quality]] = []

    def add(self, displacement: FloatArray, quality: Quality) -> None:
        """Remember a displacement, by weak reference."""
        self._qualities = [each for each in self._qualities if each[0]() is not None]
        self._qualities.append((weakref.ref(displacement), quality))

    def quality(self, start: WarmStart) -> Quality | None:
        """Return the quality of a start that matches the observations.

        Return None if the quality of one of its displacements is unknown.
        """
        parts = [self._quality_of(each) for each in start.displacements]
        error = residual = 0.0
        for share, part in zip(start.shares, parts, strict=True):
            if part is None:
                return None
            error += abs(share) * part.error
            residual += abs(share) * part.residual
        return Quality(error, residual)

    def _quality_of(self, displacement: FloatArray) -> Quality | None:
        found = (quality for known, quality in self._qualities if known() is displacement)
        return next(found, None)
