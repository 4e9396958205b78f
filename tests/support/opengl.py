"""Check for OpenGL, and jobs on the compute thread."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import pytest

from napari_hmrf import BackendError, Cancelled
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends.opengl import OpenGLBackend, describe
from tests.support.timeouts import LONG

T = TypeVar("T")


def on_compute_thread(job: Callable[[], T]) -> T:
    """Run a job on the compute thread, where OpenGL may be used."""
    return compute_thread.submit(job).result(timeout=LONG)


def count_looks(stage: str, optimizer, problem, prior, stop_at: int | None = None) -> int:
    """Solve with shaders, cancel at a given check, and return the number of earlier checks."""
    looks = 0

    def look() -> None:
        nonlocal looks
        if looks == stop_at:
            raise Cancelled
        looks += 1

    def job() -> int:
        backend = OpenGLBackend(look, stage)
        try:
            optimizer.run(problem, prior, backend, lambda _: None)
        finally:
            backend.close()
        return looks

    return on_compute_thread(job)


@cache
def _description() -> dict[str, Any] | str:
    try:
        return on_compute_thread(describe)
    except BackendError as error:
        return str(error)


def require_opengl(stage: str | None = None) -> None:
    """Skip a test that this machine cannot run, or fail it if OpenGL is expected."""
    description = _description()
    supposed = bool(os.environ.get("CI"))
    if isinstance(description, str):
        reason = description
    elif stage is not None and stage not in description["stages"]:
        reason = f"{description['renderer']} has no {stage} shaders"
        supposed = supposed and sys.platform.startswith("linux")
    else:
        return
    if supposed:
        pytest.fail(reason)
    pytest.skip(reason)


def has_opengl() -> bool:
    """Return whether this machine can run the shaders; fail if OpenGL is expected and missing."""
    try:
        require_opengl()
    except pytest.skip.Exception:
        return False
    return True


def left(objects) -> int:
    """Return the number of objects that OpenGL has not released."""
    return sum(type(each.mglo).__name__ != "InvalidObject" for each in objects)
