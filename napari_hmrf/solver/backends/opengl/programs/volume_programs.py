"""Compiled kernels for volumes, and the groups of sites on which they run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends.opengl.programs.programs import BREATH, Compiled
from napari_hmrf.solver.backends.opengl.programs.volume_source import (
    GROUP,
    VOLUME_KERNELS,
    bindings,
    compose_volume,
)

#: Buffers of a kernel's fields, by name.
Buffers = Mapping[str, Sequence[Any]]

# Largest number of work groups along the first axis of a dispatch; all drivers allow 65535.
_ACROSS = 2**15
# Largest number of planes in a work group, and number of invocations that keep a GPU busy. With
# more planes per group, fewer elements are computed twice, by two groups. With fewer planes, the
# groups contain less void.
_MOST_PLANES = 8
_ENOUGH = 2**16


@dataclass(frozen=True)
class Groups:
    """Division of a level into work groups.

    Attributes
    ----------
    grid : (int, int, int)
        Grid of the level, (D, H, W).
    planes : int
        Number of planes of sites in each group.
    """

    grid: tuple[int, ...]
    planes: int

    @property
    def count(self) -> int:
        """Number of groups."""
        depth, height, width = self.grid
        cols, rows = GROUP
        return -(-depth // self.planes) * -(-height // rows) * -(-width // cols)

    @property
    def sites(self) -> int:
        """Number of sites in a group."""
        return math.prod(GROUP) * self.planes


def groups_of(grid: tuple[int, ...], software: bool) -> Groups:
    """Divide a level into work groups; use a few large groups on a software renderer."""
    planes = _MOST_PLANES if software else math.prod(grid) // _ENOUGH
    return Groups(grid, max(1, min(planes, _MOST_PLANES)))


class Places(NamedTuple):
    """Work groups on which a kernel runs: listed groups or all groups.

    Attributes
    ----------
    groups : Groups
    buffer : moderngl.Buffer or None
        Indices of the listed groups, or None for all groups.
    number : int
        Number of groups that run.
    """

    groups: Groups
    buffer: Any
    number: int


class VolumeProgram(Compiled):
    """Compiled kernel for volumes.

    Parameters
    ----------
    ctx : moderngl.Context
    program : moderngl.ComputeShader
    names : sequence of str
        Names of the fields, in the order of their bindings.
    dispatch : callable
        Function that runs the program and releases the GIL.
    """

    def __init__(
        self,
        ctx: Any,
        program: Any,
        names: Sequence[str],
        dispatch: Callable[[int, int, int], None],
    ) -> None:
        super().__init__(ctx, program)
        self._names, self._dispatch = names, dispatch
        self._places: Places | None = None

    def visit(self, places: Places) -> None:
        """Set the groups on which the kernel runs."""
        if places is self._places:
            return
        self._places, (depth, height, width) = places, places.groups.grid
        values = {
            "depth": depth,
            "height": height,
            "width": width,
            "planes": places.groups.planes,
            "listed": int(places.buffer is not None),
        }
        self.set({name: np.array([value], np.int32) for name, value in values.items()})

    def bind(self, buffers: Buffers) -> None:
        """Set the buffers that the kernel reads and writes."""
        place = 0
        for name in self._names:
            for buffer in buffers[name]:
                buffer.bind_to_storage_buffer(place)
                place += 1

    def run(self, first: int, past: int) -> None:
        """Start the groups `first` to `past` (exclusive), without waiting for the device."""
        self._set_integers("first", first)
        self._set_integers("past", past)
        groups = past - first
        cols = min(groups, _ACROSS)
        self._dispatch(self._program.glo, cols, -(-groups // cols))
        self._ctx.memory_barrier()


def compile_volume(
    ctx: Any,
    name: str,
    defines: Mapping[str, int] | None,
    dispatch: Callable[[int, int, int], None],
) -> VolumeProgram:
    """Compile a kernel for volumes; see `compose_volume` for the parameters.

    Raises
    ------
    BackendError
        If the kernel does not compile. The message contains the compiler's log and the source with
        line numbers.
    """
    source = compose_volume(name, defines)
    try:
        program = ctx.compute_shader(source.text)
    except Exception as error:
        raise BackendError(
            f"the compute shader {name}.glsl does not compile on {ctx.info['GL_RENDERER']}; please "
            f"report this with the following text\n{source.explain(str(error))}"
        ) from error
    time.sleep(BREATH)
    fields = bindings(VOLUME_KERNELS[name], defines or {})
    return VolumeProgram(ctx, program, [field.name for field, _ in fields], dispatch)
