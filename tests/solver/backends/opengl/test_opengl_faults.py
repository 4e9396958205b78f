"""Messages when OpenGL is missing, broken or outdated, each in a separate process."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from napari_hmrf.solver.backends.opengl import describe
from tests.support.opengl import on_compute_thread, require_opengl

_OPEN = """
import json
import os
import sys

import numba  # otherwise imported by every child

from napari_hmrf import BackendError, ElasticPrior, Multigrid
from napari_hmrf.solver.backends.choice import open_backend
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.compute.thread import compute_thread

image = SolveJob((9, 9), (1.0, 1.0), ElasticPrior(), Multigrid())

def job():
    backend, reason = open_backend(image, "auto", lambda: None)
    print("auto:", backend.name, reason)
    backend.close()
    try:
        open_backend(image, "opengl", lambda: None).backend.close()
    except BackendError as error:
        print("opengl:", error)

for name, variables in json.loads(sys.argv[1]).items():
    child = os.fork()
    if not child:
        os.environ.update(variables)
        print("case:", name)
        compute_thread.submit(job).result()
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, name
"""

_SOLVE = """
import numpy as np
from napari_hmrf import ICM, BackendError, ElasticPrior, Problem, SeilerPrior, solve
from napari_hmrf.solver.backends.opengl.images import relaxing

relaxing.WORTH_AGAIN = 0  # shaders visit small levels as often as loops do
random = np.random.default_rng(0)
m = np.ones((14, 11)); m[4:8, 3:7] = 3; m[0, :4] = 0
held = np.zeros((14, 11, 2)); held[[0, -1]] = 1
problem = Problem(observed=random.normal(size=held.shape), confidence=held, stiffness=m)
for steps in (None, ICM().steps):
    plan = ICM(iterations=20, steps=steps)
    loops = solve(problem, SeilerPrior(), optimizer=plan, backend="cpu")
    shaders = solve(problem, SeilerPrior(), optimizer=plan, backend="opengl")
    print(shaders.provenance.backend, shaders.provenance.renderer)
    print("off", np.abs(loops.displacement - shaders.displacement).max())
    print("energies", loops.mean_energy, shaders.mean_energy)
loops, shaders = (solve(problem, ElasticPrior(), backend=name) for name in ("cpu", "opengl"))
print(shaders.provenance.backend, shaders.provenance.renderer)
print("elastic", np.abs(loops.displacement - shaders.displacement).max(), shaders.iterations)
try:
    solve(problem, SeilerPrior(), backend="opengl:compute")
except BackendError as error:
    print("compute:", error)
"""


@pytest.fixture(autouse=True)
def mesa() -> None:
    """Skip the tests unless OpenGL is provided by Mesa, whose environment variables they use."""
    require_opengl()
    if not sys.platform.startswith("linux"):
        pytest.skip("the environment variables that disable OpenGL exist only on Linux")
    if "Mesa" not in on_compute_thread(describe)["version"]:
        pytest.skip("the environment variables that disable OpenGL exist only in Mesa")


def run(script: str, *arguments: str, **variables: str) -> str:
    """Return the output of a process with the given arguments and environment variables."""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=environment | variables | {"NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


#: Environment variables that disable OpenGL, and words of the expected messages.
_MISSING = {
    "no vendor": (
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/dev/null"},
        ["no driver offers OpenGL through EGL", "libegl1", "NVIDIA_DRIVER_CAPABILITIES"],
    ),
    "no driver": (
        {"LIBGL_DRIVERS_PATH": "/nonexistent"},
        ["does not load", "LIBGL_DRIVERS_PATH", "/dev/dri", "0x3001"],
    ),
    "too old": (
        {"MESA_GL_VERSION_OVERRIDE": "3.2"},
        ["no OpenGL 3.3", "MESA_GL_VERSION_OVERRIDE", "0x3009"],
    ),
    "no such device": (
        {"GLCONTEXT_DEVICE_INDEX": "7"},
        ["GLCONTEXT_DEVICE_INDEX", "does not exist", "EGL device 7"],
    ),
    "no library": (
        {"GLCONTEXT_LINUX_LIBEGL": "libnone.so"},
        ["libraries are missing", "libegl1"],
    ),
}


def test_each_missing_part_of_opengl_is_reported_with_a_remedy():
    said = run(_OPEN, json.dumps({name: variables for name, (variables, _) in _MISSING.items()}))
    parts = dict(part.split("\n", 1) for part in said.split("case: ")[1:])
    assert parts.keys() == _MISSING.keys()
    for name, (_, words) in _MISSING.items():
        assert "auto: cpu no usable OpenGL" in parts[name], name
        message = parts[name].split("opengl: ")[1]
        for word in (*words, 'backend="cpu"'):
            assert word in message, name


def test_opengl_3_3_suffices():
    said = run(_SOLVE, GALLIUM_DRIVER="softpipe")
    assert said.count("opengl:fragment softpipe") == 3
    elastic = next(line.split() for line in said.splitlines() if line.startswith("elastic"))
    assert float(elastic[1]) < 1e-4
    assert int(elastic[2]) > 1
    offs = [float(line.split()[1]) for line in said.splitlines() if line.startswith("off")]
    closed_form, candidates = offs
    assert closed_form < 1e-4
    assert candidates < 0.2  # rounding decides between equal candidates
    for line in said.splitlines():
        if line.startswith("energies"):
            loops, shaders = (float(word) for word in line.split()[1:])
            assert shaders == pytest.approx(loops, rel=0.05)
    message = said.split("compute: ")[1]
    for word in ("OpenGL 4.3", "softpipe", 'backend="opengl:fragment"'):
        assert word in message
