"""Solver backend with OpenGL shaders as kernels."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np

from napari_hmrf.errors import BackendError
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
from napari_hmrf.solver.backends.opengl.context.device import the_device
from napari_hmrf.solver.backends.opengl.context.pace import MAX_PASS_SECONDS, Pace
from napari_hmrf.solver.backends.opengl.images.elastic import GLElasticModel, model_of_loops
from napari_hmrf.solver.backends.opengl.images.fields import (
    GLField,
    Pool,
    as_given,
    as_stored,
    pairs,
    pairs_with_tissue,
    singles,
)
from napari_hmrf.solver.backends.opengl.images.model import GLModel
from napari_hmrf.solver.backends.opengl.images.passes import Passes
from napari_hmrf.solver.backends.opengl.images.seiler import GLSeilerModel
from napari_hmrf.solver.backends.opengl.images.totals import (
    BLOCK,
    KEPT_SHARES,
    BlockTotals,
    PairTotals,
    Totals,
)
from napari_hmrf.solver.backends.opengl.programs.regions import Tissue
from napari_hmrf.solver.backends.opengl.programs.source import STAGES, Stage
from napari_hmrf.solver.backends.opengl.support import (
    image_refusal,
    missing_shaders,
    volume_refusal,
)
from napari_hmrf.solver.backends.opengl.volumes.volume_model import GLVolumeModel
from napari_hmrf.solver.backends.opengl.volumes.volume_passes import VolumePasses
from napari_hmrf.solver.priors import line_weights
from napari_hmrf.solver.priors.cliques import SeilerMaterial
from napari_hmrf.solver.priors.elements import ElasticMaterial
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial
from napari_hmrf.solver.quadtree import Level


class OpenGLBackend:
    """Backend that runs its kernels as fragment or compute shaders.

    Parameters
    ----------
    checkpoint : callable
        Function called between batches of passes, about every `BATCH_SECONDS`. It raises an
        exception to cancel the solve.
    stage : {"fragment", "compute"}, optional
        Shader stage. The default is compute if OpenGL 4.3 is available, otherwise fragment.

    Raises
    ------
    BackendError
        If OpenGL cannot be used, or if it does not support the stage.
    RuntimeError
        If the constructor is not called on the compute thread.
    """

    def __init__(self, checkpoint: Checkpoint, stage: str | None = None) -> None:
        if stage is not None and stage not in STAGES:
            raise BackendError(f"there is no shader stage {stage!r}; use one of {STAGES}")
        self._device = the_device()
        self._stage = cast(Stage, stage) if stage is not None else self._device.best_stage
        self._device.ensure(self._stage)
        self.name = f"opengl:{self._stage}"
        self.renderer = self._device.renderer
        software = self._device.software
        # A software renderer computes during the dispatch call, which blocks the interpreter and
        # therefore the GUI.
        longest = BATCH_SECONDS if software and self._stage == "compute" else MAX_PASS_SECONDS
        self._pace = Pace(self._device.finish, checkpoint, longest)
        self._passes = Passes(self._device, self._stage, self._pace)
        self._program, self._run, self._wait = (
            self._passes.program,
            self._passes.run,
            self._passes.wait,
        )
        self._model_passes: list[VolumePasses] = []
        self._pool = Pool(self._device.texture)
        self._keeps_shares = software
        self._tissue_of_grid: dict[tuple[int, ...], Tissue] = {}

    def supports(self, job: SolveJob) -> str | None:
        """Return the reason why the shaders cannot solve a job, or None if they can solve it."""
        missing = missing_shaders(job)
        if missing is not None:
            return f'{missing}. Use them (`backend="cpu"`).'
        if job.is_volume:
            return volume_refusal(self._device, self._stage, job.shape)
        return image_refusal(self._device, job.shape)

    def upload(self, values: FloatArray) -> GLField:
        """Copy an array of shape (H, W, C) to a texture."""
        height, width, components = values.shape
        self._refuse(image_refusal(self._device, (height, width)))
        made = self._field((height, width), components)
        made.texture.write(as_stored(values))
        self._device.check("uploading an image")
        return made

    def download(self, field: GLField) -> FloatArray:
        """Copy a field to the host as an array of shape (H, W, C).

        Also run the test kernel, to check that the device still computes correctly.
        """
        values = as_given(self._read(field), field.shape, field.components)
        self._device.canary(self._stage)
        return values.copy()

    def zeros(self, level: Level) -> GLField:
        """Return a zero displacement field on a level."""
        return self.upload(np.zeros((*level.shape, 2), np.float32))

    def project(self, finest: GLField, level: Level) -> GLField:
        """Project a field of level 0 to a coarser level by nearest-neighbour sampling."""
        made = self._field(level.shape, finest.components)
        program = self._program("project", {"PAIRS": int(finest.components == 2)})
        program.set(
            {
                "level": np.array([level.number], np.int32),
                "size": np.array(finest.shape[::-1], np.int32),
            }
        )
        self._run(program, [finest.texture], [made.texture], made.grid)
        return made

    def prolong(self, coarse: GLField, coarse_stiffness: GLField, stiffness: GLField) -> GLField:
        """Interpolate a displacement field linearly to the next finer level."""
        made = self._field(stiffness.shape, 2)
        inputs = [coarse.texture, coarse_stiffness.texture, stiffness.texture]
        self._run(self._program("prolong"), inputs, [made.texture], made.grid)
        return made

    def relax(
        self,
        displacement: GLField,
        stiffness: GLField,
        observation: GLField,
        rule: SiteRule,
        sweeps: int,
    ) -> tuple[GLField, EnergyArray]:
        """Update all sites simultaneously, `sweeps` times; see `Backend.relax`."""
        defines = {
            "BLANKET": int(rule.blanket),
            "SQUARE": _is_square(rule),
            "STEPS": len(rule.steps),
        }
        program = self._program("icm", defines)
        program.set(
            {
                "weights": rule.weights.astype(np.float32),
                "relaxation": np.array([rule.relaxation], np.float32),
                "steps": np.array(rule.steps, np.float32),
            }
        )
        around = [*self._ratios(stiffness), observation.texture]
        tissue = self._tissue(stiffness)
        grid = displacement.grid
        source, target = displacement.texture, self._pool.acquire(grid, 4)
        totals = self._totals(grid, sweeps)
        for _ in range(sweeps):
            self._run(program, [source, *around], [target, totals.share()], grid, tissue=tissue)
            totals.add()
            source, target = target, source
        energies = totals.read()
        self._pool.recycle(grid, 4, target)
        return GLField(displacement.shape, 2, source), energies

    def energy(
        self, displacement: GLField, stiffness: GLField, observation: GLField, rule: SiteRule
    ) -> float:
        """Return the energy U_total of a displacement field, in pixels squared."""
        program = self._program("energy", {"SQUARE": _is_square(rule)})
        program.set({"weights": rule.weights.astype(np.float32)})
        inputs = [displacement.texture, *self._ratios(stiffness), observation.texture]
        tissue = self._tissue(stiffness)
        totals = self._totals(displacement.grid, 1)
        self._run(program, inputs, [totals.share()], displacement.grid, tissue=tissue)
        totals.add()
        return float(totals.read()[0])

    def elastic_model(self, material: ElasticMaterial) -> LinearModel:
        """Build the linear model of an elastic image or volume.

        For images, the levels are copied from a model on the host, unless the device has them from
        the last solve. There are no shaders for a data term, so compiled loops solve the steps in
        which observations that slip are springs.
        """
        if material.data is not None:
            return model_of_loops(material)
        if material.m.ndim == 3:
            self._refuse(volume_refusal(self._device, self._stage, material.m.shape))
            passes = VolumePasses(self._device, self._pace)
            self._model_passes.append(passes)
            return GLVolumeModel(passes, material)
        return self._image_model(GLElasticModel, material)

    def seiler_model(self, material: SeilerMaterial) -> LinearModel:
        """Build the linear model of the paper's cliques, as that of an elastic image."""
        return self._image_model(GLSeilerModel, material)

    def finite_model(self, material: FiniteMaterial) -> FiniteModel:
        """Raise `BackendError`, because there are no shaders for large motion."""
        raise BackendError(
            'only the compiled loops solve large motion. Use them (`backend="cpu"`).'
        )

    def release(self, *fields: GLField) -> None:
        """Return the textures of fields to the pool for reuse."""
        for released in fields:
            self._pool.recycle(released.grid, 4, released.texture, _use(released.components))
            for ratios in released.ratios:
                self._pool.recycle(singles(released.shape), 4, ratios, use="singles")
            released.ratios.clear()

    def close(self) -> None:
        """Free the textures; context, kernels and the last model remain for the next solve."""
        for passes in (*self._model_passes, self._passes):
            passes.close()
        self._model_passes.clear()
        self._device.free(self._pool.all)
        self._tissue_of_grid.clear()
        self._pool = Pool(self._device.texture)

    def _image_model(self, kind: type[GLElasticModel | GLSeilerModel], material: Any) -> GLModel:
        """Return the model of an image, which the device keeps in place of the last model."""
        self._refuse(image_refusal(self._device, material.m.shape))
        host = kind.host_of(material)
        kept: GLModel | None = self._device.kept_model
        if kept is not None and kept.serves(host, self._stage):
            kept.resume(self._pace)
            return kept
        self._device.forget_model()
        passes = Passes(self._device, self._stage, self._pace)
        try:
            made = kind(passes, host)
        except BaseException:
            passes.close()
            raise
        self._device.kept_model = made
        return made

    def _read(self, field: GLField) -> FloatArray:
        """Wait for the device, and read the texture of a field, shape (rows, cols, 4)."""
        self._wait()
        stored = np.frombuffer(field.texture.read(), "<f4")
        self._device.check("reading an image")
        return stored.reshape(*field.grid, 4)

    def _ratios(self, stiffness: GLField) -> list[Any]:
        """Return the textures of a level's stiffness ratios, which are computed on first use."""
        if not stiffness.ratios:
            grid = singles(stiffness.shape)
            made = [self._pool.acquire(grid, 4, use="singles") for _ in range(2)]
            stiffness.ratios += made
            self._run(self._program("ratios"), [stiffness.texture], made, grid)
        return stiffness.ratios

    def _tissue(self, stiffness: GLField) -> Tissue:
        """Return the region of a level that contains tissue, which is computed on first use."""
        if stiffness.tissue is None:
            shown = pairs_with_tissue(self._read(stiffness))
            stiffness.tissue = self._passes.tissue(shown)
        if self._tissue_of_grid.get(stiffness.grid) is not stiffness.tissue:
            # Pooled textures of this grid may be nonzero where the new tissue has void.
            self._tissue_of_grid[stiffness.grid] = stiffness.tissue
            self._pool.blank(stiffness.grid)
        return stiffness.tissue

    def _field(self, shape: tuple[int, ...], components: int) -> GLField:
        grid = pairs(shape) if components == 2 else singles(shape)
        return GLField(shape, components, self._pool.acquire(grid, 4, _use(components)))

    def _totals(self, grid: tuple[int, ...], sweeps: int) -> Totals:
        wait = self._wait
        if self._keeps_shares and math.prod(grid) <= KEPT_SHARES:
            return PairTotals(self._pool, wait, grid, sweeps)
        program, largest = self._program("sum", {"BLOCK": BLOCK}), self._device.largest
        return BlockTotals(program, self._run, self._pool, wait, grid, sweeps, largest)

    def _refuse(self, reason: str | None) -> None:
        """Raise `BackendError` with the given reason, unless the reason is None."""
        if reason is not None:
            raise BackendError(reason)


def _is_square(rule: SiteRule) -> int:
    """Return 1 if the line weights are those of square pixels, otherwise 0.

    The kernels have a variant for square pixels.
    """
    return int(np.array_equal(rule.weights, line_weights((1.0, 1.0))))


def _use(components: int) -> str:
    """Return the intended use of a field's texture, which is part of its key in the pool.

    Only textures for "pairs" are reused for displacement fields.
    """
    return "pairs" if components == 2 else "singles"
