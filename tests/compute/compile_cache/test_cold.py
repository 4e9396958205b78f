"""Empty compile cache: shaders and NumPy run until the loops are compiled."""

import errno
import importlib.util
import json
import os
import pkgutil
import queue
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import napari_hmrf.field
import napari_hmrf.solver
from napari_hmrf import (
    ICM,
    BackendError,
    Cancelled,
    ElasticPrior,
    Multigrid,
    NeoHookeanPrior,
    Problem,
    SeilerPrior,
    compiling,
    solve,
    warp,
)
from napari_hmrf.compute.compile_cache import compiler, disk_cache, loader, loops, sets, stage
from napari_hmrf.compute.compile_cache.stage import PREPARING, Stage
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.data import phantom
from napari_hmrf.solver.backends.choice import COMPILING, open_backend
from napari_hmrf.solver.backends.job import SolveJob
from tests.support.opengl import require_opengl
from tests.support.timeouts import LONG

solving = sys.modules["napari_hmrf.solver.solve"]

MODELS = {
    "schedule": (SeilerPrior(), ICM()),
    "converged": (SeilerPrior(), Multigrid()),
    "blanket": (SeilerPrior(conditional="blanket"), Multigrid()),
    "elastic": (ElasticPrior(0.45), Multigrid()),
    "slipping": (ElasticPrior(0.45, penalty=100.0), Multigrid()),
}
PROBLEM = phantom("expansion", 40).problem
IMAGE = SolveJob.of(PROBLEM, *MODELS["elastic"])


@pytest.mark.parametrize("model", MODELS)
def test_fields_and_images_match_the_compiled_loops(model, cold, monkeypatch):
    require_opengl()
    prior, optimizer = MODELS[model]
    early = solve(PROBLEM, prior, optimizer=optimizer, backend="opengl")
    image = np.random.default_rng(0).random(PROBLEM.shape)
    seen = warp(image, early.displacement, spacing=PROBLEM.spacing, tissue=PROBLEM.tissue)
    assert not loops.in_use()
    monkeypatch.setenv("NAPARI_HMRF_COMPILE", "here")
    late = solve(PROBLEM, prior, optimizer=optimizer, backend="cpu")
    if early.convergence is not None:
        sure = early.convergence.error + late.convergence.error
        off = np.abs(early.displacement - late.displacement).max() / PROBLEM.unit
        assert off < sure + 1e-5
    again = warp(image, early.displacement, spacing=PROBLEM.spacing, tissue=PROBLEM.tissue)
    np.testing.assert_allclose(seen, again, atol=1e-6)


def test_a_bone_moves_rigidly_before_the_loops_are_compiled(cold, monkeypatch):
    require_opengl()
    m = PROBLEM.stiffness.copy()
    m[18:23, 12:17] = np.inf
    bony = Problem(
        observed=PROBLEM.observed,
        confidence=PROBLEM.confidence,
        stiffness=m,
        spacing=PROBLEM.spacing,
    )
    early = solve(bony, ElasticPrior(0.3), backend="opengl")
    assert not loops.in_use()
    monkeypatch.setenv("NAPARI_HMRF_COMPILE", "here")
    late = solve(bony, ElasticPrior(0.3), backend="cpu")
    sure = early.convergence.error + late.convergence.error
    assert np.abs(early.displacement - late.displacement).max() / bony.unit < sure + 1e-5


