"""Contents of the cavity that remains where tissue is removed, which load its surface."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from napari_hmrf.checks import NotNegative, Number, checked
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.body_forces import cavity
from napari_hmrf.solver.loads import Loads


@checked
class Cavity:
    """Load on the surface of the cavity that remains where tissue is removed.

    The pressure and the fluid act together, on the faces between removed and remaining tissue; by
    default nothing acts on these faces.

    Attributes
    ----------
    pressure : float
        Constant pressure in the cavity, in the unit of stiffness; negative values are suction.
    fluid : float
        Weight of the fluid per volume, which is its density times the acceleration due to gravity,
        in the unit of stiffness per length; for water, 0.00981 kPa / mm. 0 if there is no fluid.
        The direction of gravity is that of the weight in `Motion`.
    level : float
        Height of the fluid's surface, as a fraction of the height of the cavity: 0 is the lowest
        pixel of its surface, 1 the highest. Above 1, the fluid stands above the cavity.

    Raises
    ------
    ArgumentError
        If a value is invalid; the message states valid values.
    """

    pressure: Number = 0.0
    fluid: NotNegative = 0.0
    level: NotNegative = 1.0

    @property
    def acts(self) -> bool:
        """True if a pressure or a fluid acts on the surface."""
        return bool(self.pressure or (self.fluid and self.level))

    def loads(
        self,
        stiffness: npt.NDArray[np.float32],
        removed: npt.NDArray[np.bool_],
        weight: Sequence[float],
        *,
        spacing: Sequence[float],
    ) -> Loads:
        """Return the loads on the surface of a cavity.

        Parameters
        ----------
        stiffness : ndarray, shape ([D,] H, W)
            Stiffness of the remaining tissue; 0 elsewhere.
        removed : ndarray of bool, shape ([D,] H, W)
            Mask of the removed tissue.
        weight : sequence of float
            Weight of the tissue per volume along each axis, which points downwards; empty if there
            is no gravity.
        spacing : sequence of float, shape (n,)
            Size of a pixel along each axis.

        Raises
        ------
        ProblemError
            If there is a fluid, but no direction of gravity.
        """
        fluid = None
        if self.fluid and self.level:
            heaviness = math.hypot(*weight)
            if heaviness == 0:
                raise ProblemError(
                    "cavity",
                    "has a fluid, but no direction of gravity is set. Set the weight of the tissue "
                    "(`weight=...`), or remove the fluid.",
                )
            fluid = [self.fluid * part / heaviness for part in weight]
        return cavity(
            stiffness,
            removed,
            spacing=spacing,
            pressure=self.pressure,
            fluid=fluid,
            level=self.level,
        )
