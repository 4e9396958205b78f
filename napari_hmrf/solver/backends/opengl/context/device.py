"""The process's OpenGL device: one context, its limits and its compiled kernels.

It is made by the first solve that needs it, kept for the next ones, and belongs to the compute
thread. When it cannot be trusted any more it is dropped, and the next solve makes a new one.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends.opengl.context.context import (
    COMPUTE_VERSION,
    is_software_renderer,
    open_context,
)
from napari_hmrf.solver.backends.opengl.programs.programs import Program, compile_program
from napari_hmrf.solver.backends.opengl.programs.regions import Window
from napari_hmrf.solver.backends.opengl.programs.source import Stage
from napari_hmrf.solver.backends.opengl.programs.volume_programs import (
    VolumeProgram,
    compile_volume,
)
from napari_hmrf.solver.backends.thread import compute_thread, in_child_of_fork

_log = logging.getLogger("napari_hmrf")


class Device:
    """An OpenGL context that computes, with what is worth keeping between solves.

    Attributes
    ----------
    ctx : moderngl.Context
    renderer : str
        GL_RENDERER and GL_VERSION, for provenance and bug reports.
    seconds : float
        How long it took to make the context.
    largest : int
        The most sites along an axis that a texture can hold and a pass can write.
    largest_buffer, most_buffers : int
        The most bytes of a storage buffer, and how many of them a compute shader has; 0 without.
    software : bool
        Whether it is a program that plays a GPU.
    rows : int
        How many texels an invocation does in the compute stage (`source.compose`): on a GPU one,
        as it needs many invocations.
    """

    def __init__(self) -> None:
        started = time.perf_counter()
        self._opened = open_context()
        self.seconds = time.perf_counter() - started
        self.ctx = self._opened.ctx
        self.way = self._opened.way
        self.finish = self._opened.finish
        info = self.ctx.info
        self.renderer = f"{info['GL_RENDERER']}, OpenGL {info['GL_VERSION']}"
        largest = int(min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"]))
        self.largest = largest // 2 * 2  # an odd number of columns gets one more
        self.largest_buffer = int(info.get("GL_MAX_SHADER_STORAGE_BLOCK_SIZE", 0))
        self.most_buffers = int(info.get("GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS", 0))
        self.software = is_software_renderer(self.renderer)
        self.rows = 4 if self.software else 1
        self.lost = False
        self._programs: dict[Any, Program] = {}
        self._volume_programs: dict[Any, VolumeProgram] = {}
        self._checked: set[str] = set()
        # moderngl binds the framebuffer in use again whenever it makes another one, even if it has
        # been released since. So one that stays is put to use before any other is released.
        self._home = self.ctx.simple_framebuffer((1, 1))
        self._home.use()
        # The drawn plane lies half-way into the picture: it shows where a mask is deeper, and
        # everywhere in a framebuffer that has none.
        self.ctx.enable_only(self.ctx.DEPTH_TEST)
        self.ctx.depth_func = "<"

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The shader stages that there are."""
        if self.ctx.version_code >= COMPUTE_VERSION:
            return ("fragment", "compute")
        return ("fragment",)

    @property
    def best_stage(self) -> Stage:
        """Compute shaders where there are any, even where a program plays the GPU.

        Mesa's llvmpipe has its threads meet twice in every pass that is drawn, which takes longer
        than a small pass does.
        """
        return "compute" if "compute" in self.stages else "fragment"

    def program(self, name: str, stage: Stage, defines: Mapping[str, int] | None = None) -> Program:
        """Compile a kernel, or return it if it has been compiled before."""
        key = (name, stage, self.rows, *sorted((defines or {}).items()))
        if key not in self._programs:
            self._programs[key] = compile_program(
                self.ctx, name, stage, defines, self.rows, self._opened.dispatch
            )
            self.check(f"compiling {name}")
        return self._programs[key]

    def volume_program(self, name: str, defines: Mapping[str, int] | None = None) -> VolumeProgram:
        """Compile a kernel for volumes, or return it if it has been compiled before."""
        key = (name, *sorted((defines or {}).items()))
        if key not in self._volume_programs:
            dispatch = self._opened.dispatch
            self._volume_programs[key] = compile_volume(self.ctx, name, defines, dispatch)
            self.check(f"compiling {name}")
        return self._volume_programs[key]

    def buffer(self, size: int) -> Any:
        """Allocate so many bytes of zeros, or say why that cannot be."""
        self.check("computing")
        what = f"a buffer of {size / 2**20:.0f} MiB"
        try:
            made = self.ctx.buffer(reserve=size)
        except Exception as error:  # noqa: BLE001 - moderngl raises its own and plain exceptions
            self.lose(f"making {what}: {error}")
        self.clear_buffer(made)
        noted = self.ctx.error
        if noted != "GL_NO_ERROR":
            made.release()
            self.lose(
                f"making {what}: {noted}. It is probably out of memory: downsample the volume, or "
                "close what else uses the graphics card"
            )
        return made

    def clear_buffer(self, buffer: Any) -> None:
        """Fill a buffer with zeros."""
        self._opened.clear(buffer.glo)

    def texture(self, shape: tuple[int, ...], components: int) -> Any:
        """Allocate a float32 texture of (rows, cols) texels, or say why it cannot be."""
        height, width = shape
        size = height * width * components * 4
        what = f"an image of {height} x {width} texels ({size / 2**20:.0f} MiB)"
        if not 0 < max(shape) <= self.largest or min(shape) < 1:
            raise BackendError(
                f"{self.renderer} takes images of up to {self.largest} x {self.largest}, not "
                f'{what}. Downsample it, cut it, or take backend="cpu".'
            )
        self.check("computing")
        try:
            texture = self.ctx.texture((width, height), components, dtype="f4")
        except Exception as error:  # noqa: BLE001 - moderngl raises its own and plain exceptions
            self.lose(f"making {what}: {error}")
        noted = self.ctx.error
        if noted != "GL_NO_ERROR":
            texture.release()
            self.lose(
                f"making {what}: {noted}. It is probably out of memory: downsample the image, or "
                "close what else uses the graphics card"
            )
        texture.filter = (self.ctx.NEAREST, self.ctx.NEAREST)
        return texture

    def mask(self, shown: npt.NDArray[np.bool_]) -> Any:
        """Make the depth image that lets a pass run on the texels, (rows, cols), that are shown."""
        self.check("computing")
        try:
            made = self.ctx.depth_texture(shown.shape[::-1])
            made.write(shown.astype(np.float32))
        except Exception as error:  # noqa: BLE001 - moderngl raises its own and plain exceptions
            self.lose(f"making a mask of {shown.shape[0]} x {shown.shape[1]} texels: {error}")
        self.check("making a mask")
        return made

    def framebuffer(self, textures: Sequence[Any], mask: Any = None) -> Any:
        """Make what draws into textures, where a mask shows them."""
        made = self.ctx.framebuffer(list(textures), mask)
        made.depth_mask = False
        return made

    def clear(self, target: Any) -> None:
        """Fill what a framebuffer draws into with zeros."""
        target.viewport = (0, 0, *target.size)
        target.use()
        target.clear()
        # Mesa's softpipe loses what is drawn next into a framebuffer just cleared.
        self._home.use()

    def free(self, objects: Iterable[Any]) -> None:
        """Release textures and framebuffers; nothing to do if they went with the context."""
        if not self.lost:
            self._home.use()
            for made in objects:
                made.release()

    def check(self, doing: str) -> None:
        """Drop the device if OpenGL has reported an error since the last look."""
        error = self.ctx.error
        if error != "GL_NO_ERROR":
            self.lose(f"{doing}: {error}")

    def lose(self, doing: str) -> NoReturn:
        """Give the device up: nothing that it computes from now on could be trusted."""
        self.release()
        raise BackendError(
            f"{self.renderer} failed while {doing}. The result was dropped; the next solve starts "
            'a new context. If it happens again, update the driver or take backend="cpu".'
        )

    def release(self) -> None:
        """Destroy the context with everything in it; safe to call twice."""
        if self.lost:
            return
        self.lost = True
        for program in self._programs.values():
            program.release()
        for volume_program in self._volume_programs.values():
            volume_program.release()
        self._programs.clear()
        self._volume_programs.clear()
        self._opened.release()

    def ensure(self, stage: Stage) -> None:
        """Solve the canary once with a stage; refuse a device that computes nonsense."""
        if stage not in self.stages:
            raise BackendError(
                f"compute shaders need OpenGL 4.3, but this is {self.renderer}. Take "
                'backend="opengl:fragment" or backend="cpu".'
            )
        if stage not in self._checked:
            self.canary(stage)
            self._checked.add(stage)

    def canary(self, stage: Stage) -> None:
        """Run the kernel whose answer is known; lose the device if it differs anywhere.

        Raises
        ------
        BackendError
            If one value differs, or OpenGL reports an error.
        """
        rows, cols = 5, 7
        n = np.arange(rows * cols, dtype=np.float32).reshape(rows, cols)[..., None] + 100
        row, col = np.ogrid[:rows, :cols]
        row, col = row[..., None], col[..., None]
        mirrored = n[::-1, ::-1]
        expected = (
            np.concatenate(
                [3 * mirrored, mirrored + col, mirrored - row, 2.0**20 + mirrored], axis=-1
            ),
            np.concatenate([mirrored / 4, row - col + 0 * mirrored], axis=-1),
            mirrored / 8 + row * col,
        )
        program = self.program("canary", stage)
        made: list[Any] = []
        try:
            made.append(self.texture((rows, cols), 1))
            made[0].write(n.tobytes())
            made += [self.texture((rows, cols), components) for components in (4, 2, 1)]
            outputs, target = made[1:], None
            if stage == "fragment":
                target = self.framebuffer(outputs)
                made.append(target)
            program.run(made[:1], outputs, target, Window(0, 0, rows, cols))
            self.finish()
            answers = [
                np.frombuffer(output.read(), np.float32).reshape(rows, cols, -1)
                for output in outputs
            ]
        finally:
            self.free(reversed(made))
        self.check("drawing the test image")
        for answer, exact in zip(answers, expected, strict=True):
            if not np.array_equal(answer, exact):
                wrong = int((answer != exact).sum())
                self.lose(
                    f"drawing the test image as a {stage} shader: {wrong} of {exact.size} values "
                    "are wrong, so it cannot be trusted with tissue"
                )


_device: Device | None = None
# Devices of a fork's parent: drivers do not share them, and the child does not release them.
_of_parent: list[Device] = []


def _disown() -> None:
    global _device
    if _device is not None:
        _of_parent.append(_device)
        _device = None


in_child_of_fork(_disown)


def the_device() -> Device:
    """Return the process's device; the first call makes it. On the compute thread only.

    Raises
    ------
    BackendError
        If there is no usable OpenGL, or the process that forked this one has used it.
    RuntimeError
        On any other thread.
    """
    global _device
    if not compute_thread.is_current():
        raise RuntimeError("OpenGL is used on the compute thread only; call solve() instead")
    if _of_parent:
        raise BackendError(
            "this process was forked from one that uses OpenGL, which does not survive that. Start "
            'it by "spawn" (multiprocessing.get_context("spawn")), or take backend="cpu".'
        )
    if _device is None or _device.lost:
        _device = Device()
        compute_thread.at_end(_device.release)
        _log.debug("OpenGL: %s, by %s, %.3f s", _device.renderer, _device.way, _device.seconds)
    return _device