def test_a_solve_with_shaders_does_not_import_numba():
    require_opengl()
    code = """
import sys
import numpy as np
from napari_hmrf import ElasticPrior, solve
from napari_hmrf.data import phantom
problem = phantom("bar", 30).problem
found = solve(problem, ElasticPrior(0.3), backend="opengl")
found.warp(np.ones(problem.shape))
print("numba" in sys.modules)
"""
    empty = {**os.environ, "NUMBA_CACHE_DIR": "/nonexistent/cache"}
    del empty["NAPARI_HMRF_COMPILE"]
    done = subprocess.run(
        [sys.executable, "-c", code], env=empty, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False", done.stderr


def opened_backend(name):
    """Return the name of the opened backend and the reason for it."""

    def job():
        backend, reason = open_backend(IMAGE, name, lambda: None)
        backend.close()
        return backend.name.partition(":")[0], reason

    return compute_thread.submit(job).result()


def test_auto_uses_a_software_rasteriser_until_the_loops_are_compiled(cold):
    require_opengl()
    name, reason = opened_backend("auto")
    if reason == "a GPU is available":
        pytest.skip("this machine has a GPU")
    assert (name, reason) == ("opengl", COMPILING)
    assert cold == [[sys.executable, "-m", compiler.COMPILER, compiler.IDLE]]
    opened_backend("auto")
    assert len(cold) == 1
    disk_cache.mark(IMAGE.loops).touch()
    with loader._loader.step:  # the loops are not loaded yet
        assert opened_backend("auto") == ("opengl", COMPILING)
    assert loader.loaded(IMAGE.loops, LONG)
    name, reason = opened_backend("auto")
    assert name == "cpu"
    assert reason.startswith("OpenGL here is software only")


class BackgroundSolve:
    """Background solve that records its progress reports."""

    def __init__(self, prior, optimizer, backend="cpu"):
        self.reports = queue.SimpleQueue()
        self.cancel = threading.Event()
        self.answer = ThreadPoolExecutor(1).submit(
            solve,
            PROBLEM,
            prior,
            optimizer=optimizer,
            backend=backend,
            progress=self.reports.put,
            cancel=self.cancel,
        )

    def wait_for_report(self, beginning):
        while not (report := self.reports.get(timeout=LONG)).message.startswith(beginning):
            pass
        return report


@pytest.mark.parametrize("shape", [(40, 40), (12, 12, 12)])
@pytest.mark.parametrize("has_data", [False, True])
def test_a_job_compiles_the_loops_of_large_motion_with_and_without_data(shape, has_data):
    spacing, prior = (1.0,) * len(shape), NeoHookeanPrior()
    job = SolveJob(shape, spacing, prior, Multigrid(), has_data=has_data)
    assert job.loops in [each.name for each in compiling.jobs()]
    assert job.loops.endswith("-data") == has_data


@pytest.mark.parametrize("model", MODELS)
def test_a_cpu_solve_waits_for_its_loops_and_reports_progress(model, cold):
    prior, optimizer = MODELS[model]
    pending = BackgroundSolve(prior, optimizer)
    pending.wait_for_report(PREPARING)
    assert cold == [[sys.executable, "-m", compiler.COMPILER]]
    (job,) = compiler.requested_jobs()
    assert job == SolveJob.of(PROBLEM, prior.resolved(PROBLEM), optimizer).loops
    cost = sets.COSTS[job]
    # A fifth remains, on a computer of which the first set takes 100 s.
    compiler.publish_stage(Stage(job, 0.8 * cost.loops, 100 / cost.seconds))
    report = pending.wait_for_report(f"{PREPARING}: ")
    assert report.message == f"{PREPARING}: about 20 s left"
    assert report.fraction == pytest.approx(0.8)
    disk_cache.mark(job).touch()
    assert pending.answer.result(LONG).provenance.backend == "cpu"


def test_a_solve_can_be_cancelled_during_compilation_and_the_next_one_reports_it(cold):
    first = BackgroundSolve(*MODELS["elastic"])
    first.wait_for_report(PREPARING)
    first.cancel.set()
    with pytest.raises(Cancelled):
        first.answer.result(LONG)
    second = BackgroundSolve(*MODELS["schedule"])
    second.wait_for_report(PREPARING)
    assert compiler.requested_jobs() == ["schedule", "elastic"]
    disk_cache.mark("schedule").touch()
    second.answer.result(LONG)
    assert len(cold) == 1


def test_a_solve_can_be_cancelled_while_this_process_compiles(monkeypatch):
    begun, go_on = threading.Event(), threading.Event()
    monkeypatch.setattr(solving, "prepare", lambda *_: (begun.set(), go_on.wait(LONG)))
    pending = BackgroundSolve(*MODELS["elastic"])
    assert begun.wait(LONG)
    pending.cancel.set()
    with pytest.raises(Cancelled):
        pending.answer.result(LONG)
    waiting = compute_thread.submit(lambda: None)
    assert compute_thread.delays(waiting).startswith("waiting for cancelled work")
    go_on.set()
    waiting.result(LONG)
    assert compute_thread.delays(waiting) == ""


def test_the_compiler_interrupts_a_job_for_a_newer_request(cold, monkeypatch):
    done = []

    def job(name):
        def run():
            done.append(f"{name} begun")
            if name == "schedule" and done.count("schedule begun") == 1:
                compiler._request_file().write_text("converged\nschedule")
            current[0](Stage("elastic", 1, 1.0))
            done.append(name)

        return compiling.Job(name, run)

    current = [None]

    def run(job, tell):
        current[0] = tell
        job.run()

    monkeypatch.setattr(compiling, "run", run)
    monkeypatch.setattr(compiler, "lower_priority", lambda: done.append("lower priority"))
    compiler._request_file().write_text("schedule")
    todo = [job(name) for name in ("elastic", "schedule", "converged")]
    while todo:
        compiling._run_next(todo)
    assert done == [
        "schedule begun",
        "converged begun",
        "converged",
        "schedule begun",
        "schedule",
        "lower priority",
        "elastic begun",
        "elastic",
    ]
    assert disk_cache.mark("converged").exists()


def test_the_required_loops_are_compiled_first_without_opengl(cold, monkeypatch):
    class Missing:
        def __init__(self, *_):
            raise BackendError("no OpenGL here.")

    monkeypatch.setattr("napari_hmrf.solver.backends.opengl.OpenGLBackend", Missing)
    pending = BackgroundSolve(*MODELS["converged"], "auto")
    pending.wait_for_report(PREPARING)
    assert compiler.requested_jobs() == ["converged"]
    disk_cache.mark("converged").touch()
    assert "no OpenGL here" in pending.answer.result(LONG).provenance.reason


def test_this_process_compiles_if_no_other_process_can(cold, monkeypatch):
    monkeypatch.setattr(
        compiler, "_start_process", lambda command: subprocess.Popen([sys.executable, "-c", ""])
    )
    assert BackgroundSolve(*MODELS["elastic"]).answer.result(LONG).provenance.backend == "cpu"
    assert loops.compile_here()


def test_a_request_missed_by_an_ending_compiler_is_repeated(cold, monkeypatch):
    class Ending:
        """Compiler that ends after its first poll."""

        def __init__(self):
            self.states = [None, 0]

        def poll(self):
            return self.states.pop(0) if len(self.states) > 1 else self.states[0]

        def terminate(self):
            """Do nothing: there is no process."""

    def started(command):
        assert compiler.requested_jobs() == ["volume"]
        disk_cache.mark("volume").touch()
        return Ending()

    monkeypatch.setattr(compiler._State, "compiler", Ending())
    monkeypatch.setattr(compiler, "_start_process", started)
    compiler.provide("volume", lambda stage: None)
    assert disk_cache.compiled("volume")
    assert not loops.compile_here()


def test_one_process_compiles_at_a_time(cold, tmp_path):
    assert compiler.begin()
    compiler.end(compiled=False)
    assert not disk_cache.mark().exists()
    parent = os.getppid()
    compiler._status_file().write_text(json.dumps([parent, compiler._start_time(parent)]))
    assert not compiler.begin()
    compiler.compile_meanwhile()
    assert cold == []
    # Another process has the same process id now.
    compiler._status_file().write_text(json.dumps([parent, "12345"]))
    assert compiler.begin()
    compiler._status_file().write_text("no list")
    assert compiler.begin()
    compiler.end(compiled=True)
    assert disk_cache.mark().exists()
    assert not compiler._status_file().exists()
    assert loops.ready("elastic")


@pytest.fixture
def cleared_caches():
    """Clear the cached properties of the loop files before and after a test."""
    caches = disk_cache._key, disk_cache.sources, disk_cache.folder
    for each in caches:
        each.cache_clear()
    yield
    for each in caches:
        each.cache_clear()


def modules_with_compiled_functions():
    """Return the names of the modules of the solver and of fields that define such functions."""
    names = {
        found.name
        for package in (napari_hmrf.solver, napari_hmrf.field)
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    }
    functions = (
        getattr(value, "compiled", value)
        for name in sorted(names)
        for value in vars(importlib.import_module(name)).values()
    )
    return names & {each.__module__ for each in functions if isinstance(each, Dispatcher)}


def test_an_edit_of_any_module_with_loops_changes_the_mark(cleared_caches, monkeypatch):
    before, read = disk_cache.mark().name, Path.read_bytes
    modules = modules_with_compiled_functions()
    assert modules <= set(disk_cache.modules())
    for module in modules:
        edited = Path(importlib.util.find_spec(module).origin)
        with monkeypatch.context() as changed:
            changed.setattr(
                Path, "read_bytes", lambda path, edited=edited: read(path) + b"#" * (path == edited)
            )
            disk_cache._key.cache_clear()
            disk_cache.sources.cache_clear()
            assert disk_cache.mark().name != before, module


def test_optimised_python_uses_separate_marks():
    ask = "from napari_hmrf.compute.compile_cache import disk_cache; print(disk_cache.mark())"
    done = subprocess.run(
        [sys.executable, "-OO", "-c", ask], capture_output=True, check=True, text=True
    )
    marks = str(disk_cache.mark()), done.stdout.strip()
    assert marks[0] != marks[1]
    assert all(each.endswith(".compiled") for each in marks)


STORE_LOOP = """
import sys, tempfile
from pathlib import Path
from napari_hmrf.compute.compile_cache import disk_cache, loader
tempfile.tempdir = sys.argv[1]
there = disk_cache._writable
disk_cache._writable = lambda folder: str(folder).startswith(sys.argv[1]) and there(folder)
loader.before_numba()
from numba.core import caching
caching.CacheImpl._locator_classes[1:] = []  # no caches beside the source or in the home folder
sys.path.insert(0, sys.argv[1])
import one
print(one.more(1))
print(any(disk_cache.folder().rglob("*.nbi")) and disk_cache.folder().stat().st_mode & 0o77 == 0)
"""


def test_loops_are_stored_in_a_temporary_folder_if_no_other_is_writable(tmp_path):
    source = "import numba\n@numba.njit(cache=True)\ndef more(x):\n    return x + 1\n"
    (tmp_path / "one.py").write_text(source)
    nowhere = str(tmp_path / "one.py" / "folder")
    done = subprocess.run(
        [sys.executable, "-c", STORE_LOOP, tmp_path],
        env={**os.environ, "NUMBA_CACHE_DIR": nowhere},
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["2", "True"], done.stderr


@pytest.mark.parametrize(
    ("place", "redirected"), [("environment", []), ("package", [""]), ("caches", ["here"])]
)
def test_loops_are_not_stored_on_a_full_disk(place, redirected, tmp_path, monkeypatch):
    def usage(folder):
        return SimpleNamespace(free=2**40 if folder.is_relative_to(tmp_path / place) else 0)

    told = []
    monkeypatch.setattr(disk_cache.shutil, "disk_usage", usage)
    monkeypatch.setattr(disk_cache, "_LOOPS", tmp_path / "package")
    monkeypatch.setattr(disk_cache, "_redirect_numba", told.append)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "environment"))
    found = disk_cache.folder.__wrapped__()
    assert found.is_relative_to(tmp_path / place)
    assert told == [str(found) if each == "here" else each for each in redirected]


