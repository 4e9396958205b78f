"""Self-test: a report on the system and on the results of each backend.

The report is plain text for a bug report, and omits the names of the user and of the home folder.
"""

from __future__ import annotations

import getpass
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import BackendError, HmrfError
from napari_hmrf.samples.phantoms import phantom
from napari_hmrf.solver.backends.choice import open_backend
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.solver.optimizers import ICM, Multigrid
from napari_hmrf.solver.priors import ElasticPrior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solve import solve

#: Largest allowed errors of a backend for an affine field, in pixels: with the closed form, with a
#: candidate set, and with the elastic prior.
CLOSED_FORM_BOUND = 0.001
CANDIDATES_BOUND = 0.02
ELASTIC_BOUND = 0.001

# Shape of the test volume, which is wider than a work group of the shaders and has several levels.
_VOLUME = (9, 12, 37)
_BACKENDS = ("cpu", "opengl:fragment", "opengl:compute")
_PACKAGES = (
    *("napari-hmrf", "napari", "numpy", "scipy", "numba", "llvmlite", "moderngl", "glcontext"),
    *("qtpy", "PyQt6", "PyQt5", "PySide6", "superqt", "vispy", "magicgui"),
)
_SETTINGS = (
    *("DISPLAY", "WAYLAND_DISPLAY", "QT_API", "QT_QPA_PLATFORM", "PYOPENGL_PLATFORM"),
    *("GALLIUM_DRIVER", "LIBGL_ALWAYS_SOFTWARE", "LIBGL_DRIVERS_PATH", "MESA_GL_VERSION_OVERRIDE"),
    *("GLCONTEXT_DEVICE_INDEX", "GLCONTEXT_LINUX_LIBEGL", "GLCONTEXT_LINUX_LIBGL"),
    *("__EGL_VENDOR_LIBRARY_FILENAMES", "NUMBA_NUM_THREADS", "NUMBA_DISABLE_JIT"),
)


def selftest(write: Callable[[str], None] = print) -> bool:
    """Check this installation and write a report.

    Parameters
    ----------
    write : callable
        Function called with each line of the report.

    Returns
    -------
    bool
        True if at least one backend is available, and the results of all backends are correct.
    """

    def write_line(line: str) -> None:
        write(_anonymous(line))

    write_line("napari-hmrf self-test")
    write_line("")
    _report_versions(write_line)
    _report_opengl(write_line)
    write_line("solves")
    outcomes = [_check_backend(name, write_line) for name in _BACKENDS]
    passed = False not in outcomes and True in outcomes
    write_line("")
    write_line("PASS" if passed else "FAIL")
    return passed


def affine_example(shape: tuple[int, ...] = (16, 23)) -> tuple[Problem, np.ndarray[Any, Any]]:
    """Return a problem with an affine solution, and its solution.

    The border of uniform tissue moves by an affine field. This field satisfies equilibrium inside
    the tissue for every mechanical prior, so it is the exact solution.

    Parameters
    ----------
    shape : tuple of int
        Shape of the image or volume.

    Returns
    -------
    problem : Problem
    field : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Exact displacement of each site, in pixels.
    """
    axes = len(shape)
    sites = np.moveaxis(np.indices(shape), 0, -1) - (np.array(shape) - 1) / 2
    gradient = np.array([[0.06, 0.03, 0.01], [-0.02, 0.04, 0.03], [0.02, -0.01, -0.05]])
    field = sites @ gradient[:axes, :axes].T + np.array([0.7, -1.3, 0.4])[:axes]
    border = np.ones((*shape, axes), dtype=bool)
    border[(slice(1, -1),) * axes] = False
    return Problem(observed=field * border, confidence=border, stiffness=np.ones(shape)), field


def _report_versions(write_line: Callable[[str], None]) -> None:
    write_line("system")
    _list(
        write_line,
        {
            "Python": f"{platform.python_version()} ({platform.python_implementation()})",
            "system": f"{platform.system()} {platform.release()}",
            "processor": f"{platform.machine()}, {os.cpu_count()} threads",
        },
    )
    write_line("")
    write_line("packages")
    found = {}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    _list(write_line, found)
    write_line("")
    settings = {name: os.environ[name] for name in _SETTINGS if name in os.environ}
    if settings:
        write_line("environment variables")
        _list(write_line, settings)
        write_line("")


