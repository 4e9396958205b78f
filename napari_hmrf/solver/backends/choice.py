"""Choice of the backend for a solve."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any, NamedTuple

from napari_hmrf.compute.compile_cache import compiler, loops
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import BackendError
from napari_hmrf.solver.backends import BACKEND_NAMES
from napari_hmrf.solver.backends.base import Backend, Checkpoint
from napari_hmrf.solver.backends.cpu import CpuBackend
from napari_hmrf.solver.backends.job import SolveJob

#: Reason given when "auto" selects a software rasterizer.
COMPILING = "until the loops for the processor are compiled"
#: Number of voxels above which it is faster to wait for the compiled loops than to solve on a
#: software rasterizer.
LARGE_VOLUME = 1_000_000
# Environment variable with which numba runs loops as Python functions.
_NO_COMPILER = "NUMBA_DISABLE_JIT"
# Reason why "auto" uses the loops after shaders failed in a solve.
_failed: Kept[str] = Kept()


class Choice(NamedTuple):
    """Backend that runs a solve, and the reason for its choice.

    Attributes
    ----------
    backend : Backend
    reason : str
        Reason for the choice, for display.
    """

    backend: Backend[Any]
    reason: str


def open_backend(
    job: SolveJob,
    name: str,
    checkpoint: Checkpoint,
    provide_loops: Callable[[], None] = loops.use,
) -> Choice:
    """Choose a backend and open it, on the compute thread only.

    Parameters
    ----------
    job : SolveJob
    name : str
        One of `BACKEND_NAMES`. "auto" selects the shaders on a real GPU. It selects the compiled
        loops if there is no OpenGL or only a software rasterizer, which is ten times slower than
        the loops, or if the shaders do not support the job. While another process compiles the
        loops, "auto" selects the rasterizer, but a volume of more than `LARGE_VOLUME` voxels waits
        for the loops.
    checkpoint : callable
        Called by the backend at least every `BATCH_SECONDS`; raises an exception to stop the work.
    provide_loops : callable
        Called before the loops are used; returns once they are compiled. By default, each loop is
        compiled at its first call.

    Returns
    -------
    Choice

    Raises
    ------
    BackendError
        If the requested backend is missing or does not support the job, or if the environment
        disables the compiler of the loops.
    """
    if os.environ.get(_NO_COMPILER, "0") not in ("", "0"):
        raise BackendError(
            f"the environment variable {_NO_COMPILER} disables the compiler that the solver needs. "
            "Unset it before Python starts."
        )
    if name not in BACKEND_NAMES:
        raise BackendError(f"unknown backend {name!r}; use one of {', '.join(BACKEND_NAMES)}")
    if name == "cpu":
        provide_loops()
        return Choice(_compiled_loops(checkpoint), "requested")
    from napari_hmrf.solver.backends.opengl import missing_shaders  # heavy: opengl

    missing = missing_shaders(job)
    if name != "auto":
        if missing is not None:
            raise BackendError(f'{missing}, not {name}. Use them (`backend="cpu"`).')
        return Choice(_requested_shaders(job, name, checkpoint), "requested")
    if missing is not None:
        provide_loops()
        return Choice(_compiled_loops(checkpoint), missing)
    return _fastest(job, checkpoint, provide_loops)


def use_loops_after(error: BackendError) -> None:
    """Use the loops in all later solves with "auto", because shaders failed in a solve."""
    _failed.value = f"the shaders failed in an earlier solve ({error})"


def failure_of_shaders() -> str | None:
    """Return why "auto" uses the loops since shaders failed in a solve, or None."""
    return _failed.value


def _fastest(job: SolveJob, checkpoint: Checkpoint, provide_loops: Callable[[], None]) -> Choice:
    """Choose between shaders and loops, which both support the job but perhaps not its size."""
    from napari_hmrf.solver.backends.opengl import (  # heavy: opengl
        OpenGLBackend,
        is_software_renderer,
    )

    compiled = _loops_are_ready(job)
    if _failed.value is not None:
        provide_loops()
        return Choice(_compiled_loops(checkpoint), _failed.value)
    try:
        shaders = OpenGLBackend(checkpoint)
    except BackendError as error:
        provide_loops()
        return Choice(_compiled_loops(checkpoint), f"no usable OpenGL ({error})")
    compiler.compile_meanwhile()
    refusal = shaders.supports(job)
    if refusal is not None:
        shaders.close()
        provide_loops()
        kind = "volume" if job.is_volume else "image"
        reason = f"the shaders do not support this {kind} ({refusal})"
        return Choice(_compiled_loops(checkpoint), reason)
    if not is_software_renderer(shaders.renderer):
        return Choice(shaders, "a GPU is available")
    is_large = job.is_volume and math.prod(job.shape) > LARGE_VOLUME
    if not (compiled or is_large):
        if job.is_volume:
            compiler.request(job.loops)
        return Choice(shaders, COMPILING)
    shaders.close()
    if job.is_volume:
        provide_loops()
    reason = f"OpenGL here is software only ({shaders.renderer})"
    return Choice(_compiled_loops(checkpoint), reason)


def _requested_shaders(job: SolveJob, name: str, checkpoint: Checkpoint) -> Backend[Any]:
    """Return the requested shader backend; raise an error if it does not support the job."""
    from napari_hmrf.solver.backends.opengl import OpenGLBackend  # heavy: opengl

    _loops_are_ready(job)
    compiler.compile_meanwhile()
    shaders = OpenGLBackend(checkpoint, stage=name.partition(":")[2] or None)
    refusal = shaders.supports(job)
    if refusal is not None:
        shaders.close()
        raise BackendError(refusal)
    return shaders


def _loops_are_ready(job: SolveJob) -> bool:
    """Return whether the loops for a job can be used without a delay."""
    if job.is_volume:
        loops.use(False)
        return loops.ready_for_volumes()
    are_ready = loops.ready(job.loops)
    loops.use(are_ready)  # the host's part uses them beside shaders, too
    return are_ready


def _compiled_loops(checkpoint: Checkpoint) -> Backend[Any]:
    """Return the backend of compiled loops."""
    return CpuBackend(checkpoint)
