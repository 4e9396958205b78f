"""Creation of a separate OpenGL context, and advice if no context can be created.

Existing contexts are not used or changed, because napari's context belongs to the GUI thread.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from napari_hmrf.errors import BackendError

#: Minimum versions of OpenGL, times 100: for fragment shaders, and for compute shaders.
REQUIRED_VERSION = 330
COMPUTE_VERSION = 430

_SOFTWARE = (
    "llvmpipe",
    "softpipe",
    "swrast",
    "software rasterizer",
    "swiftshader",
    "gdi generic",
    "microsoft basic render",
    "apple software renderer",
)


def is_software_renderer(renderer: str) -> bool:
    """Return whether a renderer string names a software renderer, which does not use a GPU."""
    return any(name in renderer.lower() for name in _SOFTWARE)


@dataclass(frozen=True, eq=False)
class Opened:
    """OpenGL context that is current on the calling thread.

    Attributes
    ----------
    ctx : moderngl.Context
    finish : callable
        Function that calls glFinish. Unlike moderngl's function, it releases the GIL.
    dispatch : callable
        Function that runs a compute program, given its OpenGL name and the number of work groups
        along the column and row axes. It releases the GIL, because the driver may compile the
        program first.
    way : str
        Description of how the context was created.
    """

    ctx: Any
    finish: Callable[[], None]
    dispatch: Callable[[int, int, int], None]
    way: str

    def release(self) -> None:
        """Unbind and destroy the context, including all its objects."""
        with self.ctx:
            pass  # leaving the block unbinds the context
        self.ctx.release()


def open_context() -> Opened:
    """Create a context, on a GPU if possible.

    Raises
    ------
    BackendError
        If no context can be created. The message contains advice and the error of each attempt.
    """
    refused: list[tuple[str, str]] = []
    software: _Way | None = None
    try:
        for way in _ways():
            try:
                opened = _open(way)
            except Exception as error:  # noqa: BLE001 - glcontext raises plain exceptions
                refused.append((way.name, str(error)))
                continue
            hardware = not is_software_renderer(opened.ctx.info["GL_RENDERER"])
            if hardware or not way.others:
                return opened
            opened.release()
            software = software or way
        if software is not None:
            try:
                return _open(software)
            except Exception as error:  # noqa: BLE001 - as above
                refused.append((software.name, str(error)))
    except ImportError as error:
        raise BackendError(
            f"moderngl cannot be imported ({error}). Install it again, or use the compiled loops "
            '(`backend="cpu"`).'
        ) from error
    raise BackendError(_no_context(refused))


@dataclass(frozen=True)
class _Way:
    """Way to create a context: a glcontext backend and its settings."""

    name: str
    make: Callable[..., Any]
    settings: dict[str, Any]
    #: True if there are several devices, so that another device may be better.
    others: bool = False


def _ways() -> Iterator[_Way]:
    import glcontext  # heavy: glcontext

    if not sys.platform.startswith("linux"):
        yield _Way("the system's OpenGL", glcontext.default_backend(), {})
        return
    egl = glcontext.get_backend_by_name("egl")
    # The versioned names are those of the run-time packages, for systems without development files.
    for libraries in ({}, {"libegl": "libEGL.so.1", "libgl": "libGL.so.1"}):
        chosen = os.environ.get("GLCONTEXT_DEVICE_INDEX")  # overrides the setting below
        devices = 1 if chosen else max(1, _device_count(egl, libraries))
        for index in [chosen] if chosen else range(devices):
            name = f"EGL device {index}" + (" by library name" if libraries else "")
            settings = {"device_index": 0 if chosen else index, **libraries}
            yield _Way(name, egl, settings, others=devices > 1)
    if os.environ.get("DISPLAY"):
        yield _Way(f"X11 display {os.environ['DISPLAY']}", glcontext.default_backend(), {})


def _device_count(egl: Callable[..., Any], libraries: dict[str, str]) -> int:
    """Return the number of EGL devices, from the error message for an invalid index."""
    try:
        egl(mode="standalone", glversion=REQUIRED_VERSION, device_index=1 << 16, **libraries)
    except Exception as error:  # noqa: BLE001 - glcontext raises plain exceptions
        found = re.search(r"found (\d+) devices", str(error))
        return int(found[1]) if found else 1
    return 1


def _open(way: _Way) -> Opened:
    import moderngl  # heavy: moderngl

    loader = _loader(way)
    store = getattr(moderngl, "_store", None)
    default = getattr(store, "default_context", None)
    try:
        ctx = moderngl.create_context(require=100, standalone=True, context=loader)
    finally:
        # moderngl makes the new context the default of the process, so restore the old default.
        if store is not None:
            store.default_context = default
    finish = _function(loader.load("glFinish"))
    opened = Opened(ctx, finish, _dispatch(loader), way.name)
    if ctx.version_code < REQUIRED_VERSION:
        found = f"found OpenGL {ctx.info['GL_VERSION']} on {ctx.info['GL_RENDERER']}"
        opened.release()
        raise RuntimeError(found)
    return opened


def _loader(way: _Way) -> Any:
    """Create a glcontext context for moderngl, with OpenGL 4.3 if possible.

    Some drivers provide exactly the requested version, so the newer version is tried first.
    """
    if sys.platform != "darwin":
        try:
            return way.make(mode="standalone", glversion=COMPUTE_VERSION, **way.settings)
        except Exception:  # noqa: BLE001 - the next attempt raises a useful error
            pass
    return way.make(mode="standalone", glversion=REQUIRED_VERSION, **way.settings)


def _dispatch(loader: Any) -> Callable[[int, int, int], None]:
    """Return a function that runs a compute shader; requires OpenGL 4.3."""
    use, run = loader.load("glUseProgram"), loader.load("glDispatchCompute")
    use_program = _function(use, ctypes.c_uint)
    dispatch_compute = _function(run, *[ctypes.c_uint] * 3)

    def dispatch(program: int, cols: int, rows: int) -> None:
        use_program(program)
        dispatch_compute(cols, rows, 1)

    return dispatch


def _function(address: int, *kinds: Any) -> Callable[..., None]:
    """Return the C function at an address as a Python function that releases the GIL."""
    if sys.platform == "win32":
        return ctypes.WINFUNCTYPE(None, *kinds)(address)
    return ctypes.CFUNCTYPE(None, *kinds)(address)


# Advice for each driver error message, most specific first.
_ADVICE = {
    r"found OpenGL|eglCreateContext failed|glXCreateContext|CreateContextAttribs": (
        "the driver offers no OpenGL 3.3 core profile, which the shaders need; update the graphics "
        "driver, and check whether a variable such as MESA_GL_VERSION_OVERRIDE or "
        "GLCONTEXT_GLVERSION requests an older version"
    ),
    r"requested device index .* found [1-9]": (
        "GLCONTEXT_DEVICE_INDEX names an EGL device that does not exist; unset it or lower it"
    ),
    r"eglInitialize failed|eglGetPlatformDisplay|eglGetDisplay": (
        "a driver was found but does not load; check LIBGL_DRIVERS_PATH, GALLIUM_DRIVER and the "
        "permission to use /dev/dri (group render), and install libgl1-mesa-dri"
    ),
    r"found 0 devices": (
        "no driver offers OpenGL through EGL; install the graphics card's driver or Mesa (Debian "
        "and Ubuntu: libegl1 libgl1-mesa-dri); a container with an NVIDIA card needs "
        "NVIDIA_DRIVER_CAPABILITIES=graphics"
    ),
    r"not loaded": (
        "the OpenGL libraries are missing; install them (Debian and Ubuntu: libegl1 libgl1 "
        "libgl1-mesa-dri, Fedora: libglvnd-egl mesa-dri-drivers)"
    ),
    r"XOpenDisplay": "the X display cannot be opened; unset DISPLAY to use only EGL",
}


def _no_context(refused: list[tuple[str, str]]) -> str:
    """Return an error message with advice for the most specific error and a list of all errors."""
    answers = [answer for _, answer in refused]
    advice = next(
        (
            advice
            for pattern, advice in _ADVICE.items()
            if any(re.search(pattern, answer) for answer in answers)
        ),
        "update the graphics driver",
    )
    tried = "; ".join(f"{name}: {answer}" for name, answer in dict(refused).items())
    return f'no usable OpenGL: {advice}, or use backend="cpu". (Tried: {tried}.)'
