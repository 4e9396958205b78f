"""CPU backend: kernels as loops compiled for the processor."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loader
from napari_hmrf.solver.backends.base import (
    BATCH_SECONDS,
    Checkpoint,
    EnergyArray,
    FloatArray,
    SiteRule,
)
from napari_hmrf.solver.backends.finite import FiniteModel
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.backends.linear import LinearModel
from napari_hmrf.solver.priors import line_weights
from napari_hmrf.solver.priors.cliques import SeilerMaterial
from napari_hmrf.solver.priors.elements import ElasticMaterial
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial
from napari_hmrf.solver.quadtree import Level, nearest_pixels

# Upper bounds on the time per site in seconds, by number of axes; they determine the batch size.
# Measured on two cores: 1.5 to 4 ns in images, and 10 to 20 ns in volumes.
_SLOWEST_SITE_SECONDS = {2: 10e-9, 3: 50e-9}
# Levels with fewer sites than this are swept by a single thread.
_SMALL = 2000


@dataclass(frozen=True, eq=False)
class CpuField:
    """Field stored as float32 planes with a border of zeros, two sites wide.

    Attributes
    ----------
    planes : ndarray, shape (C, H + 4, W + 4) or (C, D + 4, H + 4, W + 4)
        Values with the component as the first axis, including the border.
    """

    planes: FloatArray

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid, (H, W) or (D, H, W)."""
        return tuple(size - 4 for size in self.planes.shape[1:])

    @property
    def inside(self) -> FloatArray:
        """View of the planes without the border, shape (C, H, W) or (C, D, H, W)."""
        return self.planes[(slice(None), *[slice(2, -2)] * len(self.shape))]

    @property
    def rows(self) -> FloatArray:
        """View of the planes with shape (C, R, W + 4); R counts the padded rows of all slices."""
        return self.planes.reshape(len(self.planes), -1, self.planes.shape[-1])

    @cached_property
    def spans(self) -> npt.NDArray[np.int64]:
        """Start and stop column of the tissue in each row of a stiffness field, shape (R - 4, 2).

        Kernels skip the sites outside these spans because they never move. In an image of a head,
        for example, a third of the sites are air.
        """
        tissue = self.rows[0, 2:-2, 2:-2] > 0
        first = tissue.argmax(axis=1)
        past = tissue.shape[1] - tissue[:, ::-1].argmax(axis=1)
        return np.stack([first, np.where(tissue.any(axis=1), past, first)], axis=1)


