"""Box around the tissue of a volume, so that samples skip the empty sites around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, part_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import CancelFlag, solve

#: Number of empty sites beside the tissue in the box.
_MARGIN = 1


@dataclass(frozen=True, eq=False)
class TissueBox:
    """Problem on the smallest box that contains all tissue.

    More than half of the sites of a volume of a head are empty. An image has few sites, and its
    model is cached for the next drag, so its box is the whole image.

    Attributes
    ----------
    sites : tuple of slice
        Range of sites along each axis.
    whole_problem, whole_prior : Problem, ElasticPrior
        On the whole grid.
    problem, prior : Problem, ElasticPrior
        In the box.
    """

    sites: tuple[slice, ...]
    whole_problem: Problem
    whole_prior: ElasticPrior
    problem: Problem
    prior: ElasticPrior

    @classmethod
    def of(cls, problem: Problem, prior: ElasticPrior) -> TissueBox:
        """Return the box of the tissue of a problem."""
        if not problem.is_volume:
            return cls((slice(None),) * 2, problem, prior, problem, prior)
        (box,) = scipy.ndimage.find_objects(problem.tissue.view(np.int8))
        sites = tuple(slice(max(0, b.start - _MARGIN), b.stop + _MARGIN) for b in box)
        poisson, part = prior.poisson, prior
        if isinstance(poisson, np.ndarray):
            part = replace(prior, poisson=poisson[sites])
        return cls(sites, problem, prior, part_of(problem, sites), part)

    def solve(self, backend: str, cancel: CancelFlag | None) -> Solution:
        """Return the solution on the whole grid, from a solve in the box.

        Parameters
        ----------
        backend, cancel
            As for `napari_hmrf.solve`.
        """
        found = solve(self.problem, self.prior, backend=backend, cancel=cancel)
        whole = self.whole_problem
        if self.problem is whole:
            return found
        return replace(
            found,
            displacement=self.whole(found.displacement),
            levels=tuple(replace(level, shape=whole.shape) for level in found.levels),
            tissue=whole.tissue,
            loads=whole.loads,
            elasticity=Elasticity.of_problem(whole, self.whole_prior),
            provenance=replace(found.provenance, inputs=whole.digests),
        )

    def whole(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return values on the whole grid, with 0 outside the box.

        Parameters
        ----------
        values : ndarray
            Values at each site of the box.
        """
        grid = self.whole_problem.shape
        made = np.zeros((*grid, *values.shape[len(grid) :]), values.dtype)
        made[self.sites] = values
        return made
