"""The devices that can run the kernels, and the choice between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, get_args

from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends.base import BATCH_SECONDS, Backend, Checkpoint, SiteRule
from napari_hmrf.solver.backends.compile_cache import compiler, kept, loops
from napari_hmrf.solver.backends.thread import compute_thread

#: What can be asked for by name. "opengl" takes compute shaders where the driver has them.
BackendName = Literal["auto", "opengl", "opengl:fragment", "opengl:compute", "cpu"]
BACKEND_NAMES: tuple[str, ...] = get_args(BackendName)

#: Why a software rasteriser is taken where nobody asked for it.
COMPILING = "until the loops for the processor are compiled"
#: Why the compiled loops are taken for a volume that there are no shaders for.
FOR_VOLUMES = "only the compiled loops solve such volumes"
#: Of a volume of more voxels to wait for its loops takes less than to do without, on a rasteriser.
LARGE_VOLUME = 1_000_000

#: Why the compiled loops are taken for large motion.
FOR_LARGE_MOTION = "only the compiled loops solve large motion"

__all__ = [
    "BACKEND_NAMES",
    "BATCH_SECONDS",
    "COMPILING",
    "FOR_LARGE_MOTION",
    "FOR_VOLUMES",
    "Backend",
    "BackendName",
    "Checkpoint",
    "SiteRule",
    "compute_thread",
    "open_backend",
]


def open_backend(
    name: str,
    checkpoint: Checkpoint,
    provide_loops: Callable[[], None] = loops.use,
    volume: tuple[int, ...] = (),
    plain: bool = True,
    large_motion: bool = False,
) -> tuple[Backend[Any], str]:
    """Make a backend ready; on the compute thread only.

    Parameters
    ----------
    name : str
        One of `BACKEND_NAMES`. "auto" takes the shaders on a real GPU, and the compiled loops
        where there is only a software rasteriser (ten times slower than they) or no OpenGL. Until
        the loops are compiled, which it has another process do, it takes the rasteriser; for a
        volume of more than `LARGE_VOLUME` voxels it waits for them.
    checkpoint : callable
        Called by the backend at least every `BATCH_SECONDS`; raises to stop the work.
    provide_loops : callable
        Called before the loops are taken where they may not be compiled yet: has that done, and
        waits for it. By default they are compiled as they are called.
    volume : (int, int, int), optional
        The voxels (D, H, W) that it is for, if it is a volume. Shaders take it if there are compute
        shaders, and buffers that are large enough.
    plain : bool
        Whether it is for the elastic prior, of tissue without loads of which nothing is rigid and
        nothing may slip: of volumes there are shaders for no other.
    large_motion : bool
        Whether it is for large motion, for which there are no shaders.

    Returns
    -------
    Backend
    str
        Why it was taken, in words.

    Raises
    ------
    BackendError
        What is missing, and how to get it.
    """
    if name == "cpu":
        provide_loops()
        return _compiled(checkpoint), "asked for"
    if name not in BACKEND_NAMES:
        raise BackendError(f"there is no backend {name!r}; take one of {', '.join(BACKEND_NAMES)}")
    if large_motion:
        if name != "auto":
            raise BackendError(
                f"large motion is solved by the compiled loops only, not by {name}. Take "
                'backend="cpu", or "auto"'
            )
        provide_loops()
        return _compiled(checkpoint), FOR_LARGE_MOTION
    if volume and not plain:
        if name != "auto":
            raise BackendError(
                f"{name} solves volumes of elastic tissue without loads only, of which nothing is "
                'rigid or may slip; the compiled loops solve all. Take backend="cpu", or "auto"'
            )
        provide_loops()
        return _compiled(checkpoint), FOR_VOLUMES
    from napari_hmrf.solver.backends.opengl import OpenGLBackend, is_software_renderer

    compiled = loops.ready_for_volumes() if volume else loops.ready()
    if name != "auto":
        if not volume:
            compiler.compile_meanwhile()
        asked = OpenGLBackend(checkpoint, stage=name.partition(":")[2] or None)
        asked.check_volume(volume)
        return asked, "asked for"
    try:
        backend = OpenGLBackend(checkpoint)
    except BackendError as error:
        provide_loops()
        return _compiled(checkpoint), f"no usable OpenGL ({error})"
    if not volume:
        compiler.compile_meanwhile()
    try:
        backend.check_volume(volume)
    except BackendError as error:
        backend.close()
        provide_loops()
        return _compiled(checkpoint), f"the shaders refuse this volume ({error})"
    if not is_software_renderer(backend.renderer):
        return backend, "a GPU is there"
    if not (compiled or math.prod(volume) > LARGE_VOLUME):
        if volume:
            compiler.request(kept.VOLUMES)
        return backend, COMPILING
    backend.close()
    if volume:
        provide_loops()
    return _compiled(checkpoint), f"OpenGL here is software only ({backend.renderer})"


def _compiled(checkpoint: Checkpoint) -> Backend[Any]:
    """Return the backend of loops."""
    from napari_hmrf.solver.backends.cpu import CpuBackend

    return CpuBackend(checkpoint)
