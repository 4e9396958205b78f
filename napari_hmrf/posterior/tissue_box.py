"""Box around the tissue of a volume, so that samples skip the empty sites around it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, part_of

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
    shape : tuple of int
        Shape of the whole grid.
    problem : Problem
    prior : ElasticPrior
    """

    sites: tuple[slice, ...]
    shape: tuple[int, ...]
    problem: Problem
    prior: ElasticPrior

    @classmethod
    def of(cls, problem: Problem, prior: ElasticPrior) -> TissueBox:
        """Return the box of the tissue of a problem."""
        if not problem.is_volume:
            return cls((slice(None),) * 2, problem.shape, problem, prior)
        sites = tuple(_range(problem.tissue, axis) for axis in range(3))
        poisson = prior.poisson
        if isinstance(poisson, np.ndarray):
            prior = replace(prior, poisson=poisson[sites])
        return cls(sites, problem.shape, part_of(problem, sites), prior)

    def whole(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return values on the whole grid, with 0 outside the box.

        Parameters
        ----------
        values : ndarray
            Values at each site of the box.
        """
        made = np.zeros((*self.shape, *values.shape[len(self.shape) :]), values.dtype)
        made[self.sites] = values
        return made


def _range(tissue: npt.NDArray[np.bool_], axis: int) -> slice:
    """Return the range of sites along an axis that contains all tissue, with a margin."""
    others = tuple(each for each in range(tissue.ndim) if each != axis)
    at = np.flatnonzero(tissue.any(axis=others))
    return slice(max(0, int(at[0]) - _MARGIN), int(at[-1]) + 1 + _MARGIN)
