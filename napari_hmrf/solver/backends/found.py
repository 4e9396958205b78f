"""What a solve begins with, and how good that is known to be.

A system is linear: a sum of its solutions solves it for the same sum of observations and loads, and
is wrong by no more than the sum of what each is wrong by.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from napari_hmrf.solver.backends.entrained import Entrained
    from napari_hmrf.solver.backends.factors import Factors

FloatArray = npt.NDArray[np.float32]


class Met(NamedTuple):
    """Knowledge that a warm start takes from the solves of its parts.

    Attributes
    ----------
    least : float
        The least eigenvalue that they have met; 1 if none did.
    error : float
        How far their sum is from the sum of converged fields, in pixels, as estimated.
    """

    least: float
    error: float


# Displacements with the least eigenvalue and the error of each: on the compute thread.
_met: list[tuple[weakref.ref[Any], Met]] = []


def remember(displacement: npt.NDArray[Any], met: Met) -> None:
    """Remember what the solve of a displacement has met.

    Parameters
    ----------
    displacement : ndarray
        The array itself: it is kept alive by its owner alone.
    met : Met
    """
    _met[:] = [each for each in _met if each[0]() is not None]
    _met.append((weakref.ref(displacement), met))


def met_by(start: Beginning) -> Met:
    """Return what the solves of a beginning have met.

    A warm start is close to converged but for motions that cycles hardly see, so that its own
    iteration meets them late: its estimate alone would be too small.

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


# A residual may be larger than it is known to be by this factor, as a stored field is rounded.
_ROUNDED = 4.0
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Beginning:
    """A sum of displacements, which is formed where it is needed.

    Attributes
    ----------
    displacements : tuple of ndarray, each of shape (H, W, 2)
        At least one.
    shares : tuple of float
        How often each is taken.
    unit : float
        The length of a pixel in their unit.
    missing : float
        How far the sum is from what is observed, at most, in pixels; or what pulls from the same
        sum of loads, as a part of the largest motion.
    """

    displacements: tuple[FloatArray, ...]
    shares: tuple[float, ...]
    unit: float
    missing: float

    @property
    def weighted(self) -> list[tuple[FloatArray, float]]:
        """The parts, each with its weight in a sum in pixels."""
        weights = (share / self.unit for share in self.shares)
        return list(zip(self.displacements, weights, strict=True))


class Quality(NamedTuple):
    """How far a displacement is from the solution.

    Attributes
    ----------
    error : float
        Of any site at most, in pixels, as estimated.
    residual : float
        The norm of what it leaves of the load, in the model's units.
    """

    error: float
    residual: float

    def suffices(self, tolerance: float, residual: float) -> bool:
        """Whether that is within a tolerance, in pixels, and the residual found is as known."""
        if residual > _ROUNDED * self.residual:
            return False
        # A larger residual is taken for a larger error, in proportion.
        return self.error * max(1.0, residual / max(self.residual, _TINY)) <= tolerance


class Found:
    """What was found for one system: displacements, for as long as somebody has them, and more.

    Attributes
    ----------
    doubt : float or None
        How much less cycles report than is true, where that has been tried.
    least : float
        The least eigenvalue that cycles have met.
    slow : bool
        True if cycles have met a motion that they see so badly that the tissue is not mild.
    care : int
        How often cycles had to smooth more for that.
    factors : Factors or None
        Of the system, where cycles cannot be trusted.
    entrained : Entrained or None
        What rigid bodies take along, where there are any.
    idle : ndarray of int or None
        Places in planes of tissue that is not observed and that nothing pulls at; None if they
        have not been looked for.
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
        """Remember a displacement, itself and no copy of it."""
        self._known = [each for each in self._known if each[0]() is not None]
        self._known.append((weakref.ref(displacement), quality))

    def quality(self, start: Beginning) -> Quality | None:
        """How good a sum is where it is what is observed; None if a part of it is not known."""
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
