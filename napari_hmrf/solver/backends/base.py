"""Protocol of a backend: the fields on its device, and the kernels that run on them.

The kernels are pure functions from a site to its new value, of the same name and meaning on every
backend; `solver.priors` defines them. All lengths are in pixels (``Problem.unit``), all values are
float32. Displacement is zero in void, and stays so. A backend is used by one thread only, the
compute thread.
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

#: Called by a backend at least every `BATCH_SECONDS`; raises to stop the work.
Checkpoint = Callable[[], None]

#: Longest time, in seconds, that a backend computes between two checks for a cancellation.
BATCH_SECONDS = 0.05


class Field(Protocol):
    """Values on the sites of one level, kept on the backend's device."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The level's grid, (H, W) or (D, H, W)."""
        ...


FieldType = TypeVar("FieldType", bound=Field)


@dataclass(frozen=True)
class SiteRule:
    """Rule by which a site moves, given its neighbours.

    Attributes
    ----------
    blanket : bool
        Whether the cliques count that contain the site as an end, too.
    relaxation : float
        The damping: the parabola is taken 1/relaxation times as steep and its lowest point that
        fraction of the way from where the site is.
    steps : tuple of float
        The candidate set Gamma: ``{0} and {-e, 0, e} x {-e, 0, e}`` for each step e, in pixels;
        in volumes of three components. Empty: the exact minimiser in closed form.
    weights : ndarray, shape (4, 2) or (13, 3)
        Weight of each line of cliques, for each component: `priors.line_weights`.
    """

    blanket: bool
    relaxation: float
    steps: tuple[float, ...]
    weights: npt.NDArray[np.float64]


class Backend(Protocol[FieldType]):
    """Kernels on one device. The layouts are those of the arrays `upload` takes."""

    #: "cpu", "opengl:fragment" or "opengl:compute".
    name: str
    #: Device in words: the processor with its loops, or the renderer string of OpenGL.
    renderer: str

    def supports(self, job: SolveJob) -> str | None:
        """Return None if the backend can solve a job, else the reason as a sentence."""
        ...

    def upload(self, values: FloatArray) -> FieldType:
        """Bring values to the device.

        Parameters
        ----------
        values : ndarray, shape (H, W, C) or (D, H, W, C)
            C = 2: displacement (row, col), or stiffness (m, 1/m with 0 in void).
            C = 4: observation (y_row, y_col, p_row, p_col) with p = K c, eq. 19.
            In a volume displacement has three, and observation six.
        """
        ...

    def download(self, field: FieldType) -> FloatArray:
        """Bring a field back, shape (H, W, C) or (D, H, W, C)."""
        ...

    def zeros(self, level: Level) -> FieldType:
        """Return a displacement of zero on every site of a level."""
        ...

    def project(self, finest: FieldType, level: Level) -> FieldType:
        """Project a field of level 0 to a coarser level by nearest neighbour (lines 4 to 6)."""
        ...

    def prolong(
        self, coarse: FieldType, coarse_stiffness: FieldType, stiffness: FieldType
    ) -> FieldType:
        """Project displacement one level down by linear interpolation (line 3).

        A site takes 3/4 and 1/4 of the two nearest coarse sites along each axis, the border
        repeated. Coarse sites in void have no displacement and no weight; a site with no tissue
        around it, or in void itself, gets zero.
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
        """Move all sites at once, `sweeps` times (lines 8 and 9); consumes `displacement`.

        Returns
        -------
        field
            The displacement after the last sweep.
        ndarray, shape (sweeps,)
            U_total before each sweep, in pixels squared.
        """
        ...

    def energy(
        self, displacement: FieldType, stiffness: FieldType, observation: FieldType, rule: SiteRule
    ) -> float:
        """Return U_total of a displacement, in pixels squared."""
        ...

    def elastic_model(self, material: ElasticMaterial) -> LinearModel:
        """Bring elastic tissue to the device, on all levels of multigrid."""
        ...

    def seiler_model(self, material: SeilerMaterial) -> LinearModel:
        """Bring the paper's cliques to the device, on all levels of multigrid."""
        ...

    def finite_model(self, material: FiniteMaterial) -> FiniteModel:
        """Bring tissue that moves far to the device; the processor's backend alone takes it."""
        ...

    def release(self, *fields: FieldType) -> None:
        """Free fields; a released field must not be used again."""
        ...

    def close(self) -> None:
        """Free everything that is left."""
        ...
