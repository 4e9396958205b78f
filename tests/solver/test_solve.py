"""solve: progress, cancellation, provenance, errors and the compute thread."""

import importlib
import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from napari_hmrf import ICM, BackendError, Cancelled, ElasticPrior, Multigrid, SeilerPrior, solve
from napari_hmrf.compute.thread import ComputeThread, compute_thread
from napari_hmrf.solver.backends.base import BATCH_SECONDS
from tests.support.cancel_flags import AfterLooks
from tests.support.timeouts import LONG
from validation.bodies import frame_problem


def test_progress_runs_from_0_to_1_on_the_calling_thread():
    seen, threads = [], set()

    def progress(monitor):
        seen.append(monitor)
        threads.add(threading.current_thread())

    solve(frame_problem((60, 50)), SeilerPrior(), backend="cpu", progress=progress)
    fractions = [monitor.fraction for monitor in seen]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0
    assert fractions[-1] == pytest.approx(1)
    assert threads == {threading.current_thread()}
    assert "level 0 (60 x 50), sweep 70" in seen[-1].message


def test_a_cancelled_solve_has_no_result_and_does_not_affect_the_next():
    problem = frame_problem((40, 40))
    expected = solve(problem, SeilerPrior(), backend="cpu").displacement
    for looks in (0, 1, 4, 12):
        with pytest.raises(Cancelled):
            solve(problem, SeilerPrior(), backend="cpu", cancel=AfterLooks(looks))
    np.testing.assert_array_equal(
        solve(problem, SeilerPrior(), backend="cpu").displacement, expected
    )


def test_cancellation_is_checked_after_each_short_batch(monkeypatch):
    from napari_hmrf.solver.backends.cpu import kernels

    problem = frame_problem((400, 400))
    solve(
        problem, SeilerPrior(), optimizer=ICM(iterations=1), backend="cpu"
    )  # compiles the kernels before batches are counted
    cancel, batches, sweep = threading.Event(), [], kernels.sweeps.in_turns

    def counted(*arguments):
        share, totals = arguments[-2:]
        batches.append((share.shape, share.size * len(totals)))
        if share.shape == problem.shape:
            cancel.set()
        sweep(*arguments)

    monkeypatch.setattr(kernels.sweeps, "in_turns", counted)
    with pytest.raises(Cancelled):
        solve(problem, SeilerPrior(), optimizer=ICM(iterations=100), backend="cpu", cancel=cancel)
    shapes, updates = zip(*batches, strict=True)
    assert shapes.count(problem.shape) == 1, "no batch should start after cancellation"
    assert max(updates) * 10e-9 <= BATCH_SECONDS, "a batch should be short enough at 10 ns per site"


def test_an_error_in_the_progress_callback_stops_the_solve():
    solve(frame_problem((10, 10)), SeilerPrior(), backend="cpu")  # compiles the kernels

    def progress(monitor):
        if monitor.fraction > 0:
            raise RuntimeError("the caller's own")

    with pytest.raises(RuntimeError, match="the caller's own"):
        solve(
            frame_problem((50, 50)),
            SeilerPrior(),
            optimizer=ICM(iterations=10**6),
            backend="cpu",
            progress=progress,
        )
    job = compute_thread.submit(
        lambda: solve(frame_problem((10, 10)), SeilerPrior(), backend="cpu")
    )
    assert job.result(LONG)


def test_concurrent_solves_from_many_threads_are_correct():
    problems = [frame_problem((40, 30 + k), seed=k) for k in range(6)]
    expected = [solve(problem, SeilerPrior(), backend="cpu").displacement for problem in problems]
    with ThreadPoolExecutor(6) as pool:
        found = list(
            pool.map(lambda problem: solve(problem, SeilerPrior(), backend="cpu"), problems)
        )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.displacement, other)


def test_a_solution_records_its_provenance():
    solution = solve(
        frame_problem((20, 20)), SeilerPrior(), optimizer=ICM(iterations=7), backend="cpu"
    )
    run = solution.provenance
    assert run.backend == "cpu"
    assert "threads" in run.renderer
    assert run.seconds > 0
    assert run.parameters["optimizer"]["iterations"] == 7
    assert run.parameters["prior"]["conditional"] == "centred"
    assert set(run.inputs) == {"observed", "confidence", "stiffness"}
    assert all(len(digest) == 64 for digest in run.inputs.values())
    assert "numpy" in run.versions
    assert json.loads(json.dumps(run.parameters)) == run.parameters


