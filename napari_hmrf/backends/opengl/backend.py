"""The kernels as shaders: the backend of machines with a GPU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from napari_hmrf.backends.base import Checkpoint, EnergyArray, FloatArray, SiteRule
from napari_hmrf.backends.opengl.device import the_device
from napari_hmrf.backends.opengl.pace import Pace
from napari_hmrf.backends.opengl.programs import Program
from napari_hmrf.backends.opengl.source import STAGES, Stage
from napari_hmrf.errors import BackendError
from napari_hmrf.hierarchy import Level

#: Rows and columns of sites whose energies one invocation of the sum adds up.
BLOCK = 8

# Bytes that a solve holds for each site of level 0: stiffness 8, its ratios 32, observation 16,
# displacement 2 x 8, energy 4; a third more for the coarser levels.
_BYTES_PER_SITE = 76 * 4 / 3


@dataclass(eq=False)
class GLField:
    """A float32 texture, (W, H) texels of C components."""

    shape: tuple[int, ...]
    components: int
    texture: Any
    #: Of stiffness: the ratios of each site's cliques, computed when first needed.
    ratios: list[Any] = field(default_factory=list)


class OpenGLBackend:
    """The kernels as fragment or compute shaders.

    Parameters
    ----------
    checkpoint : callable
        Called between batches of passes, about every `BATCH_SECONDS`; raises to stop the work.
    stage : {"fragment", "compute"}, optional
        By default compute where OpenGL 4.3 is there on a GPU, and fragment otherwise.

    Raises
    ------
    BackendError
        If there is no usable OpenGL, or not this stage of it.
    RuntimeError
        If this is not the compute thread.
    """

    def __init__(self, checkpoint: Checkpoint, stage: str | None = None) -> None:
        if stage is not None and stage not in STAGES:
            raise BackendError(f"there is no shader stage {stage!r}; take one of {STAGES}")
        self._device = the_device()
        self._stage = cast(Stage, stage) if stage is not None else self._device.best_stage
        self._device.ensure(self._stage)
        self.name = f"opengl:{self._stage}"
        self.renderer = self._device.renderer
        self._pace = Pace(self._device.finish, checkpoint)
        self._textures: list[Any] = []
        self._spare: dict[tuple[tuple[int, ...], int], list[Any]] = {}
        self._targets: dict[tuple[int, ...], Any] = {}

    def upload(self, values: FloatArray) -> GLField:
        """Copy values of shape (H, W, C) into a texture."""
        height, width, components = values.shape
        self._refuse_too_large(height, width)
        made = self._field((height, width), components)
        made.texture.write(np.ascontiguousarray(values, "<f4").tobytes())
        self._device.check("uploading an image")
        return made

    def download(self, field: GLField) -> FloatArray:
        """Return the values, (H, W, C); a device that has stopped computing is found out."""
        self._pace.wait()
        values = np.frombuffer(field.texture.read(), np.float32)
        self._device.check("reading an image")
        self._device.canary(self._stage)
        return values.reshape(*field.shape, field.components).copy()

    def zeros(self, level: Level) -> GLField:
        """Return a displacement of zero."""
        return self.upload(np.zeros((*level.shape, 2), np.float32))

    def project(self, finest: GLField, level: Level) -> GLField:
        """Project by nearest neighbour from level 0."""
        made = self._field(level.shape, finest.components)
        program = self._program("project")
        program.set({"level": np.array([level.number], np.int32)})
        self._run(program, [finest.texture], [made.texture], level.shape)
        return made

    def prolong(self, coarse: GLField, coarse_stiffness: GLField, stiffness: GLField) -> GLField:
        """Project displacement one level down, linearly."""
        made = self._field(stiffness.shape, 2)
        inputs = [coarse.texture, coarse_stiffness.texture, stiffness.texture]
        self._run(self._program("prolong"), inputs, [made.texture], stiffness.shape)
        return made

    def relax(
        self,
        displacement: GLField,
        stiffness: GLField,
        observation: GLField,
        rule: SiteRule,
        sweeps: int,
    ) -> tuple[GLField, EnergyArray]:
        """Move all sites at once, `sweeps` times."""
        shape = displacement.shape
        defines = {"BLANKET": int(rule.blanket), "STEPS": len(rule.steps)}
        program = self._program("icm", defines)
        program.set(
            {
                "weights": rule.weights.astype(np.float32),
                "relaxation": np.array([rule.relaxation], np.float32),
                "steps": np.array(rule.steps, np.float32),
            }
        )
        around = [*self._ratios(stiffness), observation.texture]
        source, target = displacement.texture, self._texture(shape, 2)
        share = self._texture(shape, 1)
        totals = _Totals(self, shape, sweeps)
        for _ in range(sweeps):
            self._run(program, [source, *around], [target, share], shape)
            totals.add(share)
            source, target = target, source
        energies = totals.read()
        self._recycle(shape, 2, target)
        self._recycle(shape, 1, share)
        return GLField(shape, 2, source), energies

    def energy(
        self, displacement: GLField, stiffness: GLField, observation: GLField, rule: SiteRule
    ) -> float:
        """U_total."""
        shape = displacement.shape
        program = self._program("energy")
        program.set({"weights": rule.weights.astype(np.float32)})
        share = self._texture(shape, 1)
        inputs = [displacement.texture, *self._ratios(stiffness), observation.texture]
        self._run(program, inputs, [share], shape)
        totals = _Totals(self, shape, 1)
        totals.add(share)
        self._recycle(shape, 1, share)
        return float(totals.read()[0])

    def release(self, *fields: GLField) -> None:
        """Keep the fields' textures for the next field of their kind."""
        for released in fields:
            self._recycle(released.shape, released.components, released.texture)
            for ratios in released.ratios:
                self._recycle(released.shape, 4, ratios)
            released.ratios.clear()

    def close(self) -> None:
        """Free every texture; the context and the compiled kernels stay for the next solve."""
        self._device.free((*self._targets.values(), *self._textures))
        self._targets.clear()
        self._textures.clear()
        self._spare.clear()

    def _program(self, name: str, defines: Mapping[str, int] | None = None) -> Program:
        return self._device.program(name, self._stage, defines)

    def _run(
        self,
        program: Program,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        grid: tuple[int, ...],
        first_row: int = 0,
    ) -> None:
        """Run a kernel over a grid, in as many strips as its size asks for."""
        target = self._target(outputs) if self._stage == "fragment" else None
        for rows in self._pace.strips(grid):
            program.run(inputs, outputs, target, grid, first_row, rows)

    def _target(self, outputs: Sequence[Any]) -> Any:
        """Make the framebuffer that draws into these textures, or return it."""
        key = tuple(texture.glo for texture in outputs)
        if key not in self._targets:
            self._targets[key] = self._device.ctx.framebuffer(list(outputs))
        return self._targets[key]

    def _ratios(self, stiffness: GLField) -> list[Any]:
        """Return the stiffness ratios of a level; they are the same in all of its sweeps."""
        if not stiffness.ratios:
            shape = stiffness.shape
            stiffness.ratios += [self._texture(shape, 4), self._texture(shape, 4)]
            self._run(self._program("ratios"), [stiffness.texture], stiffness.ratios, shape)
        return stiffness.ratios

    def _field(self, shape: tuple[int, ...], components: int) -> GLField:
        return GLField(shape, components, self._texture(shape, components))

    def _texture(self, shape: tuple[int, ...], components: int) -> Any:
        spare = self._spare.get((shape, components))
        if spare:
            return spare.pop()
        made = self._device.texture(shape, components)
        self._textures.append(made)
        return made

    def _recycle(self, shape: tuple[int, ...], components: int, texture: Any) -> None:
        self._spare.setdefault((shape, components), []).append(texture)

    def _refuse_too_large(self, height: int, width: int) -> None:
        """Refuse an image before anything is allocated for it."""
        largest = self._device.largest
        if max(height, width) > largest:
            size = height * width * _BYTES_PER_SITE / 2**30
            raise BackendError(
                f"the image has {height} x {width} pixels, but {self.renderer} holds at most "
                f"{largest} x {largest}; a solve of it would take about {size:.1f} GiB there. "
                'Downsample it, cut it, or take backend="cpu".'
            )


