"""Compiled kernels, and how each stage runs one over a grid of sites."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends.opengl.source import GROUP, KERNELS, Stage, compose, vertices
from napari_hmrf.errors import BackendError

Uniforms = Mapping[str, npt.NDArray[np.float32] | npt.NDArray[np.int32]]


class Window(NamedTuple):
    """A rectangle of a grid's texels: rows ``top`` to ``bottom``, columns ``left`` to ``right``."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def size(self) -> tuple[int, int]:
        """How many rows and columns it has."""
        return self.bottom - self.top, self.right - self.left

    def strip(self, begin: int, end: int) -> Window:
        """Return some of its rows, counted from its top."""
        return self._replace(top=self.top + begin, bottom=self.top + end)


class Program(Protocol):
    """A kernel, ready to run."""

    def set(self, values: Uniforms) -> None:
        """Give uniforms their values; they keep them."""
        ...

    def run(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        target: Any,
        window: Window,
        first_row: int = 0,
    ) -> None:
        """Run the kernel once for each texel of a window; returns before the device has done it.

        Parameters
        ----------
        inputs, outputs : sequence of moderngl.Texture
            In the kernel's order. No texture may be both.
        target : moderngl.Framebuffer or None
            Of the outputs; for the fragment stage. If it has a mask (`Device.mask`), the kernel is
            run in tissue only, and other texels keep what they hold.
        window : Window
            The texels to run.
        first_row : int
            Row of the outputs in which the grid of texels begins.
        """
        ...

    def release(self) -> None:
        """Free what OpenGL holds of it."""
        ...


def compile_program(
    ctx: Any, name: str, stage: Stage, defines: Mapping[str, int] | None = None
) -> Program:
    """Compile a kernel for a stage.

    Raises
    ------
    BackendError
        With the compiler's words and the numbered text, if it does not compile.
    """
    source = compose(name, stage, defines)
    try:
        if stage == "compute":
            program = ctx.compute_shader(source.text)
        else:
            program = ctx.program(vertex_shader=vertices().text, fragment_shader=source.text)
    except Exception as error:
        raise BackendError(
            f"the {stage} shader {name}.glsl does not compile on {ctx.info['GL_RENDERER']}; please "
            f"report this with what follows\n{source.explain(str(error))}"
        ) from error
    for unit, texture in enumerate(KERNELS[name].inputs):
        if texture in program:
            program[texture].value = unit
    if stage == "compute":
        return _Compute(ctx, program)
    return _Fragment(ctx, program)


class _Compiled:
    """What both stages share: uniforms that are written only when they change."""

    def __init__(self, ctx: Any, program: Any) -> None:
        self._ctx = ctx
        self._program = program
        self._written: dict[str, bytes] = {}
        self._placed: dict[str, tuple[int, ...]] = {}

    def set(self, values: Uniforms) -> None:
        for name, value in values.items():
            data = value.tobytes()
            if self._written.get(name) != data:
                self._written[name] = data
                if name in self._program:  # else the compiler saw that it does not matter
                    self._program[name].write(data)

    def _place(self, name: str, *numbers: int) -> None:
        if self._placed.get(name) != numbers:
            self._placed[name] = numbers
            self.set({name: np.array(numbers, np.int32)})

    def release(self) -> None:
        self._program.release()


class _Fragment(_Compiled):
    """A fragment shader over a triangle that fills the window."""

    def __init__(self, ctx: Any, program: Any) -> None:
        super().__init__(ctx, program)
        self._vertices = ctx.vertex_array(program, [])

    def run(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        target: Any,
        window: Window,
        first_row: int = 0,
    ) -> None:
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        rows, cols = window.size
        self._place("origin", 0, first_row)
        target.viewport = (window.left, first_row + window.top, cols, rows)
        target.use()
        self._vertices.render(vertices=3)

    def release(self) -> None:
        self._vertices.release()
        super().release()


class _Compute(_Compiled):
    """A compute shader over work groups that cover the window."""

    def run(
        self,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        target: Any,
        window: Window,
        first_row: int = 0,
    ) -> None:
        for unit, texture in enumerate(inputs):
            texture.use(unit)
        for unit, texture in enumerate(outputs):
            texture.bind_to_image(unit, read=False, write=True)
        rows, cols = window.size
        self._place("origin", 0, first_row)
        self._place("begin", window.left, window.top)
        self._place("end", window.right, window.bottom)
        self._program.run(-(-cols // GROUP[1]), -(-rows // GROUP[0]))
        self._ctx.memory_barrier()
