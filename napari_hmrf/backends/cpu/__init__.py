"""Kernels as loops compiled for the processor: the backend of machines without a GPU."""

from __future__ import annotations

import platform
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends.base import Checkpoint, EnergyArray, FloatArray, SiteRule
from napari_hmrf.hierarchy import Level, nearest_pixels


@dataclass(frozen=True, eq=False)
class CpuField:
    """Planes of float32, (C, H + 4, W + 4), in a ring of zeros."""

    planes: FloatArray

    @property
    def shape(self) -> tuple[int, ...]:
        """The level's grid, (H, W)."""
        _, height, width = self.planes.shape
        return height - 4, width - 4

    @property
    def inside(self) -> FloatArray:
        """The planes without the ring, a view of shape (C, H, W)."""
        return self.planes[:, 2:-2, 2:-2]


class CpuBackend:
    """The compiled loops, one thread per core.

    Parameters
    ----------
    checkpoint : callable
        Called between sweeps; raises to stop the work.
    """

    name = "cpu"

    def __init__(self, checkpoint: Checkpoint) -> None:
        # Numba is imported, and its kernels loaded, only by a solve that uses them.
        import numba

        from napari_hmrf.backends.cpu import kernels

        self._kernels = kernels
        self._checkpoint = checkpoint
        threads = numba.get_num_threads()
        self.renderer = f"compiled loops on {platform.machine()}, {threads} threads"

    def upload(self, values: FloatArray) -> CpuField:
        """Pad values of shape (H, W, C) by void."""
        field = CpuField(self._kernels.padded(values.shape[-1], values.shape[:-1]))
        field.inside[...] = np.moveaxis(values, -1, 0)
        return field

    def download(self, field: CpuField) -> FloatArray:
        """Return the values, (H, W, C)."""
        return np.ascontiguousarray(np.moveaxis(field.inside, 0, -1))

    def zeros(self, level: Level) -> CpuField:
        """Return a displacement of zero."""
        return CpuField(self._kernels.padded(2, level.shape))

    def project(self, finest: CpuField, level: Level) -> CpuField:
        """Project by nearest neighbour from level 0."""
        planes = range(len(finest.planes))
        field = CpuField(self._kernels.padded(len(planes), level.shape))
        field.inside[...] = finest.inside[np.ix_(planes, *nearest_pixels(level, finest.shape))]
        return field

    def prolong(
        self, coarse: CpuField, coarse_stiffness: CpuField, stiffness: CpuField
    ) -> CpuField:
        """Project displacement one level down, linearly."""
        field = CpuField(self._kernels.padded(2, stiffness.shape))
        self._kernels.prolong(
            coarse.planes, coarse_stiffness.planes, field.planes, stiffness.planes
        )
        return field

    def relax(
        self,
        displacement: CpuField,
        stiffness: CpuField,
        observation: CpuField,
        rule: SiteRule,
        sweeps: int,
    ) -> tuple[CpuField, EnergyArray]:
        """Move all sites at once, `sweeps` times."""
        kernel = self._kernels.icm_blanket if rule.blanket else self._kernels.icm_centred
        steps = tuple(np.float32(step) for step in rule.steps) or None
        weights = rule.weights.astype(np.float32)
        source, target = displacement.planes, np.zeros_like(displacement.planes)
        share, row_totals = _scratch(displacement.shape)
        energies = np.empty(sweeps)
        for sweep in range(sweeps):
            self._checkpoint()
            kernel(
                source,
                target,
                stiffness.planes,
                observation.planes,
                weights,
                steps,
                np.float32(rule.relaxation),
                share,
                row_totals,
            )
            energies[sweep] = row_totals.sum()
            source, target = target, source
        return CpuField(source), energies

    def energy(
        self, displacement: CpuField, stiffness: CpuField, observation: CpuField, rule: SiteRule
    ) -> float:
        """U_total."""
        share, row_totals = _scratch(displacement.shape)
        self._kernels.energy(
            displacement.planes,
            stiffness.planes,
            observation.planes,
            rule.weights.astype(np.float32),
            share,
            row_totals,
        )
        return float(row_totals.sum())

    def release(self, *fields: CpuField) -> None:
        """Nothing to do: memory goes with the last reference."""

    def close(self) -> None:
        """Nothing to do."""


def _scratch(shape: tuple[int, ...]) -> tuple[FloatArray, npt.NDArray[np.float64]]:
    """A plane for each site's share of the energy, and float64 totals of its rows."""
    return np.empty(shape, dtype=np.float32), np.empty(shape[0], dtype=np.float64)
