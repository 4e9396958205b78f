"""Protocol of a backend: the fields on its device, and the kernels that process these fields.

A kernel is a pure function from a site to its new value. It has the same name and meaning on every
backend; `solver.priors` defines it. All lengths are in pixels (``Problem.unit``), and all values
are float32. The displacement is zero in void. Only the compute thread uses a backend.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.backends.linear import LinearModel
from napari_hmrf.solver.priors.cliques import SeilerMaterial
from napari_hmrf.solver.priors.elements import ElasticMaterial
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial
from napari_hmrf.solver.quadtree import Level

FloatArray = npt.NDArray[np.float32]
EnergyArray = npt.NDArray[np.float64]

#: Callback that a backend calls at least every `BATCH_SECONDS`; raises an exception to cancel.
Checkpoint = Callable[[], None]

#: Longest time, in seconds, that a backend computes between two checks for cancellation.
BATCH_SECONDS = 0.05


class Field(Protocol):
    """Values on the sites of one level, stored on the device of a backend."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Grid of the level, (H, W) or (D, H, W)."""
        ...


FieldType = TypeVar("FieldType", bound=Field)


@dataclass(frozen=True)
class SiteRule:
    """Update rule of a site, given its neighbours.

    Attributes
    ----------
    blanket : bool
        True if the local energy also includes the cliques with the site at one end.
    relaxation : float
        Damping g in (0, 1]. The curvature of the local energy is divided by g, so a site without an
        observation moves by g times its distance from the minimum.
    steps : tuple of float
        Step sizes e, in pixels, of the candidate set Gamma: a site may stay, or each component may
        change by -e, 0 or e. If empty, a site moves to the exact minimizer in closed form.
    weights : ndarray, shape (4, 2) or (13, 3)
        Weight of each line of cliques for each component, as returned by `priors.line_weights`.
    """

    blanket: bool
    relaxation: float
    steps: tuple[float, ...]
    weights: npt.NDArray[np.float64]


class Backend(Protocol[FieldType]):
    """Kernels on one device. Fields have the layout of the arrays that `upload` accepts."""

    #: "cpu", "opengl:fragment" or "opengl:compute".
    name: str
    #: Description of the device: the processor, or the renderer string of OpenGL.
    renderer: str

    def supports(self, job: SolveJob) -> str | None:
        """Return the reason, as a sentence, why the backend cannot solve a job, or None."""
        ...

    def upload(self, values: FloatArray) -> FieldType:
        """Copy values to the device.

        Parameters
        ----------
        values : ndarray, shape (H, W, C) or (D, H, W, C)
            In an image, C = 2 for displacement (row, col) and for stiffness (m, 1/m, and 0 in
            void), and C = 4 for observation (y_row, y_col, p_row, p_col) with p = K c, eq. 19. In a
            volume, C = 3 for displacement, and C = 6 for observation.
        """
        ...

    def download(self, field: FieldType) -> FloatArray:
        """Copy a field to the host, shape (H, W, C) or (D, H, W, C)."""
        ...

    def zeros(self, level: Level) -> FieldType:
        """Return a displacement field of zeros on a level."""
        ...

    def project(self, finest: FieldType, level: Level) -> FieldType:
        """Project a field of level 0 to a coarser level by nearest neighbour.

        These are lines 4 to 6 of Alg. 3.7.

        Parameters
        ----------
        finest : field
            Stiffness or observation on level 0.
        level : Level
            Target level.
        """
        ...

    def prolong(
        self, coarse: FieldType, coarse_stiffness: FieldType, stiffness: FieldType
    ) -> FieldType:
        """Interpolate displacement linearly to the next finer level (Alg. 3.7, line 3).

        Along each axis, the two nearest coarse sites have the weights 3/4 and 1/4; the grid is
        extended by repeating its border sites. Coarse sites in void have weight 0, and the other
        weights are scaled to a sum of 1. The displacement is zero at a fine site in void, or
        without a coarse neighbour in tissue.

        Parameters
        ----------
        coarse : field
            Displacement on the coarser level, in pixels.
        coarse_stiffness, stiffness : field
            Stiffness on the coarser and on the finer level.
        """
        ...

    def relax(
        self,
        displacement: FieldType,
        stiffness: FieldType,
        observation: FieldType,
        rule: SiteRule,
        sweeps: int,
    ) -> tuple[FieldType, EnergyArray]:
        """Update all sites simultaneously, `sweeps` times (Alg. 3.7, lines 8 and 9).

        Parameters
        ----------
        displacement : field
            Displacement, in pixels; the call releases this field.
        stiffness, observation : field
            Stiffness and observation on the same level; see `upload`.
        rule : SiteRule
        sweeps : int
            Number of sweeps.

        Returns
        -------
        field
            Displacement after the last sweep, in pixels.
        ndarray, shape (sweeps,)
            U_total before each sweep, in pixels squared.
        """
        ...

    def energy(
        self, displacement: FieldType, stiffness: FieldType, observation: FieldType, rule: SiteRule
    ) -> float:
        """Return U_total of a displacement, in pixels squared; arguments as for `relax`."""
        ...

    def elastic_model(self, material: ElasticMaterial) -> LinearModel:
        """Build the model of elastic tissue on the device, with all multigrid levels."""
        ...

    def seiler_model(self, material: SeilerMaterial) -> LinearModel:
        """Build the model of the paper's cliques on the device, with all multigrid levels."""
        ...

    def finite_model(self, material: FiniteMaterial) -> FiniteModel:
        """Build the model of large motion; only the CPU backend supports it."""
        ...

    def release(self, *fields: FieldType) -> None:
        """Release fields; the caller must not use them again."""
        ...

    def close(self) -> None:
        """Release all resources of the backend."""
        ...
