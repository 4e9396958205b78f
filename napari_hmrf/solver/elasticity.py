"""Elastic properties of a solution: what elastic strain needs beside the displacement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors import Elastic, NeoHookeanPrior
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.real_arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Elastic properties with which a displacement was solved.

    Attributes
    ----------
    poisson : float or ndarray, shape ([D,] H, W), float32
        Poisson's ratio of all tissue, or of each site.
    plane : {"stress", "strain"}
        As of `ElasticPrior`; without meaning in a volume.
    finite : bool
        True for `NeoHookeanPrior`, False for `ElasticPrior`, whose strain is small strain.
    growth : ndarray, optional
        Strain of the tissue that grew, as of `Loads`: the part of it that the solve reached.
    rigid : ndarray of bool, shape ([D,] H, W), optional
        Rigid tissue, which has no strain; None if there is none.
    """

    poisson: float | npt.NDArray[np.float32]
    plane: Plane = "stress"
    finite: bool = False
    growth: FloatArray | None = None
    rigid: npt.NDArray[np.bool_] | None = None

    @classmethod
    def of_problem(cls, problem: Problem, prior: Elastic, grown: float = 1.0) -> Elasticity:
        """Return the properties of a problem's tissue, grown by a part of its growth."""
        growth = None if problem.loads is None else problem.loads.growth
        if growth is not None and grown != 1:
            growth = growth * np.float32(grown)
        rigid = problem.rigid if problem.rigid.any() else None
        finite = isinstance(prior, NeoHookeanPrior)
        return cls(prior.poisson, prior.plane, finite, growth, rigid)

    def mapped(self, change: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]) -> Elasticity:
        """Return the properties on other sites: `change` makes each array one of these."""
        poisson = self.poisson if isinstance(self.poisson, float) else change(self.poisson)
        growth = None if self.growth is None else change(self.growth)
        rigid = None if self.rigid is None else change(self.rigid)
        return replace(self, poisson=poisson, growth=growth, rigid=rigid)