def test_a_disk_that_fills_up_disables_the_cache_but_not_the_loops(monkeypatch, caplog):
    loader.before_numba()
    import numba
    from numba.core.caching import IndexDataCacheFile

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def more(number):
        return number + 1

    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    monkeypatch.setattr(loader._Unwritable, "is_known", False)
    loop = numba.njit(cache=True)(more)
    assert (loop(1), loop(1.5)) == (2, 2.5)
    (said,) = caplog.messages
    folder = said.partition(" cannot be written to (No space left on device)")[0]
    assert Path(loop.stats.cache_path).is_relative_to(folder)
    assert "set NUMBA_CACHE_DIR to another folder" in said
    assert not compiling._is_cached()


def test_the_loops_are_never_ready_if_no_folder_is_writable(cold, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setattr(disk_cache, "folder", lambda: tmp_path / "file" / "folder")
    assert not compiler.begin()
    assert not loops.ready("elastic")


def test_loops_for_volumes_are_ready_only_once_compiled(cold):
    disk_cache.mark("pictures").touch()
    assert loops.ready_for_pictures()
    assert not loops.ready_for_volumes()
    disk_cache.mark("volume").touch()
    assert loops.ready_for_volumes()


def test_a_stopped_preparation_continues_with_what_is_missing(cold, monkeypatch):
    done = []

    def job(name):
        return compiling.Job(name, lambda: done.append((name, compiler.progress("").fraction)))

    names = ["elastic", "volume", "data"]
    monkeypatch.setattr(sets, "COSTS", {name: sets.Cost(4, 10.0) for name in names})
    monkeypatch.setattr(stage, "COSTS", sets.COSTS)
    monkeypatch.setattr(compiling, "jobs", lambda: [job(name) for name in names])
    monkeypatch.setattr(compiling, "_is_cached", lambda: True)
    monkeypatch.setattr(compiler, "lower_priority", lambda: None)
    monkeypatch.setenv("NAPARI_HMRF_COMPILE", "there")
    disk_cache.mark("elastic").touch()
    compiler.request("data")
    assert compiling.main() == 0
    assert done == [("data", pytest.approx(1 / 3)), ("volume", pytest.approx(2 / 3))]
    assert disk_cache.compiled("")
    assert compiler.progress("").fraction == 1


def test_requests_of_an_earlier_process_are_forgotten(cold):
    compiler._request_file().write_text("volume", encoding="utf-8")
    compiler.request("data")
    assert compiler.requested_jobs() == ["data"]
    compiler.request("large-motion")
    assert compiler.requested_jobs() == ["large-motion", "data"]


def test_the_time_left_is_that_of_the_missing_sets_at_the_pace_of_the_computer():
    jobs = ["elastic", "large-motion"]
    first, second = (sets.COSTS[job] for job in jobs)
    begun = Stage("elastic", first.loops // 5, 2.0)
    part = begun.loops / first.loops
    left = 2 * ((1 - part) * first.seconds + second.seconds)
    assert begun.progress(jobs, jobs).seconds == pytest.approx(left)
    assert begun.progress(jobs, jobs[:1]).seconds == pytest.approx(left - 2 * second.seconds)
    # Loops that were expected in other sets do not complete a set.
    assert 0 < Stage("elastic", 3 * first.loops, 2.0).progress(jobs, jobs[:1]).seconds < left


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0, PREPARING),
        (2, f"{PREPARING}: about 5 s left"),
        (61, f"{PREPARING}: about 65 s left"),
        (91, f"{PREPARING}: about 2 minutes left"),
    ],
)
def test_the_time_left_is_described_in_words(seconds, words):
    assert stage.Progress(0.5, seconds).words == words
