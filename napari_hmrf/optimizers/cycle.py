"""The V-cycle over the hierarchy: smooth, hand what is left down, correct, smooth."""

from __future__ import annotations

from typing import Any

from napari_hmrf.backends.linear import LinearModel, Steps

# The part of the spectrum of D^-1 A that a level's smoother is for, as a fraction of its largest.
_SMOOTHED = 0.1
_COARSEST_SMOOTHED = 0.02
_SWEEPS = 2
_COARSEST_SWEEPS = 20


class Cycle:
    """A V(2, 2) cycle from the finest level down and back.

    Parameters
    ----------
    model : LinearModel
    """

    def __init__(self, model: LinearModel) -> None:
        self.levels = model.levels
        usual, self._worst = model.bounds
        self._smooth_up_to(usual)

    def be_careful(self) -> bool:
        """Smooth for any mixture of materials from now on; False if that is so already.

        A smoother that amplifies what lies beyond its bound makes a preconditioner that is not
        positive, which conjugate gradients notice.
        """
        if self._bound >= self._worst:
            return False
        self._smooth_up_to(self._worst)
        return True

    def _smooth_up_to(self, bound: float) -> None:
        self._bound = bound
        self._steps = chebyshev(_SMOOTHED * bound, bound, _SWEEPS)
        self._coarsest = chebyshev(_COARSEST_SMOOTHED * bound, bound, _COARSEST_SWEEPS)

    def run(self, load: Any) -> Any:
        """Return the correction for a load on the finest level; valid until the next run."""
        self.levels[0].load = load
        *upper, last = self.levels
        for level, coarse in zip(upper, self.levels[1:], strict=True):
            level.descend(self._steps, coarse)
        last.descend(self._coarsest, None)
        for level, coarse in zip(reversed(upper), reversed(self.levels[1:]), strict=True):
            level.ascend(self._steps, coarse)
        return self.levels[0].correction


def chebyshev(low: float, high: float, steps: int) -> Steps:
    """(scale, momentum) of each step of the polynomial that is least on [low, high]."""
    centre, half = (high + low) / 2, (high - low) / 2
    sigma = centre / half
    rho = 1 / sigma
    made = [(1 / centre, 0.0)]
    for _ in range(steps - 1):
        following = 1 / (2 * sigma - rho)
        made.append((2 * following / half, following * rho))
        rho = following
    return made
