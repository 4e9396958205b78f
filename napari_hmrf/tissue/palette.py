"""The tissues that can be painted, and what tissue becomes where they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.tissue.boundary_rules import (
    Material,
    default_rigid,
    poisson_image,
    stiffness_image,
)
from napari_hmrf.tissue.material_presets import PRESETS, Preset

FloatArray = npt.NDArray[np.float32]

#: The label of what has a stiffness, but no row in the table.
OTHER = -1
_VOID = Material(0, "no tissue", 0.0)


@dataclass(frozen=True)
class Palette:
    """Tissues to paint with.

    Attributes
    ----------
    materials : tuple of Material
        One for each label.
    unit : str
        Of their stiffness; may be "".
    one : float
        The stiffness that counts as 1 on the ground that is painted on.
    own : bool
        Whether it is the tissue layer's own table, and not a preset.
    """

    materials: tuple[Material, ...]
    unit: str = ""
    one: float = 1.0
    own: bool = False

    @classmethod
    def of_preset(cls, preset: Preset | None = None, relative: bool = True) -> Palette:
        """The tissues of a preset, the void, and what is rigid.

        Parameters
        ----------
        preset : Preset, optional
            By default the first.
        relative : bool
            Whether the first of them counts as 1, as what is not painted does.
        """
        preset = preset or PRESETS[0]
        listed = {row.label for row in preset.materials}
        rows = (*([] if 0 in listed else [_VOID]), *preset.materials)
        first = next(row.stiffness for row in rows if row.is_deformable)
        rigid = default_rigid(max(row.label for row in rows) + 1)
        return cls((*rows, rigid), preset.unit, first if relative else 1.0)

    @property
    def usual(self) -> int:
        """The label of what is not painted, where there is no table."""
        return next(row.label for row in self.materials if row.is_deformable)

    def painted(
        self, labels: npt.NDArray[Any], before: npt.NDArray[Any], m: FloatArray, prior: Prior
    ) -> tuple[FloatArray, Prior]:
        """Stiffness and energy where some tissue has become another.

        Parameters
        ----------
        labels, before : ndarray of int, shape (H, W)
            As painted, and as they were.
        m : ndarray, shape (H, W), float32
            Stiffness as it was.
        prior : Prior
            With Poisson's ratios as they were.
        """
        changed = labels != before
        if not changed.any():
            return m, prior
        now = labels[changed][None]
        m = m.copy()
        m[changed] = stiffness_image(now, self.materials)[0] / np.float32(self.one)
        if isinstance(prior, ElasticPrior):
            ratios = np.broadcast_to(np.asarray(prior.poisson, dtype=np.float32), m.shape).copy()
            ratios[changed] = np.broadcast_to(poisson_image(now, self.materials), now.shape)[0]
            same = np.unique(ratios[(m > 0) & np.isfinite(m)])
            prior = replace(prior, poisson=float(same[0]) if len(same) == 1 else ratios)
        return m, prior
