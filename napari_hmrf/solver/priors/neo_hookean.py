"""Large motion without folding: reference implementation of finite strain on the grid.

The elements are those of `ElasticPrior`, but their rotation and stretch are unlimited.
`finite_strain` defines their energy in an image, and `finite_bricks` in a volume.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import first_index
from napari_hmrf.solver.model_names import Plane
from napari_hmrf.solver.priors.elastic import ElasticPrior, prior_in_words
from napari_hmrf.solver.priors.elements import Float64Array
from napari_hmrf.solver.priors.finite_bricks import FiniteBricks, brick_moduli
from napari_hmrf.solver.priors.finite_strain import FiniteElements, FiniteMaterial, grown_sizes
from napari_hmrf.solver.priors.growth import Load
from napari_hmrf.solver.priors.hexahedra import BrickShape
from napari_hmrf.solver.problem import Problem, in_pixels


@dataclass(frozen=True, eq=False)
class NeoHookeanPrior:
    """Neo-Hookean tissue, for large displacements and rotations without folding.

    For small motion, it is equivalent to `ElasticPrior`, which takes a tenth of the time. Use
    `ElasticPrior` if displacements are less than a tenth of the distances over which they vary.

    Parameters
    ----------
    poisson : float or array_like, shape (H, W) or (D, H, W)
        Poisson's ratio at small strain, from 0 to 0.499, of all tissue or of each site.
    plane : {"stress", "strain"}
        Same as for `ElasticPrior`.
    penalty : float, optional
        Same as for `ElasticPrior`. If there is rigid tissue, observations cannot slip: by default,
        all observations are then prescribed exactly, and a finite penalty is refused.
    """

    poisson: float | npt.NDArray[np.float32] = 0.45
    _: KW_ONLY
    plane: Plane = "stress"
    penalty: float | None = None

    def __post_init__(self) -> None:
        same = ElasticPrior(self.poisson, plane=self.plane, penalty=self.penalty)
        object.__setattr__(self, "poisson", same.poisson)
        object.__setattr__(self, "penalty", same.penalty)

    def __repr__(self) -> str:
        return prior_in_words(self)

    @property
    def at_rest(self) -> ElasticPrior:
        """Prior for small motion with the same parameters."""
        return ElasticPrior(self.poisson, plane=self.plane, penalty=self.penalty)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name (JSON types only), with the shape and digest of a map of ratios."""
        return {**self.at_rest.parameters, "name": "NeoHookeanPrior"}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NeoHookeanPrior) and self.parameters == other.parameters

    def __hash__(self) -> int:
        return hash(repr(self.parameters))

    @property
    def kernels(self) -> str:
        """Key of the kernels that this prior uses."""
        return "large motion"

    def rehearsal(self, shape: tuple[int, ...]) -> NeoHookeanPrior:
        """Return a prior that uses the same kernels, for a small problem of the given shape."""
        return NeoHookeanPrior(0.3, plane=self.plane)

    def resolved(self, problem: Problem) -> NeoHookeanPrior:
        """Check that the problem has a unique solution, and return the prior for this problem.

        Raises
        ------
        ProblemError
            If growth turns tissue inside out, if landmarks have a drift, if there is rigid tissue
            and the penalty is finite, or in the cases of `ElasticPrior.resolved`.
        """
        _check_growth(problem)
        if problem.landmarks is not None and problem.landmarks.drift:
            raise ProblemError(
                "landmarks",
                "cannot have a drift in large motion. Use ElasticPrior, or estimate no drift "
                "(`drift=False`).",
            )
        if self.penalty is not None and self.penalty < math.inf and problem.has_rigid:
            raise ProblemError(
                "stiffness",
                "is infinite (rigid) somewhere, but observations cannot slip in large motion if "
                "there is rigid tissue. Omit the prior's penalty, or give that tissue a finite "
                "stiffness.",
            )
        self.at_rest.resolved(problem)
        return self.in_force(problem)

    def in_force(self, problem: Problem) -> NeoHookeanPrior:
        """Return the prior with an infinite penalty if the problem's observations cannot slip."""
        return self if self.can_slip(problem) else replace(self, penalty=math.inf)

    def can_slip(self, problem: Problem) -> bool:
        """Return whether any observation of the problem may slip."""
        return self.at_rest.can_slip(problem) and not problem.has_rigid

    def material(self, problem: Problem) -> FiniteMaterial:
        """Return the properties of a problem's tissue that the kernels require."""
        same = self.at_rest.material(problem)
        growth = None if problem.loads is None else problem.loads.growth
        return FiniteMaterial(
            same.m,
            same.poisson,
            same.strain,
            same.shape,
            same.data,
            same.coupling,
            same.unit,
            growth=growth,
        )

    def limit(self, problem: Problem) -> Float64Array | None:
        """Return the force limits; see `ElasticPrior.limit`."""
        return self.in_force(problem).at_rest.limit(problem)

    def force_unit(self, problem: Problem) -> float:
        """Return the unit of force; see `ElasticPrior.force_unit`."""
        return self.at_rest.force_unit(problem)

    def load(self, problem: Problem) -> Load | None:
        """Return the dead loads, which do not depend on the motion, or None if there are none."""
        if problem.loads is None or problem.loads.force is None:
            return None
        return Load(problem.loads.force / np.float64(self.force_unit(problem)), 0.0)

    def energy(self, problem: Problem, displacement: npt.ArrayLike) -> float:
        """Return U, in pixels squared, for a displacement in units of ``spacing``.

        U is the elastic energy minus the work of forces.
        """
        d, load = in_pixels(problem, displacement), self.load(problem)
        stored = self._elements(problem).energy(d)
        return stored if load is None else stored - float((load.forces * d).sum())

    def forces(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return the gradient of the energy with respect to the displacement in pixels."""
        d, load = in_pixels(problem, displacement), self.load(problem)
        forces = self._elements(problem).forces(d)
        return forces if load is None else forces - load.forces

    def tangents(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return second derivatives with respect to element differences, (H - 1, W - 1, 6, 6).

        For images only.
        """
        d, elements = in_pixels(problem, displacement), self._elements(problem)
        assert isinstance(elements, FiniteElements)
        return elements.tangents(d)

    def corner_jacobians(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return numbers that bound the Jacobian of each element; they are 1 in void.

        If all are positive, the element is not folded anywhere. The numbers include growth: in
        tissue that has doubled its area or volume, they are 2.

        Returns
        -------
        ndarray, shape (4, H - 1, W - 1) or (27, D - 1, H - 1, W - 1)
            Jacobians at the four corners, or Bernstein coefficients in a volume.
        """
        d = in_pixels(problem, displacement)
        return self._elements(problem).corner_jacobians(d)

    def _elements(self, problem: Problem) -> FiniteElements | FiniteBricks:
        material, shape = self.material(problem), self.at_rest.shape(problem.spacing)
        if isinstance(shape, BrickShape):
            return FiniteBricks(brick_moduli(material), shape)
        return FiniteElements(material.moduli(), shape)


def _check_growth(problem: Problem) -> None:
    """Raise an error if growth shrinks tissue to nothing in some direction."""
    growth = None if problem.loads is None else problem.loads.growth
    if growth is None:
        return
    wrong = problem.tissue & ~(grown_sizes(growth, len(problem.shape)) > 0)
    if wrong.any():
        raise ProblemError(
            "growth",
            f"shrinks tissue to nothing in some direction, first at {first_index(wrong)}. Pass "
            "growth tensors with a strain above -1 in all directions.",
        )