def _report_opengl(write_line: Callable[[str], None]) -> None:
    write_line("OpenGL")

    from napari_hmrf.solver.backends import opengl  # heavy: opengl

    try:
        _list(write_line, compute_thread.submit(opengl.describe).result())
    except BackendError as error:
        write_line(f"  not usable: {error}")
    write_line("")


def _check_backend(name: str, write_line: Callable[[str], None]) -> bool | None:
    """Return whether the results of a backend are correct, or None if it is not available."""
    write_line(f"  {name}")
    image, volume = affine_example(), affine_example(_VOLUME)
    refusal = _refusal(name, image[0])
    if refusal is not None:
        write_line(f"    not available: {refusal}")
        return None
    elastic = (ElasticPrior(), Multigrid(tolerance=1e-4), ELASTIC_BOUND)
    checks: list[tuple[Any, ...]] = [
        ("closed form", image, SeilerPrior(), ICM(iterations=1000, steps=None), CLOSED_FORM_BOUND),
        ("candidate set", image, SeilerPrior(), ICM(iterations=300), CANDIDATES_BOUND),
        ("elastic", image, *elastic),
    ]
    if name != "cpu" and (refusal := _refusal(name, volume[0])) is not None:
        write_line(f"    no volumes: {refusal}")
    elif name != "cpu" or loops.ready_for_volumes():  # the report does not wait for the compiler
        checks.append(("elastic volume", volume, *elastic))
    passed = True
    try:
        for title, (problem, field), prior, schedule, bound in checks:
            solution = solve(problem, prior, optimizer=schedule, backend=name)
            off = float(np.abs(solution.displacement - field).max())
            right = off <= bound
            passed = passed and right
            write_line(
                f"    {'PASS' if right else 'FAIL'} affine motion, {title}: "
                f"max error {off:.1e} px (at most {bound:g})"
            )
        for timing in _timings(name):
            write_line(f"    {timing}")
    except HmrfError as failure:
        write_line(f"    FAIL {failure}")
        return False
    return passed


def _refusal(name: str, problem: Problem) -> BackendError | None:
    """Return the error if a backend is not available or does not support a problem, else None."""
    try:
        job = SolveJob.of(problem, ElasticPrior().resolved(problem), Multigrid())
        opened = partial(open_backend, job, name, lambda: None)
        compute_thread.submit(lambda: opened().backend.close()).result()
    except BackendError as error:
        return error
    return None


def _timings(name: str) -> Iterator[str]:
    """Yield descriptions of the solve times for an image of the paper's size."""
    problem = phantom("expansion").problem
    started = time.perf_counter()
    solution = solve(problem, SeilerPrior(), backend=name)
    seconds = time.perf_counter() - started
    visits = sum(level.iterations * math.prod(level.shape) for level in solution.levels)
    yield (
        f"300 x 300, {solution.iterations} iterations: {seconds:.2f} s, "
        f"{1e9 * solution.provenance.seconds / visits:.1f} ns per site and iteration"
    )
    solve(problem, ElasticPrior(), backend=name)
    started = time.perf_counter()
    solution = solve(problem, ElasticPrior(), backend=name)
    seconds = time.perf_counter() - started
    yield f"300 x 300, elastic, second solve: {seconds:.3f} s, {solution.iterations} cycles"


def _list(
    write_line: Callable[[str], None], entries: Mapping[str, Any], indent: str = "  "
) -> None:
    """Write names and values in two columns; nested mappings are indented below their name."""
    width = max((len(str(name)) for name in entries), default=0)
    for name, value in entries.items():
        if isinstance(value, Mapping):
            write_line(f"{indent}{name}")
            _list(write_line, value, indent + "  ")
            continue
        if isinstance(value, (list, tuple)):
            value = ", ".join(str(item) for item in value) or "none"
        write_line(f"{indent}{name!s:<{width}}  {value}")


def _anonymous(text: str) -> str:
    """Replace the home folder and the user name in a text with tildes."""
    text = text.replace(str(Path.home()), "~")
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):
        return text
    # Only names between slashes are replaced, because a short name may be a part of other words.
    return text.replace(f"/{user}/", "/~/").replace(f"\\{user}\\", "\\~\\")