def test_an_environment_without_the_compiler_of_the_loops_is_named(monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    with pytest.raises(BackendError, match="NUMBA_DISABLE_JIT"):
        solve(frame_problem((5, 5)), ElasticPrior(), backend="cpu")


def test_an_unknown_backend_is_rejected_with_a_list_of_backends():
    with pytest.raises(BackendError, match="auto, opengl"):
        solve(frame_problem((5, 5)), SeilerPrior(), backend="cuda")


@pytest.mark.parametrize(
    ("name", "wrong", "right"),
    [
        ("problem", None, "Problem"),
        ("problem", np.zeros((4, 4)), "Problem"),
        ("prior", "el", "ElasticPrior"),
        ("prior", ElasticPrior, "ElasticPrior"),
        ("optimizer", "icm", "Multigrid"),
        ("optimizer", Multigrid, "Multigrid"),
        ("progress", 3, "Monitor"),
        ("cancel", 3, "threading.Event"),
        ("initial", "x", "Solution"),
        ("initial", [3], "Solution"),
        ("initial", np.zeros((5, 5, 2)), "Solution"),
    ],
)
def test_an_argument_of_the_wrong_type_is_named_before_any_work(name, wrong, right, monkeypatch):
    monkeypatch.setattr(compute_thread, "submit", None)
    arguments = {"problem": frame_problem((5, 5)), "backend": "cpu", name: wrong}
    with pytest.raises(TypeError, match=rf"{name} is (.|\n)*, of type \w+\. Pass .*{right}"):
        solve(**arguments)


def test_numpy_scalars_in_parameters_can_be_saved(tmp_path):
    prior = ElasticPrior(np.float32(0.3), penalty=np.float32(2))
    solve(frame_problem((8, 8)), prior, backend="cpu").write(tmp_path / "numbers.npz")


def test_a_job_on_the_compute_thread_can_call_solve():
    job = compute_thread.submit(
        lambda: solve(frame_problem((12, 12)), SeilerPrior(), backend="cpu")
    )
    assert job.result(timeout=60).displacement.shape == (12, 12, 2)


def test_the_compute_thread_can_be_stopped_and_restarted():
    solve(frame_problem((6, 6)), SeilerPrior(), backend="cpu")
    assert compute_thread.stop()
    names = [thread.name for thread in threading.enumerate()]
    assert "napari-hmrf compute" not in names
    solve(frame_problem((6, 6)), SeilerPrior(), backend="cpu")


def test_there_is_never_more_than_one_compute_thread():
    release, began = threading.Event(), threading.Event()
    threads = []

    def long_job():
        began.set()
        release.wait(10)
        threads.append(threading.current_thread())

    thread = ComputeThread()
    first = thread.submit(long_job)
    began.wait(10)
    assert not thread.stop(timeout=0.05)
    second = thread.submit(lambda: threads.append(threading.current_thread()))
    release.set()
    first.result(10), second.result(10)
    assert threads[0] is threads[1]
    assert thread.stop()


def test_a_failing_release_does_not_prevent_the_others():
    released = []
    thread = ComputeThread()
    thread.at_end(lambda: released.append(1))
    thread.at_end(lambda: 1 / 0)
    thread.submit(lambda: None).result(10)
    assert thread.stop()
    assert released == [1]


PREPARATION = """
import sys, pkgutil
import numpy as np
import napari_hmrf.solver.solve
from napari_hmrf import *
from napari_hmrf.solver.backends import cpu
from napari_hmrf.solver.backends.job import SolveJob
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.preparation import prepare

def made():
    names = [f"{cpu.__name__}.{each.name}" for each in pkgutil.iter_modules(cpu.__path__)]
    modules = [vars(sys.modules[name]) for name in names if name in sys.modules]
    found = [getattr(each, "compiled", each) for module in modules for each in module.values()]
    return {each.__name__: each.signatures for each in found if hasattr(each, "signatures")}

for spacing in ((1.0, 1.0), (1.0, 2.0)):
    y, c, m = np.zeros((60, 57, 2)), np.zeros((60, 57, 2)), np.ones((60, 57))
    c[0] = c[-1] = 1
    y[-1] = 3
    problem = Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)
    for prior in (SeilerPrior(), ElasticPrior(), ElasticPrior(penalty=0.02), ElasticPrior(0.4 * m)):
        optimizer = ICM(iterations=2) if isinstance(prior, SeilerPrior) else Multigrid()
        compute_thread.submit(
            lambda: prepare(
                cpu.CpuBackend(lambda: None),
                SolveJob.of(problem, prior.resolved(problem), optimizer),
                optimizer,
                lambda _: None,
            )
        ).result()
        before = made()
        found = solve(problem, prior, optimizer=optimizer, backend="cpu")
        if isinstance(optimizer, Multigrid):
            for many in (1, 2, 3):
                solve(problem, prior, optimizer=optimizer, backend="cpu", initial=[found] * many)
        after = made()
        new = {name: after[name] for name in after if after[name] != before.get(name)}
        assert not new, (prior, spacing, new)
"""


def test_kernels_are_compiled_before_the_timed_solve():
    # Other tests may have compiled kernels in this process, so run a new process.
    subprocess.run([sys.executable, "-c", PREPARATION], check=True, timeout=300)


def test_the_device_is_logged_once_at_info_level(caplog, monkeypatch):
    caplog.set_level("INFO", "napari_hmrf")
    monkeypatch.setattr(sys.modules["napari_hmrf.solver.solve"], "_announced", set())
    monkeypatch.setattr("napari_hmrf.solver.backends.opengl.is_software_renderer", lambda _: True)
    for _ in range(2):
        solve(frame_problem((6, 6)), SeilerPrior(), backend="auto")
    told = [record for record in caplog.records if "solving on" in record.message]
    assert len(told) == 1
    assert "compiled loops" in told[0].message
    assert told[0].levelname == "INFO"


def test_the_repr_of_a_solution_is_one_line_without_arrays():
    solution = solve(frame_problem((20, 30)), ElasticPrior(), optimizer=Multigrid(), backend="cpu")
    said = repr(solution)
    assert said.startswith("Solution(20 x 30 sites of 1 x 1 pixels, elastic, moved up to ")
    assert " iterations in " in said
    assert " on cpu, within " in said
    assert len(said) < 150
    assert "array" not in said


@pytest.mark.parametrize(("progress", "count"), [(None, 1), (lambda monitor: None, 0)])
def test_the_wait_for_the_compiler_is_logged_once_without_progress(
    progress, count, caplog, monkeypatch
):
    module = importlib.import_module("napari_hmrf.solver.solve")
    monkeypatch.setattr(module, "are_compiled", lambda job: False)
    monkeypatch.setattr(module, "provide_loops", lambda *_: None)
    module._announce_compilation.cache_clear()
    for _ in range(2):
        solve(frame_problem((12, 12)), backend="cpu", progress=progress)
    messages = [
        text for text in caplog.messages if "the solver is compiled for this computer" in text
    ]
    assert len(messages) == count
