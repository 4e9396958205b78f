"""Kernel passes over textures, in batches that leave time for other programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.opengl.context.device import Device
from napari_hmrf.solver.backends.opengl.context.pace import Pace
from napari_hmrf.solver.backends.opengl.context.resources import DeviceResources
from napari_hmrf.solver.backends.opengl.programs.programs import Program
from napari_hmrf.solver.backends.opengl.programs.regions import (
    Groups,
    Tissue,
    Window,
    groups_with,
    window_around,
)
from napari_hmrf.solver.backends.opengl.programs.source import Stage

# Largest texture that is created from zeros, in bytes. A framebuffer, which clears a larger one, is
# slow to create.
_FEW_ZEROS = 2**20


class Passes(DeviceResources):
    """Runner of kernels for one solve, which owns the solve's textures.

    Parameters
    ----------
    device : Device
    stage : {"fragment", "compute"}
    pace : Pace
        Scheduler of batches, which waits for the device.
    """

    def __init__(self, device: Device, stage: Stage, pace: Pace) -> None:
        super().__init__(device, pace)
        self.stage = stage
        self._targets: dict[tuple[Any, ...], Any] = {}
        self._unit: Any = None
        self._zero: Any = None

    def program(self, name: str, defines: Mapping[str, int] | None = None) -> Program:
        """Return the program of a kernel, compiled on first use."""
        return self.device.program(name, self.stage, defines)

    @property
    def rows(self) -> int:
        """Number of texels that an invocation of a kernel for tissue computes."""
        return self.device.rows if self.stage == "compute" else 1

    def run(
        self,
        program: Program,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        grid: tuple[int, ...],
        first_row: int = 0,
        tissue: Tissue | None = None,
    ) -> None:
        """Run a kernel over a grid of texels, in strips if the grid is large."""
        region = Window(0, 0, *grid) if tissue is None else tissue.region
        target = self._target(outputs, tissue) if self.stage == "fragment" else None
        for rows in self.pace.strips(region.size):
            part = region if rows is None else region.strip(*rows)
            program.run(inputs, outputs, target, part, first_row)

    def tissue(self, shown: npt.NDArray[np.bool_]) -> Tissue:
        """Return the region that limits passes to the True texels of a mask (rows, cols)."""
        if self.stage == "fragment":
            made = self.device.mask(shown)
            tissue = Tissue(window_around(shown), made)
        else:
            places = groups_with(shown)
            made = self.device.texture(places.shape[:2], 2)
            made.write(places)
            rows, cols = shown.shape
            tissue = Tissue(Groups(made, (rows, cols), 0, len(places)))
        self._own.append(made)
        return tissue

    def texture(self, values: npt.NDArray[np.float32]) -> Any:
        """Create a texture from an array of shape (rows, cols, components)."""
        data = np.ascontiguousarray(values)
        return self._owned(self.device.texture(values.shape[:2], values.shape[2], data))

    def empty(self, grid: tuple[int, ...], components: int) -> Any:
        """Create an uninitialized texture."""
        return self._owned(self.device.texture(grid, components))

    def blank(self, grid: tuple[int, ...], components: int) -> Any:
        """Create a texture of zeros."""
        size = 4 * math.prod(grid) * components
        if size <= _FEW_ZEROS:
            return self._owned(self.device.texture(grid, components, bytes(size)))
        made = self.empty(grid, components)
        self.clear(made)
        return made

    def _owned(self, texture: Any) -> Any:
        """Return a texture that `close` frees."""
        self._own.append(texture)
        return texture

    @property
    def unit(self) -> Any:
        """Texture of one texel with the value 1."""
        if self._unit is None:
            self._unit = self.texture(np.ones((1, 1, 1), np.float32))
        return self._unit

    @property
    def zero(self) -> Any:
        """Texture of one texel with four values 0."""
        if self._zero is None:
            self._zero = self.texture(np.zeros((1, 1, 4), np.float32))
        return self._zero

    def clear(self, texture: Any) -> None:
        """Fill a texture with zeros."""
        self.device.clear(self._target([texture], None))

    def close(self) -> None:
        """Free all framebuffers and textures."""
        self.device.free(self._targets.values())
        self._targets.clear()
        self._unit = self._zero = None
        super().close()

    def _target(self, outputs: Sequence[Any], tissue: Tissue | None) -> Any:
        """Return the framebuffer for textures and a tissue mask, creating it on first use."""
        key = (*outputs, tissue)
        if key not in self._targets:
            mask = None if tissue is None else tissue.mask
            self._targets[key] = self.device.framebuffer(outputs, mask)
        return self._targets[key]
