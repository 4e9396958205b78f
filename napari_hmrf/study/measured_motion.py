"""Measured motion of a study: displacements with a precision at each site, as of a registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_float32, check_finite

FloatArray = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Measured displacements, with a precision at each site.

    Tissue follows the measurement as far as its stiffness and the other motion of the study allow.
    Unlike `Motion.observed`, a measurement never holds tissue exactly.

    Attributes
    ----------
    displacement : ndarray, shape ([D,] H, W, n), float32
        Measured material displacement y, in the order of the axes and in the unit of the grid.
    precision : ndarray, shape ([D,] H, W, n, n), float32
        Precision W of the displacement, relative to the typical stiffness of the tissue: the energy
        ``1/2 (d - y)^T W (d - y)`` is added to that of tissue of stiffness 1. Unit as for a
        `Problem`.
    record : mapping
        Origin of the measurement, in JSON types, such as the name of the second image.
    missing : ndarray of bool, shape ([D,] H, W), optional
        Mask of the tissue without counterpart in the second image, which has no effect.
    frees_edge : bool
        True if the measurement took the place of a held outer edge, which is held again once the
        measurement is removed; see `Motion.unmeasured`.

    Raises
    ------
    ProblemError
        If the shapes do not match, or a value is not finite.
    """

    displacement: FloatArray
    precision: FloatArray
    record: Mapping[str, Any] = field(default_factory=dict)
    missing: BoolArray | None = None
    frees_edge: bool = False

    def __post_init__(self) -> None:
        for name in ("displacement", "precision"):
            array = as_float32(f"measured {name}", getattr(self, name))
            check_finite(f"measured {name}", array)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        axes = self.displacement.shape[-1] if self.displacement.ndim else 0
        needed = (*self.displacement.shape, axes)
        if self.displacement.ndim != axes + 1 or self.precision.shape != needed:
            raise ProblemError(
                "measured motion",
                f"has displacements of shape {self.displacement.shape} and a precision of shape "
                f"{self.precision.shape}. Pass shapes ([D,] H, W, n) and ([D,] H, W, n, n).",
            )

        if self.missing is not None and self.missing.shape != self.displacement.shape[:-1]:
            raise ProblemError(
                "measured motion",
                f"has missing tissue of shape {self.missing.shape}, but displacements of shape "
                f"{self.displacement.shape}. Pass a mask of the shape ([D,] H, W).",
            )

    def __repr__(self) -> str:
        sites = int(np.count_nonzero(self.sites))
        return f"MeasuredMotion({sites:,} sites)"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the displacement."""
        return self.displacement.shape

    @property
    def is_of_images(self) -> bool:
        """True if the motion is that of a registration of two images."""
        return "similarity" in self.record

    @cached_property
    def sites(self) -> npt.NDArray[np.bool_]:
        """Mask of the sites with a measurement, shape ([D,] H, W)."""
        return np.asarray(self.precision.any(axis=(-2, -1)))
