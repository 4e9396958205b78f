"""Linear elasticity on the pixel grid: reference energy and forces, in NumPy and float64.

Every 2 x 2 block of tissue sites is an *element*: a clique of four sites within which the
displacement is bilinear. With the mean stiffness of its sites and Poisson's ratio, its energy is

    U = 1/2 integral of  lambda (e_rr + e_cc)^2 + 2 mu (e_rr^2 + e_cc^2) + mu (gamma_rc)^2

The most probable field is therefore the finite-element solution on the mesh of pixels. In a volume,
elements are blocks of 2 x 2 x 2 sites (`priors.hexahedra`), and U includes all six strains.

Growth strain (`priors.growth`) is subtracted from the strain in the energy, and the work of forces
is subtracted from the energy. Both terms are linear in the displacement.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import KW_ONLY, dataclass, replace
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import real
from napari_hmrf.checks import POISSON_RANGE, Choice, Penalty, Poisson, convert
from napari_hmrf.errors import ArgumentError, ProblemError
from napari_hmrf.real_arrays import as_numbers, grid_in_words
from napari_hmrf.solver.data_term import DataTerm
from napari_hmrf.solver.model_names import Plane
from napari_hmrf.solver.priors.elements import (
    ElasticMaterial,
    ElementShape,
    Float64Array,
    Lame,
    differences,
    lame_parameters,
    stiffest,
)
from napari_hmrf.solver.priors.growth import Load, growth_load, slabs
from napari_hmrf.solver.priors.hexahedra import BrickShape, brick_shape
from napari_hmrf.solver.problem import Problem, in_pixels
from napari_hmrf.solver.rigid_modes import check_held
from napari_hmrf.solver.sliding_parts import refuse_sliding

_PLANE = Annotated[Plane, Choice()]

#: Default penalty K (eq. 19) of doubted observations. A force of 1 strains a pixel of the stiffest
#: tissue by 1.
DOUBTED_PENALTY = 1.0


@dataclass(frozen=True, eq=False)
class ElasticPrior:
    """Linear elasticity: plane in an image, and three-dimensional in a volume.

    Parameters
    ----------
    poisson : float or array_like, shape (H, W) or (D, H, W)
        Poisson's ratio of all tissue or of each site, from 0 to 0.499: the amount by which tissue
        bulges when compressed. A ratio of 0.5 would be incompressible; soft tissue has 0.45 to
        0.499. Values in void are ignored.
    plane : {"stress", "strain"}
        ``"stress"`` describes a thin slice that is free to bulge out of the image. ``"strain"``
        describes a slice confined between its neighbours. In plane strain, the twist of an element
        does not count as a change in volume (selective reduced integration), because counting it
        would lock nearly incompressible tissue. Ignored for volumes, which are strained in all
        directions.
    penalty : float, optional
        Strength of observations. By default, it depends on the confidence c: with c = 1, an
        observation is certain and prescribed exactly; with 0 < c < 1 it is doubted and exerts a
        force of at most c per component, where a force of 1 strains a pixel of the stiffest tissue
        by 1. The observation slips where the force would exceed this limit. A number sets
        K of eq. 19 for all observations, including certain ones: each exerts a force of at most
        K c. With ``inf``, every observation with c > 0 is prescribed exactly.
    """

    poisson: float | npt.NDArray[np.float32] = 0.45
    _: KW_ONLY
    plane: Plane = "stress"
    penalty: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "poisson", _checked_poisson(self.poisson))
        convert(_PLANE, self.plane, "plane")
        if self.penalty is not None and real(self.penalty) != math.inf:
            object.__setattr__(self, "penalty", convert(Penalty, self.penalty, "penalty"))

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name (JSON types only); a map of ratios is given by shape and digest."""
        nu: Any = self.poisson
        if isinstance(nu, np.ndarray):
            digest = hashlib.sha256(nu.tobytes()).hexdigest()
            nu = {"shape": list(nu.shape), "sha256": digest}
        penalty: Any = "inf" if self.penalty == math.inf else self.penalty
        return {
            "name": "ElasticPrior",
            "poisson": nu,
            "plane": self.plane,
            "penalty": penalty,
        }

    def __repr__(self) -> str:
        return prior_in_words(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ElasticPrior) and self.parameters == other.parameters

    def __hash__(self) -> int:
        return hash(repr(self.parameters))

    @property
    def kernels(self) -> str:
        """Key of the kernels that this prior uses after `resolved`.

        Maps of Poisson's ratio and observations that may slip require special kernels.
        """
        mapped, slips = isinstance(self.poisson, np.ndarray), self.penalty != math.inf
        return f"elastic{', mapped' * mapped}{', slipping' * slips}"

    def rehearsal(self, shape: tuple[int, ...]) -> ElasticPrior:
        """Return a prior that uses the same kernels, for a small problem of the given shape."""
        mapped, slips = isinstance(self.poisson, np.ndarray), self.penalty != math.inf
        poisson = np.full(shape, 0.45, np.float32) if mapped else 0.45
        return ElasticPrior(poisson, plane=self.plane, penalty=1.0 if slips else math.inf)

    def resolved(self, problem: Problem) -> ElasticPrior:
        """Check that the problem has a unique solution, and return the prior for this problem.

        A penalty of None becomes ``inf`` if the observations of this problem cannot slip.

        Raises
        ------
        ProblemError
            If a piece of tissue could move freely.
        """
        if isinstance(self.poisson, np.ndarray):
            _check_poisson_map(self.poisson, problem)
        check_held(problem)
        return self.in_force(problem)

    def in_force(self, problem: Problem) -> ElasticPrior:
        """Return the prior with an infinite penalty if the problem's observations cannot slip."""
        return self if self.can_slip(problem) else replace(self, penalty=math.inf)

    def can_slip(self, problem: Problem) -> bool:
        """Return whether any observation of the problem may slip."""
        if self.penalty is not None:
            return self.penalty < math.inf
        return bool((problem.known_confidence < 1).any())

    def limit(self, problem: Problem) -> Float64Array | None:
        """Return the force limits P, (H, W, 2), or None if observations cannot slip.

        P is infinite for components that are prescribed exactly.
        """
        if not self.can_slip(problem):
            return None
        c = problem.confidence.astype(np.float64)
        if self.penalty is None:
            return np.where(c < 1, DOUBTED_PENALTY * c, math.inf)
        limit: Float64Array = self.penalty * c
        return limit

    def material(self, problem: Problem) -> ElasticMaterial:
        """Return the properties of a problem's tissue that the kernels require."""
        shape = self.shape(problem.spacing)
        unit = self.force_unit(problem) / problem.unit
        return ElasticMaterial(
            problem.stiffness,
            self.poisson,
            self._strain(problem),
            shape,
            DataTerm.of(problem, unit),
            problem.coupling,
            unit,
        )

    def _strain(self, problem: Problem) -> bool:
        """Return True in plane strain and in volumes, where tissue cannot bulge out of the grid."""
        return self.plane == "strain" or problem.stiffness.ndim == 3

    def lame(self, problem: Problem, sites: slice = slice(None)) -> Lame:
        """Return Lame parameters of elements from the means of their sites.

        The parameters are 0 for elements with void or rigid sites. If `sites` is given, only the
        elements between this range of sites along the first axis are included.
        """
        m = problem.stiffness[sites] / np.float64(stiffest(problem.stiffness))
        nu = self.poisson if isinstance(self.poisson, float) else self.poisson[sites]
        if problem.has_rigid:
            # Rigid tissue does not stretch, so its elastic energy is zero, as in void.
            m = np.where(np.isinf(m), 0.0, m)
        return lame_parameters(m, nu, self._strain(problem))

    def shape(self, spacing: tuple[float, ...]) -> ElementShape | BrickShape:
        """Return the constants of an element for a pixel size; only the aspect ratio matters."""
        if len(spacing) == 3:
            return brick_shape(spacing)
        row, col = spacing
        volume = 1.0 if self.plane == "stress" else 0.0
        return ElementShape(
            col / row / 4, row / col / 4, 0.25, col / row / 12, row / col / 12, volume
        )

    def force_unit(self, problem: Problem) -> float:
        """Return the force that strains a pixel of the stiffest tissue by 1, in `Loads` units."""
        return stiffest(problem.stiffness) * problem.unit ** (len(problem.shape) - 1)

    def load(self, problem: Problem) -> Load | None:
        """Return the contribution of a problem's loads to its energy, or None if there are none."""
        loads, grid = problem.loads, problem.shape
        if loads is None or (loads.growth is None and loads.force is None):
            return None
        load = Load(np.zeros((*grid, len(grid))), 0.0)
        if loads.growth is not None:
            sides, across = self.shape(problem.spacing).sides, self.plane == "strain"

            def lame_of(sites: slice) -> Lame:
                return self.lame(problem, sites)

            load = growth_load(loads.growth, grid, sides, lame_of, across and len(grid) == 2)
        if loads.force is not None:
            np.add(load.forces, loads.force / self.force_unit(problem), out=load.forces)
        return load

    def energy(self, problem: Problem, displacement: npt.ArrayLike) -> float:
        """Return U, in pixels squared, for a displacement (H, W, 2) in units of ``spacing``.

        U is the elastic energy minus the work of forces.
        """
        d = in_pixels(problem, displacement)
        refuse_sliding(problem.sliding, "the energy of one displacement")
        stored, load = self._stored(problem, d), self.load(problem)
        return stored if load is None else stored + load.energy - float((load.forces * d).sum())

    def _stored(self, problem: Problem, d: Float64Array) -> float:
        """Return the energy of a displacement in pixels, without loads."""
        (first, shear), k = self.lame(problem), self.shape(problem.spacing)
        if isinstance(k, BrickShape):
            return k.energy(Lame(first, shear), d)
        (rr, rc), (cr, cc), (xr, xc) = differences(d)
        stretch = k.rows * rr**2 + k.cols * cc**2
        volume = first * (stretch + 2 * k.mixed * rr * cc)
        strain = 2 * shear * stretch
        slide = shear * (k.cols * cr**2 + k.rows * rc**2 + 2 * k.mixed * cr * rc)
        own = k.twist_volume * first + 2 * shear
        twist = (k.twist_rows * own + k.twist_cols * shear) * xr**2
        twist += (k.twist_cols * own + k.twist_rows * shear) * xc**2
        return float((volume + strain + slide + twist).sum() / 2)

    def forces(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return the gradient of the energy with respect to the displacement in pixels, (H, W, 2).

        The gradient consists of the internal forces of the tissue minus the forces of the loads.
        """
        d = in_pixels(problem, displacement)
        refuse_sliding(problem.sliding, "the force of one displacement")
        shape, load, forces = self.shape(problem.spacing), self.load(problem), np.zeros(d.shape)
        for sites in slabs(problem.shape):
            forces[sites] += shape.forces(self.lame(problem, sites), d[sites])
        return forces if load is None else forces - load.forces


def _checked_poisson(value: Any) -> float | npt.NDArray[np.float32]:
    """Return Poisson's ratio as a float, or as a read-only copy of an array."""
    given = as_numbers("poisson", value)
    if given.ndim == 0:
        return float(convert(Poisson, given, "poisson"))
    with np.errstate(over="ignore"):  # values that overflow are refused as out of range
        poisson = np.array(given, dtype=np.float32, order="C")
    if poisson.ndim not in (2, 3):
        raise ArgumentError(
            "poisson must be a number or an array of shape (H, W) or (D, H, W), not an array of "
            f"shape {poisson.shape}"
        )
    poisson.setflags(write=False)
    return poisson


def _check_poisson_map(poisson: npt.NDArray[np.float32], problem: Problem) -> None:
    if poisson.shape != problem.shape:
        raise ProblemError(
            "poisson",
            f"has shape {poisson.shape}, but stiffness has shape {problem.shape}. Use the "
            "same pixel grid for both.",
        )
    low, high = (np.float32(bound) for bound in POISSON_RANGE)
    wrong = problem.tissue & ~((poisson >= low) & (poisson <= high))
    if wrong.any():
        first = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise ProblemError(
            "poisson",
            f"has {int(wrong.sum())} values outside {POISSON_RANGE[0]} to {POISSON_RANGE[1]} in "
            f"tissue, the first at {first}. Soft tissue has ratios of 0.45 to 0.499.",
        )


def prior_in_words(prior: Any) -> str:
    """Return a one-line description of an elastic prior, with the size of any map of ratios."""
    nu = prior.poisson
    ratio = f"map of {grid_in_words(nu.shape)}" if isinstance(nu, np.ndarray) else f"{nu}"
    name = type(prior).__name__
    return f"{name}(poisson={ratio}, plane={prior.plane!r}, penalty={prior.penalty})"