class CpuBackend:
    """Backend that runs compiled loops, with one thread per core.

    Parameters
    ----------
    checkpoint : callable
        Function called between sweeps; it raises an exception to cancel the work.
    """

    name = "cpu"

    def __init__(self, checkpoint: Checkpoint) -> None:
        loader.before_numba()
        import numba  # heavy: numba

        from napari_hmrf.solver.backends.cpu import kernels, transfer  # heavy: numba

        self._kernels = kernels
        self._transfer = transfer
        self._checkpoint = checkpoint
        self._numba = numba
        self._threads = threads = numba.get_num_threads()
        # Scratch arrays of the previous sweeps, reused by the next sweeps on the same level.
        self._scratch_arrays: tuple[CpuField, FloatArray, FloatArray] | None = None
        self.renderer = f"compiled loops on {platform.machine()}, {threads} threads"

    def supports(self, job: SolveJob) -> str | None:
        """Return None, because the loops support every job."""
        return None

    def upload(self, values: FloatArray) -> CpuField:
        """Return a field that contains values of shape (H, W, C) or (D, H, W, C)."""
        field = CpuField(self._transfer.padded(values.shape[-1], values.shape[:-1]))
        field.inside[...] = np.moveaxis(values, -1, 0)
        return field

    def download(self, field: CpuField) -> FloatArray:
        """Return the values of a field as an array of shape (H, W, C) or (D, H, W, C)."""
        return np.ascontiguousarray(np.moveaxis(field.inside, 0, -1))

    def zeros(self, level: Level) -> CpuField:
        """Return a zero displacement field on a level."""
        return CpuField(self._transfer.padded(len(level.shape), level.shape))

    def project(self, finest: CpuField, level: Level) -> CpuField:
        """Sample a field of level 0 on a coarser level by nearest neighbour."""
        field = CpuField(self._transfer.padded(len(finest.planes), level.shape))
        values = finest.inside
        for axis, pixels in enumerate(nearest_pixels(level, finest.shape)):
            values = values.take(pixels, axis=1 + axis)
        field.inside[...] = values
        return field

    def prolong(
        self, coarse: CpuField, coarse_stiffness: CpuField, stiffness: CpuField
    ) -> CpuField:
        """Interpolate a displacement linearly to the next finer level."""
        axes = len(stiffness.shape)
        field = CpuField(self._transfer.padded(axes, stiffness.shape))
        prolong = self._transfer.prolong if axes == 2 else self._transfer.prolong_volume
        prolong(coarse.planes, coarse_stiffness.planes, field.planes, stiffness.planes)
        return field

    def relax(
        self,
        displacement: CpuField,
        stiffness: CpuField,
        observation: CpuField,
        rule: SiteRule,
        sweeps: int,
    ) -> tuple[CpuField, EnergyArray]:
        """Update all sites simultaneously, `sweeps` times; see `Backend.relax`."""
        even, (odd, share) = displacement.planes, self._scratch(stiffness)
        row_totals = np.empty((sweeps, len(stiffness.spans)))
        sites = math.prod(displacement.shape)
        # On a small level, waking the other threads would take longer than the sweep itself.
        self._numba.set_num_threads(1 if sites < _SMALL else self._threads)
        a_site = _SLOWEST_SITE_SECONDS[len(displacement.shape)]
        batch = max(1, int(BATCH_SECONDS / (a_site * sites)))
        for start in range(0, sweeps, batch):
            self._checkpoint()
            totals = row_totals[start : start + batch]
            self._sweep(even, odd, stiffness, observation, rule, share, totals)
            if len(totals) % 2 == 1:
                even, odd = odd, even
        self._scratch_arrays = (stiffness, odd, share)
        return CpuField(even), row_totals.sum(axis=1)

    def energy(
        self, displacement: CpuField, stiffness: CpuField, observation: CpuField, rule: SiteRule
    ) -> float:
        """Return U_total of a displacement, in pixels squared."""
        totals, (odd, share) = np.empty((1, len(stiffness.spans))), self._scratch(stiffness)
        self._sweep(displacement.planes, odd, stiffness, observation, rule, share, totals)
        return float(totals.sum())

    def _sweep(
        self,
        even: FloatArray,
        odd: FloatArray,
        stiffness: CpuField,
        observation: CpuField,
        rule: SiteRule,
        share: FloatArray,
        row_totals: EnergyArray,
    ) -> None:
        """Run one sweep per row of `row_totals`; `even` and `odd` alternate as the output."""
        if len(stiffness.shape) == 3:
            self._sweep_volume(even, odd, stiffness, observation, rule, row_totals)
            return
        self._kernels.sweeps.in_turns(
            len(row_totals),
            even,
            odd,
            stiffness.planes,
            observation.planes,
            stiffness.spans,
            _weights(rule),
            rule.blanket or None,
            tuple(np.float32(step) for step in rule.steps) or None,
            np.float32(rule.relaxation),
            share,
            row_totals,
        )

    def _sweep_volume(
        self,
        even: FloatArray,
        odd: FloatArray,
        stiffness: CpuField,
        observation: CpuField,
        rule: SiteRule,
        row_totals: EnergyArray,
    ) -> None:
        from napari_hmrf.solver.backends.cpu import volume_cliques  # heavy: numba

        volume_cliques.sweeps.in_turns(
            len(row_totals),
            CpuField(even).rows,
            CpuField(odd).rows,
            stiffness.rows,
            observation.rows,
            stiffness.spans,
            rule.weights.astype(np.float32),
            volume_cliques.offsets(stiffness.shape),
            np.array(rule.steps, dtype=np.float32),
            np.float32(rule.relaxation),
            row_totals,
        )

    def elastic_model(self, material: ElasticMaterial) -> LinearModel:
        """Return the model of elastic tissue with all its levels."""
        if material.coupling is not None:
            from napari_hmrf.solver.backends.cpu import sliding_model  # heavy: numba

            return sliding_model.the_model(material)
        from napari_hmrf.solver.backends.cpu.elastic_model import the_model  # heavy: numba

        return the_model(material, whole=False)

    def seiler_model(self, material: SeilerMaterial) -> LinearModel:
        """Return the model of the paper's cliques with all its levels."""
        from napari_hmrf.solver.backends.cpu.seiler_model import the_model  # heavy: numba

        return the_model(material)

    def finite_model(self, material: FiniteMaterial) -> FiniteModel:
        """Return the large-motion model."""
        if material.coupling is not None:
            from napari_hmrf.solver.backends.cpu import finite_sliding_model  # heavy: numba

            return finite_sliding_model.the_model(material)
        from napari_hmrf.solver.backends.cpu import finite_base  # heavy: numba

        if material.m.ndim == 3:
            from napari_hmrf.solver.backends.cpu import finite_volume_model  # heavy: numba

            kind: Any = finite_volume_model.CpuFiniteVolumeModel
        else:
            from napari_hmrf.solver.backends.cpu import finite_model  # heavy: numba

            kind = finite_model.CpuFiniteModel
        model: FiniteModel = finite_base.the_model(material, kind)
        return model

    def _scratch(self, stiffness: CpuField) -> tuple[FloatArray, FloatArray]:
        """Return scratch planes for the displacement, zero in void, and an array for energies."""
        if self._scratch_arrays is not None and self._scratch_arrays[0] is stiffness:
            return self._scratch_arrays[1:]
        shape = stiffness.shape
        energies = shape if len(shape) == 2 else (0, 0)  # volume kernels do not use this array
        return self._transfer.padded(len(shape), shape), np.empty(energies, dtype=np.float32)

    def release(self, *fields: CpuField) -> None:
        """Ignore the call, because memory is freed when the last reference is dropped."""

    def close(self) -> None:
        """Free the scratch arrays and restore the number of threads."""
        self._scratch_arrays = None
        self._numba.set_num_threads(self._threads)


def _weights(rule: SiteRule) -> FloatArray | None:
    """Return the weights of the lines, or None to select the special kernel for square pixels."""
    if not rule.blanket and np.array_equal(rule.weights, line_weights((1.0, 1.0))):
        return None
    return rule.weights.astype(np.float32)
