"""Warm start of a solve, and the known quality of this start.

The system is linear. A weighted sum of solutions is therefore the solution for the same weighted
sum of observations and loads, and its error is at most the weighted sum of the errors.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept

if TYPE_CHECKING:
    from napari_hmrf.solver.backends.direct.factors import Factors
    from napari_hmrf.solver.backends.rigid.deflation import Deflation

FloatArray = npt.NDArray[np.float32]


class StartQuality(NamedTuple):
    """Properties of a warm start that are known from earlier solves.

    Attributes
    ----------
    least : float
        Smallest eigenvalue of the preconditioned system found by the iterations; at most 1.
    error : float
        Estimated largest distance of the start from the converged field, in pixels.
    """

    least: float
    error: float


# Displacements with their properties.
_start_qualities: Kept[list[tuple[weakref.ref[Any], StartQuality]]] = Kept()


def remember(displacement: npt.NDArray[Any], quality: StartQuality) -> None:
    """Store the quality of a displacement for later warm starts.

    Parameters
    ----------
    displacement : ndarray
        Displacement; only a weak reference to this array is stored.
    quality : StartQuality
        Properties found by the solve of this displacement.
    """
    living = [each for each in _start_qualities.value or [] if each[0]() is not None]
    _start_qualities.value = [*living, (weakref.ref(displacement), quality)]


def start_quality_of(start: WarmStart) -> StartQuality:
    """Combine the known properties of the parts of a warm start.

    A warm start has nearly converged, except for motions that cycles hardly reduce. The iteration
    finds these motions late, so its error estimate alone would be too small.

    Parameters
    ----------
    start : WarmStart

    Returns
    -------
    StartQuality
        Smallest eigenvalue of all parts and weighted sum of their errors.
    """
    least, error = 1.0, 0.0
    for share, part in zip(start.shares, start.displacements, strict=True):
        for known, met in _start_qualities.value or []:
            if known() is part:
                least, error = min(least, met.least), error + abs(share) * met.error
    return StartQuality(least, error)


# Largest accepted ratio of a residual to its stored value, because stored fields are rounded.
_ROUNDED = 4.0
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Weighted sum of displacements, computed on demand.

    Attributes
    ----------
    displacements : tuple of ndarray, each of shape (H, W, 2)
        One or more displacements.
    shares : tuple of float
        Weight of each displacement.
    unit : float
        Length of a pixel in the unit of the displacements.
    missing : float
        Largest deviation of the weighted sum from the observations, in pixels, or from the loads,
        which are scaled to the largest displacement.
    is_unfinished : bool
        True if a budget ended the solve of the latest displacement.
    """

    displacements: tuple[FloatArray, ...]
    shares: tuple[float, ...]
    unit: float
    missing: float
    is_unfinished: bool = False

    @property
    def weighted(self) -> list[tuple[FloatArray, float]]:
        """Displacements, with the weights of a sum that is in pixels."""
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

        The result is False if the current residual exceeds the stored residual by more than
        rounding errors.
        """
        if residual > _ROUNDED * self.residual:
            return False
        # The error is assumed to grow in proportion to the residual.
        return self.error * max(1.0, residual / max(self.residual, _TINY)) <= tolerance


class EarlierResults:
    """Results of earlier solves of one system.

    Displacements are stored as weak references.

    Attributes
    ----------
    underestimate : float or None
        Factor by which cycles underestimate the error, or None if it is unknown.
    least : float
        Smallest eigenvalue of the preconditioned system found by the iterations.
    slow : bool
        True if the iterations have found a motion that cycles hardly reduce.
    care : int
        Number of switches to better cycles or to double precision.
    factors : Factors or None
        Factorization of the system, or None if cycles are used.
    deflation : Deflation or None
        Motions that rigid bodies induce in the surrounding tissue, or None without rigid bodies.
    idle : ndarray of int or None
        Indices (in the flattened planes) of tissue without observations and loads; None until they
        are computed.
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
        """Store a displacement, as a weak reference, with its quality."""
        self._qualities = [each for each in self._qualities if each[0]() is not None]
        self._qualities.append((weakref.ref(displacement), quality))

    def quality(self, start: WarmStart) -> Quality | None:
        """Return the quality of a start that satisfies the observations.

        The result is None if the quality of one of its displacements is unknown.
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
