"""Solves in child processes, and files of killed processes."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from napari_hmrf import SeilerPrior, Solution, solve
from napari_hmrf.data import phantom
from tests.support.opengl import require_opengl
from tests.support.timeouts import LONG

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="os.fork is not available")

CHILDREN = """
import multiprocessing
import sys

import numpy as np

from napari_hmrf import ElasticPrior, SeilerPrior, solve
from napari_hmrf.data import phantom


def displacement(prior):
    return solve(phantom("expansion", size=40).problem, prior, backend="cpu").displacement


if __name__ == "__main__":
    priors = [ElasticPrior(), SeilerPrior()]
    expected = [displacement(prior) for prior in priors]
    for method in sys.argv[1:]:
        # A child that is not a fork imports all modules again, which takes a second.
        with multiprocessing.get_context(method).Pool(2 if method == "fork" else 1) as pool:
            found = pool.map_async(displacement, priors, 1).get(240)
        for one, other in zip(found, expected, strict=True):
            assert np.array_equal(one, other), method
        assert np.array_equal(displacement(priors[0]), expected[0]), "the parent has changed"
"""


def run_script(tmp_path, script, *arguments):
    path = tmp_path / "script.py"
    path.write_text(script, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", path, *arguments],
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.campaign
def test_child_processes_reproduce_the_solution_of_the_parent(tmp_path):
    run_script(tmp_path, CHILDREN, *multiprocessing.get_all_start_methods())


AFTER_OPENGL = """
import os
import threading

import numpy as np

from napari_hmrf import BackendError, SeilerPrior, solve
from napari_hmrf.data import phantom
from napari_hmrf.compute.thread import compute_thread

problem = phantom("expansion", size=40).problem
expected = solve(problem, SeilerPrior(), backend="opengl").displacement
child = os.fork()
if not child:
    try:
        solve(problem, SeilerPrior(), backend="opengl")
    except BackendError as error:
        assert "spawn" in str(error)
        found = solve(problem, SeilerPrior(), backend="auto")
        assert found.provenance.backend == "cpu"
        assert "forked" in found.provenance.reason
        os._exit(0)
    os._exit(1)
assert os.waitpid(child, 0)[1] == 0
assert np.array_equal(solve(problem, SeilerPrior(), backend="opengl").displacement, expected)
"""


DURING_A_JOB = """
problem = phantom("expansion", size=24).problem
begun, go_on = threading.Event(), threading.Event()
job = compute_thread.submit(lambda: (begun.set(), go_on.wait()))
begun.wait()
child = os.fork()
if not child:
    try:
        solve(problem, SeilerPrior(), backend="cpu")
    except BackendError as error:
        assert "spawn" in str(error)
        os._exit(0)
    os._exit(1)
assert os.waitpid(child, 0)[1] == 0

def fork_and_solve():
    child = os.fork()
    if not child:
        solve(problem, SeilerPrior(), backend="cpu")
        os._exit(0)
    return os.waitpid(child, 0)[1]

go_on.set()
job.result()
solve(problem, SeilerPrior(), backend="cpu")
assert compute_thread.submit(fork_and_solve).result() == 0, "the fork in a job failed"
"""


@needs_fork
def test_a_fork_solves_without_opengl_and_a_fork_during_a_job_raises_an_error(tmp_path):
    require_opengl()
    run_script(tmp_path, AFTER_OPENGL + DURING_A_JOB)


SAVING = """
import sys

import numpy as np

from napari_hmrf import Solution

path = sys.argv[1]
one = Solution.read(path)
other = Solution.read(sys.argv[2])
print("begun", flush=True)
while True:
    one.write(path)
    other.write(path)
"""


def is_partly_saved(folder, size):
    """Return whether a temporary file of at least `size` bytes exists."""
    for path in folder.glob("*.tmp"):
        with suppress(FileNotFoundError):
            if path.stat().st_size >= size:
                return True
    return False


def wait_until(condition):
    last = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < last


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="SIGKILL requires POSIX")
@pytest.mark.parametrize("share", [0.5, pytest.param(0.0, marks=pytest.mark.campaign)])
def test_a_process_killed_while_saving_leaves_a_complete_file(tmp_path, share):
    sizes = (48, 40)
    paths = [tmp_path / f"{size}.npz" for size in sizes]
    for path, size in zip(paths, sizes, strict=True):
        solve(phantom("expansion", size=size).problem, SeilerPrior(), backend="cpu").write(path)
    path = paths[0]
    written = round(share * path.stat().st_size)
    with subprocess.Popen(
        [sys.executable, "-c", SAVING, *paths], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline()
        wait_until(lambda: is_partly_saved(tmp_path, written))
        process.kill()
    assert Solution.read(path).displacement.shape[0] in sizes
