"""Elastic properties of a solution, for the computation of elastic strain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.real_arrays import FloatArray
from napari_hmrf.solver.model_names import Plane
from napari_hmrf.solver.priors import Elastic, ElasticPrior, NeoHookeanPrior
from napari_hmrf.solver.problem import Problem


@dataclass(frozen=True, eq=False)
class Elasticity:
    """Elastic properties of the tissue of a solution.

    Attributes
    ----------
    stiffness : ndarray, shape ([D,] H, W)
        Young's modulus of each site: infinite in rigid tissue, 0 in void.
    poisson : float or ndarray, shape ([D,] H, W), float32
        Poisson's ratio of all tissue or of each site.
    plane : {"stress", "strain"}
        As for `ElasticPrior`; ignored in a volume.
    finite : bool
        True for the finite strain of `NeoHookeanPrior`, False for the small strain of
        `ElasticPrior`.
    growth : ndarray, optional
        Growth strain as in `Loads`, multiplied by the completed fraction of the growth.
    """

    stiffness: FloatArray
    poisson: float | npt.NDArray[np.float32]
    plane: Plane = "stress"
    finite: bool = False
    growth: FloatArray | None = None

    @cached_property
    def rigid(self) -> npt.NDArray[np.bool_] | None:
        """Mask of rigid tissue, which has no strain, shape ([D,] H, W); None if there is none."""
        mask: npt.NDArray[np.bool_] = np.isinf(self.stiffness)
        return mask if mask.any() else None

    @classmethod
    def of_problem(cls, problem: Problem, prior: Elastic, grown: float = 1.0) -> Elasticity:
        """Return the elastic properties of a problem's tissue.

        Parameters
        ----------
        problem : Problem
        prior : ElasticPrior or NeoHookeanPrior
        grown : float
            Completed fraction of the growth.
        """
        growth = None if problem.loads is None else problem.loads.growth
        if growth is not None and grown != 1:
            growth = growth * np.float32(grown)
        finite = isinstance(prior, NeoHookeanPrior)
        return cls(problem.stiffness, prior.poisson, prior.plane, finite, growth)

    @property
    def prior(self) -> Elastic:
        """Prior of this tissue, without its penalty, on which no force depends."""
        kind = NeoHookeanPrior if self.finite else ElasticPrior
        return kind(self.poisson, plane=self.plane)

    def mapped(self, change: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]) -> Elasticity:
        """Return the properties at other sites; `change` maps each array to these sites."""
        poisson = self.poisson if isinstance(self.poisson, float) else change(self.poisson)
        growth = None if self.growth is None else change(self.growth)
        return replace(self, stiffness=change(self.stiffness), poisson=poisson, growth=growth)


class MovedTissue(Protocol):
    """Displacement of tissue whose strain and stress are computed: a `Solution`."""

    @property
    def displacement(self) -> FloatArray:
        """Displacement, shape ([D,] H, W, n), in the unit of `spacing`."""
        ...

    @property
    def tissue(self) -> npt.NDArray[np.bool_]:
        """Mask of the tissue, shape ([D,] H, W)."""
        ...

    @property
    def spacing(self) -> tuple[float, ...]:
        """Pixel size along each axis."""
        ...

    @property
    def parts(self) -> npt.NDArray[np.int32] | None:
        """Labels of parts that slide along each other, shape ([D,] H, W)."""
        ...

    @property
    def elasticity(self) -> Elasticity | None:
        """Elastic properties of the tissue; None if they are unknown."""
        ...

    @property
    def provenance(self) -> Any:
        """Model and parameters of the displacement; see `Provenance`."""
        ...
