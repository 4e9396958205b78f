"""Start of a solve, and the known quality of that start.

A system is linear: a sum of its solutions solves it for the same sum of observations and loads, and
its error is at most the sum of the errors of its parts.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from napari_hmrf.solver.backends.direct.factors import Factors
    from napari_hmrf.solver.backends.rigid.entrained import Entrained

FloatArray = npt.NDArray[np.float32]


class Met(NamedTuple):
    """Knowledge that a warm start takes from the solves of its parts.

    Attributes
    ----------
    least : float
        The least eigenvalue that they have met; 1 if they have met none.
    error : float
        Estimated error of their sum, in pixels: distance from the sum of converged fields.
    """

    least: float
    error: float


# Displacements, each with its least eigenvalue and error; used on the compute thread only.
_met: list[tuple[weakref.ref[Any], Met]] = []


def remember(displacement: npt.NDArray[Any], met: Met) -> None:
    """Remember the least eigenvalue and the error of the solve of a displacement.

    Parameters
    ----------
    displacement : ndarray
        The array itself; only a weak reference is kept.
    met : Met
    """
    _met[:] = [each for each in _met if each[0]() is not None]
    _met.append((weakref.ref(displacement), met))


def met_by(start: Beginning) -> Met:
    """Return the combined knowledge of the solves of a start.

    A warm start is close to converged except for motions that cycles hardly reduce, so its own
    iteration meets them late, and its estimate alone would be too small.

    Parameters
    ----------
    start : Beginning
    """
    least, error = 1.0, 0.0
    for share, part in zip(start.shares, start.displacements, strict=True):
        for known, met in _met:
            if known() is part:
                least, error = min(least, met.least), error + abs(share) * met.error
    return Met(least, error)


# A residual may exceed its known value by this factor, as stored fields are rounded.
_ROUNDED = 4.0
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Beginning:
    """Sum of displacements, computed only when needed.

    Attributes
    ----------
    displacements : tuple of ndarray, each of shape (H, W, 2)
        At least one.
    shares : tuple of float
        Factor of each displacement.
    unit : float
        Length of a pixel in the unit of the displacements.
    missing : float
        Largest distance of the sum from the observations, in pixels; or of its loads from the
        given ones, as a part of the largest motion.
    """

    displacements: tuple[FloatArray, ...]
    shares: tuple[float, ...]
    unit: float
    missing: float

    @property
    def weighted(self) -> list[tuple[FloatArray, float]]:
        """The displacements, each with its factor in a sum in pixels."""
        weights = (share / self.unit for share in self.shares)
        return list(zip(self.displacements, weights, strict=True))


class Quality(NamedTuple):
    """Error and residual of a displacement.

    Attributes
    ----------
    error : float
        Estimated largest error of any site, in pixels.
    residual : float
        Norm of the load that the displacement leaves unbalanced, in the model's units.
    """

    error: float
    residual: float

    def suffices(self, tolerance: float, residual: float) -> bool:
        """Return whether the error is within a tolerance, in pixels, and the residual as known."""
        if residual > _ROUNDED * self.residual:
            return False
        # A larger residual is taken for a larger error, in proportion.
        return self.error * max(1.0, residual / max(self.residual, _TINY)) <= tolerance


class Found:
    """Results for one system: displacements, as long as the caller keeps them, and more.

    Attributes
    ----------
    doubt : float or None
        Factor by which cycles underestimate the error, where a rehearsal has measured it.
    least : float
        Least eigenvalue that cycles have met.
    slow : bool
        True if cycles have met a motion that they reduce so badly that the tissue is not mild.
    care : int
        Number of times that cycles had to smooth more for that reason.
    factors : Factors or None
        Factors of the system, where cycles cannot be trusted.
    entrained : Entrained or None
        Motions that rigid bodies induce in the tissue around them, if there are any bodies.
    idle : ndarray of int or None
        Indices in planes of tissue that is not observed and bears no load; None before they are
        searched for.
    """

    def __init__(self) -> None:
        self.doubt: float | None = None
        self.least = 1.0
        self.slow = False
        self.care = 0
        self.factors: Factors | None = None
        self.entrained: Entrained | None = None
        self.idle: npt.NDArray[np.intp] | None = None
        self._known: list[tuple[weakref.ref[Any], Quality]] = []

    def add(self, displacement: FloatArray, quality: Quality) -> None:
        """Remember a displacement, by weak reference."""
        self._known = [each for each in self._known if each[0]() is not None]
        self._known.append((weakref.ref(displacement), quality))

    def quality(self, start: Beginning) -> Quality | None:
        """Return the quality of a sum that matches the observations; None if a part is unknown."""
        parts = [self._of(each) for each in start.displacements]
        error = residual = 0.0
        for share, part in zip(start.shares, parts, strict=True):
            if part is None:
                return None
            error += abs(share) * part.error
            residual += abs(share) * part.residual
        return Quality(error, residual)

    def _of(self, displacement: FloatArray) -> Quality | None:
        found = (quality for known, quality in self._known if known() is displacement)
        return next(found, None)
