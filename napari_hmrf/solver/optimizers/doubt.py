"""Whether what an iteration reports is true: of a random field, whose answer is known.

A Krylov iteration judges itself by the modes that it has met. Where parts of stiff tissue are so
thin or so close together that coarse levels weld them, to move them costs so little that it is not
met before all else has converged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from napari_hmrf.solver.backends.linear import Balance, Planes
from napari_hmrf.solver.optimizers.base import Monitor, Report
from napari_hmrf.solver.optimizers.krylov import ConjugateGradients, Step

#: What an iteration reports may be this much less than what is true, and is believed.
BELIEVABLE = 3.0
# What a round must leave of its error at most, for another one.
_GAIN = 0.5


class Rehearsal(NamedTuple):
    """How long a rehearsal goes on.

    Attributes
    ----------
    part : float
        It ends at this part of its field, as reported.
    patience : int
        After so many cycles it has failed.
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
        """How far off a known answer is, over how far off it is said to be.

        Parameters
        ----------
        iteration : ConjugateGradients
        error : ndarray, planes
            The random field; changed in place.
        balance_of : callable
            What a displacement leaves of no load.
        report : callable
        """
        most = float(np.abs(error).max())
        doubt, cycles, rounds, left = math.inf, 0, 0, most
        while most > 0 and doubt > BELIEVABLE and cycles < self.patience:
            # What is left of the error is what was not met: from there it is.
            balance, step = balance_of(error), None
            target = self.part * most / balance.unit

            def enough(latest: Step, target: float = target) -> bool:
                nonlocal step, cycles
                step, cycles = latest, cycles + 1
                report(Monitor(f"rehearsal, cycle {cycles}", 0.0))
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
            # Else single precision has carried no further from there. A motion may be met late, but
            # once there have been two rounds each must gain something.
            rounds += 1
            if rounds > 1 and left > _GAIN * before:
                break
        return doubt if most > 0 else 1.0
