"""V-cycle over the hierarchy: smooth, restrict the residual, correct, smooth."""

from __future__ import annotations

from typing import Any, NamedTuple

from napari_hmrf.solver.backends.linear import Balance, Hierarchy, Steps
from napari_hmrf.solver.priors.elements import ElasticMaterial, lame_ratio


class Smoothing(NamedTuple):
    """Settings for the smoothing of a level at each visit, and number of visits.

    Attributes
    ----------
    part : float
        Lower end of the range of eigenvalues of D^-1 A that the smoother damps, as a fraction of
        the upper end.
    sweeps : int
        Number of Chebyshev steps.
    coarsest_part, coarsest_sweeps : float, int
        Values of `part` and `sweeps` on the coarsest level.
    visits : int
        Number of visits to the second level and all coarser levels in each cycle, on devices where
        a second visit is worth its cost. A second visit compensates for the slower convergence of
        V-cycles with many levels and adds a fifth to the work.
    patience : int
        Number of cycles after which a factorization is faster.
    careful : Smoothing or None
        Smoothing to use once this smoothing amplifies a motion. If None, only the upper bound of
        the eigenvalues is raised, to the bound for any mixture of materials.
    """

    part: float
    sweeps: int
    coarsest_part: float
    coarsest_sweeps: int
    visits: int = 1
    patience: int = 60
    careful: Smoothing | None = None


#: Smoothing for elastic tissue.
STRETCHING = Smoothing(0.1, 2, 0.02, 20, visits=2)
#: Smoothing for elastic tissue that resists changes in volume much more than changes in shape.
#: Coarse levels represent its motions less accurately.
NEARLY_INCOMPRESSIBLE = Smoothing(0.06, 14, 0.005, 60, visits=2, patience=38)
# Largest ratio of lambda to mu for which `STRETCHING` is sufficient.
_MOST_RATIO = 50.0
#: Smoothing for volumes with motions that coarse levels represent less accurately: near free
#: surfaces, at a high stiffness contrast, or with oblong voxels.
CAREFUL_VOLUME = Smoothing(0.02, 14, 0.01, 30, visits=2)
#: Counterpart of `STRETCHING` for volumes.
STRETCHING_VOLUME = Smoothing(0.1, 3, 0.02, 20, visits=2, careful=CAREFUL_VOLUME)
#: Counterpart of `NEARLY_INCOMPRESSIBLE` for volumes.
NEARLY_INCOMPRESSIBLE_VOLUME = Smoothing(0.02, 10, 0.01, 30, visits=2, careful=CAREFUL_VOLUME)
# Largest ratio of lambda to mu for which `STRETCHING_VOLUME` is sufficient.
_MOST_RATIO_VOLUME = 20.0
#: Smoothing for the centred reading, which averages neighbours and is not symmetric.
AVERAGING = Smoothing(0.3, 2, 0.02, 20)
#: Smoothing for the blanket reading, which resists bending. Its spectrum is wider, and bilinear
#: transfer between levels is less accurate.
BENDING = Smoothing(0.1, 4, 0.005, 40)


def smoothing_of(material: ElasticMaterial) -> Smoothing:
    """Return the smoothing for elastic tissue."""
    ratio = lame_ratio(material.largest_poisson, material.strain)
    if material.m.ndim == 3:
        return STRETCHING_VOLUME if ratio <= _MOST_RATIO_VOLUME else NEARLY_INCOMPRESSIBLE_VOLUME
    return STRETCHING if ratio <= _MOST_RATIO else NEARLY_INCOMPRESSIBLE


class Cycle:
    """V-cycle from the finest level to the coarsest and back.

    Parameters
    ----------
    model : Hierarchy
    smoothing : Smoothing
    """

    def __init__(self, model: Hierarchy, smoothing: Smoothing = STRETCHING) -> None:
        self.levels = model.levels
        rest = (number for number, level in enumerate(self.levels) if level.finishes_cycle)
        self._visited = self.levels[: next(rest, len(self.levels)) + 1]
        self._smoothing = smoothing
        #: Number of switches to `Smoothing.careful`.
        self.care = 0
        usual, self._worst = model.bounds
        self._smooth_up_to(usual)

    def use_safe_bound(self) -> bool:
        """Raise the smoother's eigenvalue bound to the safe bound; return False if already done.

        A smoother amplifies motions with eigenvalues above its bound. The preconditioner is then
        not positive definite, which conjugate gradients detect.
        """
        if self._smoothing.careful is not None:
            self._smoothing, self.care = self._smoothing.careful, self.care + 1
        elif self._bound >= self._worst:
            return False
        self._smooth_up_to(self._worst)
        return True

    def smooth_more(self) -> bool:
        """Switch to `Smoothing.careful`; return False if there is no such smoothing."""
        return self._smoothing.careful is not None and self.use_safe_bound()

    def _smooth_up_to(self, bound: float) -> None:
        self._bound = bound
        part, sweeps, coarsest_part, coarsest_sweeps = self._smoothing[:4]
        self._steps = chebyshev(part * bound, bound, sweeps)
        self._coarsest = chebyshev(coarsest_part * bound, bound, coarsest_sweeps)

    @property
    def steps(self) -> tuple[Steps, Steps]:
        """Smoothing steps on all levels except the coarsest, and on the coarsest."""
        return self._steps, self._coarsest

    def use_steps(self, steps: Steps, coarsest: Steps) -> None:
        """Set the smoothing steps, for a cycle that is a part of another cycle."""
        self._steps, self._coarsest = steps, coarsest

    def run(self, load: Any) -> Any:
        """Return the correction for a load on the finest level; valid until the next run."""
        self.levels[0].load = load
        self._visit(0)
        return self.levels[0].correction

    def largest_correction(self, balance: Balance) -> float:
        """Return the largest component of the correction for a residual, in the model's units."""
        if balance.most == 0:
            return 0.0
        level = self.levels[0]
        rest = level.vector(balance.rest)
        correction = self.run(rest)
        level.project(correction)
        most, _ = level.read(*level.weigh(correction, rest))
        level.free(rest)
        return float(most) * balance.unit

    def _visit(self, number: int) -> None:
        """Compute the correction of a level for its load, using all coarser levels."""
        level, *rest = self._visited[number:]
        if not rest:
            level.finish(self._steps, self._coarsest)
            return
        again = number == 1 and level.is_revisited
        for visit in range(self._smoothing.visits if again else 1):
            level.descend(self._steps, rest[0], again=visit > 0)
            self._visit(number + 1)
            level.ascend(self._steps, rest[0])


def chebyshev(low: float, high: float, steps: int) -> Steps:
    """Return (scale, momentum) for each step of the Chebyshev iteration on [low, high]."""
    centre, half = (high + low) / 2, (high - low) / 2
    sigma = centre / half
    rho = 1 / sigma
    coefficients = [(1 / centre, 0.0)]
    for _ in range(steps - 1):
        following = 1 / (2 * sigma - rho)
        coefficients.append((2 * following / half, following * rho))
        rho = following
    return tuple(coefficients)
