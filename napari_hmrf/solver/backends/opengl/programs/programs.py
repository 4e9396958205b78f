"""Compiled kernels for grids of texels, as fragment or compute shaders."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends.opengl.programs.regions import Groups, Window
from napari_hmrf.solver.backends.opengl.programs.source import (
    GROUP,
    KERNELS,
    Stage,
    compose,
    vertices,
)

Uniforms = Mapping[str, npt.NDArray[np.float32] | npt.NDArray[np.float64] | npt.NDArray[np.int32]]


class Program(Protocol):
    """Compiled kernel."""

    def set(self, values: Uniforms) -> None:
        """Set uniforms; they retain their values until they are set again."""
        ...

    def run(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        target: Any,
        region: Window | Groups,
        first_row: int = 0,
    ) -> None:
        """Start the kernel for each texel of a region, without waiting for the device.

        Parameters
        ----------
        inputs, outputs : sequence of moderngl.Texture
            Textures in the kernel's order. A texture must not be both an input and an output.
        target : moderngl.Framebuffer or None
            Framebuffer of the outputs, for the fragment stage. If it has a mask (`Device.mask`),
            only texels in the mask are computed, and all other texels remain unchanged.
        region : Window or Groups
            Texels to compute: `Groups` for tissue kernels in the compute stage, else a `Window`.
        first_row : int
            Row of the outputs at which the grid of texels begins.
        """
        ...

    def release(self) -> None:
        """Free the OpenGL objects of the kernel."""
        ...


# Number of initial runs that use `dispatch`, which releases the GIL.
_FIRST_RUNS = 3
#: Pause for other threads after each compilation, in seconds.
BREATH = 0.005


def compile_program(
    ctx: Any,
    name: str,
    stage: Stage,
    defines: Mapping[str, int] | None = None,
    rows: int = 1,
    dispatch: Callable[[int, int, int], None] | None = None,
) -> Program:
    """Compile a kernel for a stage; see `source.compose` for the other parameters.

    Parameters
    ----------
    dispatch : callable, optional
        Function that runs a compute shader and releases the GIL. A software renderer compiles a
        shader during its first run, which would otherwise freeze the GUI.

    Raises
    ------
    BackendError
        If the kernel does not compile. The message contains the compiler's log and the source with
        line numbers.
    """
    source = compose(name, stage, defines, rows)
    try:
        if stage == "compute":
            program = ctx.compute_shader(source.text)
        else:
            program = ctx.program(vertex_shader=vertices().text, fragment_shader=source.text)
    except Exception as error:
        raise BackendError(
            f"the {stage} shader of the kernel {name!r} ({KERNELS[name].text}.glsl) does not "
            f"compile on {ctx.info['GL_RENDERER']}; please report this with the following text\n"
            f"{source.explain(str(error))}"
        ) from error
    time.sleep(BREATH)
    for unit, texture in enumerate((*KERNELS[name].inputs, "groups")):
        if texture in program:
            program[texture].value = unit
    if stage == "compute":
        return _Compute(ctx, program, KERNELS[name].tissue, dispatch)
    return _Fragment(ctx, program)


class Compiled:
    """Base class of compiled kernels; writes only uniforms that have changed."""

    def __init__(self, ctx: Any, program: Any) -> None:
        self._ctx = ctx
        self._program = program
        self._uniforms = set(program)
        self._written: dict[str, bytes] = {}
        self._placed: dict[str, tuple[int, ...]] = {}

    def set(self, values: Uniforms) -> None:
        """Set uniforms."""
        for name, value in values.items():
            data = value.tobytes()
            if self._written.get(name) != data:
                self._written[name] = data
                if name in self._uniforms:  # the compiler may remove unused uniforms
                    self._program[name].write(data)

    def _set_integers(self, name: str, *numbers: int) -> None:
        if self._placed.get(name) != numbers:
            self._placed[name] = numbers
            self.set({name: np.array(numbers, np.int32)})

    def release(self) -> None:
        """Free the OpenGL program."""
        self._program.release()


class _Fragment(Compiled):
    """Fragment shader; runs by drawing a triangle that covers the window."""

    def __init__(self, ctx: Any, program: Any) -> None:
        super().__init__(ctx, program)
        self._vertices = ctx.vertex_array(program, [])

    def run(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        target: Any,
        region: Window | Groups,
        first_row: int = 0,
    ) -> None:
        if not isinstance(region, Window):
            raise TypeError("a fragment shader runs in a window, not in work groups")
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        rows, cols = region.size
        self._set_integers("origin", 0, first_row)
        target.viewport = (region.left, first_row + region.top, cols, rows)
        target.use()
        self._vertices.render(vertices=3)

    def release(self) -> None:
        self._vertices.release()
        super().release()


class _Compute(Compiled):
    """Compute shader; runs on listed work groups for tissue kernels, otherwise on a window."""

    def __init__(
        self,
        ctx: Any,
        program: Any,
        listed: bool,
        dispatch: Callable[[int, int, int], None] | None,
    ) -> None:
        super().__init__(ctx, program)
        self._listed = listed
        self._dispatch = dispatch
        self._first = 0 if dispatch is None else _FIRST_RUNS

    def run(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        target: Any,
        region: Window | Groups,
        first_row: int = 0,
    ) -> None:
        if isinstance(region, Groups) != self._listed:
            raise TypeError("tissue kernels run on listed groups, and other kernels in a window")
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        for unit, texture in enumerate(outputs):
            texture.bind_to_image(unit, read=False, write=True)
        self._set_integers("origin", 0, first_row)
        if isinstance(region, Window):
            rows, cols = (-(-size // side) for size, side in zip(region.size, GROUP, strict=True))
            self._set_integers("begin", region.left, region.top)
            self._set_integers("end", region.right, region.bottom)
        else:
            rows, cols = region.bottom - region.top, region.places.width
            region.places.use(len(inputs))
            self._set_integers("first_group", region.top)
            self._set_integers("end", *reversed(region.grid))
        if self._first and self._dispatch is not None:
            self._first -= 1
            self._dispatch(self._program.glo, cols, rows)
        else:
            self._program.run(cols, rows)
        self._ctx.memory_barrier()
