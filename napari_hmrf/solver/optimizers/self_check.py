"""Test of the error estimate of an iteration, on a random field with a known solution.

A Krylov iteration estimates its error from the modes that it has found. If parts of stiff tissue
are so thin or so close together that they merge on coarse levels, the modes that move these parts
have such low energies that the iteration may find them only after all other modes have converged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from napari_hmrf.solver.backends.linear import Balance, Planes
from napari_hmrf.solver.optimizers.base import Monitor, Report
from napari_hmrf.solver.optimizers.krylov import ConjugateGradients, Step

#: Largest ratio of the true error to the estimated error for which an estimate is accepted.
BELIEVABLE = 3.0
# Largest ratio of the error after a round to the error before it for which another round starts.
_ROUND_REDUCTION = 0.5


class Rehearsal(NamedTuple):
    """Trial run of an iteration on a random field, for which the solution is known to be zero.

    Attributes
    ----------
    part : float
        Estimated error at which the run ends, as a fraction of the largest value of the field.
    patience : int
        Number of cycles after which the run fails.
    """

    part: float = 0.003
    patience: int = 40

    def run(
        self,
        iteration: ConjugateGradients,
        error: Planes,
        balance_of: Callable[[Planes], Balance],
        report: Report,
    ) -> float:
        """Return the ratio of the true to the estimated error; infinite if the run fails.

        Parameters
        ----------
        iteration : ConjugateGradients
        error : ndarray, planes
            Random field; changed in place.
        balance_of : callable
            Function that returns the residual of a displacement without a load.
        report : callable
            Called with a `Monitor` after each cycle.
        """
        most = float(np.abs(error).max())
        doubt, cycles, rounds, left = math.inf, 0, 0, most
        while most > 0 and doubt > BELIEVABLE and cycles < self.patience:
            # Modes that were not found dominate the remaining error; a new round finds them.
            balance, step = balance_of(error), None
            target = self.part * most / balance.unit

            def enough(latest: Step, target: float = target) -> bool:
                nonlocal step, cycles
                step, cycles = latest, cycles + 1
                report(Monitor(f"check of the accuracy, cycle {cycles}", 0.0))
                return latest.error <= target or cycles >= self.patience

            try:
                iteration.run(balance, error, enough)
            except FloatingPointError:
                return math.inf
            if step is None:
                return math.inf
            before, left = left, float(np.abs(error).max())
            if step.error <= target:
                doubt = left / (balance.unit * step.error)
            # Otherwise the round ended at the limit of single precision. A mode may be found late,
            # but every round except the first must reduce the error.
            rounds += 1
            if rounds > 1 and left > _ROUND_REDUCTION * before:
                break
        return doubt if most > 0 else 1.0
