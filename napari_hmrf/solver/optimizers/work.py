"""Work of a large-motion solve, and its limit."""

from __future__ import annotations

import math

# Costs in cycles on the same grid, measured at 512 x 512 on two cores.

#: Cost of a solve with linear elasticity.
LINEAR_SOLVE = 2.2
#: The same for parts that slide along each other.
SLIDING_SOLVE = 9.0
# Cost of a Newton step without its linear system.
_STEP = 3.0
# Cost of a factorization, per square root of the number of sites of an image, and per site of a
# volume. Volumes are factorized up to a few ten thousand voxels only.
_FACTORIZATION = 0.28
_FACTORIZATION_OF_VOLUME = 0.02
# Number of sites of a grid on which the fixed costs of a cycle double its time.
_FIXED_COST_SITES = 4000
# Smallest budget of an image and of a volume, in cycles times sites: about half a second of work
# in an image and two seconds in a volume, on two cores.
_LEAST_CYCLE_SITES = {2: 2e7, 3: 4e6}
#: Default largest work, in solves with linear elasticity.
USUAL_BUDGET = 60.0


class Work:
    """Work of a solve so far, and its limit, in cycles on the finest grid.

    Work is counted, not timed, so results do not depend on the speed of the machine.

    Parameters
    ----------
    budget : float or None
        Largest amount of work, in solves with linear elasticity; None for no limit. A small problem
        may take more, up to half a second in an image.
    shape : tuple of int
        Shape of the finest grid.
    solve : float
        Cost of a solve with linear elasticity, in cycles.
    """

    def __init__(
        self, budget: float | None, shape: tuple[int, ...], solve: float = LINEAR_SOLVE
    ) -> None:
        sites = math.prod(shape)
        least = _LEAST_CYCLE_SITES[len(shape)] / (sites + _FIXED_COST_SITES)
        #: Largest amount of work.
        self.limit = math.inf if budget is None else max(solve * budget, least)
        #: Amount of work that other ways to solve are measured against: a solve that takes long
        #: is started again from coarser grids, whether or not its work is limited.
        self.measure = min(self.limit, max(solve * USUAL_BUDGET, least))
        #: Work so far.
        self.spent = 0.0
        # Cost of one cycle on this grid, and of one factorization, in cycles on the finest grid.
        self._sites, self._cycle = sites, 1.0
        self._factorization = (
            _FACTORIZATION * math.sqrt(sites)
            if len(shape) == 2
            else _FACTORIZATION_OF_VOLUME * sites
        )
        self._whole: Work | None = None

    def part(self, fraction: float, shape: tuple[int, ...]) -> Work:
        """Return a fraction of the work that is left, for a solve on a coarser grid.

        Parameters
        ----------
        fraction : float
            Fraction of the work that is left, or of `measure` if the work is not limited.
        shape : tuple of int
            Shape of the coarser grid.
        """
        part = Work(None, shape)
        left = self.measure if math.isinf(self.limit) else self.limit - self.spent
        part.limit = part.measure = fraction * left
        share = (part._sites + _FIXED_COST_SITES) / (self._sites + _FIXED_COST_SITES)
        part._cycle = share * self._cycle
        part._factorization *= part._cycle
        part._whole = self
        return part

    @property
    def is_done(self) -> bool:
        """True once the limit is reached."""
        return self.spent >= self.limit

    @property
    def allows_factorization(self) -> bool:
        """True if a factorization does not exceed the limit."""
        return self.spent + self._factorization <= self.limit

    def begin_again(self) -> None:
        """Allow the whole budget once more, for a solve that begins again."""
        self.spent = 0.0

    def add_cycle(self) -> None:
        """Add one cycle."""
        self._add(self._cycle)

    def add_step(self) -> None:
        """Add one Newton step without its linear system."""
        self._add(_STEP * self._cycle)

    def add_factorization(self) -> None:
        """Add one factorization."""
        self._add(self._factorization)

    def _add(self, amount: float) -> None:
        work: Work | None = self
        while work is not None:
            work.spent += amount
            work = work._whole
