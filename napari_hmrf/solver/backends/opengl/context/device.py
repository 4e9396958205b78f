"""OpenGL device of the process: one context, its limits and its compiled kernels.

The first solve that needs the device creates it on the compute thread, and later solves reuse it.
After an error the device is released, and the next solve creates a new device.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import in_child_of_fork
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
from napari_hmrf.solver.backends.opengl.programs.volume_source import TOGETHER

_log = logging.getLogger("napari_hmrf")


class Device:
    """OpenGL context with its limits and compiled kernels, shared by all solves.

    Attributes
    ----------
    ctx : moderngl.Context
    renderer : str
        GL_RENDERER and GL_VERSION, for provenance and bug reports.
    seconds : float
        Time to create the context, in seconds.
    way : str
        Description of how the context was created.
    largest : int
        Largest number of sites along an axis of a texture.
    largest_buffer, most_buffers : int
        Largest size of a storage buffer in bytes, and largest number of storage buffers in a
        compute shader; 0 if compute shaders are not supported.
    software : bool
        True for a software renderer.
    rows : int
        Number of texels that an invocation computes in the compute stage (see `source.compose`);
        1 on a GPU, because a GPU needs many invocations.
    lost : bool
        True after the device was released, for example after an error.
    kept_model : GLModel or None
        Model of the last image, for the next solve of the same tissue.
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
        self.largest = largest // 2 * 2  # textures have an even number of columns
        self.largest_buffer = int(info.get("GL_MAX_SHADER_STORAGE_BLOCK_SIZE", 0))
        self.most_buffers = int(info.get("GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS", 0))
        self.software = is_software_renderer(self.renderer)
        self.rows = 8 if self.software else 1
        self.lost = False
        self.kept_model: Any = None
        self._programs: dict[Any, Program] = {}
        self._volume_programs: dict[Any, VolumeProgram] = {}
        self._checked: set[str] = set()
        # After creating a framebuffer, moderngl rebinds the previously bound framebuffer, even if
        # it has been released. Therefore bind a permanent framebuffer before each release.
        self._idle_framebuffer = self.ctx.simple_framebuffer((1, 1))
        self._idle_framebuffer.use()
        # The triangle has depth 0.5, so the depth test passes where the mask is 1. Without a mask,
        # the depth test always passes.
        self.ctx.enable_only(self.ctx.DEPTH_TEST)
        self.ctx.depth_func = "<"

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Shader stages that the context supports."""
        if self.ctx.version_code >= COMPUTE_VERSION:
            return ("fragment", "compute")
        return ("fragment",)

    @property
    def best_stage(self) -> Stage:
        """Default stage: compute if available, even on a software renderer.

        Mesa's llvmpipe synchronizes its threads twice in each pass of a fragment shader, which
        takes longer than the computation of a small pass.
        """
        return "compute" if "compute" in self.stages else "fragment"

    def program(self, name: str, stage: Stage, defines: Mapping[str, int] | None = None) -> Program:
        """Return the program of a kernel for images, compiled on first use."""
        key = (name, stage, self.rows, *sorted((defines or {}).items()))
        if key not in self._programs:
            self._programs[key] = compile_program(
                self.ctx, name, stage, defines, self.rows, self._opened.dispatch
            )
            self.check(f"compiling {name}")
        return self._programs[key]

    def volume_program(self, name: str, defines: Mapping[str, int] | None = None) -> VolumeProgram:
        """Return the program of a kernel for volumes, compiled on first use."""
        key = (name, *sorted((defines or {}).items()))
        if key not in self._volume_programs:
            dispatch = self._opened.dispatch
            self._volume_programs[key] = compile_volume(self.ctx, name, defines, dispatch)
            self.check(f"compiling {name}")
        return self._volume_programs[key]

    def buffer(self, size: int) -> Any:
        """Allocate a zero-filled buffer of `size` bytes; raise `BackendError` on failure."""
        self.check("computing")
        description = f"a buffer of {size / 2**20:.0f} MiB"
        try:
            made = self.ctx.buffer(reserve=size)
        except Exception as error:  # noqa: BLE001 - moderngl raises its own and plain exceptions
            self.lose(f"allocating {description}: {error}")
        self.clear_buffer(made)
        failure = self.ctx.error
        if failure != "GL_NO_ERROR":
            made.release()
            self.lose(
                f"allocating {description}: {failure}. The device is probably out of memory: "
                "downsample the volume, or close other programs that use the graphics card"
            )
        return made

    def clear_buffer(self, buffer: Any) -> None:
        """Fill a buffer with zeros, by a kernel, as glClearBufferData is slow on some drivers."""
        count = buffer.size // 4
        program = self.volume_program("volume_clear")
        program.set({"count": np.array([count], np.int32)})
        program.bind({"values": [buffer]})
        program.run(0, -(-count // TOGETHER))

    def write_buffer(self, buffer: Any, values: npt.NDArray[Any]) -> None:
        """Copy an array to a buffer, after all kernels have finished.

        OpenGL promises this order without a wait, but an NVIDIA driver (580.159, H100) executed
        the copy before kernels that were started earlier.
        """
        self.finish()
        buffer.write(np.ascontiguousarray(values))

    def texture(self, shape: tuple[int, ...], components: int, data: Any = None) -> Any:
        """Allocate a float32 texture of (rows, cols) texels; raise `BackendError` on failure.

        The texture contains the bytes of the buffer `data`, or is not initialized.
        """
        height, width = shape
        size = height * width * components * 4
        description = f"an image of {height} x {width} texels ({size / 2**20:.0f} MiB)"
        if not 0 < max(shape) <= self.largest or min(shape) < 1:
            raise BackendError(
                f"{self.renderer} supports images of up to {self.largest} x {self.largest}, not "
                f"{description}. Downsample or crop the image, or use the compiled loops "
                '(`backend="cpu"`).'
            )
        self.check("computing")
        try:
            texture = self.ctx.texture((width, height), components, data, dtype="f4")
        except Exception as error:  # noqa: BLE001 - moderngl raises its own and plain exceptions
            self.lose(f"allocating {description}: {error}")
        failure = self.ctx.error
        if failure != "GL_NO_ERROR":
            texture.release()
            self.lose(
                f"allocating {description}: {failure}. The device is probably out of memory: "
                "downsample the image, or close other programs that use the graphics card"
            )
        texture.filter = (self.ctx.NEAREST, self.ctx.NEAREST)
        return texture

    def mask(self, shown: npt.NDArray[np.bool_]) -> Any:
        """Create a depth texture that limits passes to the True texels of a mask (rows, cols)."""
        self.check("computing")
        try:
            made = self.ctx.depth_texture(shown.shape[::-1])
            made.write(shown.astype(np.float32))
        except Exception as error:  # noqa: BLE001 - moderngl raises its own and plain exceptions
            self.lose(f"allocating a mask of {shown.shape[0]} x {shown.shape[1]} texels: {error}")
        self.check("allocating a mask")
        return made

    def framebuffer(self, textures: Sequence[Any], mask: Any = None) -> Any:
        """Create a framebuffer for textures, with an optional mask that limits drawing."""
        made = self.ctx.framebuffer(list(textures), mask)
        made.depth_mask = False
        return made

    def clear(self, target: Any) -> None:
        """Fill the textures of a framebuffer with zeros."""
        target.viewport = (0, 0, *target.size)
        target.use()
        target.clear()
        # Mesa's softpipe drops the next pass into a framebuffer that was just cleared, unless
        # another framebuffer was bound in between.
        self._idle_framebuffer.use()

    def free(self, objects: Iterable[Any]) -> None:
        """Release textures and framebuffers, unless the context has released them."""
        if not self.lost:
            self._idle_framebuffer.use()
            for made in objects:
                made.release()

    def forget_model(self) -> None:
        """Free the textures of the kept model."""
        kept, self.kept_model = self.kept_model, None
        if kept is not None:
            kept.free()

    def check(self, doing: str) -> None:
        """Release the device and raise `BackendError` if OpenGL has reported an error.

        Parameters
        ----------
        doing : str
            Description of the operations since the last check, for the message.
        """
        error = self.ctx.error
        if error != "GL_NO_ERROR":
            self.lose(f"{doing}: {error}")

    def lose(self, doing: str) -> NoReturn:
        """Release the device after an error and raise `BackendError`.

        Parameters
        ----------
        doing : str
            Description of the operation that failed, for the message.
        """
        self.release()
        raise BackendError(
            f"{self.renderer} failed while {doing}. The result was discarded; the next solve "
            "starts a new context. If it happens again, update the driver or use the compiled "
            'loops (`backend="cpu"`).'
        )

    def release(self) -> None:
        """Destroy the context and all its objects; a second call has no effect."""
        if self.lost:
            return
        self.lost, self.kept_model = True, None
        for program in self._programs.values():
            program.release()
        for volume_program in self._volume_programs.values():
            volume_program.release()
        self._programs.clear()
        self._volume_programs.clear()
        self._opened.release()

    def ensure(self, stage: Stage) -> None:
        """Check that a stage is available, and run its test kernel once (`canary`)."""
        if stage not in self.stages:
            raise BackendError(
                f"compute shaders require OpenGL 4.3, but the device is {self.renderer}. Use "
                'fragment shaders (`backend="opengl:fragment"`) or the compiled loops '
                '(`backend="cpu"`).'
            )
        if stage not in self._checked:
            self.canary(stage)
            self._checked.add(stage)

    def canary(self, stage: Stage) -> None:
        """Run the test kernel, and compare its outputs with the known result.

        Raises
        ------
        BackendError
            If a value is wrong, or if OpenGL reports an error. The device is then released.
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
            for components in (4, 2, 1):
                made.append(self.texture((rows, cols), components))
                # The memory may hold the results of the last test, which would hide a failure.
                made[-1].write(np.full((rows, cols, components), np.nan, np.float32).tobytes())
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
                    "are wrong, so its results cannot be trusted"
                )


_device: Device | None = None
# In a forked child process: devices of the parent, which the child can neither use nor release.
_parent_devices: list[Device] = []


def _disown_device() -> None:
    global _device
    if _device is not None:
        _parent_devices.append(_device)
        _device = None


in_child_of_fork(_disown_device)


def the_device() -> Device:
    """Return the device of the process, created on first use.

    Raises
    ------
    BackendError
        If OpenGL cannot be used, or if this process was forked from a process that uses OpenGL.
    RuntimeError
        If the function is not called on the compute thread.
    """
    global _device
    if not compute_thread.is_current():
        raise RuntimeError("OpenGL can be used on the compute thread only; call solve() instead")
    if _parent_devices:
        raise BackendError(
            "this process was forked from a process that uses OpenGL, and a context cannot be used "
            'after a fork. Start the process with multiprocessing.get_context("spawn"), or use '
            'the compiled loops (`backend="cpu"`).'
        )
    if _device is None or _device.lost:
        _device = Device()
        compute_thread.at_end(_device.release)
        _log.debug("OpenGL: %s, by %s, %.3f s", _device.renderer, _device.way, _device.seconds)
    return _device
