"""Whether this machine can run the shaders, and jobs on the compute thread."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import pytest

from napari_hmrf import BackendError, Cancelled
from napari_hmrf.solver.backends import compute_thread
from napari_hmrf.solver.backends.opengl import OpenGLBackend, describe
from tests.support.timeouts import LONG

T = TypeVar("T")


def on_compute_thread(job: Callable[[], T]) -> T:
    """Run a job where OpenGL may be used."""
    return compute_thread.submit(job).result(timeout=LONG)


def count_looks(stage: str, optimizer, problem, prior, stop_at: int | None = None) -> int:
    """Solve with shaders of a stage, cancelled at a look; return the number of looks before."""
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
    """Skip a test that this machine cannot run; fail it where OpenGL is supposed to be."""
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
    """Whether this machine can run the shaders, which it is to where OpenGL is supposed to be."""
    try:
        require_opengl()
    except pytest.skip.Exception:
        return False
    return True


def left(objects) -> int:
    """How many objects OpenGL still has."""
    return sum(type(each.mglo).__name__ != "InvalidObject" for each in objects)