class _Totals:
    """Energies of many sweeps, kept on the device until the last one.

    The totals of a sweep's blocks fill one strip of rows of an atlas; the atlas is read once.
    """

    def __init__(self, backend: OpenGLBackend, shape: tuple[int, ...], sweeps: int) -> None:
        self._backend = backend
        self._device = backend._device
        self._program = backend._program("sum", {"BLOCK": BLOCK})
        self._blocks = tuple(-(-size // BLOCK) for size in shape)
        rows, cols = self._blocks
        self._strips = max(1, min(sweeps, self._device.largest // rows))
        self._shape = (rows * self._strips, cols)
        self._atlas = backend._texture(self._shape, 1)
        self._used = 0
        self._energies: list[float] = []

    def add(self, share: Any) -> None:
        """Sum the sites' shares of one sweep."""
        if self._used == self._strips:
            self._flush()
        row = self._used * self._blocks[0]
        self._backend._run(self._program, [share], [self._atlas], self._blocks, row)
        self._used += 1

    def read(self) -> EnergyArray:
        """Return the sums, in the order they were added, and give the atlas back."""
        self._flush()
        self._backend._recycle(self._shape, 1, self._atlas)
        return np.array(self._energies)

    def _flush(self) -> None:
        self._backend._pace.wait()
        blocks = np.frombuffer(self._atlas.read(), np.float32).reshape(self._strips, -1)
        self._device.check("reading energies")
        self._energies += list(blocks[: self._used].sum(axis=1, dtype=np.float64))
        self._used = 0
