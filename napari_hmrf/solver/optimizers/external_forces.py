"""External forces on tissue in large motion: dead loads, data, and observations that may slip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.data_term import DataTerm

# Largest force of an observation in the tangent system, as a fraction of its limit.
_LARGEST_SHARE = 1 - 1e-9


class Measurements(NamedTuple):
    """Data term of a problem with its observed displacement, as planes in pixels."""

    term: DataTerm
    observed: Planes


class ExternalForces:
    """Dead loads, which do not depend on the displacement, and forces of the data term.

    Parameters
    ----------
    load : ndarray, planes, or None
        Force on each component, or None if there is no load.
    data : Measurements or None
        Data term, or None. The linear model contains its second derivatives.
    """

    def __init__(self, load: Planes | None, data: Measurements | None = None) -> None:
        self._load, self._data = load, data

    @classmethod
    def of(cls, load: Planes | None, data: Measurements | None) -> ExternalForces | None:
        """Return the external forces, or None if there are none."""
        return None if load is None and data is None else cls(load, data)

    def energy(self, d: Planes) -> float:
        """Return the potential energy of the loads and the data at a displacement."""
        energy = -host.work_of(self._load, d)
        if self._data is not None:
            energy += self._data.term.derivative(d, self._data.observed)[1]
        return energy

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the potential energy with respect to the displacement."""
        if self._data is None:
            return np.zeros_like(d) if self._load is None else -self._load
        forces, _ = self._data.term.derivative(d, self._data.observed)
        return forces if self._load is None else forces - self._load

    def springs(self, d: Planes) -> Planes | None:
        """Return values to add to the diagonal of the linear model; None if they are 0."""
        return None

    def follow(self, before: Planes, after: Planes) -> None:
        """Update the forces after a step; dead loads do not change."""


class SoftObservations(ExternalForces):
    """Observations with a force of at most p, and an energy that is smooth near y.

    Their energy is ``p (sqrt(r^2 + width^2) - width)`` with ``r = d - y``; for a width of 0 it is
    ``p |r|``, which has a kink at y. For a small width, the derivative changes abruptly near y.
    Newton's method therefore solves for the force ``p w`` together with d, where
    ``w sqrt(r^2 + width^2) = r`` (Chan, Golub and Mulet, SIAM J. Sci. Comput. 20, 1999).

    Parameters
    ----------
    y : ndarray, planes
        Observed displacement, in pixels.
    limit : ndarray, planes
        Largest force p of each component; 0 if the component is not observed.
    load : ndarray, planes, or None
        Dead load on each component.
    data : Measurements or None
        Data term.
    """

    def __init__(
        self, y: Planes, limit: Planes, load: Planes | None, data: Measurements | None = None
    ) -> None:
        super().__init__(load, data)
        self._at = np.flatnonzero(limit)
        self._y, self._limit = y.ravel()[self._at], limit.ravel()[self._at]
        self._shape, self._width = limit.shape, 1.0
        self._share: npt.NDArray[np.float64] = np.zeros(len(self._at))

    def sharpen(self, d: Planes, width: float) -> None:
        """Set the width of the smoothed kink, in pixels, and the forces at the displacement `d`."""
        self._width = width
        off, length = self._lengths(d)
        self._share = off / length

    def energy(self, d: Planes) -> float:
        """Return the total energy of the loads and the observations at a displacement."""
        _, length = self._lengths(d)
        return super().energy(d) + float((self._limit * (length - self._width)).sum())

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the total energy with respect to the displacement."""
        off, length = self._lengths(d)
        return super().forces(d) + self._planes(self._limit * off / length)

    def springs(self, d: Planes) -> Planes:
        """Return the contribution to the diagonal of the tangent matrix, after elimination of w."""
        off, length = self._lengths(d)
        return self._planes(self._limit * (1 - self._share * off / length) / length)

    def follow(self, before: Planes, after: Planes) -> None:
        """Update the forces ``p w`` after a step, using their linearization."""
        off, length = self._lengths(before)
        step = after.ravel()[self._at] - before.ravel()[self._at]
        share = (off + step * (1 - self._share * off / length)) / length
        self._share = np.clip(share, -_LARGEST_SHARE, _LARGEST_SHARE)

    def _lengths(self, d: Planes) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return ``r = d - y`` and ``sqrt(r^2 + width^2)`` at the observed components."""
        off = d.ravel()[self._at] - self._y
        return off, np.hypot(off, self._width)

    def _planes(self, values: npt.NDArray[np.float64]) -> Planes:
        planes: Planes = np.zeros(self._shape)
        planes.ravel()[self._at] = values
        return planes
