"""The kernels as shaders: the backend of machines with a GPU."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from napari_hmrf.backends.base import BATCH_SECONDS, Checkpoint, EnergyArray, FloatArray, SiteRule
from napari_hmrf.backends.opengl.context import is_software_renderer
from napari_hmrf.backends.opengl.device import the_device
from napari_hmrf.backends.opengl.pace import MAX_PASS_SECONDS, Pace
from napari_hmrf.backends.opengl.programs import Bands, Program, find_bands
from napari_hmrf.backends.opengl.source import STAGES, Stage
from napari_hmrf.backends.opengl.totals import (
    BLOCK,
    KEPT_SITES,
    BlockTotals,
    SiteTotals,
    Totals,
)
from napari_hmrf.coarsening import ElasticLevel
from napari_hmrf.errors import BackendError
from napari_hmrf.hierarchy import Level
from napari_hmrf.priors import line_weights
from napari_hmrf.priors.elastic import ElementShape

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
    #: Of stiffness: where there is tissue, found when first needed.
    bands: Bands | None = None


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
        software = is_software_renderer(self.renderer)
        # A software renderer dispatches while the interpreter, and with it the window, waits.
        longest = BATCH_SECONDS if software and self._stage == "compute" else MAX_PASS_SECONDS
        self._pace = Pace(self._device.finish, checkpoint, longest)
        self._pool = _Pool(self._device.texture)
        self._keeps_shares = software
        self._targets: dict[tuple[int, ...], Any] = {}
        self._drawn: dict[tuple[int, ...], Bands | None] = {}

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
        values = self._read(field)
        self._device.canary(self._stage)
        return values.copy()

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
        bands = self._bands(stiffness)
        source, target = displacement.texture, self._pool.take(shape, 2)
        totals = self._totals(shape, sweeps)
        for _ in range(sweeps):
            self._run(program, [source, *around], [target, totals.share()], shape, bands=bands)
            totals.add()
            source, target = target, source
        energies = totals.read()
        self._pool.give(shape, 2, target)
        return GLField(shape, 2, source), energies

    def energy(
        self, displacement: GLField, stiffness: GLField, observation: GLField, rule: SiteRule
    ) -> float:
        """U_total."""
        shape = displacement.shape
        program = self._program("energy", {"SQUARE": _is_square(rule)})
        program.set({"weights": rule.weights.astype(np.float32)})
        inputs = [displacement.texture, *self._ratios(stiffness), observation.texture]
        bands = self._bands(stiffness)
        totals = self._totals(shape, 1)
        self._run(program, inputs, [totals.share()], shape, bands=bands)
        totals.add()
        return float(totals.read()[0])

    def elastic_level(self, level: ElasticLevel, shape: ElementShape) -> Any:
        """Refuse: the shaders have no multigrid yet."""
        raise BackendError(
            'elastic tissue is solved by the compiled loops only, so far. Take backend="cpu".'
        )

    def release(self, *fields: GLField) -> None:
        """Keep the fields' textures for the next field of their kind."""
        for released in fields:
            self._pool.give(released.shape, released.components, released.texture)
            for ratios in released.ratios:
                self._pool.give(released.shape, 4, ratios)
            released.ratios.clear()

    def close(self) -> None:
        """Free every texture; the context and the compiled kernels stay for the next solve."""
        self._device.free((*self._targets.values(), *self._pool.all))
        self._targets.clear()
        self._drawn.clear()
        self._pool = _Pool(self._device.texture)

    def _read(self, field: GLField) -> FloatArray:
        self._wait()
        values = np.frombuffer(field.texture.read(), np.float32)
        self._device.check("reading an image")
        return values.reshape(*field.shape, field.components)

    def _program(self, name: str, defines: Mapping[str, int] | None = None) -> Program:
        return self._device.program(name, self._stage, defines)

    def _run(
        self,
        program: Program,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        grid: tuple[int, ...],
        first_row: int = 0,
        bands: Bands | None = None,
    ) -> None:
        """Run a kernel over a grid, in as many strips as its size asks for."""
        target = self._target(outputs) if self._stage == "fragment" else None
        for rows in self._pace.strips(grid):
            program.run(inputs, outputs, target, grid, first_row, rows, bands)

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
            stiffness.ratios += [self._pool.take(shape, 4), self._pool.take(shape, 4)]
            self._run(self._program("ratios"), [stiffness.texture], stiffness.ratios, shape)
        return stiffness.ratios

    def _bands(self, stiffness: GLField) -> Bands | None:
        """Return where a level has tissue, for the stage that makes use of it."""
        if self._stage == "fragment" and stiffness.bands is None:
            spans = find_bands(self._read(stiffness)[..., 0] > 0)
            texture = self._pool.take(spans.shape[:2], 2, use="bands")
            texture.write(spans.tobytes())
            stiffness.bands = Bands(texture, len(spans))
        if self._drawn.get(stiffness.shape) is not stiffness.bands:
            # Other tissue on the same grid: what it left must not show up in this one's void.
            self._drawn[stiffness.shape] = stiffness.bands
            self._pool.blank(stiffness.shape)
        return stiffness.bands

    def _field(self, shape: tuple[int, ...], components: int) -> GLField:
        return GLField(shape, components, self._pool.take(shape, components))

    def _totals(self, shape: tuple[int, ...], sweeps: int) -> Totals:
        wait = self._wait
        if self._keeps_shares and math.prod(shape) <= KEPT_SITES:
            return SiteTotals(self._pool, wait, shape, sweeps)
        program, largest = self._program("sum", {"BLOCK": BLOCK}), self._device.largest
        return BlockTotals(program, self._run, self._pool, wait, shape, sweeps, largest)

    def _wait(self) -> None:
        self._pace.wait()
        self._device.check("computing")

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


def _is_square(rule: SiteRule) -> int:
    """1 if the weights of the lines are those of square pixels, which the kernels know."""
    return int(np.array_equal(rule.weights, line_weights((1.0, 1.0))))


class _Pool:
    """The textures of one backend: those in use, and those waiting to be used again."""

    def __init__(self, make: Callable[[tuple[int, ...], int], Any]) -> None:
        self._make = make
        self._spare: dict[tuple[tuple[int, ...], int, str], list[Any]] = {}
        self.all: list[Any] = []

    def take(self, shape: tuple[int, ...], components: int, use: str = "sites") -> Any:
        """Return a texture; of ``sites`` it holds 0 where the level has no tissue.

        Kernels that run on tissue only rely on that, so that what holds anything else must not
        come back as sites.
        """
        spare = self._spare.get((shape, components, use))
        if spare:
            return spare.pop()
        made = self._make(shape, components)
        made.write(np.zeros((*shape, components), np.float32).tobytes())
        self.all.append(made)
        return made

    def give(
        self, shape: tuple[int, ...], components: int, texture: Any, use: str = "sites"
    ) -> None:
        """Take a texture back for others of the same use."""
        self._spare.setdefault((shape, components, use), []).append(texture)

    def blank(self, shape: tuple[int, ...]) -> None:
        """Fill the waiting ``sites`` of a level with 0."""
        for (size, components, use), waiting in self._spare.items():
            if size == shape and use == "sites":
                for texture in waiting:
                    texture.write(np.zeros((*size, components), np.float32).tobytes())
