"""Large motion with observations that may slip: search for the slipping observations.

The energy of each observation has a kink at the observed position. At first the kink is smoothed,
and the width of the smoothing is reduced in steps. The result shows which observations are held and
which slip. The problem with these states is then solved without smoothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.optimizers.external_forces import (
    ExternalForces,
    Measurements,
    SoftObservations,
)
from napari_hmrf.solver.optimizers.newton import Newton

# Initial width of the kink, as a fraction of the largest distance from an observed position.
_FIRST_WIDTH = 0.2
# Ratio of each width of the kink to the previous one.
_WIDTH_FACTOR = 0.1
# Final width of the kink, as a fraction of the tolerance.
_LAST_WIDTH = 0.1
# Distance beyond which an observation counts as slipping, in widths of the kink.
_SLIP_DISTANCE = 30.0
# Largest accepted excess of the force of a held observation, as a fraction of its limit.
_EXCESS = 1e-3
# Largest number of exchanges of states.
_EXCHANGES = 8


class LargeSlip:
    """Search for the slipping observations in large motion.

    Parameters
    ----------
    newton : Newton
    y : ndarray, planes
        Observed displacement, in pixels.
    limit : ndarray, planes
        Largest force of the observation of each component; infinite for a component that never
        slips, and 0 if the component is not observed.
    load : ndarray, planes, or None
        Dead load on each component, or None if there is no load.
    data : Measurements or None
        Data term, or None.
    """

    def __init__(
        self,
        newton: Newton,
        y: Planes,
        limit: Planes,
        load: Planes | None,
        data: Measurements | None,
    ) -> None:
        self._newton, self._y, self._limit = newton, y, limit
        self._load, self._data = load, data
        self._observed: HeldPlanes = limit > 0
        self._fixed: HeldPlanes = np.isinf(limit)
        #: Limits of the observations that may slip; 0 at all other components.
        self._yielding = np.where(self._fixed, 0.0, limit)

    def run(self, d: Planes, tolerance: float, warm: bool = False) -> None:
        """Minimize the energy over `d`, in place.

        Parameters
        ----------
        d : ndarray, planes
            Initial displacement, in pixels.
        tolerance : float
            Largest error of the field, in pixels.
        warm : bool
            True if `d` is close to the result, so that its forces show which observations slip.

        Raises
        ------
        ConvergenceError
            If Newton's method fails or no consistent set of slipping observations is found.
        """
        begun = d.copy()
        if warm:
            if self._sharpen(d, self._slipping(d), tolerance):
                return
            np.copyto(d, begun)
        try:
            self._soften(d, tolerance)
        except ConvergenceError:
            # Large forces may have crushed tissue. Start again with all observations held, and let
            # an observation slip only if its force exceeds the limit.
            np.copyto(d, begun)
            self._newton.external_forces = ExternalForces.of(self._load, self._data)
            self._newton.run(d, self._y, self._observed, tolerance)
            if not self._sharpen(d, self._slipping(d), tolerance):
                raise

    def _slipping(self, d: Planes) -> npt.NDArray[np.float64]:
        """Return the sign of the force on each slipping component; 0 for held components."""
        needed = self._required(d, self._observed)
        slips = np.abs(needed) >= (1 - _EXCESS) * self._limit
        return np.where(slips, np.sign(needed), 0.0)

    def _soften(self, d: Planes, tolerance: float) -> None:
        """Minimize the energy over `d`, in place, with successively narrower kinks."""
        newton = self._newton
        far = float(np.abs(np.where(self._yielding > 0, self._y - d, 0.0)).max())
        last = _LAST_WIDTH * tolerance
        width = max(_FIRST_WIDTH * far, last)
        soft = SoftObservations(self._y, self._yielding, self._load, self._data)
        while True:
            soft.sharpen(d, width)
            newton.external_forces = soft
            newton.run(d, self._y, self._fixed, max(tolerance, _FIRST_WIDTH * width))
            if width == last:
                break
            width = max(_WIDTH_FACTOR * width, last)
        off = np.where(self._yielding > 0, self._y - d, 0.0)
        sides = np.where(np.abs(off) > _SLIP_DISTANCE * width, np.sign(off), 0.0)
        rounded, distance = d.copy(), newton.distance
        if not self._sharpen(d, sides, tolerance):
            # No consistent states were found; the solution with a smoothed kink is the best
            # available.
            np.copyto(d, rounded)
            newton.external_forces = soft
            newton.distance = distance

    def _sharpen(self, d: Planes, sides: npt.NDArray[np.float64], tolerance: float) -> bool:
        """Solve for the given states, in place; return whether the result is consistent."""
        newton = self._newton
        for _ in range(_EXCHANGES):
            held, pulls = self._observed & (sides == 0), sides * self._yielding
            load = pulls if self._load is None else pulls + self._load
            newton.external_forces = ExternalForces(load, self._data)
            try:
                newton.run(d, self._y, held, tolerance)
            except ConvergenceError:
                return False
            needed = self._required(d, held)
            passed = sides * (d - self._y) > tolerance
            wrong = (np.abs(needed) > (1 + _EXCESS) * self._limit) | passed
            missed = held & ~self._fixed & (np.abs(self._y - d) > tolerance)
            if not (wrong | missed).any():
                return True
            sides = np.where(wrong, np.where(passed, 0.0, np.sign(needed)), sides)
        return False

    def _required(self, d: Planes, held: HeldPlanes) -> Planes:
        """Return the force that is required to hold each held component in place; 0 elsewhere."""
        self._newton.external_forces = ExternalForces.of(self._load, self._data)
        return np.where(held, self._newton.forces(d), 0.0)
