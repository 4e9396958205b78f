"""A fresh process whose caches are empty: shaders and NumPy until the loops are compiled."""

import os
import subprocess
import sys

import numpy as np
import pytest
from opengl_here import require_opengl
from patience import LONG

from napari_hmrf import ICM, ElasticPrior, Multigrid, Problem, SeilerPrior, phantom, solve, warp
from napari_hmrf.backends import COMPILING, compiler, kept, loader, loops, open_backend
from napari_hmrf.backends.thread import compute_thread

MODELS = {
    "schedule": (SeilerPrior(), ICM()),
    "converged": (SeilerPrior(), Multigrid()),
    "blanket": (SeilerPrior(conditional="blanket"), Multigrid()),
    "elastic": (ElasticPrior(0.45), Multigrid()),
    "slipping": (ElasticPrior(0.45, penalty=100.0), Multigrid()),
}
PROBLEM = phantom("expansion", 40).problem


@pytest.fixture
def cold(monkeypatch, tmp_path):
    """No loops yet, and nobody who compiles them; the commands that would be started."""
    started = []

    class Compiler:
        def __init__(self, command):
            started.append(command)

        def terminate(self):
            """Nothing runs."""

    monkeypatch.delenv("NAPARI_HMRF_COMPILE")
    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    monkeypatch.setattr(loops._State, "solver", loops._Part())
    monkeypatch.setattr(loops._State, "pictures", loops._Part())
    monkeypatch.setattr(loops._State, "alone", False)
    monkeypatch.setattr(compiler._State, "compiler", None)
    monkeypatch.setattr(compiler, "_started", Compiler)
    monkeypatch.setattr(loader, "_loader", loader._Loader())
    return started


@pytest.mark.parametrize("model", MODELS)
def test_the_field_and_the_picture_are_those_of_the_loops(model, cold, monkeypatch):
    require_opengl()
    prior, optimizer = MODELS[model]
    early = solve(PROBLEM, prior, optimizer, backend="opengl")
    image = np.random.default_rng(0).random(PROBLEM.shape)
    seen = warp(image, early.displacement, PROBLEM.spacing, tissue=PROBLEM.tissue)
    assert not loops.in_use()
    monkeypatch.setenv("NAPARI_HMRF_COMPILE", "here")
    late = solve(PROBLEM, prior, optimizer, backend="cpu")
    if early.convergence is not None:
        sure = early.convergence.error + late.convergence.error
        off = np.abs(early.displacement - late.displacement).max() / PROBLEM.unit
        assert off < sure + 1e-5
    again = warp(image, early.displacement, PROBLEM.spacing, tissue=PROBLEM.tissue)
    np.testing.assert_allclose(seen, again, atol=1e-6)


def test_a_bone_moves_as_one_before_the_loops_are_compiled(cold, monkeypatch):
    require_opengl()
    m = PROBLEM.m.copy()
    m[18:23, 12:17] = np.inf
    bony = Problem(PROBLEM.y, PROBLEM.c, m, PROBLEM.spacing)
    early = solve(bony, ElasticPrior(0.3), backend="opengl")
    assert not loops.in_use()
    monkeypatch.setenv("NAPARI_HMRF_COMPILE", "here")
    late = solve(bony, ElasticPrior(0.3), backend="cpu")
    sure = early.convergence.error + late.convergence.error
    assert np.abs(early.displacement - late.displacement).max() / bony.unit < sure + 1e-5


def test_nothing_on_the_way_imports_the_compiler():
    require_opengl()
    code = """
import sys
import numpy as np
from napari_hmrf import ElasticPrior, phantom, solve, warp
problem = phantom("bar", 30).problem
found = solve(problem, ElasticPrior(0.3), backend="opengl")
warp(np.ones(problem.shape), found.displacement)
print("numba" in sys.modules)
"""
    empty = {**os.environ, "NUMBA_CACHE_DIR": "/nonexistent/cache"}
    del empty["NAPARI_HMRF_COMPILE"]
    done = subprocess.run(
        [sys.executable, "-c", code], env=empty, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False", done.stderr


def opened(name):
    """Which backend is taken, and why."""

    def job():
        backend, reason = open_backend(name, lambda: None)
        backend.close()
        return backend.name.partition(":")[0], reason

    return compute_thread.submit(job).result()


def test_a_rasteriser_in_software_is_taken_until_the_loops_are_compiled(cold):
    require_opengl()
    name, reason = opened("auto")
    if reason == "a GPU is there":
        pytest.skip("this machine takes its GPU anyhow")
    assert (name, reason) == ("opengl", COMPILING)
    assert cold == [[sys.executable, "-m", compiler.COMPILER]]
    opened("auto")
    assert len(cold) == 1
    kept.mark().touch()
    with loader._loader.step:  # nothing is loaded yet
        assert opened("auto") == ("opengl", COMPILING)
    assert loader._loader.done.wait(LONG)
    name, reason = opened("auto")
    assert name == "cpu"
    assert reason.startswith("OpenGL here is software only")


def test_who_asks_for_loops_compiles_them_himself(cold):
    assert opened("cpu") == ("cpu", "asked for")
    assert loops.in_use()
    assert cold == []


def test_one_process_compiles_at_a_time(cold, tmp_path):
    assert compiler.begin()
    compiler.end(compiled=False)
    assert not kept.mark().exists()
    parent = os.getppid()
    compiler._compiler_file().write_text(f"{parent} {compiler._begun(parent)}")
    assert not compiler.begin()
    compiler.compile_meanwhile()
    assert cold == []
    # Another process has its number by now.
    compiler._compiler_file().write_text(f"{parent} 12345")
    assert compiler.begin()
    compiler._compiler_file().write_text("no number")
    assert compiler.begin()
    compiler.end(compiled=True)
    assert kept.mark().exists()
    assert not compiler._compiler_file().exists()
    assert loops.ready()


def test_other_loops_have_another_mark(cold, monkeypatch):
    first = kept.mark()
    kept._key.cache_clear()
    monkeypatch.setattr(kept, "sources", lambda: b"edited")
    assert kept.mark() != first
    kept._key.cache_clear()


def test_where_nothing_can_be_kept_shaders_go_on(cold, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setattr(kept, "folder", lambda: tmp_path / "file" / "folder")
    assert not compiler.begin()
    assert not loops.ready()
