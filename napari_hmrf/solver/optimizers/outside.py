"""What pulls at tissue that moves far besides the tissue itself."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.optimizers.loading import work_of

# How near to its limit a part of a force is taken to be at most.
_ALMOST = 1 - 1e-9


class Outside:
    """Dead loads: forces that stay as they are, wherever tissue gets to.

    Parameters
    ----------
    load : ndarray, planes, or None
    """

    def __init__(self, load: Planes | None) -> None:
        self._load = load

    def energy(self, d: Planes) -> float:
        """What they add to the energy of a displacement."""
        return -work_of(self._load, d)

    def forces(self, d: Planes) -> Planes:
        """The derivative of that."""
        return np.zeros_like(d) if self._load is None else -self._load

    def springs(self, d: Planes) -> Planes | None:
        """How much that changes with the motion of each component; None if it does not."""
        return None

    def follow(self, before: Planes, after: Planes) -> None:
        """Take notice of a step."""


class SoftObservations(Outside):
    """Observations that pull with a force p at most, next to which the kink at y is rounded.

    Their energy is p (sqrt(r^2 + width^2) - width) with r = d - y: with a width of 0, p |r|. As its
    derivative bends sharply, Newton's method finds the force p w along with d, from
    w sqrt(r^2 + width^2) = r (Chan, Golub and Mulet, SIAM J. Sci. Comput. 20, 1999).

    Parameters
    ----------
    y : ndarray, planes
    limit : ndarray, planes
        The greatest force of each component, p.
    load : ndarray, planes, or None
    """

    def __init__(self, y: Planes, limit: Planes, load: Planes | None) -> None:
        super().__init__(load)
        self._at = np.flatnonzero(limit)
        self._y, self._limit = y.ravel()[self._at], limit.ravel()[self._at]
        self._shape, self._width = limit.shape, 1.0
        self._share: npt.NDArray[np.float64] = np.zeros(len(self._at))

    def sharpen(self, d: Planes, width: float) -> None:
        """Round the kink by so much, in pixels, from here on."""
        self._width = width
        off, length = self._lengths(d)
        self._share = off / length

    def energy(self, d: Planes) -> float:
        """What they add to the energy of a displacement."""
        _, length = self._lengths(d)
        return super().energy(d) + float((self._limit * (length - self._width)).sum())

    def forces(self, d: Planes) -> Planes:
        """The derivative of that."""
        off, length = self._lengths(d)
        return super().forces(d) + self._planes(self._limit * off / length)

    def springs(self, d: Planes) -> Planes:
        """How much that changes with the motion of each component."""
        off, length = self._lengths(d)
        return self._planes(self._limit * (1 - self._share * off / length) / length)

    def follow(self, before: Planes, after: Planes) -> None:
        """Take notice of a step: of the forces that go with it."""
        off, length = self._lengths(before)
        way = after.ravel()[self._at] - before.ravel()[self._at]
        share = (off + way * (1 - self._share * off / length)) / length
        self._share = np.clip(share, -_ALMOST, _ALMOST)

    def _lengths(self, d: Planes) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """How far each component is from what was observed, and that with the kink rounded."""
        off = d.ravel()[self._at] - self._y
        return off, np.hypot(off, self._width)

    def _planes(self, values: npt.NDArray[np.float64]) -> Planes:
        made: Planes = np.zeros(self._shape)
        made.ravel()[self._at] = values
        return made
