"""Compiled kernels for volumes, and which sites they are run for."""

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

#: The buffers of a kernel's fields, by name.
Buffers = Mapping[str, Sequence[Any]]

# Most work groups along the first axis of a dispatch, of which every driver allows 65535.
_ACROSS = 2**15
# Planes that a work group does, at most; and columns of them that keep a GPU busy. More planes
# spare elements that two groups share, and fewer spare void.
_MOST_PLANES = 8
_ENOUGH = 2**16


@dataclass(frozen=True)
class Groups:
    """The work groups of a level.

    Attributes
    ----------
    grid : (int, int, int)
        The level's sites.
    planes : int
        How many each group does.
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
        """Number of sites of a group."""
        return math.prod(GROUP) * self.planes


def groups_of(grid: tuple[int, ...], software: bool) -> Groups:
    """Divide a level among work groups; a program that plays the GPU needs few of them."""
    planes = _MOST_PLANES if software else math.prod(grid) // _ENOUGH
    return Groups(grid, max(1, min(planes, _MOST_PLANES)))


class Places(NamedTuple):
    """Groups that a kernel runs on: those in a list, or all.

    Attributes
    ----------
    groups : Groups
    buffer : moderngl.Buffer or None
        The numbers of those in the list.
    number : int
        How many are run.
    """

    groups: Groups
    buffer: Any
    number: int


class VolumeProgram(Compiled):
    """A kernel for volumes, ready to run.

    Parameters
    ----------
    ctx : moderngl.Context
    program : moderngl.ComputeShader
    names : sequence of str
        Its fields, in the order of their bindings.
    dispatch : callable
        Runs it without keeping the interpreter from others.
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
        """Say which sites it will run for."""
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
        """Say which buffers it reads and writes."""
        place = 0
        for name in self._names:
            for buffer in buffers[name]:
                buffer.bind_to_storage_buffer(place)
                place += 1

    def run(self, first: int, past: int) -> None:
        """Run some of the groups that it visits; returns before the device has done it."""
        self._place("first", first)
        self._place("past", past)
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
    """Compile a kernel for volumes; the parameters are those of `compose_volume`.

    Raises
    ------
    BackendError
        With the compiler's words and the numbered text, if it does not compile.
    """
    source = compose_volume(name, defines)
    try:
        program = ctx.compute_shader(source.text)
    except Exception as error:
        raise BackendError(
            f"the compute shader {name}.glsl does not compile on {ctx.info['GL_RENDERER']}; please "
            f"report this with what follows\n{source.explain(str(error))}"
        ) from error
    time.sleep(BREATH)
    fields = bindings(VOLUME_KERNELS[name], defines or {})
    return VolumeProgram(ctx, program, [field.name for field, _ in fields], dispatch)
