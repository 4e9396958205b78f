"""Elastic properties of a solution, for the computation of elastic strain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from napari_hmrf import array_file
from napari_hmrf.checks import POISSON_RANGE
from napari_hmrf.solver.priors import Elastic, ElasticPrior, NeoHookeanPrior
from napari_hmrf.solver.priors.elastic import Plane
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.real_arrays import FloatArray


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


def read_elasticity(header: array_file.Header, arrays: array_file.Arrays) -> Elasticity | None:
    """Read elastic properties from a file; None if the model is not elastic.

    Raises
    ------
    Invalid
        If the properties are invalid or do not match the grid of the file.
    """
    grid, poisson, growth = arrays["tissue"].shape, arrays.get("poisson"), arrays.get("growth")
    given, stiffness = header.get("elasticity"), arrays.get("stiffness")
    if given is None:
        if any(each is not None for each in (poisson, growth, stiffness)):
            raise array_file.Invalid("it has arrays for elastic tissue, but no elastic model")
        return None
    if stiffness is None or stiffness.shape != grid or not (stiffness >= 0).all():
        raise array_file.Invalid("its stiffness is missing or does not match the tissue")
    nu, plane, finite = given["poisson"], given["plane"], given["finite"]
    if poisson is None:
        if not (isinstance(nu, float | int) and POISSON_RANGE[0] <= nu <= POISSON_RANGE[1]):
            raise array_file.Invalid(f"its Poisson's ratio is invalid: {nu!r}"[:200])
    elif nu is not None or poisson.shape != grid:
        raise array_file.Invalid(f"its Poisson's ratios {poisson.shape} do not match the tissue")
    elif not (np.isfinite(poisson) & (np.abs(poisson) < 1)).all():
        raise array_file.Invalid("its Poisson's ratios are out of range")
    if plane not in get_args(Plane) or not isinstance(finite, bool):
        raise array_file.Invalid("its elastic model is unknown")
    if growth is not None:
        sizes = {len(grid), 3}
        if growth.shape not in [grid, *((*grid, size, size) for size in sizes)]:
            raise array_file.Invalid(f"its growth {growth.shape} does not match the tissue")
        if not np.isfinite(growth).all():
            raise array_file.Invalid("its growth contains values that are not numbers")
    return Elasticity(stiffness, float(nu) if poisson is None else poisson, plane, finite, growth)
