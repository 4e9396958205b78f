"""What was found for a linear system, for solves of the same system that begin with it.

A system is linear: a sum of its solutions solves it for the same sum of observations, and is wrong
by no more than the sum of what each is wrong by.
"""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

from napari_hmrf.backends.base import FloatArray
from napari_hmrf.backends.host import Beginning


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


class Found:
    """The displacements that were found for one system, for as long as somebody has them."""

    def __init__(self) -> None:
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
