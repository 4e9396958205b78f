"""The V-cycle over the hierarchy: smooth, hand what is left down, correct, smooth."""

from __future__ import annotations

from typing import Any, NamedTuple

from napari_hmrf.solver.backends.linear import Hierarchy, Steps
from napari_hmrf.solver.priors.elements import ElasticMaterial, lame_ratio


class Smoothing(NamedTuple):
    """How much each level smooths, each time it is visited.

    Attributes
    ----------
    part, sweeps : float, int
        The part of the spectrum of D^-1 A that the smoother is for, as a fraction of its largest,
        and its Chebyshev steps.
    coarsest_part, coarsest_sweeps : float, int
        The same, for the coarsest level.
    visits : int
        How often a cycle visits the second level, and from there all below, if that is worth it
        there: what V-cycles lose with every level, that wins back, for a fifth more work.
    patience : int
        Cycles after which factors are the shorter way.
    careful : Smoothing or None
        What to go over to where this turns out to amplify something; by default the same, for any
        mixture of materials.
    """

    part: float
    sweeps: int
    coarsest_part: float
    coarsest_sweeps: int
    visits: int = 1
    patience: int = 60
    careful: Smoothing | None = None


#: For models that stretch: elastic tissue.
STRETCHING = Smoothing(0.1, 2, 0.02, 20, visits=2)
#: The same, for tissue that resists changes of volume much more than those of shape, which coarse
#: levels see less well.
NEARLY_INCOMPRESSIBLE = Smoothing(0.06, 14, 0.005, 60, visits=2, patience=38)
# Up to which ratio of lambda to mu the former does.
_MOST_RATIO = 50.0
#: For volumes that coarse levels turn out to see less well, beside free surfaces, of high contrast
#: or of oblong voxels.
CAREFUL_VOLUME = Smoothing(0.02, 14, 0.01, 30, visits=2)
#: For volumes; and for those that resist changes of volume much more than those of shape.
STRETCHING_VOLUME = Smoothing(0.1, 3, 0.02, 20, visits=2, careful=CAREFUL_VOLUME)
NEARLY_INCOMPRESSIBLE_VOLUME = Smoothing(0.02, 10, 0.01, 30, visits=2, careful=CAREFUL_VOLUME)
# Up to which ratio of lambda to mu the former does.
_MOST_RATIO_VOLUME = 20.0
#: For models of means of neighbours, which are not symmetric.
AVERAGING = Smoothing(0.3, 2, 0.02, 20)
#: For models that bend: their spectra are wider, and bilinear transfer leaves more to do.
BENDING = Smoothing(0.1, 4, 0.005, 40)


def smoothing_of(material: ElasticMaterial) -> Smoothing:
    """How much to smooth elastic tissue."""
    ratio = lame_ratio(material.largest_poisson, material.strain)
    if material.m.ndim == 3:
        return STRETCHING_VOLUME if ratio <= _MOST_RATIO_VOLUME else NEARLY_INCOMPRESSIBLE_VOLUME
    return STRETCHING if ratio <= _MOST_RATIO else NEARLY_INCOMPRESSIBLE


class Cycle:
    """A V-cycle from the finest level down and back.

    Parameters
    ----------
    model : Hierarchy
    smoothing : Smoothing
    """

    def __init__(self, model: Hierarchy, smoothing: Smoothing = STRETCHING) -> None:
        self.levels = model.levels
        rest = (number for number, level in enumerate(self.levels) if level.takes_rest)
        self._visited = self.levels[: next(rest, len(self.levels)) + 1]
        self._smoothing = smoothing
        #: How often it has gone over to `Smoothing.careful`.
        self.care = 0
        usual, self._worst = model.bounds
        self._smooth_up_to(usual)

    def be_careful(self) -> bool:
        """Smooth for any mixture of materials from now on; False if that is so already.

        A smoother that amplifies what lies beyond its bound makes a preconditioner that is not
        positive, which conjugate gradients notice.
        """
        if self._smoothing.careful is not None:
            self._smoothing, self.care = self._smoothing.careful, self.care + 1
        elif self._bound >= self._worst:
            return False
        self._smooth_up_to(self._worst)
        return True

    def smooth_more(self) -> bool:
        """Be careful if that takes more smoothing; False if it takes none, or is so already."""
        return self._smoothing.careful is not None and self.be_careful()

    def _smooth_up_to(self, bound: float) -> None:
        self._bound = bound
        part, sweeps, coarsest_part, coarsest_sweeps = self._smoothing[:4]
        self._steps = chebyshev(part * bound, bound, sweeps)
        self._coarsest = chebyshev(coarsest_part * bound, bound, coarsest_sweeps)

    @property
    def steps(self) -> tuple[Steps, Steps]:
        """Of smoothing: on all levels but the coarsest, and there."""
        return self._steps, self._coarsest

    def run(self, load: Any) -> Any:
        """Return the correction for a load on the finest level; valid until the next run."""
        self.levels[0].load = load
        self._visit(0)
        return self.levels[0].correction

    def _visit(self, number: int) -> None:
        """Find a level's correction for its load."""
        level, *rest = self._visited[number:]
        if not rest:
            level.finish(self._steps, self._coarsest)
            return
        again = number == 1 and level.worth_again
        for visit in range(self._smoothing.visits if again else 1):
            level.descend(self._steps, rest[0], again=visit > 0)
            self._visit(number + 1)
            level.ascend(self._steps, rest[0])


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
    return tuple(made)
