"""Large motion without folding: finite strain on the pixel grid, in a reference implementation.

Every 2 x 2 block of tissue sites is an element, as in `ElasticPrior`, but it may turn and stretch
without limit. Its energy is defined in `finite_strain`.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.priors.elastic import ElasticPrior, Plane, prior_in_words
from napari_hmrf.solver.priors.elements import Float64Array
from napari_hmrf.solver.priors.finite_bricks import FiniteBricks, brick_moduli
from napari_hmrf.solver.priors.finite_strain import FiniteElements, FiniteMaterial, grown_sizes
from napari_hmrf.solver.priors.growth import Load
from napari_hmrf.solver.priors.hexahedra import BrickShape
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.real_arrays import first_index


@dataclass(frozen=True, eq=False)
class NeoHookeanPrior:
    """Neo-Hookean tissue of an image: it may move far, turns without strain, and never folds.

    For small motion it equals `ElasticPrior`, which takes a tenth of the time. Use that prior if
    displacements are less than a tenth of the distances over which they vary.

    Parameters
    ----------
    poisson : float or array_like, shape (H, W)
        Poisson's ratio at small strain, 0 to 0.499, of all tissue or of each site.
    plane : {"stress", "strain"}
        As for `ElasticPrior`.
    penalty : float, optional
        As for `ElasticPrior`.
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
        """Prior for small motion, with the same parameters."""
        return ElasticPrior(self.poisson, plane=self.plane, penalty=self.penalty)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name (JSON types only); a map of ratios by its shape and digest."""
        return {**self.at_rest.parameters, "name": "NeoHookeanPrior"}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NeoHookeanPrior) and self.parameters == other.parameters

    def __hash__(self) -> int:
        return hash(repr(self.parameters))

    @property
    def kernels(self) -> str:
        """Kernels of this prior, as a key."""
        return "large motion"

    def rehearsal(self, shape: tuple[int, ...]) -> NeoHookeanPrior:
        """Return a prior with the same kernels, for a small problem of this shape."""
        return NeoHookeanPrior(0.3, plane=self.plane)

    def resolved(self, problem: Problem) -> NeoHookeanPrior:
        """Check that the problem has a unique solution, and return the prior for this problem.

        Raises
        ------
        ProblemError
            For a volume, for growth that turns tissue inside out, and as for `ElasticPrior`.
        """
        _check_growth(problem)
        self.at_rest.resolved(problem)
        return self.in_force(problem)

    def in_force(self, problem: Problem) -> NeoHookeanPrior:
        """Return the prior with an infinite penalty if no observation of the problem may slip."""
        return replace(self, penalty=self.at_rest.in_force(problem).penalty)

    def can_slip(self, problem: Problem) -> bool:
        """Return whether any observation of the problem may slip."""
        return self.at_rest.can_slip(problem)

    def material(self, problem: Problem) -> FiniteMaterial:
        """Return the properties of a problem's tissue that the kernels need."""
        same = self.at_rest.material(problem)
        growth = None if problem.loads is None else problem.loads.growth
        return FiniteMaterial(same.m, same.poisson, same.strain, same.shape, growth)

    def limit(self, problem: Problem) -> Float64Array | None:
        """Return the limits of `ElasticPrior.limit`."""
        return self.at_rest.limit(problem)

    def force_unit(self, problem: Problem) -> float:
        """Return the force unit of `ElasticPrior.force_unit`."""
        return self.at_rest.force_unit(problem)

    def load(self, problem: Problem) -> Load | None:
        """Return the dead loads, forces that do not depend on the motion; None without any."""
        if problem.loads is None or problem.loads.force is None:
            return None
        return Load(problem.loads.force / np.float64(self.force_unit(problem)), 0.0)

    def energy(self, problem: Problem, displacement: npt.ArrayLike) -> float:
        """Return U, in pixels squared, for a displacement (H, W, 2) in units of ``spacing``.

        U is the energy stored in tissue, less the work of forces.
        """
        d, load = _pixels(problem, displacement), self.load(problem)
        stored = self._elements(problem).energy(d)
        return stored if load is None else stored - float((load.forces * d).sum())

    def forces(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return the gradient of the energy with respect to the displacement in pixels."""
        load = self.load(problem)
        forces = self._elements(problem).forces(_pixels(problem, displacement))
        return forces if load is None else forces - load.forces

    def tangents(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return second derivatives of the energy of each element.

        Returns
        -------
        ndarray, shape (H - 1, W - 1, 6, 6) or (D - 1, H - 1, W - 1, 24, 24)
            With respect to the differences of an element of an image, or to the displacement of
            the eight corners of an element of a volume.
        """
        return self._elements(problem).tangents(_pixels(problem, displacement))

    def corner_jacobians(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return the numbers that bound the Jacobian of each element; 1 in void.

        If all are positive, the element is folded nowhere. They include growth: tissue that has
        grown to twice its size has 2.

        Returns
        -------
        ndarray, shape (4, H - 1, W - 1) or (27, D - 1, H - 1, W - 1)
            Jacobians at the four corners, or Bernstein coefficients in a volume.
        """
        return self._elements(problem).corner_jacobians(_pixels(problem, displacement))

    def _elements(self, problem: Problem) -> FiniteElements | FiniteBricks:
        material, shape = self.material(problem), self.at_rest.shape(problem.spacing)
        if isinstance(shape, BrickShape):
            return FiniteBricks(brick_moduli(material), shape)
        return FiniteElements(material.moduli(), shape)


def _check_growth(problem: Problem) -> None:
    """Refuse growth tensors that shrink tissue to nothing in some direction."""
    growth = None if problem.loads is None else problem.loads.growth
    if growth is None:
        return
    wrong = problem.tissue & ~(grown_sizes(growth, len(problem.shape)) > 0)
    if wrong.any():
        raise ProblemError(
            "growth",
            f"shrinks tissue to nothing in some direction, first at {first_index(wrong)}. Give "
            "tensors whose strain is above -1 in all directions.",
        )


def _pixels(problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
    return np.asarray(displacement, dtype=np.float64) / problem.unit
